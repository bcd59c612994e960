"""Falloff of light from the middle of the frame to its corners (vignetting), from the scene's points.

A point has one color in all photos, so where log I changes with its pixel, something in front changes. A lens darkens
by the angle to its axis alone, which is taken to be in the frame's center, and a photo editor by the distance from the
center in units of the frame's sides. Shading, reflections and other artifacts have no reason to do either: what of the
same smoothness is not radial says how much of the radial part may be theirs. docs/method.md derives it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from scipy.special import fdtrc, stdtrit
from torch import Tensor

from ssa_nerfstudio.evidence.layer_estimate import CLEAR_SHARE, OUTLIER_SCALE, robust_deviation
from ssa_nerfstudio.evidence.null_distribution import SIGNIFICANCE
from ssa_nerfstudio.evidence.photo_exposure import DAMPING, ROUNDS, USABLE
from ssa_nerfstudio.evidence.point_samples import PointSamples, summed
from ssa_nerfstudio.evidence.statistics import GRAY_LEVEL

MAX_SAMPLES = 20_000
"""Of more, those of a regular subset of the points are used: a falloff has five or six parameters."""
MAX_VIEWS = 128
"""Of more, a regular subset is used."""
RADIAL_MODES = 5
"""r^2 to r^10. A photo editor's falloff may have one mode more, which makes it squarer."""


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
    observed = _observed(samples, clear)
    if observed is None:
        return nothing
    # Round in front of the lens, or as wide and as high as the frame.
    tests = [_test(observed, stretch) for stretch in dict.fromkeys((samples.focal_ratio, width / height))]
    likeliest = min((test for test in tests if test is not None), key=lambda test: test.chance, default=None)
    # Bonferroni's correction: that one of two is significant is twice as likely.
    if likeliest is None or len(tests) * likeliest.chance >= SIGNIFICANCE:
        return nothing
    log_transmittance = likeliest.log_transmittance(observed)
    if log_transmittance is None:
        return nothing
    return log_transmittance.exp().clamp(GRAY_LEVEL, 1).reshape(height, width, 1).to(samples.color)


@dataclass(frozen=True)
class _Observed:
    """What regressions use of the samples: those at clear pixels. At others a patch may be of what is beside."""

    size: tuple[int, int]
    clear: Tensor
    """Pixels that show the scene, bool [h w]."""
    pixel: Tensor
    """Of the samples, [S]."""
    point: Tensor
    """[S], of those that are observed, which are numbered anew."""
    points: int
    shown_by: Tensor
    """[S, V]: 1 for a sample's view."""
    log_brightness: Tensor
    """log I of the samples, [S, 1]."""


@dataclass(frozen=True)
class _Test:
    """Whether log I changes with the modes of a falloff more than with others of the same smoothness."""

    modes: Tensor
    """Of the falloff, [h w, K], orthonormal over the clear pixels."""
    places: Tensor
    """Of the pixels, see `_places`."""
    chance: float
    """Probability of as large a ratio of mean squares if all coefficients have one variance (F-test)."""
    error: Tensor
    """Standard error of a coefficient []: root mean square of the other modes'."""
    freedom: int
    """Number of the other modes."""

    def log_transmittance(self, observed: _Observed) -> Tensor | None:
        """Fit the modes by themselves: [h w], 0 on the mean of the clearest of the clear pixels.

        In a capture whose points move along few paths, the other modes take part of the falloff.

        Returns:
            None unless it darkens from the middle outwards, and the farther out the faster. A logo in the middle does
            not: outside of it nothing changes any more.
        """
        clear, coefficients = observed.clear, _regression(observed, self.modes)
        fitted = self.modes @ coefficients
        seen = fitted[clear]
        # Where nothing is seen the modes may be anything.
        fitted = fitted.clamp(seen.min(), seen.max())
        rank = max(1, round((1 - CLEAR_SHARE) * len(seen)))
        least_clear = clear.nonzero()[seen.kthvalue(rank).indices, 0]
        farthest = torch.where(clear, self.places.abs(), -1).argmax()
        middle, halfway = self.places.abs().argmin(), (self.places - self.places[farthest] / 2).abs().argmin()
        # A flat middle is never quite flat: by chance, and as polynomials of a finite degree ripple. What r^10 adds is
        # about what higher powers would.
        ways = self.modes[middle] - self.modes[least_clear]
        by_chance = float(stdtrit(self.freedom, 1 - SIGNIFICANCE)) * self.error * ways.norm()
        by_degree = coefficients[RADIAL_MODES - 1] * ways[RADIAL_MODES - 1]
        darker = fitted[least_clear] - fitted[middle] > torch.hypot(by_chance, by_degree)
        faster = fitted[farthest] < 2 * fitted[halfway] - fitted[middle]
        return fitted - seen[seen >= fitted[least_clear]].mean() if faster & ~darker else None


