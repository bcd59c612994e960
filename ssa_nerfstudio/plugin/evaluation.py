"""What is logged of a render: metrics of a training step, metrics and images of a test view."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from ssa_nerfstudio.metrics import image as metrics
from ssa_nerfstudio.metrics.color_correction import color_corrected
from ssa_nerfstudio.overlay.rgba import over_checkerboard
from ssa_nerfstudio.plugin.artifacts import Artifacts

MAX_PSNR = 100.0
"""dB; errors of a thousandth of a gray level."""


@torch.no_grad()
def step_metrics(outputs: Mapping[str, Tensor], target: Tensor, artifacts: Artifacts) -> dict[str, Tensor]:
    """Metrics of a training step, unchecked and on the device.

    Args:
        outputs: the model's.
        target: the photo [H, W, 3] in [0, 1].
        artifacts: the model's overlays.

    Returns:
        psnr (dB) of the clean render, composite_psnr of the composite, and per overlay the fraction of the frame with a
        matte above one half and the mean matte.
    """
    values = {"psnr": _psnr(outputs["rgb"], target)}
    if "composite" in outputs:
        values["composite_psnr"] = _psnr(outputs["composite"], target)
    for group in range(len(artifacts)):
        suffix = f"_{group}" if len(artifacts) > 1 else ""
        values["overlay_covered" + suffix], values["overlay_matte" + suffix] = artifacts.coverage(group)
    return values


def view_metrics(outputs: Mapping[str, Tensor], target: Tensor) -> dict[str, float]:
    """Metrics of the clean render: psnr (dB), ssim ("valid" padding), mean_color_deviation, flip; and composite_psnr.

    The render is at the mean exposure of the training photos; cc_psnr is of the render brought to the photo's.

    Args:
        outputs: the model's.
        target: the photo [H, W, 3] in [0, 1].
    """
    return {**view_metrics_without_flip(outputs, target), "flip": metrics.flip(outputs["rgb"], target)}


def view_metrics_without_flip(outputs: Mapping[str, Tensor], target: Tensor) -> dict[str, float]:
    """`view_metrics` without FLIP, which takes longer than all the others on a GPU."""
    render = outputs["rgb"]
    values = {
        "psnr": metrics.psnr(render, target),
        # A photo of one color is corrected without error, and JSON knows no infinity.
        "cc_psnr": min(metrics.psnr(color_corrected(render, target), target), MAX_PSNR),
        "ssim": metrics.ssim(render, target),
        "mean_color_deviation": metrics.mean_color_deviation(render, target),
    }
    if "composite" in outputs:
        values["composite_psnr"] = metrics.psnr(outputs["composite"], target)
    return values


def view_images(outputs: Mapping[str, Tensor], target: Tensor) -> dict[str, Tensor]:
    """Photo beside render; with an overlay also render beside composite and overlay beside matte.

    Args:
        outputs: the model's.
        target: the photo [H, W, 3] in [0, 1].
    """
    render = outputs["rgb"]
    pictures = {"img": torch.cat([target, render], dim=1)}
    if "overlay_alpha" in outputs:
        alpha = outputs["overlay_alpha"]
        pictures["clean_and_composite"] = torch.cat([render, outputs["composite"]], dim=1)
        pictures["overlay_and_matte"] = torch.cat(
            [over_checkerboard(outputs["overlay_rgb"], alpha), alpha.expand_as(target)], dim=1
        )
    return pictures


def _psnr(render: Tensor, target: Tensor) -> Tensor:
    """PSNR in dB, unchecked."""
    return -10.0 * torch.log10((render - target).square().mean())
