"""What a start would wait for, loaded by threads while photos are decoded: Triton, and CUDA's kernels."""

from __future__ import annotations

import importlib.util
import logging
from collections.abc import Callable
from threading import Thread

import torch

from ssa_nerfstudio.evidence.change_points import change_points
from ssa_nerfstudio.evidence.falloff import estimate_falloff
from ssa_nerfstudio.evidence.initialization import guide_of
from ssa_nerfstudio.evidence.point_samples import View, sample_points
from ssa_nerfstudio.evidence.scene_photos import scene_photos
from ssa_nerfstudio.evidence.statistics import accumulate
from ssa_nerfstudio.plugin.extra_seeds import seeds_between

_LOG = logging.getLogger(__name__)

_VIEWS, _HEIGHT, _WIDTH = 12, 180, 240


def load_kernels_meanwhile(device: torch.device) -> None:
    """Let threads load what the first steps need, which takes half a second each.

    Triton hashes its files, to find the kernels that it compiled before. CUDA loads a kernel when it is first launched,
    so those of an overlay's start are launched for a few small photos of noise. Neither holds Python's lock for long,
    nor draws from global random state.

    Args:
        device: of the training, of type cuda.
    """
    if importlib.util.find_spec("triton") is not None:
        _in_thread("ssa-triton", _load_triton)
    _in_thread("ssa-kernels", lambda: rehearse_start(device))


@torch.no_grad()
def rehearse_start(device: torch.device) -> None:
    """Launch the kernels of an overlay's start (`overlay_setup.learned_overlays`) and of `find_extra_seeds`.

    Left out are detection, whose kernels these are already, and what is captured as a CUDA graph, during which no
    other thread may allocate.
    """
    generator = torch.Generator().manual_seed(0)
    images = (255 * torch.rand(_VIEWS, _HEIGHT, _WIDTH, 3, generator=generator)).to(device, torch.uint8)
    points = (torch.rand(2000, 3, generator=generator) - torch.tensor([0.5, 0.5, -1.0])).to(device)
    lens = torch.tensor([[float(_WIDTH), 0, _WIDTH / 2], [0, _WIDTH, _HEIGHT / 2], [0, 0, 1]])
    poses = torch.eye(4).repeat(_VIEWS, 1, 1)
    poses[:, 0, 3] = torch.linspace(-0.5, 0.5, _VIEWS)
    views = [View(image, None, pose, lens) for image, pose in zip(images, poses, strict=True)]
    statistics = accumulate((image, None) for image in images)
    change_points(statistics)
    estimate_falloff(sample_points(points, views, guide_of(statistics)))
    half = torch.full((_HEIGHT, _WIDTH, 1), 0.5, device=device)
    layers = half, half.expand(-1, -1, 3)
    seeds_between(points, scene_photos(views, [layers] * _VIEWS, [0] * _VIEWS))


def _load_triton() -> None:
    from triton.runtime.cache import triton_key

    triton_key()


def _in_thread(name: str, load: Callable[[], object]) -> None:
    def attempt() -> None:
        try:
            load()
        except Exception as error:  # the start or the first step does it, and says what is wrong
            _LOG.debug(f"{name}: nothing was loaded ahead: {error}")

    Thread(target=attempt, name=name, daemon=True).start()
