"""Per-pixel statistics over a stream of views."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from ssa_nerfstudio.evidence.brightness import BrightnessBlocks

GRAY_LEVEL = 1 / 255
"""Step of 8 bits, by which photos are rounded (white = 1). Less than half of it is no difference."""
UNKNOWN_DEVIATION = 1.0
"""More than any pixel can have, which is 0.5."""
FULL_SCALE = {torch.uint8: 255.0, torch.uint16: 65535.0}
"""White of the integer types; 1 of all others."""
_MAX_VIEWS_IN_INT32 = 33_000
"""So many squares of uint8 add up to less than 2^31."""


class ImageStatistics:
    """Per-pixel mean and standard deviation of images of one size; memory does not depend on their number.

    Integer images are summed in int64 (uint8 in int32 while it suffices), which is exact; in float32,
    E[x^2] - E[x]^2 would cancel at the deviations of 0.05 that matter here. Floating-point images are summed in
    float64. The same pass accumulates the brightness of blocks of neighboring views for detection.
    """

    brightness: BrightnessBlocks
    """Of the views in the order of their addition."""

    def __init__(self) -> None:
        self._sum: Tensor | None = None
        self._squares: Tensor
        self._views: Tensor
        self._scale = 1.0
        self._added = 0
        self._dtype: torch.dtype

    def add(self, image: Tensor, mask: Tensor | None = None) -> None:
        """Add one view.

        Args:
            image: [H, W, 3 or more], uint8 or uint16 in full range, or float in [0, 1]; channels beyond 3 are ignored.
            mask: [H, W] or [H, W, 1]; only pixels where it is True (or not 0) count. None: all.

        Raises:
            ValueError: the size or dtype differs from that of the earlier views.
        """
        image = image[..., :3]
        if self._sum is None:
            exact = image.dtype in FULL_SCALE
            self._dtype = image.dtype
            self._scale = FULL_SCALE.get(image.dtype, 1.0)
            # int32 halves the memory traffic until its sums could overflow.
            kind = torch.int32 if image.dtype == torch.uint8 else torch.int64 if exact else torch.float64
            self._sum = torch.zeros(image.shape, dtype=kind, device=image.device)
            self._squares = torch.zeros_like(self._sum)
            self._views = torch.zeros(*image.shape[:2], 1, dtype=torch.int64, device=image.device)
            self.brightness = BrightnessBlocks(*image.shape[:2], device=image.device)
        if image.shape != self._sum.shape or image.dtype != self._dtype:
            raise ValueError(
                f"image of {tuple(image.shape[:2])} {image.dtype} among images of {self.size} {self._dtype}"
            )
        values = image.to(self._sum.dtype)
        seen = None
        if mask is None:
            self._views += 1
        else:
            seen = (mask.reshape(*image.shape[:2], 1) != 0).to(image.device)
            self._views += seen
            values = torch.where(seen, values, torch.zeros_like(values))
        if self._sum.dtype == torch.int32 and self._added == _MAX_VIEWS_IN_INT32:
            self._sum, self._squares = self._sum.long(), self._squares.long()
        self._added += 1
        self._sum += values
        self._squares.addcmul_(values, values)
        self.brightness.add(values, seen)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the images.

        Raises:
            ValueError: before the first view.
        """
        if self._sum is None:
            raise ValueError("no image has been added")
        return self._sum.shape[0], self._sum.shape[1]

    @property
    def scale(self) -> float:
        """Value of white in the images: 255, 65535 or 1."""
        return self._scale

    @property
    def views(self) -> Tensor:
        """Number of views that show each pixel: [H, W, 1] int64."""
        _ = self.size
        return self._views

    def mean(self) -> Tensor:
        """Mean color over the views that show the pixel: [H, W, 3] float64 in [0, 1]; 0.5 where none does."""
        views = self.views
        mean = self._total().to(torch.float64) / (views.clamp_min(1) * self._scale)
        return torch.where(views > 0, mean, torch.full_like(mean, 0.5))

    def deviation(self) -> Tensor:
        """Largest standard deviation (of the population) among the channels: [H, W, 1] float64 in [0, 0.5].

        With fewer than two views it is UNKNOWN_DEVIATION: nothing is known to be static there.
        """
        views = self.views
        total = self._total()
        # n sum x^2 - (sum x)^2 is exact in int64: up to 1e7 views of uint8, 4e4 of uint16.
        spread = (views * self._squares.to(total.dtype) - total * total).clamp_min(0).to(torch.float64)
        deviation = spread.sqrt() / (views.clamp_min(1) * self._scale)
        deviation = deviation.amax(dim=-1, keepdim=True)
        return torch.where(views > 1, deviation, torch.full_like(deviation, UNKNOWN_DEVIATION))

    def _total(self) -> Tensor:
        assert self._sum is not None
        return self._sum.long() if self._sum.dtype == torch.int32 else self._sum


def accumulate(views: Iterable[tuple[Tensor, Tensor | None]]) -> ImageStatistics:
    """Accumulate a stream of (image, mask or None); see `ImageStatistics.add`."""
    statistics = ImageStatistics()
    for image, mask in views:
        statistics.add(image, mask)
    return statistics
