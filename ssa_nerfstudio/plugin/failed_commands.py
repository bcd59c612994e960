"""What made a command of nerfstudio fail, where the command asserts, or calls libraries with whatever a file holds.

Upstream's functions have no hook for this. Their variables say which file or option they were at.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from traceback import walk_tb
from types import FrameType, TracebackType
from typing import Any

from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.engine.trainer import TrainerConfig

from ssa_nerfstudio.errors import InputError, SSAError
from ssa_nerfstudio.plugin.training.checkpoints import reason


def culprit(error: BaseException, traceback: TracebackType | None) -> InputError | None:
    """The file or option of a nerfstudio command that an error comes from; None where it has another cause."""
    if not isinstance(error, Exception) or isinstance(error, SSAError):
        return None
    frames = [frame for frame, _ in walk_tb(traceback)]
    for number, frame in enumerate(frames):
        explain = _FUNCTIONS.get((_module(frame), frame.f_code.co_name))
        below = frames[number + 1 :]
        if explain is not None and (found := explain(frame.f_locals, below, error)) is not None:
            return found
    return None


Explanation = Callable[[dict[str, Any], list[FrameType], Exception], InputError | None]
"""Of an error, from the variables of a function of nerfstudio's and the functions that it has called."""


def _module(frame: FrameType) -> str:
    """The module's name, of `python -m nerfstudio.scripts...` too."""
    spec = frame.f_globals.get("__spec__")
    return frame.f_globals.get("__name__", "") if spec is None else spec.name


def _config(here: dict[str, Any], below: list[FrameType], error: Exception) -> InputError | None:
    if "device" in here:
        return None
    return InputError(
        f"{here['config_path']} cannot be read as the config.yml of a run ({reason(error)})",
        "choose the one that ns-train wrote",
    )


def _checkpoint(here: dict[str, Any], below: list[FrameType], error: Exception) -> InputError | None:
    path = here.get("load_path", here["config"].load_dir)
    return InputError(
        f"{path} cannot be read as a checkpoint ({reason(error)})", "copy it again, remove it, or train again"
    )


def _train(here: dict[str, Any], below: list[FrameType], error: Exception) -> InputError | None:
    """--load-config. Once it is read, `config` is what it holds."""
    config: object = here.get("config")
    read = not isinstance(config, TrainerConfig)
    reading = bool(below) and _module(below[0]).partition(".")[0] in ("yaml", "pathlib")
    if not read and not reading:
        return None
    why = f"it holds a {type(config).__name__}" if read else reason(error)
    return InputError(
        f"--load-config {option_value('--load-config')} cannot be read as the config.yml of a run ({why})",
        "choose the one that ns-train wrote",
    )


def _evaluate(here: dict[str, Any], below: list[FrameType], error: Exception) -> InputError | None:
    path: Path = here["self"].output_path
    if below or path.suffix == ".json":
        return None
    return InputError(f"--output-path {path}: the results are JSON", "choose a name that ends in .json")


def _render(here: dict[str, Any], below: list[FrameType], error: Exception) -> InputError | None:
    path = getattr(here["self"], "camera_path_filename", None)
    if path is None or "pipeline" not in here or isinstance(here.get("camera_path"), Cameras):
        return None
    return InputError(
        f"--camera-path-filename {path} cannot be read as a camera path ({type(error).__name__}: {reason(error)})",
        "save one in the tab Render of ns-viewer",
    )


def _export(here: dict[str, Any], below: list[FrameType], error: Exception) -> InputError | None:
    command = type(here["self"]).__name__
    if "pipeline" not in here:
        return None
    if command == "ExportGaussianSplat":
        if not below or below[-1].f_code.co_name != "write_ply" or below[-1].f_locals["count"]:
            return None
        if "crop_obb" in here:
            return InputError(
                "no Gaussian lies in the box of --obb-center, --obb-rotation and --obb-scale",
                "choose another box, or leave these out",
            )
        return InputError("the run has no Gaussian that can be seen", "train again")
    casts = any(isinstance(frame.f_locals.get("camera"), RayBundle) for frame in below)
    asserts = not below and isinstance(error, AssertionError)
    if not casts and not asserts and "train_pixel_sampler" not in str(error):  # which samples rays
        return None
    textured = command == "ExportTSDFMesh"
    return InputError(
        "the texture of a mesh is made by casting rays, which splats cannot"
        if textured
        else "splats have neither a point cloud by casting rays nor a field to make a mesh of",
        "add --texture-method tsdf" if textured else "export the splats: ns-export gaussian-splat",
    )


def option_value(option: str) -> str:
    """What this process was called with for an option; empty where it was not."""
    for number, word in enumerate(sys.argv):
        name, equals, value = word.partition("=")
        if name.replace("_", "-") == option:
            return value if equals else "".join(sys.argv[number + 1 : number + 2])
    return ""


_FUNCTIONS: dict[tuple[str, str], Explanation] = {
    ("nerfstudio.utils.eval_utils", "eval_load_checkpoint"): _checkpoint,
    ("nerfstudio.utils.eval_utils", "eval_setup"): _config,
    ("nerfstudio.scripts.train", "main"): _train,
    ("nerfstudio.scripts.eval", "main"): _evaluate,
    ("nerfstudio.scripts.render", "main"): _render,
    ("nerfstudio.scripts.exporter", "main"): _export,
}
