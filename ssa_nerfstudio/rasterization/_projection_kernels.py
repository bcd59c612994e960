"""Numba kernels of the `cpu` rasterizer: projection of Gaussians and spherical harmonics, forward and backward.

The formulas are those of `projection.project` (EWA splatting, Zwicker et al. 2002, as in gsplat 1.4.0), chained by
hand: some two hundred small torch operations forward and back take longer than blending the splats does. A thread owns
a contiguous range of Gaussians; a Gaussian's gradients depend on it alone, so results do not depend on the threads.

Gaussians are visited in the order of memory, not of depth: `places` [N] int32 has the rank in depth of each among the V
drawn ones, -1 where it is not drawn.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

C1 = 0.48860251190292
K2, M2, P2, Q2 = 0.5462742152960395, 1.092548430592079, 0.9461746957575601, 0.3153915652525201
A3, B3, C3, S3 = -0.5900435899266435, 1.445305721320277, -2.285228997322329, 0.4570457994644658
D3, E3 = 1.865881662950577, -1.119528997770346
NORM_MIN = 1e-12
"""Vectors shorter than this are divided by it, as torch.nn.functional.normalize does."""


@njit(cache=True, nogil=True, inline="always")
def _rotation(quat, out):
    """Rotation matrix of a quaternion w x y z of any length into out [3, 3]; returns the length divided by."""
    w, x, y, z = float(quat[0]), float(quat[1]), float(quat[2]), float(quat[3])
    norm = max(math.sqrt(w * w + x * x + y * y + z * z), NORM_MIN)
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    out[0, 0] = 1 - 2 * (y * y + z * z)
    out[0, 1] = 2 * (x * y - w * z)
    out[0, 2] = 2 * (x * z + w * y)
    out[1, 0] = 2 * (x * y + w * z)
    out[1, 1] = 1 - 2 * (x * x + z * z)
    out[1, 2] = 2 * (y * z - w * x)
    out[2, 0] = 2 * (x * z - w * y)
    out[2, 1] = 2 * (y * z + w * x)
    out[2, 2] = 1 - 2 * (x * x + y * y)
    return norm


@njit(cache=True, nogil=True, inline="always")
def _limits(K, width, height):
    """Bounds of x / z and y / z within which the projection is linearized: the frame and 15 % beyond each side."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = 0.3 * 0.5 * width / fx, 0.3 * 0.5 * height / fy
    return -(cx / fx + margin_x), (width - cx) / fx + margin_x, -(cy / fy + margin_y), (height - cy) / fy + margin_y


