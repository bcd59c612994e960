"""SSA-Nerfstudio: Gaussian Splatting that learns a scene together with a static screen-space artifact.

The public interface; everything else may change between versions. Importing the package is cheap: a name's module is
imported when the name is first used.

- `detect(data)`: test whether photos carry a static artifact; one `Detection` per camera.
- `load_overlay(config)`: the overlay of a run, a `torch.nn.Module` with `layers()`: an `Overlay`, or the oracle
  overlay of a run that was given one.
- `Overlay`: the learnable RGBA overlay that all views of a camera share.
- `composite(clean, transmittance, addition)`: the image formation model I = T C + B, differentiable.
- `SSAError`, `InputError`, `TrainingError`: all exceptions that the library raises on purpose.

Training goes through nerfstudio, as `ns-train ssa-splatfacto` or from Python (docs/api.md).
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from ssa_nerfstudio.errors import InputError, SSAError, TrainingError

if TYPE_CHECKING:
    from ssa_nerfstudio.evidence.capture_detection import detect_artifacts as detect
    from ssa_nerfstudio.evidence.detection import Detection
    from ssa_nerfstudio.export.checkpoint import load_overlay
    from ssa_nerfstudio.overlay.compositing import composite
    from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay as Overlay

__all__ = [
    "Detection",
    "InputError",
    "Overlay",
    "SSAError",
    "TrainingError",
    "__version__",
    "composite",
    "detect",
    "load_overlay",
]
__version__ = "0.1.0"

_LAZY = {
    "Detection": ("ssa_nerfstudio.evidence.detection", "Detection"),
    "Overlay": ("ssa_nerfstudio.overlay.layer", "ScreenSpaceOverlay"),
    "composite": ("ssa_nerfstudio.overlay.compositing", "composite"),
    "detect": ("ssa_nerfstudio.evidence.capture_detection", "detect_artifacts"),
    "load_overlay": ("ssa_nerfstudio.export.checkpoint", "load_overlay"),
}


def __getattr__(name: str) -> Any:
    """Import a public name on first use (PEP 562)."""
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _LAZY[name]
    value = getattr(importlib.import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
