"""Falloff of light from the middle of the frame to its corners (vignetting), from the scene's points.

A point has one color in all photos, so where log I changes with its pixel, something in front changes. A lens darkens
by the angle to its axis alone, which is taken to be in the frame's center. Shading, reflections and other artifacts
have no reason to: what of the same smoothness is not radial says how much of the radial part may be theirs.
docs/method.md derives it.
"""

from __future__ import annotations

import torch
from scipy.special import fdtrc
from torch import Tensor

from ssa_nerfstudio.evidence.detection import SIGNIFICANCE
from ssa_nerfstudio.evidence.layer_estimate import CLEAR_SHARE, OUTLIER_SCALE, robust_deviation
from ssa_nerfstudio.evidence.photo_exposure import DAMPING, ROUNDS, USABLE
from ssa_nerfstudio.evidence.point_samples import PointSamples, summed
from ssa_nerfstudio.evidence.statistics import GRAY_LEVEL

MAX_SAMPLES = 20_000
"""Of more, those of a regular subset of the points are used: a falloff has five parameters."""
MAX_VIEWS = 128
"""Of more, a regular subset is used."""
RADIAL_MODES = 5


@torch.no_grad()
def estimate_falloff(samples: PointSamples) -> Tensor:
    """Estimate the transmittance of a falloff by robust regression, with the points' colors and views' gains unknown.

    Args:
        samples: of the scene's points.

    Returns:
        [h, w, 1] in (0, 1], of the working size: about 1 in the clearest CLEAR_SHARE of the frame, and 1 everywhere
        unless the falloff is significant.
    """
    height, width = samples.size
    modes = _modes(height, width, samples.focal_ratio).to(samples.color.device)
    radial = modes[:, :RADIAL_MODES]
    found = _regression(samples, modes).square()
    nothing = samples.color.new_ones(height, width, 1)
    if _chance(found) >= SIGNIFICANCE:
        return nothing
    # By itself: in a capture whose points move along few paths, the other modes take part of the falloff.
    log_transmittance = radial @ _regression(samples, radial)
    clearest = log_transmittance.kthvalue(max(1, round((1 - CLEAR_SHARE) * height * width))).values
    # A lens darkens from the middle outwards, and the farther out the faster. A logo in the middle does not: outside of
    # it nothing changes any more.
    middle, halfway, corner = (log_transmittance[y * width + x] for y, x in _ways_out(height, width))
    if middle < clearest or middle - halfway > halfway - corner:
        return nothing
    clear = log_transmittance[log_transmittance >= clearest].mean()
    return (log_transmittance - clear).exp().clamp(GRAY_LEVEL, 1).reshape(height, width, 1).to(samples.color)


def _chance(squares: Tensor) -> float:
    """Probability that radial modes have as large a share of these squares [K] if all have one variance (F-test)."""
    others = squares[RADIAL_MODES:].mean()
    ratio = float(squares[:RADIAL_MODES].mean() / others) if others > 0 else 0.0
    return float(fdtrc(RADIAL_MODES, len(squares) - RADIAL_MODES, ratio))


def _ways_out(height: int, width: int) -> list[tuple[int, int]]:
    """Pixels in the middle of the frame, halfway to its last corner, and there: y and x."""
    middle = height // 2, width // 2
    corner = height - 1, width - 1
    return [middle, ((middle[0] + corner[0]) // 2, (middle[1] + corner[1]) // 2), corner]


def _modes(height: int, width: int, focal_ratio: float) -> Tensor:
    """Polynomials of the position, orthonormal over the frame [h w, 17], float64: r^2 to r^10 and all others up to the
    fourth degree. x is divided by the ratio of focal lengths, so that r is proportional to the tangent of the angle to
    the lens's axis: undistorted photos may be stretched."""
    y, x = (torch.arange(side, dtype=torch.float64) + 0.5 - side / 2 for side in (height, width))
    z = torch.complex(*torch.broadcast_tensors(x / focal_ratio, y[:, None])).flatten() / max(height, width)
    squared = z.abs().square()
    turning = [z, z**2, z * squared, z**3, z**2 * squared, z**4]
    radial = [squared**power for power in range(1, RADIAL_MODES + 1)]
    modes = [*radial, *(part for mode in turning for part in (mode.real, mode.imag))]
    stacked = torch.stack(modes, dim=-1)
    return torch.linalg.qr(stacked - stacked.mean(dim=0)).Q


def _regression(samples: PointSamples, modes: Tensor) -> Tensor:
    """Coefficients [K] of modes [h w, K] in log I = log C + log g + modes, g of views, with Cauchy's weights."""
    # Of patches, because a point's own color changes with its distance.
    color = samples.color if samples.patch is None else samples.patch
    brightness, every = color.mean(dim=-1).double(), int(samples.view.max()) // MAX_VIEWS + 1
    usable = (brightness < USABLE[1]) & (samples.view % every == 0)
    usable &= samples.point % (int(usable.sum()) // MAX_SAMPLES + 1) == 0
    if not usable.any():
        return modes.new_zeros(modes.shape[1])
    known, point = samples.point[usable].unique(return_inverse=True)
    shown_by = torch.nn.functional.one_hot(samples.view[usable] // every)
    columns = torch.cat([modes[samples.pixel[usable]], shown_by.to(modes)], dim=-1)
    values = brightness[usable].clamp_min(GRAY_LEVEL).log()[:, None]
    # The modes only need to be regular; gains are taken for none where nothing is known of them.
    damping = torch.full(columns.shape[1:], DAMPING, dtype=columns.dtype, device=columns.device)
    damping[: modes.shape[1]] = 1e-9
    weight, solution = torch.ones_like(values), torch.zeros_like(damping)
    for _ in range(ROUNDS):
        total = summed(point, weight, len(known))
        centered = columns - (summed(point, weight * columns, len(known)) / total)[point]
        rest = values - (summed(point, weight * values, len(known)) / total)[point]
        weighted = weight * centered
        solution = torch.linalg.solve(weighted.T @ centered + damping.diag(), weighted.T @ rest)
        rest -= centered @ solution
        weight = 1 / (1 + (rest / (OUTLIER_SCALE * robust_deviation(rest))).square())
    return solution.flatten()[: modes.shape[1]]
