"""Seed points: the Gaussians that a training starts from, and what they say about the space before the cameras."""

from __future__ import annotations

import logging

import torch
from gsplat.strategy.ops import _update_param_with_optimizer
from nerfstudio.models.splatfacto import RGB2SH
from torch import Tensor
from torch.nn import Parameter, ParameterDict

from ssa_nerfstudio.evidence.point_samples import project, regular_subset
from ssa_nerfstudio.evidence.seeds import Seeds
from ssa_nerfstudio.rasterization.constants import NEAR_PLANE

_LOG = logging.getLogger(__name__)

MIN_DISTANCE = NEAR_PLANE
"""A seed point nearer to a camera than this (world units) is inside it: that camera never draws it."""
NEAREST_SHARE = 0.001
"""Share of all projections of seed points that may be nearer than `nearest_depth`: wrong matches."""
BACKDROP_OPACITY = 0.99
"""Of seeds behind what no photo shows: opaque, and a logit that is finite."""


def nearest_depth(points: Tensor, view_matrices: Tensor, Ks: Tensor, width: int, height: int) -> float | None:
    """Depth of the nearest seed points in the frames of all cameras, world units; None where no frame shows any.

    Args:
        points: [N, 3].
        view_matrices: world to camera [V, 4, 4].
        Ks: intrinsics [V, 3, 3], pixels.
        width, height: of the largest frame, pixels.
    """
    points = regular_subset(points, len(view_matrices))
    depths = project(points, view_matrices, Ks, height, width)[3]
    depths = depths[depths > NEAR_PLANE]
    return float(depths.kthvalue(1 + int(NEAREST_SHARE * (len(depths) - 1))).values) if len(depths) else None


def outside_cameras(means: Tensor, positions: Tensor) -> Tensor:
    """[N] bool, True where a seed point [N, 3] is inside none of the cameras at positions [V, 3].

    All are True, with a warning, where none would be left.
    """
    inside = torch.zeros(len(means), dtype=torch.bool, device=means.device)
    for chunk in positions.to(means).split(64):
        # By differences: by products it would be less exact, and load cuBLAS.
        distances = torch.cdist(means, chunk, compute_mode="donot_use_mm_for_euclid_dist")
        inside |= (distances < MIN_DISTANCE).any(dim=1)
    if inside.all():
        _LOG.warning(
            f"every seed point is within {MIN_DISTANCE} of a camera, nearer than any is drawn: the scene is too small; "
            "leave --pipeline.datamanager.dataparser.auto-scale-poses True"
        )
        inside.zero_()
    return ~inside


def color_parameters(colors: Tensor, sh_degree: int) -> Tensor:
    """Constant spherical harmonics, or logits without harmonics, [N, 3] of colors [N, 3] uint8, or float in [0, 1]."""
    values = colors if colors.is_floating_point() else colors.float() / 255.0
    return RGB2SH(values) if sh_degree > 0 else torch.logit(values, eps=1e-6)


@torch.no_grad()
def add_seeds(
    seeds: Seeds,
    params: ParameterDict,
    sh_degree: int,
    opacity: float | None = None,
    optimizers: dict[str, torch.optim.Optimizer] | None = None,
) -> None:
    """Add Gaussians at seeds, round and as wide as these say, with MCMC, too, which starts others smaller.

    What no photo shows is added after the last step: densification would remove it.

    Args:
        seeds: N of them.
        params: of the model's Gaussians, at least one.
        sh_degree: the model's degree of spherical harmonics.
        opacity: in (0, 1); None: that of the first of the others.
        optimizers: of the parameters, by their names, so that a checkpoint can be resumed; None before they are built.
    """
    count = len(seeds)
    if not count:
        return
    new = {name: values.data.new_zeros(count, *values.shape[1:]) for name, values in params.items()}
    new["means"].copy_(seeds.positions)
    new["scales"].copy_(seeds.widths.log()[:, None].expand(count, 3))
    new["quats"][:, 0] = 1
    new["features_dc"].copy_(color_parameters(seeds.colors, sh_degree))
    logit = params["opacities"].data[:1] if opacity is None else torch.tensor(opacity).logit()
    new["opacities"].copy_(logit.expand(count, 1))
    if optimizers is None:
        for name, values in params.items():
            params[name] = Parameter(torch.cat([values.data, new[name]]))
        return
    _update_param_with_optimizer(
        lambda name, values: Parameter(torch.cat([values.data, new[name]])),
        lambda _, state: torch.cat([state, state.new_zeros(count, *state.shape[1:])]),
        params,
        optimizers,
    )
