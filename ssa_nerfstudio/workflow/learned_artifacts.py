"""What the overlays of a training have learned, in words."""

from __future__ import annotations

from collections.abc import Sequence

from ssa_nerfstudio._system.name_list import name_list
from ssa_nerfstudio.cameras.intervals import BEGINNING
from ssa_nerfstudio.export.artifact_layers import ArtifactLayers

_MIN_MATTE, _MIN_COVERED = 0.3, 0.001
"""An overlay whose matte exceeds the first in less than the second of the frame is nearly clear."""


def learned_in_words(layers: Sequence[ArtifactLayers], on_sphere: bool) -> str:
    """What was learned, as the beginning of a sentence.

    Args:
        layers: of the artifact of every camera and interval; none where there was no overlay.
        on_sphere: whether the cameras are faces of panoramas.
    """
    if len(layers) < 2:
        return "the artifact was learned with the scene" if layers else "the scene alone was learned"
    if any(layer.start != BEGINNING for layer in layers):
        return f"the artifacts of {len(layers)} intervals were learned with the scene"
    if on_sphere:
        return f"the artifact in {len(layers)} faces of the panoramas was learned with the scene"
    return f"the artifacts of {len(layers)} cameras were learned with the scene"


def learned_shares(layers: Sequence[ArtifactLayers]) -> str:
    """How much of the frame the learned artifacts hide or light, to be put behind a sentence; empty for none."""
    shares = [f"{_covered(layer):.1%} of {layer.name if len(layers) > 1 else 'the frame'}" for layer in layers]
    return f", over {name_list(shares)}" if shares else ""


def clear_overlays(layers: Sequence[ArtifactLayers]) -> list[str]:
    """Warnings of artifacts that the training was told of and has not learned."""
    clear = [layer.name for layer in layers if _covered(layer) < _MIN_COVERED]
    if not clear:
        return []
    of = f" of {name_list(clear)}" if len(layers) > 1 else ""
    return [
        f"the overlay{of} is nearly clear: what was found there may be left in the splats; look at them, and add "
        "photos from other places"
    ]


def _covered(layer: ArtifactLayers) -> float:
    """Share of the frame where the matte is not nearly clear."""
    return float((layer.straight()[1] > _MIN_MATTE).mean())
