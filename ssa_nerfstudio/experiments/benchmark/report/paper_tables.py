"""The paper's published metrics, read from configs/published/ssa-3dgs.yaml."""

from __future__ import annotations

from typing import Any

from ssa_nerfstudio.experiments.configuration import locate, read

Triple = tuple[float, float, float]
METRICS = ("psnr", "ssim", "flip")
"""What a triple holds; PSNR in dB."""


def _flat(table: dict[str, Any]) -> dict[Any, Triple]:
    """A nested table by tuples of its keys: (category or scene, method, densification) or (method, densification)."""
    flat: dict[Any, Triple] = {}
    for key, inner in table.items():
        if isinstance(inner, list):
            flat[(key,)] = (inner[0], inner[1], inner[2])
        else:
            flat |= {(key, *rest): triple for rest, triple in _flat(inner).items()}
    return flat


_PUBLISHED = read(locate("published", "ssa-3dgs"))
RESULTS: dict[tuple[str, str, str], Triple] = _flat(_PUBLISHED["results"])
REAL: dict[tuple[str, str, str], Triple] = _flat(_PUBLISHED["real"])
REAL_BY_SCENE: dict[tuple[str, str, str], Triple] = _flat(_PUBLISHED["real_by_scene"])
SENSITIVITY: dict[tuple[str, str, str], Triple] = _flat(_PUBLISHED["sensitivity"])
REAL_SENSITIVITY: dict[tuple[str, str, str], Triple] = _flat(_PUBLISHED["real_sensitivity"])
ABLATION: dict[tuple[str, str], Triple] = _flat(_PUBLISHED["ablation"])
REAL_ABLATION: dict[tuple[str, str], Triple] = _flat(_PUBLISHED["real_ablation"])
COLOR_DEVIATION: dict[str, float] = _PUBLISHED["color_deviation"]
