"""Mean brightness of blocks of neighboring views at a working resolution: the input of detection."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

WORKING_SIZE = 480
"""Photos are reduced by the integer that brings their longer side nearest to this, pixels."""
MAX_BLOCKS = 16
"""Blocks of a test; more are joined in pairs. Neighboring views of a video are alike, so small blocks would be, too."""
MAX_FINE_BLOCKS = 64
"""Blocks in memory. When so many are full, they are joined in pairs, and a block holds twice as many views from then
on."""


class BrightnessBlocks:
    """Mean brightness of blocks of neighboring views, reduced by box filtering.

    Neighboring views of a video are alike; views of different blocks are much less so. Gradients are linear: that of a
    block's mean is the mean of its views' gradients, at any scale. Memory is one image of the working resolution per
    block (two where views have masks), for any number of views.
    """

    def __init__(self, height: int, width: int, device: torch.device | str = "cpu") -> None:
        """Expect views of this size, pixels."""
        self.reduction = max(1, round(max(height, width) / WORKING_SIZE))
        """Side, in pixels, of the square that becomes one working pixel."""
        size = height // self.reduction, width // self.reduction
        if min(size) < 1:
            # A strip narrower than the square keeps its resolution.
            self.reduction, size = 1, (height, width)
        self.views = 0
        """Number of views."""
        self.views_per_block = 1
        """Of all blocks but the last, which may hold fewer."""
        self._size, self._device = size, device
        self._sums: list[Tensor] = []
        self._counts: list[Tensor] = []  # scalars until a view has a mask

    def __len__(self) -> int:
        """Number of blocks, the last of which may be incomplete."""
        return len(self._sums)

    def add(self, values: Tensor, seen: Tensor | None) -> None:
        """Add the next view.

        Args:
            values: [H, W, 3], 0 where the view does not show the pixel.
            seen: [H, W, 1] bool, or None where the view shows all of it.
        """
        if self.views == MAX_FINE_BLOCKS * self.views_per_block:
            self._sums, self._counts = _joined(self._sums), _joined(self._counts)
            self.views_per_block *= 2
        if self.views % self.views_per_block == 0:
            self._sums.append(torch.zeros(self._size, dtype=torch.float64, device=self._device))
            self._counts.append(torch.zeros((), dtype=torch.float64, device=self._device))
        self.views += 1
        self._sums[-1] += self._reduced(values)
        whole = 3 * self.reduction**2
        shown = whole if seen is None else self._reduced(seen.to(values.dtype).expand(-1, -1, 3))
        self._counts[-1] = self._counts[-1] + shown

    def means(self, blocks: Sequence[int] | None = None) -> tuple[Tensor, Tensor]:
        """Mean brightness of at most MAX_BLOCKS blocks, and whether any of their views shows the pixel.

        A last block with less than half the views is left out: its mean would be noisier than the others.

        Args:
            blocks: the blocks to read, from 0 and ascending; neighbors of these are joined. None: all.

        Returns:
            float64 [K, h, w] in the units of the added values, and bool [K, h, w].
        """
        chosen = range(len(self)) if blocks is None else blocks
        sums, counts = [self._sums[k] for k in chosen], [self._counts[k] for k in chosen]
        views, full = [self._views_in(k) for k in chosen], self.views_per_block
        while len(sums) > MAX_BLOCKS:
            sums, counts, views, full = _joined(sums), _joined(counts), _joined(views), 2 * full
        if len(sums) > 2 and views[-1] < full / 2:
            sums, counts = sums[:-1], counts[:-1]
        shown = torch.stack([count.expand(self._size) for count in counts])
        return torch.stack(sums) / shown.clamp_min(1), shown > 0

    def _views_in(self, block: int) -> int:
        return min(self.views_per_block, self.views - block * self.views_per_block)

    def _reduced(self, values: Tensor) -> Tensor:
        """Sums over squares of pixels and channels [h, w]; incomplete squares at the right and bottom are dropped."""
        r = self.reduction
        h, w = self._size
        rows = values[: h * r, : w * r].reshape(h, r, -1).sum(dim=1, dtype=values.dtype)
        return rows.reshape(h, w, 3 * r).sum(dim=-1, dtype=values.dtype)


def _joined(values: list) -> list:
    """Sums of neighboring pairs; the last of an odd number stays alone."""
    pairs = [first + second for first, second in zip(values[::2], values[1::2], strict=False)]
    return pairs + values[len(pairs) * 2 :]
