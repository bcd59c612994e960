"""exp(x) for x <= 0 inside numba loops over pixels, in a form that LLVM vectorizes in float32."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types
from numba.extending import overload

_f32 = np.float32
LOWEST, LOG2_E, ROUND = _f32(-87.0), _f32(1.4426950408889634), _f32(1.5 * 2**23)
LN2_HIGH, LN2_LOW = _f32(0.693359375), _f32(-2.12194440e-4)
C2, C3, C4 = _f32(5.0000001201e-1), _f32(1.6666665459e-1), _f32(4.1665795894e-2)
C5, C6, C7 = _f32(8.3334519073e-3), _f32(1.3981999507e-3), _f32(1.9875691500e-4)
ONE, MANTISSA = _f32(1.0), np.int32(23)


def exp_negative(x):
    """exp(x), x <= 0: in float64 libm's; in float32 within 1e-7 of it, relatively, and e^-87 below -87.

    x = n ln 2 + f, |f| <= ln 2 / 2: a polynomial in f (Cephes' `expf`), and n added to the exponent's bits.
    """
    raise NotImplementedError("called by numba kernels only")


@njit(cache=True, fastmath={"contract"})
def _exp_float32(x):
    x = max(x, LOWEST)
    shifted = x * LOG2_E + ROUND  # the integer nearest to x / ln 2, in the lowest bits of the mantissa
    n = shifted - ROUND
    f = x - n * LN2_HIGH - n * LN2_LOW
    power = ((((C7 * f + C6) * f + C5) * f + C4) * f + C3) * f + C2
    power = power * f * f + f + ONE
    return np.int32(_f32(power).view(np.int32) + (_f32(shifted).view(np.int32) << MANTISSA)).view(_f32)


@overload(exp_negative, inline="never")
def _select(x):
    if x == types.float32:
        return lambda x: _exp_float32(x)
    return lambda x: math.exp(x)
