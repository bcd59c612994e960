"""exposure.json: the exposures that a run learned, for whoever wants a photo's look and not the splats' mean one."""

from __future__ import annotations

import json
from pathlib import Path

import torch

from ssa_nerfstudio.data.writing import staged_file
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.export.checkpoint import Checkpoint
from ssa_nerfstudio.plugin.exposure import Exposure

FILE = "exposure.json"
"""Its name, beside the splats or the artifact."""
_FORMULAS = {
    "photo": "photo = clip(gain (T splats + B) + offset): exposure acts on scene and artifact",
    "scene": "photo = T clip(gain splats + offset) + B: exposure acts on the scene alone",
}


def write_exposure(checkpoint: Checkpoint, folder: Path) -> Path | None:
    """Write each photo's gain and offset per channel (red, green, blue; 1: white), if the run learned them.

    Args:
        checkpoint: of the run.
        folder: to write into; made where missing.

    Returns:
        The file; None where the run learned no exposures.

    Raises:
        InputError: the checkpoint's exposures cannot be read.
    """
    transforms, prefix = checkpoint.model.get("exposure.transforms"), "exposure."
    if transforms is None:
        return None
    try:
        exposure = Exposure(len(transforms))
        exposure.load_state_dict(
            {name.removeprefix(prefix): v for name, v in checkpoint.model.items() if name.startswith(prefix)}
        )
        formula = _FORMULAS[exposure.place]
        if len(exposure.photos) != len(transforms) or not torch.isfinite(transforms).all():
            raise ValueError("not one finite exposure for each photo")
    except (RuntimeError, LookupError, TypeError, ValueError) as error:
        raise InputError(
            f"{checkpoint.path}: its exposures cannot be read ({str(error).splitlines()[0]})",
            "choose another checkpoint with --step, or train again",
        ) from error
    photos = {}
    for view, name in enumerate(exposure.photos):
        photo = exposure.of_view(view)
        photos[name] = {"gain": photo.gain.tolist(), "offset": photo.offset.tolist()}
    folder.mkdir(parents=True, exist_ok=True)
    with staged_file(folder / FILE) as part:
        values = {"place": exposure.place, "formula": formula, "splats": "at the mean exposure", "photos": photos}
        part.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
    return folder / FILE
