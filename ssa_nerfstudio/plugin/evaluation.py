"""What is logged of a render beside its photo: figures of a training step, figures and pictures of a test view."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from ssa_nerfstudio.metrics import image as metrics
from ssa_nerfstudio.overlay.rgba import over_checkerboard
from ssa_nerfstudio.plugin.artifacts import Artifacts


@torch.no_grad()
def figures_of_step(outputs: Mapping[str, Tensor], target: Tensor, artifacts: Artifacts) -> dict[str, Tensor]:
    """On the device, for the log of a training that may hold anything.

    Args:
        outputs: the model's.
        target: the photo [H, W, 3] in [0, 1].
        artifacts: what is in front of the cameras.

    Returns:
        psnr (dB) of the clean render, composite_psnr of what the photo shows, and of each artifact the fraction of the
        frame with a matte above one half, and the mean matte.
    """
    values = {"psnr": _psnr(outputs["rgb"], target)}
    if "composite" in outputs:
        values["composite_psnr"] = _psnr(outputs["composite"], target)
    for group in range(len(artifacts)):
        suffix = f"_{group}" if len(artifacts) > 1 else ""
        values["overlay_covered" + suffix], values["overlay_matte" + suffix] = artifacts.covered(group)
    return values


def figures_of_view(outputs: Mapping[str, Tensor], target: Tensor) -> dict[str, float]:
    """Of the clean render: psnr (dB), ssim ("valid" padding), mean_color_deviation, flip; and composite_psnr.

    Args:
        outputs: the model's.
        target: the photo [H, W, 3] in [0, 1].
    """
    return {**figures_but_flip(outputs, target), "flip": metrics.flip(outputs["rgb"], target)}


def figures_but_flip(outputs: Mapping[str, Tensor], target: Tensor) -> dict[str, float]:
    """`figures_of_view` without the one that takes longer than all the others on a GPU."""
    render = outputs["rgb"]
    values = {
        "psnr": metrics.psnr(render, target),
        "ssim": metrics.ssim(render, target),
        "mean_color_deviation": metrics.mean_color_deviation(render, target),
    }
    if "composite" in outputs:
        values["composite_psnr"] = metrics.psnr(outputs["composite"], target)
    return values


def pictures_of_view(outputs: Mapping[str, Tensor], target: Tensor) -> dict[str, Tensor]:
    """Photo beside render; and where there is an artifact, render beside composite, overlay beside matte.

    Args:
        outputs: the model's.
        target: the photo [H, W, 3] in [0, 1].
    """
    render = outputs["rgb"]
    pictures = {"img": torch.cat([target, render], dim=1)}
    if "composite" in outputs:
        alpha = outputs["overlay_alpha"]
        pictures["clean_and_composite"] = torch.cat([render, outputs["composite"]], dim=1)
        pictures["overlay_and_matte"] = torch.cat(
            [over_checkerboard(outputs["overlay_rgb"], alpha), alpha.expand_as(target)], dim=1
        )
    return pictures


def _psnr(render: Tensor, target: Tensor) -> Tensor:
    """PSNR in dB, unchecked."""
    return -10.0 * torch.log10((render - target).square().mean())
