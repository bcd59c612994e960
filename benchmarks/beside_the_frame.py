"""What Gaussians beside the frame draw into a test view: `python benchmarks/beside_the_frame.py --load-config CONFIG`

Splatting projects a Gaussian by an affine approximation at its center (EWA; gsplat takes it at most 15 % beside the
frame). Of a large one whose center is beside the frame it draws several times as much into the picture as a ray sees.
One row for each of those that change a view's error most when they are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import Count
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.metrics.image import psnr
from ssa_nerfstudio.rasterization.constants import ALPHA_MIN, EPS2D
from ssa_nerfstudio.rasterization.interface import Gaussians

if TYPE_CHECKING:
    from nerfstudio.cameras.cameras import Cameras

    from ssa_nerfstudio.plugin.model import SSASplatfactoModel

STRIDE = 4
"""Areas are sums over every fourth pixel and row."""
CANDIDATES = 50
"""Gaussians that are left out one by one: those that draw most into the view."""


class Areas(NamedTuple):
    """Alpha that N Gaussians, each by itself, have in a frame, [N], pixels."""

    seen: Tensor
    """Along rays: of the Gaussian's largest density on the ray of each pixel."""
    drawn: Tensor
    """By gsplat's projection, also beyond the three standard deviations at which it ends a splat."""


def beside(places: Tensor, depths: Tensor, scales: Tensor, count: int) -> Tensor:
    """Indices of at most so many Gaussians in front of a camera and outside its frame, those that look largest first.

    Args:
        places: of the centers in the frame, [N, 2], from 0 to 1.
        depths: of the centers, [N]; up to 0 it is behind the camera.
        scales: largest standard deviations [N], as depths in world units.
    """
    outside = ((places < 0) | (places > 1)).any(dim=-1) & (depths > 0)
    those = outside.nonzero()[:, 0]
    order = (scales[those] / depths[those]).argsort(descending=True)
    return those[order[:count]]


def areas(gaussians: Gaussians, viewmat: Tensor, K: Tensor, width: int, height: int) -> Areas:
    """How much of a frame N Gaussians cover; world to camera [4, 4], intrinsics [3, 3] in pixels."""
    from gsplat.cuda._torch_impl import _persp_proj, _quat_scale_to_covar_preci, _world_to_cam

    covariances, _ = _quat_scale_to_covar_preci(gaussians.quats, gaussians.scales, compute_preci=False)
    centers, covariances = _world_to_cam(gaussians.means, covariances, viewmat[None])  # pyright: ignore[reportArgumentType]
    places, flat = (found[0] for found in _persp_proj(centers, covariances, K[None], width, height))
    flat = torch.linalg.inv(flat + EPS2D * torch.eye(2).to(flat))
    precisions = torch.linalg.inv(covariances[0].double())
    rows, columns = (torch.arange(STRIDE / 2, side, STRIDE).to(K) for side in (height, width))
    pixels = torch.cartesian_prod(rows, columns).flip(-1)  # x, y
    rays = torch.cat([(pixels - K[:2, 2]) / K.diagonal()[:2], torch.ones_like(pixels[:, :1])], dim=-1).double()
    seen, drawn = [], []
    for center, precision, place, inverse, opacity in zip(
        centers[0].double(), precisions, places, flat, gaussians.opacities, strict=True
    ):
        along = rays @ (precision @ center)
        nearest = center @ precision @ center - along.square() / ((rays @ precision) * rays).sum(dim=-1)
        seen.append(_area(opacity * torch.exp(-nearest / 2) * (along > 0)))  # a ray does not go back
        offset = pixels - place
        drawn.append(_area(opacity * torch.exp(-((offset @ inverse) * offset).sum(dim=-1) / 2)))
    return Areas(torch.stack(seen).to(K), torch.stack(drawn).to(K))


def _area(alpha: Tensor) -> Tensor:
    return STRIDE**2 * torch.where(alpha > ALPHA_MIN, alpha, 0.0).sum()