@njit(cache=True, nogil=True, error_model="numpy")
def project_gaussians(
    thread, threads, means, quats, scales, viewmat, K, width, height, near, far, radius_clip, eps2d, geometry, radii
):
    """Fill geometry [N, 6] (center x y, conic xx xy yy, depth) and radii [N], 0 where the Gaussian is not drawn."""
    n = means.shape[0]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    x_min, x_max, y_min, y_max = _limits(K, width, height)
    rotation, axes = np.empty((3, 3)), np.empty((2, 3))
    for i in range(n * thread // threads, n * (thread + 1) // threads):
        radii[i] = 0
        m0, m1, m2 = float(means[i, 0]), float(means[i, 1]), float(means[i, 2])
        z = viewmat[2, 0] * m0 + viewmat[2, 1] * m1 + viewmat[2, 2] * m2 + viewmat[2, 3]
        if not near < z < far:
            continue
        x = viewmat[0, 0] * m0 + viewmat[0, 1] * m1 + viewmat[0, 2] * m2 + viewmat[0, 3]
        y = viewmat[1, 0] * m0 + viewmat[1, 1] * m1 + viewmat[1, 2] * m2 + viewmat[1, 3]
        tx, ty = min(max(x / z, x_min), x_max), min(max(y / z, y_min), y_max)
        _rotation(quats[i], rotation)
        for j in range(3):
            v0 = viewmat[0, 0] * rotation[0, j] + viewmat[0, 1] * rotation[1, j] + viewmat[0, 2] * rotation[2, j]
            v1 = viewmat[1, 0] * rotation[0, j] + viewmat[1, 1] * rotation[1, j] + viewmat[1, 2] * rotation[2, j]
            v2 = viewmat[2, 0] * rotation[0, j] + viewmat[2, 1] * rotation[1, j] + viewmat[2, 2] * rotation[2, j]
            axes[0, j] = fx / z * (v0 - tx * v2) * scales[i, j]
            axes[1, j] = fy / z * (v1 - ty * v2) * scales[i, j]
        a = axes[0, 0] ** 2 + axes[0, 1] ** 2 + axes[0, 2] ** 2 + eps2d
        b = axes[0, 0] * axes[1, 0] + axes[0, 1] * axes[1, 1] + axes[0, 2] * axes[1, 2]
        c = axes[1, 0] ** 2 + axes[1, 1] ** 2 + axes[1, 2] ** 2 + eps2d
        det = max(a * c - b * b, 1e-10)
        middle = 0.5 * (a + c)
        radius = math.ceil(3.0 * math.sqrt(middle + math.sqrt(max(middle * middle - det, 0.01))))
        u, v = fx * x / z + cx, fy * y / z + cy
        if not (radius > radius_clip and u + radius > 0 and u - radius < width):
            continue
        if not (v + radius > 0 and v - radius < height):
            continue
        radii[i] = min(radius, 1 << 30)
        geometry[i, 0] = u
        geometry[i, 1] = v
        geometry[i, 2] = c / det
        geometry[i, 3] = -b / det
        geometry[i, 4] = a / det
        geometry[i, 5] = z


@njit(cache=True, nogil=True, error_model="numpy")
def backpropagate_projection(
    thread,
    threads,
    places,
    means,
    quats,
    scales,
    viewmat,
    K,
    width,
    height,
    eps2d,
    v_splats,
    v_means,
    v_quats,
    v_scales,
):
    """Add to v_means [N, 3], v_quats [N, 4], v_scales [N, 3] what v_splats [V, 6] (as geometry) contributes."""
    n = places.shape[0]
    fx, fy = K[0, 0], K[1, 1]
    x_min, x_max, y_min, y_max = _limits(K, width, height)
    rotation, turned, axes = np.empty((3, 3)), np.empty((3, 3)), np.empty((2, 3))
    v_axes, v_rotation = np.empty((2, 3)), np.empty((3, 3))
    for i in range(n * thread // threads, n * (thread + 1) // threads):
        s = places[i]
        if s < 0:
            continue
        m0, m1, m2 = float(means[i, 0]), float(means[i, 1]), float(means[i, 2])
        x = viewmat[0, 0] * m0 + viewmat[0, 1] * m1 + viewmat[0, 2] * m2 + viewmat[0, 3]
        y = viewmat[1, 0] * m0 + viewmat[1, 1] * m1 + viewmat[1, 2] * m2 + viewmat[1, 3]
        z = viewmat[2, 0] * m0 + viewmat[2, 1] * m1 + viewmat[2, 2] * m2 + viewmat[2, 3]
        tx, ty = min(max(x / z, x_min), x_max), min(max(y / z, y_min), y_max)
        norm = _rotation(quats[i], rotation)
        for j in range(3):
            for k in range(3):
                turned[k, j] = (
                    viewmat[k, 0] * rotation[0, j] + viewmat[k, 1] * rotation[1, j] + viewmat[k, 2] * rotation[2, j]
                )
            axes[0, j] = fx / z * (turned[0, j] - tx * turned[2, j]) * scales[i, j]
            axes[1, j] = fy / z * (turned[1, j] - ty * turned[2, j]) * scales[i, j]
        a = axes[0, 0] ** 2 + axes[0, 1] ** 2 + axes[0, 2] ** 2 + eps2d
        b = axes[0, 0] * axes[1, 0] + axes[0, 1] * axes[1, 1] + axes[0, 2] * axes[1, 2]
        c = axes[1, 0] ** 2 + axes[1, 1] ** 2 + axes[1, 2] ** 2 + eps2d
        det = max(a * c - b * b, 1e-10)
        q0, q1, q2 = c / det, -b / det, a / det
        # The inverse of a symmetric matrix: v_cov = -Q v_Q Q.
        g0, g1, g2 = v_splats[s, 2], 0.5 * v_splats[s, 3], v_splats[s, 4]
        left0, left1 = q0 * g0 + q1 * g1, q0 * g1 + q1 * g2
        right0, right1 = q1 * g0 + q2 * g1, q1 * g1 + q2 * g2
        v_a, v_b, v_c = -(left0 * q0 + left1 * q1), -(left0 * q1 + left1 * q2), -(right0 * q1 + right1 * q2)
        v_x = fx / z * v_splats[s, 0]
        v_y = fy / z * v_splats[s, 1]
        v_z = v_splats[s, 5] - (fx * x * v_splats[s, 0] + fy * y * v_splats[s, 1]) / (z * z)
        v_tx = v_ty = 0.0
        for j in range(3):
            v_axes[0, j] = 2 * (v_a * axes[0, j] + v_b * axes[1, j])
            v_axes[1, j] = 2 * (v_b * axes[0, j] + v_c * axes[1, j])
            # axes = f / z (turned_xy - t turned_z) scale, linear in 1 / z and in t
            v_z -= (v_axes[0, j] * axes[0, j] + v_axes[1, j] * axes[1, j]) / z
            in_x, in_y = v_axes[0, j] * fx / z * scales[i, j], v_axes[1, j] * fy / z * scales[i, j]
            v_tx -= in_x * turned[2, j]
            v_ty -= in_y * turned[2, j]
            in_z = -(in_x * tx + in_y * ty)
            v_scale = 0.0
            for k in range(3):
                v_turned = in_x * viewmat[0, k] + in_y * viewmat[1, k] + in_z * viewmat[2, k]
                v_rotation[k, j] = v_turned
                v_scale += v_turned * rotation[k, j]
            if scales[i, j] != 0:
                v_scales[i, j] += v_scale / scales[i, j]
        if x_min <= x / z <= x_max:
            v_x += v_tx / z
            v_z -= v_tx * x / (z * z)
        if y_min <= y / z <= y_max:
            v_y += v_ty / z
            v_z -= v_ty * y / (z * z)
        for k in range(3):
            v_means[i, k] += viewmat[0, k] * v_x + viewmat[1, k] * v_y + viewmat[2, k] * v_z
        w, qx, qy, qz = quats[i, 0] / norm, quats[i, 1] / norm, quats[i, 2] / norm, quats[i, 3] / norm
        r = v_rotation
        v_w = 2 * (qx * (r[2, 1] - r[1, 2]) + qy * (r[0, 2] - r[2, 0]) + qz * (r[1, 0] - r[0, 1]))
        v_qx = 2 * (
            -2 * qx * (r[1, 1] + r[2, 2])
            + qy * (r[0, 1] + r[1, 0])
            + qz * (r[0, 2] + r[2, 0])
            + w * (r[2, 1] - r[1, 2])
        )
        v_qy = 2 * (
            qx * (r[0, 1] + r[1, 0]) - 2 * qy * (r[0, 0] + r[2, 2]) + qz * (r[1, 2] + r[2, 1]) + w * (r[0, 2] - r[2, 0])
        )
        v_qz = 2 * (
            qx * (r[0, 2] + r[2, 0]) + qy * (r[1, 2] + r[2, 1]) - 2 * qz * (r[0, 0] + r[1, 1]) + w * (r[1, 0] - r[0, 1])
        )
        along = v_w * w + v_qx * qx + v_qy * qy + v_qz * qz
        if norm == NORM_MIN:
            along = 0.0
        v_quats[i, 0] += (v_w - along * w) / norm
        v_quats[i, 1] += (v_qx - along * qx) / norm
        v_quats[i, 2] += (v_qy - along * qy) / norm
        v_quats[i, 3] += (v_qz - along * qz) / norm


@njit(cache=True, nogil=True, inline="always")
def _bases(degree, x, y, z, Y):
    """Real spherical harmonics up to `degree` <= 3 in the direction (x, y, z) of length 1 (Sloan, JCGT 2013)."""
    Y[0] = 0.2820947917738781
    if degree > 0:
        Y[1], Y[2], Y[3] = -C1 * y, C1 * z, -C1 * x
    if degree > 1:
        Y[4], Y[5], Y[6] = 2 * K2 * x * y, -M2 * y * z, P2 * z * z - Q2
        Y[7], Y[8] = -M2 * x * z, K2 * (x * x - y * y)
    if degree > 2:
        line = C3 * z * z + S3
        Y[9], Y[10], Y[11] = A3 * (3 * x * x * y - y * y * y), 2 * B3 * x * y * z, line * y
        Y[12], Y[13] = z * (D3 * z * z + E3), line * x
        Y[14], Y[15] = B3 * z * (x * x - y * y), A3 * (x * x * x - 3 * x * y * y)


@njit(cache=True, nogil=True)
def shade(thread, threads, places, means, center, coefficients, degree, colors):
    """Fill colors [V, 0:3] with max(0, 0.5 + sum_k Y_k c_k) in the direction from the camera's center [3]."""
    n = places.shape[0]
    bases = (degree + 1) ** 2
    Y = np.empty(16)
    for i in range(n * thread // threads, n * (thread + 1) // threads):
        s = places[i]
        if s < 0:
            continue
        x, y, z = means[i, 0] - center[0], means[i, 1] - center[1], means[i, 2] - center[2]
        norm = max(math.sqrt(x * x + y * y + z * z), NORM_MIN)
        _bases(degree, x / norm, y / norm, z / norm, Y)
        r, g, b = 0.5, 0.5, 0.5
        for k in range(bases):
            r += Y[k] * coefficients[i, k, 0]
            g += Y[k] * coefficients[i, k, 1]
            b += Y[k] * coefficients[i, k, 2]
        colors[s, 0], colors[s, 1], colors[s, 2] = max(r, 0.0), max(g, 0.0), max(b, 0.0)


@njit(cache=True, nogil=True)
def backpropagate_shading(
    thread, threads, places, means, center, coefficients, degree, colors, v_colors, v_means, v_coefficients
):
    """Add to v_means [N, 3] what v_colors [V, 0:3] contributes, none where clamped; write v_coefficients [N, K, 3]."""
    n = places.shape[0]
    bases = (degree + 1) ** 2
    Y, dot = np.empty(16), np.zeros(16)
    for i in range(n * thread // threads, n * (thread + 1) // threads):
        s = places[i]
        if s < 0:
            continue
        x, y, z = means[i, 0] - center[0], means[i, 1] - center[1], means[i, 2] - center[2]
        norm = max(math.sqrt(x * x + y * y + z * z), NORM_MIN)
        x, y, z = x / norm, y / norm, z / norm
        _bases(degree, x, y, z, Y)
        r = float(v_colors[s, 0]) if colors[s, 0] > 0 else 0.0
        g = float(v_colors[s, 1]) if colors[s, 1] > 0 else 0.0
        b = float(v_colors[s, 2]) if colors[s, 2] > 0 else 0.0
        for k in range(bases):
            v_coefficients[i, k, 0], v_coefficients[i, k, 1], v_coefficients[i, k, 2] = Y[k] * r, Y[k] * g, Y[k] * b
            dot[k] = coefficients[i, k, 0] * r + coefficients[i, k, 1] * g + coefficients[i, k, 2] * b
        if degree == 0:
            continue
        v_x = -C1 * dot[3]
        v_y = -C1 * dot[1]
        v_z = C1 * dot[2]
        if degree > 1:
            v_x += 2 * K2 * (y * dot[4] + x * dot[8]) - M2 * z * dot[7]
            v_y += 2 * K2 * (x * dot[4] - y * dot[8]) - M2 * z * dot[5]
            v_z += -M2 * (y * dot[5] + x * dot[7]) + 2 * P2 * z * dot[6]
        if degree > 2:
            line, slope, square = C3 * z * z + S3, 2 * C3 * z, x * x - y * y
            v_x += 6 * A3 * x * y * dot[9] + 2 * B3 * z * (y * dot[10] + x * dot[14]) + line * dot[13]
            v_x += 3 * A3 * square * dot[15]
            v_y += 3 * A3 * square * dot[9] + 2 * B3 * z * (x * dot[10] - y * dot[14]) + line * dot[11]
            v_y -= 6 * A3 * x * y * dot[15]
            v_z += 2 * B3 * x * y * dot[10] + slope * (y * dot[11] + x * dot[13]) + B3 * square * dot[14]
            v_z += (3 * D3 * z * z + E3) * dot[12]
        along = v_x * x + v_y * y + v_z * z
        if norm == NORM_MIN:
            along = 0.0
        v_means[i, 0] += (v_x - along * x) / norm
        v_means[i, 1] += (v_y - along * y) / norm
        v_means[i, 2] += (v_z - along * z) / norm
