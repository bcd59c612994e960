"""albumentations' `Spatter`, its parameters drawn once instead of for every photo."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:
    from albumentations import Spatter


def draw_spatter(
    mode: Literal["rain", "mud"],
    height: int,
    width: int,
    rng: np.random.Generator,
    *,
    color: tuple[int, int, int],
    intensity: float,
    mean: float,
    deviation: float,
    blur: float,
    threshold: float,
) -> dict[str, np.ndarray]:
    """Draws the arrays that `albumentations.Spatter` puts into a photo, once, for the first frame of a capture.

    Args:
        mode: which of Spatter's two formations.
        height, width: the frame, pixels.
        rng: seeds the transform.
        color: sRGB, 0..255.
        intensity, mean, deviation, blur, threshold: Spatter's `intensity`, `mean`, `std`, `gauss_sigma` (pixels) and
            `cutout_threshold`.

    Returns:
        Spatter's own: `drops` for rain, `mud` and `non_mud` for mud, each float [height, width, 3].
    """
    transform = _spatter()(
        mode=mode,
        color=color,
        intensity=(intensity, intensity),
        mean=(mean, mean),
        std=(deviation, deviation),
        gauss_sigma=(blur, blur),
        cutout_threshold=(threshold, threshold),
        p=1.0,
    )
    transform.set_random_seed(int(rng.integers(2**31)))
    parameters: dict[str, Any] = transform.get_params_dependent_on_data({"shape": (height, width, 3)}, {})
    return {name: values for name, values in parameters.items() if isinstance(values, np.ndarray)}


def _spatter() -> type[Spatter]:
    """albumentations' class, imported without what it does on the side."""
    # It asks its server for a newer version, which stalls without a network.
    os.environ.setdefault("NO_ALBUMENTATIONS_UPDATE", "1")
    # It imports torch where it can, for a transform that is not used here: two of the three seconds that it takes.
    hidden = "torch" not in sys.modules
    if hidden:
        sys.modules["torch"] = None  # type: ignore[assignment]
    try:
        from albumentations import Spatter
    finally:
        if hidden:
            del sys.modules["torch"]
    return Spatter
