"""Mean brightness of blocks of neighboring views at a working resolution: the input of detection."""

from __future__ import annotations

import torch
from torch import Tensor

WORKING_SIZE = 480
"""Photos are reduced by the integer that brings their longer side nearest to this, pixels."""
MAX_BLOCKS = 16
"""When so many blocks are full, they are merged in pairs, and a block holds twice as many views from then on."""


class BrightnessBlocks:
    """Mean brightness of blocks of neighboring views, reduced by box filtering.

    Neighboring views of a video are alike; views of different blocks are much less so. Gradients are linear: that of a
    block's mean is the mean of its views' gradients, at any scale. Memory is two images of the working resolution per
    block, for any number of views.
    """

    def __init__(self, height: int, width: int, device: torch.device | str = "cpu") -> None:
        """Expect views of this size, pixels."""
        self.reduction = max(1, round(max(height, width) / WORKING_SIZE))
        """Side, in pixels, of the square that becomes one working pixel."""
        size = height // self.reduction, width // self.reduction
        if min(size) < 1:
            # A strip narrower than the square keeps its resolution.
            self.reduction, size = 1, (height, width)
        self._sums = torch.zeros(MAX_BLOCKS, *size, dtype=torch.float64, device=device)
        self._counts = torch.zeros_like(self._sums)
        self._views_per_block = 1
        self._filled = 0
        self._views_in_last = 0

    def add(self, values: Tensor, seen: Tensor | None) -> None:
        """Add the next view.

        Args:
            values: [H, W, 3], 0 where the view does not show the pixel.
            seen: [H, W, 1] bool, or None where the view shows all of it.
        """
        if self._filled == 0 or self._views_in_last == self._views_per_block:
            if self._filled == MAX_BLOCKS:
                self._merge_pairs()
            self._filled += 1
            self._views_in_last = 0
        self._sums[self._filled - 1] += self._reduced(values)
        self._counts[self._filled - 1] += (
            3 * self.reduction**2 if seen is None else self._reduced(seen.to(values.dtype).expand(-1, -1, 3))
        )
        self._views_in_last += 1

    def means(self) -> tuple[Tensor, Tensor]:
        """Mean brightness of each block, and whether any of its views shows the pixel.

        A last block with less than half the views is left out: its mean would be noisier than the others.

        Returns:
            float64 [K, h, w] in the units of the added values, and bool [K, h, w].
        """
        count = self._filled
        if count > 2 and self._views_in_last < self._views_per_block / 2:
            count -= 1
        sums, counts = self._sums[:count], self._counts[:count]
        return sums / counts.clamp_min(1), counts > 0

    def _reduced(self, values: Tensor) -> Tensor:
        """Sums over squares of pixels and channels [h, w]; incomplete squares at the right and bottom are dropped."""
        r = self.reduction
        h, w = self._sums.shape[1:]
        rows = values[: h * r, : w * r].reshape(h, r, -1).sum(dim=1, dtype=values.dtype)
        return rows.reshape(h, w, 3 * r).sum(dim=-1, dtype=values.dtype)

    def _merge_pairs(self) -> None:
        for blocks in (self._sums, self._counts):
            merged = blocks.reshape(MAX_BLOCKS // 2, 2, *blocks.shape[1:]).sum(dim=1)
            blocks.zero_()
            blocks[: MAX_BLOCKS // 2] = merged
        self._filled = MAX_BLOCKS // 2
        self._views_per_block *= 2
        self._views_in_last = self._views_per_block
