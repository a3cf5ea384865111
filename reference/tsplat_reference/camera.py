"""Camera models: camera-space points to pixels, with the Jacobian that EWA splatting needs, and the backward of both.

A model maps a camera-space point p = (x, y, z) to the pixel (u, v). Everything is in planes (see planes.py): x, y, z are `[C, N]`, the
intrinsics (fx, fy, cx, cy) `[C, 1]`, and the Jacobian J = d(u, v)/dp is a 2 x 3 matrix of planes.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tsplat_reference.constants import FRUSTUM_MARGIN
from tsplat_reference.planes import Matrix, Plane

Intrinsics = tuple[Tensor, Tensor, Tensor, Tensor]
Point = tuple[Tensor, Tensor, Tensor]

SERIES_BELOW = 0.05     # (r/z)^2 under which the fisheye uses its power series: 12 terms leave 1e-15
SERIES_TERMS = 12


def camera_centers(viewmats: Tensor) -> Tensor:
    """World positions `[..., 3]` of the cameras: -R^T t for world-to-camera matrices `[..., 4, 4]`."""
    return -(viewmats[..., :3, :3] * viewmats[..., :3, 3:]).sum(-2)                         # no `@`: autocast would round it


def split_intrinsics(Ks: Tensor) -> Intrinsics:
    """(fx, fy, cx, cy), each `[C, 1]`, of matrices `[C, 3, 3]`."""
    return Ks[:, 0, 0, None], Ks[:, 1, 1, None], Ks[:, 0, 2, None], Ks[:, 1, 2, None]


def join_intrinsics(v_fx: Tensor, v_fy: Tensor, v_cx: Tensor, v_cy: Tensor) -> Tensor:
    """Gradients with respect to (fx, fy, cx, cy), each `[C, N]`, to that of the matrices `[C, 3, 3]`."""
    v_fx, v_fy, v_cx, v_cy = (v.sum(1) for v in (v_fx, v_fy, v_cx, v_cy))
    zero = torch.zeros_like(v_fx)
    return torch.stack([v_fx, zero, v_cx, zero, v_fy, v_cy, zero, zero, zero], -1).view(-1, 3, 3)


def project_points(p: Point, intrinsics: Intrinsics, width: int, height: int, model: str) -> tuple[Tensor, Tensor, Matrix]:
    """Pixels u, v `[C, N]` and the Jacobian at camera-space points with z > 0 (any z for the orthographic model)."""
    x, y, z = p
    fx, fy, cx, cy = intrinsics
    if model == "pinhole":
        (u, ux, uz), (v, vy, vz) = _pinhole_axis(x, z, fx, cx, width), _pinhole_axis(y, z, fy, cy, height)
        return u, v, [[ux, 0.0, uz], [0.0, vy, vz]]
    if model == "orthographic":
        return fx * x + cx, fy * y + cy, [[fx.expand_as(x), 0.0, 0.0], [0.0, fy.expand_as(y), 0.0]]
    s, k, _, w = _fisheye_terms(x, y, z)
    xy_k = x * y * k
    return fx * x * s + cx, fy * y * s + cy, [[fx * (s + x * x * k), fx * xy_k, -fx * x * w],
                                              [fy * xy_k, fy * (s + y * y * k), -fy * y * w]]


def project_points_backward(p: Point, intrinsics: Intrinsics, width: int, height: int, model: str, v_u: Tensor, v_v: Tensor, v_J: Matrix
                            ) -> tuple[list[Plane], Tensor]:
    """Gradients with respect to x, y, z and to the intrinsics, these as matrices `[C, 3, 3]`."""
    x, y, z = p
    fx, fy, cx, cy = intrinsics
    (v_ux, v_uy, v_uz), (v_vx, v_vy, v_vz) = v_J
    if model == "pinhole":
        v_x, v_z0, v_fx, v_cx = _pinhole_axis_backward(x, z, fx, cx, width, v_u, v_ux, v_uz)
        v_y, v_z1, v_fy, v_cy = _pinhole_axis_backward(y, z, fy, cy, height, v_v, v_vy, v_vz)
        return [v_x, v_y, v_z0 + v_z1], join_intrinsics(v_fx, v_fy, v_cx, v_cy)
    if model == "orthographic":
        return [fx * v_u, fy * v_v, 0.0], join_intrinsics(v_u * x + v_ux, v_v * y + v_vy, v_u, v_v)
    s, k, m, w = _fisheye_terms(x, y, z)
    xx, xy, yy = x * x, x * y, y * y
    v_fx = v_u * x * s + v_ux * (s + xx * k) + v_uy * xy * k - v_uz * x * w
    v_fy = v_v * y * s + v_vy * (s + yy * k) + v_vx * xy * k - v_vz * y * w
    a, b, c, d, e, f, g, h = fx * v_u, fx * v_ux, fx * v_uy, fx * v_uz, fy * v_v, fy * v_vy, fy * v_vx, fy * v_vz
    v_s = a * x + b + e * y + f
    v_k = b * xx + (c + g) * xy + f * yy
    v_w = -d * x - h * y
    # ds = k (x dx + y dy) - w dz,  dk = m (x dx + y dy) + 2 w^2 dz,  dw = -2 w^2 (x dx + y dy + z dz)
    radial = v_s * k + v_k * m - 2 * v_w * w * w
    v_x = a * s + 2 * b * x * k + (c + g) * y * k - d * w + radial * x
    v_y = e * s + 2 * f * y * k + (c + g) * x * k - h * w + radial * y
    v_z = -v_s * w + 2 * v_k * w * w - 2 * v_w * w * w * z
    return [v_x, v_y, v_z], join_intrinsics(v_fx, v_fy, v_u, v_v)


def _frustum(f: Tensor, c: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """The range of x/z to which the pinhole Jacobian clamps: the frustum, widened on each side."""
    margin = FRUSTUM_MARGIN * 0.5 * size
    return -(c + margin) / f, (size - c + margin) / f


def _pinhole_axis(x: Tensor, z: Tensor, f: Tensor, c: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """U = f x/z + c, du/dx = f/z and du/dz = -f clamp(x/z)/z."""
    low, high = _frustum(f, c, size)
    t = x / z
    f_z = f / z
    return f * t + c, f_z, -f_z * torch.minimum(torch.maximum(t, low), high)


def _pinhole_axis_backward(x: Tensor, z: Tensor, f: Tensor, c: Tensor, size: int, v_u: Tensor, v_jx: Plane, v_jz: Plane
                           ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Gradients with respect to x, z, f and c; the clamp passes its gradient on to the intrinsics that set the frustum."""
    low, high = _frustum(f, c, size)
    t = x / z
    f_z = f / z
    clamped = torch.minimum(torch.maximum(t, low), high)
    v_clamped = -f_z * v_jz
    v_limit = torch.where(t != clamped, v_clamped, 0.0)
    v_t = f * v_u + v_clamped - v_limit
    v_f_z = v_jx - clamped * v_jz
    # low = -(c + margin)/f, high = (size - c + margin)/f: d/df = -limit/f, d/dc = -1/f
    v_f = v_u * t + v_f_z / z - v_limit * clamped / f
    return v_t / z, -(v_t * t + v_f_z * f_z) / z, v_f, v_u - v_limit / f


