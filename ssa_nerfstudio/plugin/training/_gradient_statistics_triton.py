# pyright: reportArgumentType=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false, reportIndexIssue=false
# (Triton's kernels are no Python to a type checker.)
"""`gradient_statistics.GradientStatistics.add` on CUDA, in one kernel."""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

_BLOCK = 256


def add_view(
    gradients: Tensor,
    counts: Tensor,
    largest: Tensor | None,
    of_view: Tensor,
    radii: Tensor,
    taken: Tensor | None,
    half: float,
    aspect: float,
    share: float,
) -> None:
    """Add a view to the sums [N], given its gradients [N, 2] and radii [N]; all contiguous on the device.

    Args:
        half: factor of the gradients.
        aspect: factor of their second component.
        share: factor of the radii.
    """
    n = len(radii)
    _add[(triton.cdiv(n, _BLOCK),)](
        gradients,
        counts,
        counts if largest is None else largest,  # any pointer, where it is not read
        of_view,
        radii,
        counts if taken is None else taken,
        half,
        aspect,
        share,
        n,
        largest is not None,
        taken is not None,
        _BLOCK,
    )


@triton.jit(do_not_specialize=["n", "taken"])  # both change: one compilation for all of their values
def _add(
    gradients, counts, largest, of_view, radii, taken, half, aspect, share, n,
    SIZES: tl.constexpr, GUARDED: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < n
    radius = tl.load(radii + i, mask=inside, other=0)
    visible = inside & (radius > 0)
    if GUARDED:
        visible = visible & (tl.load(taken + 0 * i) != 0)
    x = tl.abs(tl.load(of_view + 2 * i, mask=visible, other=0.0))
    y = tl.abs(aspect * tl.load(of_view + 2 * i + 1, mask=visible, other=0.0))
    # As hypot: squares of small gradients would be 0.
    larger = tl.maximum(tl.maximum(x, y), 1e-37)
    ratio = tl.minimum(x, y) / larger
    total = x + y  # NaN where one of them is: tl.maximum may drop it
    norm = tl.where(total > 0, larger * tl.sqrt(1.0 + ratio * ratio), total)
    tl.store(gradients + i, tl.load(gradients + i, mask=visible, other=0.0) + half * norm, mask=visible)
    tl.store(counts + i, tl.load(counts + i, mask=visible, other=0.0) + 1.0, mask=visible)
    if SIZES:
        before = tl.load(largest + i, mask=visible, other=0.0)
        tl.store(largest + i, tl.maximum(before, share * radius.to(tl.float32)), mask=visible)