@dataclass
class Command:
    """Print which Gaussians beside the frame change a test view most, and how much of them a ray would see."""

    load_config: Path
    """The run's config.yml; `ssa bench ... --keep-models` keeps those of its runs."""
    view: int = -1
    """Number of the test view, from 0; -1: the worst."""
    rows: Count = 5
    """So many Gaussians are listed."""

    def run(self) -> None:
        """Render, leave out and print.

        Raises:
            InputError: the run or the view cannot be found.
        """
        from nerfstudio.utils.eval_utils import eval_setup

        from ssa_nerfstudio.plugin.splat_rendering import activated
        from ssa_nerfstudio.plugin.view_geometry import frame, intrinsics, view_matrix

        if not self.load_config.is_file():
            raise InputError(f"{self.load_config} is no file", "choose the config.yml of a run")
        _, pipeline, _, _ = eval_setup(self.load_config, test_mode="test")
        model, views = pipeline.model, pipeline.datamanager.fixed_indices_eval_dataloader  # pyright: ignore
        if not -1 <= self.view < len(views):
            raise InputError(f"view {self.view} is none of the {len(views)} test views", "count from 0")
        learned = {name: values.detach().clone() for name, values in model.gauss_params.items()}
        everything = torch.ones(len(learned["means"]), dtype=torch.bool, device=model.device)

        def quality(number: int, kept: Tensor) -> float:
            for name, values in learned.items():
                model.gauss_params[name].data = values[kept]
            camera, photo = views[number]
            return _psnr(model, camera, photo)

        before = [quality(number, everything) for number in range(len(views))]
        chosen = min(range(len(views)), key=before.__getitem__) if self.view < 0 else self.view
        print(f"PSNR of test views, dB: {', '.join(f'{value:.2f}' for value in before)}; view {chosen}:\n")
        camera = views[chosen][0].to(model.device)
        width, height = frame(camera)
        viewmat, K = view_matrix(camera.camera_to_worlds)[0], intrinsics(camera, 1)[0]
        centers = learned["means"] @ viewmat[:3, :3].T + viewmat[:3, 3]
        places = (centers[:, :2] / centers[:, 2:] * K.diagonal()[:2] + K[:2, 2]) / torch.tensor([width, height]).to(K)
        scales = torch.exp(learned["scales"]).amax(dim=-1)
        depths = torch.where(centers[:, 2] > model.near_plane, centers[:, 2], 0.0)  # nearer ones are not drawn
        largest = beside(places, depths, scales, 20 * CANDIDATES)
        if not len(largest):
            print("no Gaussian beside the frame is drawn")
            return
        shown = activated({name: values[largest] for name, values in learned.items()}, with_harmonics=False)
        covered = areas(shown, viewmat, K, width, height)
        rows = []
        for i in covered.drawn.topk(min(len(largest), CANDIDATES)).indices.tolist():
            kept = everything.clone()
            kept[largest[i]] = False
            gain = quality(chosen, kept) - before[chosen]
            place, depth = places[largest[i]].tolist(), depths[largest[i]].item()
            size, opacity = shown.scales[i].max().item(), shown.opacities[i].item()
            seen, drawn = covered.seen[i].item(), covered.drawn[i].item()
            rows.append((*place, depth, size, opacity, seen, drawn, drawn / max(seen, 1.0), gain))
        print("| center (frame: 0 to 1) | depth | largest sigma | opacity | seen | drawn | ratio | without it, dB |")
        print("|---|---|---|---|---|---|---|---|")
        row = "| {:.2f}, {:.2f} | {:.2f} | {:.2f} | {:.2f} | {:.0f} | {:.0f} | {:.1f} | {:+.2f} |"
        for values in sorted(rows, key=lambda values: -abs(values[-1]))[: self.rows]:
            print(row.format(*values))


@torch.no_grad()
def _psnr(model: SSASplatfactoModel, camera: Cameras, photo: dict) -> float:
    outputs = model.get_outputs_for_camera(camera)
    return psnr(outputs["rgb"], model.target(outputs, photo))


if __name__ == "__main__":
    run_script(Command)
