# pyright: reportArgumentType=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false, reportIndexIssue=false
# (Triton's kernels are no Python to a type checker.)
"""MCMC's noise on CUDA, in one kernel. See `noise.perturb`."""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

_BLOCK = 256


def move(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    normals: Tensor,
    rate: float,
    skipped: Tensor | None,
) -> None:
    """`noise.perturb` with normals [N, 3] that are drawn already; all contiguous float32 on the device."""
    n = len(means)
    skips = normals if skipped is None else skipped
    _move[(triton.cdiv(n, _BLOCK),)](
        means, quats, scales, opacities, normals, skips, rate, n, skipped is not None, _BLOCK
    )  # fmt: skip


@triton.jit(do_not_specialize=["n", "skipped"])  # which change: no version of the kernel for each kind of them
def _move(
    means, quats, scales, opacities, normals, skipped, rate, n, GUARDED: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    """mu += rate sigmoid(100 (0.005 - o)) R S^2 R^T eta, without ever writing the covariance down."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < n
    if GUARDED:
        inside = inside & (tl.load(skipped + 0 * i) == 0)
    opacity = tl.sigmoid(tl.load(opacities + i, mask=inside, other=0.0))
    size = rate / (1.0 + tl.exp(100.0 * (opacity - 0.005)))
    w = tl.load(quats + 4 * i, mask=inside, other=1.0)
    x = tl.load(quats + 4 * i + 1, mask=inside, other=0.0)
    y = tl.load(quats + 4 * i + 2, mask=inside, other=0.0)
    z = tl.load(quats + 4 * i + 3, mask=inside, other=0.0)
    two = 2.0 / tl.maximum(w * w + x * x + y * y + z * z, 1e-30)  # a quaternion of zeros turns nothing
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