def _test(observed: _Observed, stretch: float) -> _Test | None:
    """Test the modes that are radial where x is divided by `stretch`; None where clear pixels do not tell them apart.

    As wide and as high as the frame, a falloff may be squarer than an ellipse. What changes with the corners as much as
    with the radius, and so is less square, is none: four panels in the corners.
    """
    height, width = observed.size
    places = _places(height, width, stretch)
    modes = _modes(places, observed.clear)
    if modes is None:
        return None
    coefficients = _regression(observed, modes)
    squarer = stretch == width / height and bool(coefficients[RADIAL_MODES] < 0)
    count = RADIAL_MODES + 1 if squarer else RADIAL_MODES
    chance = _chance(coefficients[:count], coefficients[count:])
    if not squarer and coefficients[RADIAL_MODES] > coefficients[:count].square().mean().sqrt():
        chance = 1.0
    error, freedom = coefficients[count:].square().mean().sqrt(), len(coefficients) - count
    return _Test(modes[:, :count], places.to(modes.device), chance, error, freedom)


def _chance(those: Tensor, others: Tensor) -> float:
    """Probability of as large a ratio of mean squares of coefficients if all have one variance (F-test)."""
    variance = others.square().mean().clamp_min(torch.finfo(others.dtype).tiny)
    return float(fdtrc(len(those), len(others), float(those.square().mean() / variance)))


def _places(height: int, width: int, stretch: float) -> Tensor:
    """Of the pixels, x / stretch + i y from the frame's center in units of its longer side, complex128 [h w].

    With the ratio of focal lengths for a stretch, the absolute value is proportional to the tangent of the angle to the
    lens's axis: undistorted photos may be stretched. With the frame's, it is the same in the middles of all its sides.
    """
    y, x = (torch.arange(side, dtype=torch.float64) + 0.5 - side / 2 for side in (height, width))
    return torch.complex(*torch.broadcast_tensors(x / stretch, y[:, None])).flatten() / max(height, width)


def _modes(z: Tensor, clear: Tensor) -> Tensor | None:
    """Polynomials [h w, 17] of places [h w], float64, orthonormal over the clear pixels [h w]: r^2 to r^10, r^4 times
    the cosine of four times the angle, and all others up to the fourth degree. None where these pixels do not tell them
    apart, as in tiny frames."""
    squared, seen = z.abs().square(), clear.cpu()
    radial = [squared**power for power in range(1, RADIAL_MODES + 1)]
    turning = [part for mode in (z, z**2, z * squared, z**3, z**2 * squared) for part in (mode.real, mode.imag)]
    stacked = torch.stack([*radial, (z**4).real, (z**4).imag, *turning], dim=-1)
    stacked -= stacked[seen].mean(dim=0)
    R = torch.linalg.qr(stacked[seen]).R
    scale = R.diagonal()
    if len(R) < stacked.shape[1] or scale.abs().min() < 1e-12 * scale.abs().max():
        return None
    modes = torch.linalg.solve_triangular(R, stacked, upper=True, left=False)
    return (modes * scale.sign()).to(clear.device)  # of the polynomials' own sign


def _observed(samples: PointSamples, clear: Tensor) -> _Observed | None:
    """Those of the samples that are used, given the clear pixels [h w]; None where none is."""
    # Of patches, because a point's own color changes with its distance.
    color = samples.color if samples.patch is None else samples.patch
    brightness, every = color.mean(dim=-1).double(), int(samples.view.max()) // MAX_VIEWS + 1
    usable = clear[samples.pixel] & (brightness < USABLE[1]) & (samples.view % every == 0)
    usable &= samples.point % (int(usable.sum()) // MAX_SAMPLES + 1) == 0
    if not usable.any():
        return None
    known, point = samples.point[usable].unique(return_inverse=True)
    shown_by = torch.nn.functional.one_hot(samples.view[usable] // every).double()
    log_brightness = brightness[usable].clamp_min(GRAY_LEVEL).log()[:, None]
    return _Observed(samples.size, clear, samples.pixel[usable], point, len(known), shown_by, log_brightness)


def _regression(observed: _Observed, modes: Tensor) -> Tensor:
    """Coefficients [K] of modes [h w, K] in log I = log C + log g + modes, g of views, with Cauchy's weights."""
    point, points, values = observed.point, observed.points, observed.log_brightness
    columns = torch.cat([modes[observed.pixel], observed.shown_by], dim=-1)
    # The modes only need to be regular; gains are taken for none where nothing is known of them.
    damping = torch.full(columns.shape[1:], DAMPING, dtype=columns.dtype, device=columns.device)
    damping[: modes.shape[1]] = 1e-9
    weight, solution = torch.ones_like(values), torch.zeros_like(damping)
    for _ in range(ROUNDS):
        total = summed(point, weight, points)
        centered = columns - (summed(point, weight * columns, points) / total)[point]
        rest = values - (summed(point, weight * values, points) / total)[point]
        weighted = weight * centered
        solution = torch.linalg.solve(weighted.T @ centered + damping.diag(), weighted.T @ rest)
        rest -= centered @ solution
        weight = 1 / (1 + (rest / (OUTLIER_SCALE * robust_deviation(rest))).square())
    return solution.flatten()[: modes.shape[1]]
