# pyright: reportArgumentType=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false, reportIndexIssue=false
# (Triton's kernels are no Python to a type checker.)
"""`langevin_noise.perturb` on CUDA, in one kernel."""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

_BLOCK = 256


def perturb_means(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    normals: Tensor,
    rate: float,
    scale: Tensor | None,
) -> None:
    """`langevin_noise.perturb` with given normals [N, 3]; all contiguous float32 on the device."""
    n = len(means)
    factor = normals if scale is None else scale  # any pointer, where it is not read
    _perturb[(triton.cdiv(n, _BLOCK),)](
        means, quats, scales, opacities, normals, factor, rate, n, scale is not None, _BLOCK
    )  # fmt: skip


@triton.jit(do_not_specialize=["n", "factor"])  # both change: one compilation for all of their values
def _perturb(
    means, quats, scales, opacities, normals, factor, rate, n, SCALED: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    """mu += rate sigmoid(100 (0.005 - o)) R S^2 R^T eta, without storing the covariance."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < n
    amplitude = rate
    if SCALED:
        scale = tl.load(factor + 0 * i)
        inside = inside & (scale != 0)  # a scale of 0 changes nothing, whatever the Gaussian holds
        amplitude = rate * scale
    opacity = tl.sigmoid(tl.load(opacities + i, mask=inside, other=0.0))
    size = amplitude / (1.0 + tl.exp(100.0 * (opacity - 0.005)))
    w = tl.load(quats + 4 * i, mask=inside, other=1.0)
    x = tl.load(quats + 4 * i + 1, mask=inside, other=0.0)
    y = tl.load(quats + 4 * i + 2, mask=inside, other=0.0)
    z = tl.load(quats + 4 * i + 3, mask=inside, other=0.0)
    two = 2.0 / tl.maximum(w * w + x * x + y * y + z * z, 1e-30)  # a zero quaternion rotates nothing
    xx, xy, xz = 1.0 - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)
    yx, yy, yz = two * (x * y + w * z), 1.0 - two * (x * x + z * z), two * (y * z - w * x)
    zx, zy, zz = two * (x * z - w * y), two * (y * z + w * x), 1.0 - two * (x * x + y * y)
    a = tl.load(normals + 3 * i, mask=inside, other=0.0)
    b = tl.load(normals + 3 * i + 1, mask=inside, other=0.0)
    c = tl.load(normals + 3 * i + 2, mask=inside, other=0.0)
    p = size * tl.exp(2.0 * tl.load(scales + 3 * i, mask=inside, other=0.0)) * (xx * a + yx * b + zx * c)
    q = size * tl.exp(2.0 * tl.load(scales + 3 * i + 1, mask=inside, other=0.0)) * (xy * a + yy * b + zy * c)
    r = size * tl.exp(2.0 * tl.load(scales + 3 * i + 2, mask=inside, other=0.0)) * (xz * a + yz * b + zz * c)
    at = means + 3 * i
    tl.store(at, tl.load(at, mask=inside, other=0.0) + xx * p + xy * q + xz * r, mask=inside)
    tl.store(at + 1, tl.load(at + 1, mask=inside, other=0.0) + yx * p + yy * q + yz * r, mask=inside)
    tl.store(at + 2, tl.load(at + 2, mask=inside, other=0.0) + zx * p + zy * q + zz * r, mask=inside)
