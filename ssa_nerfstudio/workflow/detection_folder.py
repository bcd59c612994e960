"""The folder that the first stage of a run leaves: what was detected in the photos of each camera."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image

from ssa_nerfstudio._system.text_files import read_text
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.evidence.capture_detection import detections_to_json, write_detections
from ssa_nerfstudio.evidence.detection import Detection
from ssa_nerfstudio.sfm.detected_mask import FoundArtifact

VERDICTS = "detection.json"
"""File of the verdicts, beside the masks."""
_MASK = "mask_colmap.png"


def write_found(folder: Path, detections: dict[str, Detection]) -> None:
    """Write the files of `write_detections`, and the verdicts, into an empty folder."""
    write_detections(folder, detections)
    (folder / VERDICTS).write_text(detections_to_json(detections), encoding="utf-8")


def found_artifacts(folder: Path) -> list[FoundArtifact]:
    """What was found in the photos of each camera, in their order.

    Raises:
        InputError: a file of the folder is gone or broken.
    """
    try:
        groups = json.loads(read_text(folder / VERDICTS))["groups"]
        found = []
        for group in groups:
            own = folder / group["name"] if len(groups) > 1 else folder
            with Image.open(own / _MASK) as mask:
                hidden = np.asarray(mask.convert("L")) == 0
            intervals = [(each["first"], each["end"], each["verdict"]) for each in group["intervals"]]
            found.append(FoundArtifact.of(group["verdict"], hidden, group["views"], intervals))
        return found
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise InputError(
            f"what was detected cannot be read ({error})", f"remove {folder}, and the same command detects again"
        ) from error
