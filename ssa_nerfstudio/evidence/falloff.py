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
def estimate_falloff(samples: PointSamples, opaque: Tensor | None = None) -> Tensor:
    """Estimate the transmittance of a falloff by robust regression, with the points' colors and views' gains unknown.

    Args:
        samples: of the scene's points.
        opaque: bool [h, w, 1]: pixels that show nothing of the scene, of which patches say nothing; None: none are.

    Returns:
        [h, w, 1] in (0, 1], of the working size: about 1 in the clearest CLEAR_SHARE of the frame, and 1 everywhere
        unless the falloff is significant.
    """
    height, width = samples.size
    nothing = samples.color.new_ones(height, width, 1)
    shown = torch.ones_like(nothing, dtype=torch.bool) if opaque is None else ~opaque.to(nothing.device)
    clear = shown.flatten()
    if clear.float().mean() < CLEAR_SHARE:
        return nothing
    modes = _modes(height, width, samples.focal_ratio, clear.cpu())
    if modes is None:
        return nothing
    modes = modes.to(samples.color.device)
    radial = modes[:, :RADIAL_MODES]
    if _chance(_regression(samples, modes, clear).square()) >= SIGNIFICANCE:
        return nothing
    # By itself: in a capture whose points move along few paths, the other modes take part of the falloff.
    log_transmittance = radial @ _regression(samples, radial, clear)
    seen = log_transmittance[clear]
    # Where nothing is seen the modes may be anything.
    log_transmittance = log_transmittance.clamp(seen.min(), seen.max())
    clearest = seen.kthvalue(max(1, round((1 - CLEAR_SHARE) * len(seen)))).values
    # A lens darkens from the middle outwards, and the farther out the faster. A logo in the middle does not: outside of
    # it nothing changes any more.
    middle, halfway, outside = log_transmittance[_ways_out(height, width, samples.focal_ratio, clear)]
    if middle < clearest or middle - halfway > halfway - outside:
        return nothing
    unity = seen[seen >= clearest].mean()
    return (log_transmittance - unity).exp().clamp(GRAY_LEVEL, 1).reshape(height, width, 1).to(samples.color)


def _chance(squares: Tensor) -> float:
    """Probability that radial modes have as large a share of these squares [K] if all have one variance (F-test)."""
    others = squares[RADIAL_MODES:].mean()
    ratio = float(squares[:RADIAL_MODES].mean() / others) if others > 0 else 0.0
    return float(fdtrc(RADIAL_MODES, len(squares) - RADIAL_MODES, ratio))


def _ways_out(height: int, width: int, focal_ratio: float, clear: Tensor) -> Tensor:
    """Indices [3] of the pixels in the middle of the frame, halfway out, and the farthest of those that are clear."""
    radius = _places(height, width, focal_ratio).abs().to(clear.device)
    farthest = torch.where(clear, radius, -1).argmax()
    return torch.stack([radius.argmin(), (radius - radius[farthest] / 2).abs().argmin(), farthest])


def _places(height: int, width: int, focal_ratio: float) -> Tensor:
    """Of the pixels, x + i y from the frame's center in units of its longer side, complex128 [h w]. x is divided by the
    ratio of focal lengths, so that the absolute value is proportional to the tangent of the angle to the lens's axis:
    undistorted photos may be stretched."""
    y, x = (torch.arange(side, dtype=torch.float64) + 0.5 - side / 2 for side in (height, width))
    return torch.complex(*torch.broadcast_tensors(x / focal_ratio, y[:, None])).flatten() / max(height, width)


def _modes(height: int, width: int, focal_ratio: float, clear: Tensor) -> Tensor | None:
    """Polynomials of the position [h w, 17], float64, orthonormal over the clear pixels [h w]: r^2 to r^10 and all
    others up to the fourth degree. None where these pixels do not tell them apart, as in tiny frames."""
    z = _places(height, width, focal_ratio)
    squared = z.abs().square()
    turning = [z, z**2, z * squared, z**3, z**2 * squared, z**4]
    radial = [squared**power for power in range(1, RADIAL_MODES + 1)]
    modes = [*radial, *(part for mode in turning for part in (mode.real, mode.imag))]
    stacked = torch.stack(modes, dim=-1)
    stacked -= stacked[clear].mean(dim=0)
    R = torch.linalg.qr(stacked[clear]).R
    scale = R.diagonal().abs()
    if len(R) < len(modes) or scale.min() < 1e-12 * scale.max():
        return None
    return torch.linalg.solve_triangular(R, stacked, upper=True, left=False)


def _regression(samples: PointSamples, modes: Tensor, clear: Tensor) -> Tensor:
    """Coefficients [K] of modes [h w, K] in log I = log C + log g + modes, g of views, with Cauchy's weights, from the
    samples at clear pixels [h w]: at others a patch may be of what is beside, but modes are extrapolated."""
    # Of patches, because a point's own color changes with its distance.
    color = samples.color if samples.patch is None else samples.patch
    brightness, every = color.mean(dim=-1).double(), int(samples.view.max()) // MAX_VIEWS + 1
    usable = clear[samples.pixel] & (brightness < USABLE[1]) & (samples.view % every == 0)
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