def _fisheye_terms(x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """S = theta/r, k = (ds/dr)/r, m = (dk/dr)/r and w = 1/(r^2 + z^2), with r^2 = x^2 + y^2 and theta = atan2(r, z).

    The equidistant fisheye is u = fx x s + cx. Towards the axis the closed forms cancel, so there the series in (r/z)^2 serves.
    """
    r2 = x * x + y * y
    near_axis = (r2 < SERIES_BELOW * z * z) & (z > 0)
    far_r2 = torch.where(near_axis, torch.ones_like(r2), r2)
    far_z = torch.where(near_axis, torch.zeros_like(z), z)
    far_w = 1 / (far_r2 + far_z * far_z)
    r = far_r2.sqrt()
    far_s = torch.atan2(r, far_z) / r
    far_k = (far_z * far_w - far_s) / far_r2
    far_m = (-2 * far_z * far_w * far_w - 3 * far_k) / far_r2

    safe_z = torch.where(near_axis, z, torch.ones_like(z))
    iz2 = 1 / (safe_z * safe_z)
    t = torch.where(near_axis, r2, torch.zeros_like(r2)) * iz2
    s, k, m = torch.zeros_like(t), torch.zeros_like(t), torch.zeros_like(t)
    for n in reversed(range(SERIES_TERMS)):                  # theta/r = (1/z) sum (-1)^n t^n / (2n + 1), and its derivatives
        sign = (-1) ** n
        s = s * t + sign / (2 * n + 1)
        k = k * t - sign * 2 * (n + 1) / (2 * n + 3)
        m = m * t + sign * 4 * (n + 1) * (n + 2) / (2 * n + 5)
    s, k, m = s / safe_z, k * iz2 / safe_z, m * iz2 * iz2 / safe_z
    return (torch.where(near_axis, s, far_s), torch.where(near_axis, k, far_k), torch.where(near_axis, m, far_m),
            1 / (r2 + z * z))
