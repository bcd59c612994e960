"""What every effect amounts to: how much light it lets through and how much it adds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


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

    @property
    def matte(self) -> np.ndarray:
        """The artifact's matte A = 1 - mean over channels of T, float32 [H, W] in [0, 1]."""
        return 1 - self.transmittance.mean(axis=2)

    def apply(self, image: np.ndarray) -> np.ndarray:
        """The image with the artifact in front of it.

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
        formed = self.transmittance * (image.astype(np.float32) / 255) + self.addition
        return np.rint(formed.clip(0, 1) * 255).astype(np.uint8)
