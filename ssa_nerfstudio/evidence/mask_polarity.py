"""Whether a mask of the user's keeps the static artifact and leaves out the scene."""

from __future__ import annotations

import logging
from typing import Literal

import numpy as np

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.evidence.detection import Detection, detect
from ssa_nerfstudio.evidence.static_area import MAX_OPAQUE_DEVIATION
from ssa_nerfstudio.evidence.statistics import ImageStatistics

_LOG = logging.getLogger(__name__)

_MIN_ARTIFACT = 0.5
"""Share of the detected artifact that a mask of the wrong polarity keeps."""
_MAX_SCENE = 0.1
"""Share of the rest of the frame that it keeps. Masks of people or of the sky keep more, with it or without."""

Polarity = Literal["plausible", "doubtful", "inverted"]
"""doubtful: the mask keeps the artifact and little else; inverted: and what it keeps stands still."""


def polarity(used: np.ndarray, statistics: ImageStatistics, detection: Detection) -> Polarity:
    """Judge a mask by the artifact that is detected; without one there is no telling.

    Args:
        used: bool [H, W], True where the mask keeps the photos.
        statistics: of the photos, without the mask, in the same frame.
        detection: from these statistics.
    """
    artifact = detection.mask.numpy()
    if not artifact.any() or used.all() or not used.any():
        return "plausible"
    if used[artifact].mean() < _MIN_ARTIFACT or used[~artifact].mean() > _MAX_SCENE:
        return "plausible"
    deviation = statistics.deviation()[..., 0].cpu().numpy()
    still = np.median(deviation[used]) < MAX_OPAQUE_DEVIATION * np.median(deviation[~used])
    return "inverted" if still else "doubtful"


def check_polarity(used: np.ndarray, statistics: ImageStatistics, name: str, remedy: str) -> None:
    """Warn of a mask that seems to keep the artifact alone, and refuse one that certainly does.

    Args:
        used, statistics: as for `polarity`.
        name: what the message calls the mask.
        remedy: how to invert it.

    Raises:
        InputError: the mask is inverted.
    """
    judged = polarity(used, statistics, detect(statistics))
    problem = f"{name} keeps {used.mean():.0%} of the frame, which is the static artifact, and leaves out the scene"
    if judged == "inverted":
        raise InputError(problem, remedy)
    if judged == "doubtful":
        _LOG.warning(f"it seems that {problem}; if so, {remedy}")
