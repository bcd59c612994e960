"""Brightness of runs of neighboring views at a working resolution: what detection looks at, whatever their number."""

from __future__ import annotations

import torch
from torch import Tensor

WORKING_SIZE = 480
"""Photos are reduced by a whole number until their longer side is nearest to this, pixels."""
MOST_BLOCKS = 16
"""When so many blocks are full, neighbors are joined and blocks grow to twice as many views."""


class BrightnessBlocks:
    """Mean brightness of blocks of neighboring views, reduced by box filtering.

    Neighboring views of a video look alike; views of different blocks much less. Gradients are linear, so that of a
    block's mean is the mean of its views' gradients, at any scale. Memory: two images of the working resolution a
    block, for any number of views.
    """

    def __init__(self, height: int, width: int, device: torch.device | str = "cpu") -> None:
        """Take views of this size, pixels."""
        self.reduction = max(1, round(max(height, width) / WORKING_SIZE))
        """Side of the square of pixels that becomes one."""
        size = height // self.reduction, width // self.reduction
        if min(size) < 1:
            # A strip narrower than the square: kept as it is.
            self.reduction, size = 1, (height, width)
        self._sums = torch.zeros(MOST_BLOCKS, *size, dtype=torch.float64, device=device)
        self._counts = torch.zeros_like(self._sums)
        self._views_a_block = 1
        self._filled = 0
        self._views_in_last = 0

    def add(self, values: Tensor, seen: Tensor | None) -> None:
        """Take the next view.

        Args:
            values: [H, W, 3], 0 where the view does not show the pixel.
            seen: [H, W, 1] bool, or None where the view shows all of it.
        """
        if self._filled == 0 or self._views_in_last == self._views_a_block:
            if self._filled == MOST_BLOCKS:
                self._join()
            self._filled += 1
            self._views_in_last = 0
        self._sums[self._filled - 1] += self._reduced(values)
        self._counts[self._filled - 1] += (
            3 * self.reduction**2 if seen is None else self._reduced(seen.to(values.dtype).expand(-1, -1, 3))
        )
        self._views_in_last += 1

    def means(self) -> tuple[Tensor, Tensor]:
        """Mean brightness of each block, and whether any of its views shows the pixel: two tensors [K, h, w].

        In units of what was added, float64. A last block of less than half the views is left out: its mean would be
        noisier than the others.
        """
        count = self._filled
        if count > 2 and self._views_in_last < self._views_a_block / 2:
            count -= 1
        sums, counts = self._sums[:count], self._counts[:count]
        return sums / counts.clamp_min(1), counts > 0

    def _reduced(self, values: Tensor) -> Tensor:
        """Sums over squares of pixels and channels [h, w]; what is left over at the right and bottom is ignored."""
        r = self.reduction
        h, w = self._sums.shape[1:]
        rows = values[: h * r, : w * r].reshape(h, r, -1).sum(dim=1, dtype=values.dtype)
        return rows.reshape(h, w, 3 * r).sum(dim=-1, dtype=values.dtype)

    def _join(self) -> None:
        for blocks in (self._sums, self._counts):
            joined = blocks.reshape(MOST_BLOCKS // 2, 2, *blocks.shape[1:]).sum(dim=1)
            blocks.zero_()
            blocks[: MOST_BLOCKS // 2] = joined
        self._filled = MOST_BLOCKS // 2
        self._views_a_block *= 2
        self._views_in_last = self._views_a_block
