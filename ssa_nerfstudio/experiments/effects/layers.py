"""The image formation of every effect: how much light it lets through and how much it adds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

Box = tuple[slice, slice]
"""Rows and columns of a rectangle in the frame, with explicit starts and stops."""


@dataclass(frozen=True, eq=False)
class Layers:
    """An artifact as its exact image formation, I = clip(T C + B, 0, 1) per pixel and channel.

    Covers the paper's compositing (T = 1 - A, B = A W) as well as effects that only add light (T = 1).

    Raises:
        ValueError: an array is not float32 [H, W, 3], is out of its range, or the shapes differ.
    """

    transmittance: np.ndarray
    """T, float32 [H, W, 3] in [0, 1]: the share of the scene's light that passes."""
    addition: np.ndarray
    """B, float32 [H, W, 3], not negative: the light the artifact adds, 1 = white."""

    def __post_init__(self) -> None:
        for name, highest in (("transmittance", 1.0), ("addition", np.inf)):
            values = getattr(self, name)
            if values.dtype != np.float32 or values.ndim != 3 or values.shape[2] != 3:
                raise ValueError(f"{name} must be float32 [H, W, 3], got {values.dtype} {list(values.shape)}")
            if not np.isfinite(values).all() or (values < 0).any() or (values > highest).any():
                raise ValueError(f"{name} must be finite and in [0, {highest:g}]")
        if self.transmittance.shape != self.addition.shape:
            raise ValueError(f"transmittance {self.transmittance.shape} and addition {self.addition.shape} differ")

    @classmethod
    def composited(cls, matte: np.ndarray, color: np.ndarray) -> Layers:
        """Composite as the paper does: T = 1 - A and B = A W.

        Args:
            matte: A, [H, W] in [0, 1].
            color: W, [3] or [H, W, 3] in [0, 1].
        """
        alpha = np.repeat(matte.astype(np.float32)[..., None], 3, axis=2)
        return cls(1 - alpha, alpha * np.asarray(color, np.float32))

    @classmethod
    def dimming(cls, transmittance: np.ndarray) -> Layers:
        """Make a multiplicative artifact: T [H, W] in [0, 1] for all channels, B = 0."""
        values = np.repeat(transmittance.astype(np.float32)[..., None], 3, axis=2)
        return cls(values, np.zeros_like(values))

    @classmethod
    def clear(cls, height: int, width: int) -> Layers:
        """Make the layers of no artifact: T = 1, B = 0."""
        return cls.dimming(np.ones((height, width)))

    @property
    def matte(self) -> np.ndarray:
        """The artifact's matte A = 1 - mean over channels of T, float32 [H, W] in [0, 1]."""
        return 1 - self.transmittance.mean(axis=2)

    def behind(self, front: Layers) -> Layers:
        """These layers seen through others in front: T = T2 T1, B = T2 B1 + B2, not clipped in between."""
        return Layers(front.transmittance * self.transmittance, front.transmittance * self.addition + front.addition)

    def crop(self, box: Box) -> Layers:
        """The layers inside a rectangle."""
        return Layers(self.transmittance[box], self.addition[box])

    def pasted(self, box: Box, inside: Layers) -> Layers:
        """These layers with those inside a rectangle replaced."""
        transmittance, addition = self.transmittance.copy(), self.addition.copy()
        transmittance[box], addition[box] = inside.transmittance, inside.addition
        return Layers(transmittance, addition)

    def within(self, coverage: np.ndarray) -> Layers:
        """These layers where coverage float32 [H, W] in [0, 1] is 1, none where it is 0."""
        share = coverage[..., None]
        return Layers(1 - share * (1 - self.transmittance), share * self.addition)

    def apply(self, image: np.ndarray) -> np.ndarray:
        """Put the artifact in front of an image.

        Args:
            image: clean photo, uint8 [H, W, 3]; C = image / 255.

        Returns:
            uint8 [H, W, 3], rounded to nearest.

        Raises:
            ValueError: the image is not uint8 or not of the layers' size.
        """
        if image.dtype != np.uint8 or image.shape != self.transmittance.shape:
            expected = list(self.transmittance.shape)
            raise ValueError(f"image must be uint8 {expected}, got {image.dtype} {list(image.shape)}")
        # OpenCV saturates and rounds while it converts: three times as fast as the same in numpy.
        passed = cv2.multiply(self.transmittance, image, dtype=cv2.CV_32F)
        return cv2.addWeighted(passed, 1, self.addition, 255, 0, dtype=cv2.CV_8U)


@dataclass(frozen=True, eq=False)
class VaryingLayers:
    """An artifact that changes a little from view to view, and only inside a rectangle."""

    box: Box
    """Where T can differ from 1 or B from 0, in any view."""
    view: Callable[[np.random.Generator], Layers]
    """Draws one view's layers inside the box; the generator decides how this view differs."""
