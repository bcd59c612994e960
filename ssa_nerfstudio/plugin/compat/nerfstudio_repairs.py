"""Repairs of nerfstudio 1.1.5."""

from __future__ import annotations

import atexit
import contextlib
import inspect
import os
import shutil
import sys
import tempfile
import types
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import torch
from nerfstudio.configs import external_methods
from nerfstudio.utils import install_checks


def allow_checkpoint_scalars() -> None:
    """Let `torch.load` of torch >= 2.6 read nerfstudio's checkpoints, which hold numpy scalars of the schedulers.

    Without it `ns-eval`, `ns-render`, `ns-export`, `ns-viewer` and resuming fail with "Weights only load failed".
    May go when nerfstudio saves plain floats (https://github.com/nerfstudio-project/nerfstudio/issues/3683).
    """
    reconstruct = np.float64(0).__reduce__()[0]
    allowed: list[Any] = [
        reconstruct,
        # numpy 2 renamed the module; checkpoints written under the other major version name it the other way.
        (reconstruct, "numpy.core.multiarray.scalar"),
        (reconstruct, "numpy._core.multiarray.scalar"),
        np.dtype,
        *{type(np.dtype(kind)) for kind in (np.float32, np.float64, np.int32, np.int64, np.bool_)},
    ]
    torch.serialization.add_safe_globals(allowed)


def provide_ffmpeg() -> None:
    """Let `ns-render` find the ffmpeg of `imageio-ffmpeg`; it demands one even where it writes images.

    Looked for only when nerfstudio asks, and not where the system has one. May go when `ns-render` asks for it only
    for videos.
    """
    check = install_checks.check_ffmpeg_installed

    def check_ffmpeg_installed() -> None:
        if shutil.which("ffmpeg") is None:
            import imageio_ffmpeg

            folder = tempfile.mkdtemp(prefix="ssa-ffmpeg-")
            atexit.register(shutil.rmtree, folder, ignore_errors=True)
            os.symlink(imageio_ffmpeg.get_ffmpeg_exe(), os.path.join(folder, "ffmpeg"))
            os.environ["PATH"] = os.pathsep.join([folder, os.environ.get("PATH", "")])
        check()

    install_checks.check_ffmpeg_installed = check_ffmpeg_installed


def list_external_methods_fast() -> None:
    """Let nerfstudio list the methods that can be installed without reading its sources for each of them.

    Each entry asks `inspect.stack` for the name of its caller, and that also reads the source lines of all callers: a
    second of the start of every command. May go when nerfstudio asks otherwise.
    """
    external_methods.inspect = types.SimpleNamespace(stack=partial(inspect.stack, 0))  # pyright: ignore


@contextlib.contextmanager
def without_torchmetrics() -> Iterator[None]:
    """Build a splatfacto model with placeholders for its `psnr` and `lpips`, which no method of ours calls.

    The import of torchmetrics, in `SplatfactoModel.populate_modules`, takes a fifth of all imports, and LPIPS downloads
    AlexNet's weights, which fails offline. The model is built in the main thread before a viewer exists, so that the
    patch meets no other thread. May go when splatfacto builds its metrics only where it evaluates.
    """

    class _Placeholder(torch.nn.Module):
        def __init__(self, **_) -> None:
            super().__init__()

    modules = {name: types.ModuleType(name) for name in ("torchmetrics.image", "torchmetrics.image.lpip")}
    for module in modules.values():
        vars(module).update(PeakSignalNoiseRatio=_Placeholder, LearnedPerceptualImagePatchSimilarity=_Placeholder)
    imported = {name: sys.modules[name] for name in modules if name in sys.modules}
    sys.modules.update(modules)
    try:
        yield
    finally:
        for name in modules:
            del sys.modules[name]
        sys.modules.update(imported)
