"""Photos whose exposure varies: a gain and an offset per photo and color channel."""

from __future__ import annotations

import zlib
from collections.abc import Iterable

import numpy as np

from ssa_nerfstudio.errors import InputError

TINT = 0.25
"""Deviation of the single channels' gains around the photo's, as a share of the photos'."""
OFFSET = 0.1
"""Deviation of the photos' offsets (1: white), as a share of that of the gains' logarithms."""
DRAWN_BY_SOFTWARE = frozenset({"watermark", "ui"})
"""Effects that are put into the finished photo: exposure does not act on them."""


def draw_exposures(spread: float, photos: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw the exposures of a capture, whose mean is the identity.

    Args:
        spread: standard deviation of the logarithm of the photos' gains, in displayed values, not of light.
        photos: their number.
        seed: decides the draw, not negative.

    Returns:
        Gains [photos, 3], whose geometric mean is 1, and offsets [photos, 3], whose mean is 0.
    """
    generator = np.random.default_rng([seed, zlib.crc32(b"exposure")])
    log_gain = generator.normal(size=(photos, 1)) + TINT * generator.normal(size=(photos, 3))
    offset = np.repeat(OFFSET * generator.normal(size=(photos, 1)), 3, axis=1)
    return np.exp(spread * (log_gain - log_gain.mean(axis=0))), spread * (offset - offset.mean(axis=0))


def expose(photo: np.ndarray, gain: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """g C + o of a photo uint8 [H, W, 3], rounded and clipped as it is."""
    return np.rint(photo * gain + 255 * offset).clip(0, 255).astype(np.uint8)


def acts_on_artifact(effects: Iterable[str]) -> bool:
    """Whether exposure acts on scene and artifact together, as behind a lens; on the scene alone, where software drew.

    Raises:
        InputError: the effects are of both kinds.
    """
    by_software = {name in DRAWN_BY_SOFTWARE for name in effects}
    if len(by_software) > 1:
        raise InputError(
            "exposure acts on what is on the lens and not on what software drew, and the effects are of both kinds",
            f"choose effects of one kind: {', '.join(sorted(DRAWN_BY_SOFTWARE))}, or the others",
        )
    return by_software != {True}
