"""Projection of Gaussians to 2D splats: a thread per pair of camera and splat; its backward: a thread per splat, a loop over the cameras.

The twin of `tsplat_reference.projection`. A covariance given as quaternion and scales is never formed, as float32 would lose needles: with
F = R S, Sigma' = T T^T for T = J W F. Its determinant is then |T0 x T1|^2, and that of Sigma' + eps2d I is det + eps2d (trace + eps2d).
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor
from tsplat_reference.constants import ALPHA_MIN, COMPENSATION_MIN, FRUSTUM_MARGIN, LARGEST

from tsplat.kernels.camera import (
    dot,
    load_camera,
    load_row,
    or_ahead,
    project_point,
    project_point_backward,
    stack,
    store_row,
    to_camera,
    transform,
    transform_transposed,
)
from tsplat.kernels.launch import Launcher, ceil_div, launch

SUMS = 16
"""Camera gradients of a block of splats: the rows of W | t, then fx, fy, cx, cy."""


@triton.jit
def largest(v):
    """The largest of |v|, NaN if any is.

    So there is one comparison for all, and no predicate for each, which LLVM would pack into a vector and take through the stack.
    """
    result = tl.abs(v[0])
    for i in tl.static_range(1, len(v)):
        result = tl.maximum(result, tl.abs(v[i]), propagate_nan=tl.PropagateNan.ALL)
    return result


@triton.jit
def square(quat):
    """Squared norm."""
    return quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3]


@triton.jit
def rotation(quat):
    """The rotation of a quaternion (w, x, y, z), its unit and 1/norm."""
    inverse = 1.0 / tl.sqrt(square(quat))
    w = quat[0] * inverse
    x = quat[1] * inverse
    y = quat[2] * inverse
    z = quat[3] * inverse
    R = ((1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
         (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
         (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)))
    return R, (w, x, y, z), inverse


@triton.jit
def scale_columns(A, s):
    """A diag(s)."""
    return ((A[0][0] * s[0], A[0][1] * s[1], A[0][2] * s[2]), (A[1][0] * s[0], A[1][1] * s[1], A[1][2] * s[2]),
            (A[2][0] * s[0], A[2][1] * s[1], A[2][2] * s[2]))


@triton.jit
def dot_columns(A, B, j: tl.constexpr):
    """Inner product of the columns j of two 3 x 3 matrices."""
    return A[0][j] * B[0][j] + A[1][j] * B[1][j] + A[2][j] * B[2][j]


@triton.jit
def factor_backward(quat, scale, v_F):
    """Gradients of F = R S with respect to the raw quaternion and the scales."""
    R, unit, inverse = rotation(quat)
    v_scale = (dot_columns(v_F, R, 0), dot_columns(v_F, R, 1), dot_columns(v_F, R, 2))
    r0, r1, r2 = scale_columns(v_F, scale)
    w, x, y, z = unit
    v_w = 2.0 * (x * (r2[1] - r1[2]) + y * (r0[2] - r2[0]) + z * (r1[0] - r0[1]))
    v_x = 2.0 * (-2.0 * x * (r1[1] + r2[2]) + y * (r0[1] + r1[0]) + z * (r0[2] + r2[0]) + w * (r2[1] - r1[2]))
    v_y = 2.0 * (x * (r0[1] + r1[0]) - 2.0 * y * (r0[0] + r2[2]) + z * (r1[2] + r2[1]) + w * (r0[2] - r2[0]))
    v_z = 2.0 * (x * (r0[2] + r2[0]) + y * (r1[2] + r2[1]) - 2.0 * z * (r0[0] + r1[1]) + w * (r1[0] - r0[1]))
    along = w * v_w + x * v_x + y * v_y + z * v_z
    return ((v_w - w * along) * inverse, (v_x - x * along) * inverse, (v_y - y * along) * inverse, (v_z - z * along) * inverse), v_scale


@triton.jit
def load_quat(quats, n, wanted):
    """Quaternions; (1, 1, 1, 1) where not wanted."""
    return load_row(quats + n * 4, wanted, 4, 4, 1.0)


@triton.jit
def load_shape(quats, scales, covars, n, wanted, LARGEST: tl.constexpr):
    """F with Sigma = F F^T, or Sigma itself if it is given; and whether that is sane: finite, not huge, a rotation, an extent."""
    if covars is not None:
        s = load_row(covars + n * 9, wanted, 9, 1)
        return (s[0:3], s[3:6], s[6:9]), (largest(s) < LARGEST * LARGEST) & (tl.maximum(tl.maximum(s[0], s[4]), s[8]) > 0)
    else:
        quat = load_quat(quats, n, wanted)
        scale = load_row(scales + n * 3, wanted, 3, 1)
        extent = largest(scale)
        sane = (largest(quat) < LARGEST) & (square(quat) > 0) & (extent < LARGEST) & (extent > 0)
        return scale_columns(rotation(quat)[0], scale), sane


@triton.jit
def cross(a, b):
    """Vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@triton.jit
def covariance2d(M, F, HAS_COVARS: tl.constexpr):
    """T = M F, then xx, xy, yy and the determinant of Sigma' = M Sigma M^T (3DGS, equation 5) without blur."""
    T0 = transform_transposed(F, M[0])
    T1 = transform_transposed(F, M[1])
    if HAS_COVARS:
        a = dot(T0, M[0])
        b = dot(T0, M[1])
        c = dot(T1, M[1])
        return T0, T1, a, b, c, a * c - b * b
    else:
        normal = cross(T0, T1)
        return T0, T1, dot(T0, T0), dot(T0, T1), dot(T1, T1), dot(normal, normal)


@triton.jit
def compensation(ratio, FLOOR: tl.constexpr):
    """Root of the ratio of the determinants, FLOOR at the least."""
    return tl.sqrt(tl.where(ratio > FLOOR * FLOOR, ratio, FLOOR * FLOOR))


@triton.jit
def half_size(extent, variance):
    """ceil(extent sigma) in pixels, 2^30 at the most."""
    return tl.minimum(tl.ceil(extent * tl.sqrt(tl.where(variance < 1e18, variance, 1e18))), 1073741824.0)


@Launcher
@triton.jit(do_not_specialize=["N", "C", "width", "height"])
def project_fwd_kernel(means, quats, scales, covars, opacities, viewmats, Ks, radii, means2d, depths, conics, compensations, N, C, width,
                       height, near: tl.float64, far: tl.float64, eps2d: tl.float64, MODEL: tl.constexpr, ANTIALIASED: tl.constexpr,
                       MARGIN: tl.constexpr, FLOOR: tl.constexpr, ALPHA_MIN: tl.constexpr, LARGEST: tl.constexpr,
                       BLOCK: tl.constexpr):
    """One camera and one block of splats; the cameras of a block are neighbours, which find its splats in the cache."""
    camera = (tl.program_id(0) % C).to(tl.int64)
    n = (tl.program_id(0) // C).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = n < N
    dt: tl.constexpr = means.dtype.element_ty
    eps = tl.full((), eps2d, dt)
    W, t, intrinsics = load_camera(viewmats, Ks, camera)
    mean = load_row(means + n * 3, inside, 3, 1)
    p = to_camera(mean, W, t)
    valid = inside & (largest(mean) < LARGEST) & (p[2] > tl.full((), near, dt)) & (p[2] < tl.full((), far, dt))
    if MODEL != "orthographic":
        valid &= p[2] > 0
    opacity = tl.load(opacities + n, mask=valid, other=0.0)                                 # not even read if culled by depth
    F, sane = load_shape(quats, scales, covars, n, valid, LARGEST)
    valid &= sane & (tl.abs(opacity) < float("inf"))

    p = or_ahead(valid, p)
    u, v, J0, J1 = project_point(p, intrinsics, width, height, MODEL, MARGIN)
    M = (transform_transposed(W, J0), transform_transposed(W, J1))
    _, _, a, b, c, det_sharp = covariance2d(M, F, covars is not None)
    det = det_sharp + eps * (a + c + eps)
    a += eps
    c += eps
    valid &= (det > 0) & (det < float("inf"))
    det = tl.where(valid, det, 1.0)
    scaling = tl.full((BLOCK,), 1.0, dt)
    if ANTIALIASED:
        scaling = compensation(det_sharp / det, FLOOR)
        opacity *= scaling
    # alpha reaches ALPHA_MIN at e standard deviations
    e = tl.sqrt(2.0 * tl.log(tl.where(opacity > ALPHA_MIN, opacity, ALPHA_MIN) / ALPHA_MIN))
    rx = half_size(e, tl.where(valid, a, 0.0))
    ry = half_size(e, tl.where(valid, c, 0.0))
    valid &= (opacity >= ALPHA_MIN) & (rx > 0) & (ry > 0) & (u + rx > 0) & (u - rx < width) & (v + ry > 0) & (v - ry < height)

    row = camera * N + n
    store_row(radii + row * 2, (tl.where(valid, rx, 0.0).to(tl.int32), tl.where(valid, ry, 0.0).to(tl.int32)), inside, 2, 2)
    store_row(means2d + row * 2, (tl.where(valid, u, 0.0), tl.where(valid, v, 0.0)), inside, 2, 2)
    tl.store(depths + row, tl.where(valid, p[2], 0.0), mask=inside)
    store_row(conics + row * 3, (tl.where(valid, c / det, 0.0), tl.where(valid, -b / det, 0.0), tl.where(valid, a / det, 0.0)), inside, 3, 1)
    tl.store(compensations + row, tl.where(valid, scaling, 0.0), mask=inside)


@triton.jit
def load_visible(radii, row, inside):
    """Whether a pair was not culled."""
    rx, ry = load_row(radii + row * 2, inside, 2, 2, 0)
    return (rx > 0) & (ry > 0)


@triton.jit
def combine(a, u, b, v):
    """a u + b v of 3-vectors."""
    return a * u[0] + b * v[0], a * u[1] + b * v[1], a * u[2] + b * v[2]


@triton.jit
def where_valid(valid, v):
    """The 3-vector, 0 where not valid."""
    return tl.where(valid, v[0], 0.0), tl.where(valid, v[1], 0.0), tl.where(valid, v[2], 0.0)


@triton.jit
def add_outer(A, u, v):
    """A + u v^T."""
    return combine(1.0, A[0], u[0], v), combine(1.0, A[1], u[1], v), combine(1.0, A[2], u[2], v)


@Launcher
@triton.jit(do_not_specialize=["N", "C", "width", "height"])
def project_bwd_kernel(means, quats, scales, covars, viewmats, Ks, radii, v_means2d, v_depths, v_conics, v_compensations, v_means, v_quats,
                       v_scales, v_covars, partials, N, C, width, height, eps2d: tl.float64, MODEL: tl.constexpr, MARGIN: tl.constexpr,
                       FLOOR: tl.constexpr, LARGEST: tl.constexpr, SUMS: tl.constexpr, BLOCK: tl.constexpr):
    """One block of splats, all cameras in turn: sums over cameras in registers, in a fixed order; sums over the block for each camera to
    `[programs, C, SUMS]`, which torch adds up, if there are such. No atomics: the same bits in every run.

    Nothing that was culled can do harm: a splat that no camera sees is not read (its shape is 0), the point of a pair that was culled is
    (0, 0, 1), and what comes from above is 0 for it.
    """
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = n < N
    dt: tl.constexpr = means.dtype.element_ty
    eps = tl.full((), eps2d, dt)
    seen = load_visible(radii, n, inside)
    camera = tl.full((), 1, tl.int64)
    while camera < C:
        seen |= load_visible(radii, camera * N + n, inside)
        camera += 1
    mean = load_row(means + n * 3, seen, 3, 1)
    F = load_shape(quats, scales, covars, n, seen, LARGEST)[0]
    zero = tl.zeros_like(mean[0])
    v_mean = (zero, zero, zero)
    v_F = (v_mean, v_mean, v_mean)
    camera = tl.full((), 0, tl.int64)
    while camera < C:
        row = camera * N + n
        valid = load_visible(radii, row, inside)
        W, t, intrinsics = load_camera(viewmats, Ks, camera)
        p = or_ahead(valid, to_camera(mean, W, t))
        _, _, J0, J1 = project_point(p, intrinsics, width, height, MODEL, MARGIN)
        M = (transform_transposed(W, J0), transform_transposed(W, J1))
        T0, T1, a, b, c, det_sharp = covariance2d(M, F, covars is not None)
        trace = a + c + eps
        inverse = 1.0 / tl.where(valid, det_sharp + eps * trace, 1.0)
        blur = eps * inverse

        # conic Q = (A, B, C), the inverse of Sigma': v_Sigma' = -Q v_Q Q; wanted is G = 2 v_Sigma' T, or 2 v_Sigma' M if Sigma is given, by
        # way of X = adj(Sigma' before blur) T/det and Q T: see the reference
        qa = (c + eps) * inverse
        qb = -b * inverse
        qc = (a + eps) * inverse
        if covars is not None:
            T0 = M[0]
            T1 = M[1]
            X0 = combine(c * inverse, T0, qb, T1)
            X1 = combine(qb, T0, a * inverse, T1)
        else:
            normal = cross(T0, T1)
            normal = (normal[0] * inverse, normal[1] * inverse, normal[2] * inverse)
            X0 = cross(T1, normal)
            X1 = cross(normal, T0)
        U0 = combine(1.0, X0, blur, T0)
        U1 = combine(1.0, X1, blur, T1)
        v_A, v_B, v_C = load_row(v_conics + row * 3, valid, 3, 1)
        VU0 = combine(2.0 * v_A, U0, v_B, U1)
        VU1 = combine(v_B, U0, 2.0 * v_C, U1)
        G0 = combine(-qa, VU0, -qb, VU1)
        G1 = combine(-qb, VU0, -qc, VU1)
        if v_compensations is not None:
            ratio = det_sharp * inverse
            v_scaling = tl.load(v_compensations + row, mask=valid, other=0.0)
            v_ratio = tl.where(ratio >= FLOOR * FLOOR, v_scaling / compensation(ratio, FLOOR), 0.0) * blur
            G0 = combine(1.0, combine(1.0, G0, v_ratio * trace, X0), -v_ratio * ratio, T0)
            G1 = combine(1.0, combine(1.0, G1, v_ratio * trace, X1), -v_ratio * ratio, T1)
        G0 = where_valid(valid, G0)
        G1 = where_valid(valid, G1)

        # Sigma' = T T^T, T = M F; or M Sigma M^T
        v_F = add_outer(add_outer(v_F, M[0], G0), M[1], G1)
        v_M0 = transform(F, G0)
        v_M1 = transform(F, G1)

        # M = J W, p = W mean + t
        v_u, v_v = load_row(v_means2d + row * 2, valid, 2, 2)
        v_p, v_intrinsics = project_point_backward(p, intrinsics, width, height, v_u, v_v, transform(W, v_M0), transform(W, v_M1), MODEL,
                                                   MARGIN)
        if v_depths is not None:
            v_p = (v_p[0], v_p[1], v_p[2] + tl.load(v_depths + row, mask=valid, other=0.0))
        v_mean = combine(1.0, v_mean, 1.0, transform_transposed(W, v_p))
        if partials is not None:
            v_W = (combine(J0[0], v_M0, J1[0], v_M1), combine(J0[1], v_M0, J1[1], v_M1), combine(J0[2], v_M0, J1[2], v_M1))
            v_W = add_outer(v_W, v_p, mean)
            sums = tl.sum(stack(v_W[0] + (v_p[0],) + v_W[1] + (v_p[1],) + v_W[2] + (v_p[2],) + v_intrinsics, SUMS), 0)
            tl.store(partials + (tl.program_id(0).to(tl.int64) * C + camera) * SUMS + tl.arange(0, SUMS), sums)
        camera += 1

    store_row(v_means + n * 3, v_mean, inside, 3, 1)
    if covars is not None:
        v_F = scale_columns(v_F, (0.5, 0.5, 0.5))
        store_row(v_covars + n * 9, v_F[0] + v_F[1] + v_F[2], inside, 9, 1)
    else:
        v_quat, v_scale = factor_backward(load_quat(quats, n, seen), load_row(scales + n * 3, seen, 3, 1), v_F)
        store_row(v_quats + n * 4, v_quat, inside, 4, 4)
        store_row(v_scales + n * 3, v_scale, inside, 3, 1)


def project(means: Tensor, quats: Tensor | None, scales: Tensor | None, covars: Tensor | None, opacities: Tensor, viewmats: Tensor,
            Ks: Tensor, width: int, height: int, model: str, near: float, far: float, eps2d: float, antialiased: bool
            ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Launcher; see `tsplat_reference.project`."""
    C, N = len(viewmats), len(means)
    radii = means.new_empty(C, N, 2, dtype=torch.int32)
    means2d, depths, conics, compensations = (means.new_empty(C, N, *s) for s in ((2,), (), (3,), ()))
    if C * N > 0:
        options = launch("project")
        project_fwd_kernel[(ceil_div(N, options["BLOCK"]) * C,)](
            means.contiguous(), *map(_contiguous, (quats, scales, covars)), opacities.contiguous(), viewmats.contiguous(),
            Ks.contiguous(), radii, means2d, depths, conics, compensations, N, C, width, height, near, far, eps2d, MODEL=model,
            ANTIALIASED=antialiased, MARGIN=FRUSTUM_MARGIN, FLOOR=COMPENSATION_MIN, ALPHA_MIN=ALPHA_MIN, LARGEST=LARGEST,
            **options)
    return radii, means2d, depths, conics, compensations


def project_backward(means: Tensor, quats: Tensor | None, scales: Tensor | None, covars: Tensor | None, viewmats: Tensor, Ks: Tensor,
                     width: int, height: int, model: str, eps2d: float, antialiased: bool, radii: Tensor, v_means2d: Tensor,
                     v_depths: Tensor | None, v_conics: Tensor, v_compensations: Tensor | None, cameras: bool = True
                     ) -> tuple[Tensor, Tensor | None, Tensor | None, Tensor | None, Tensor, Tensor]:
    """Launcher; see `tsplat_reference.project_backward`."""
    C, N = len(viewmats), len(means)
    means, viewmats, Ks = means.contiguous(), viewmats.contiguous(), Ks.contiguous()
    quats, scales, covars = map(_contiguous, (quats, scales, covars))
    new = torch.empty_like if C * N > 0 else torch.zeros_like
    v_means, (v_quats, v_scales, v_covars) = new(means), (None if x is None else new(x) for x in (quats, scales, covars))
    v_viewmats, v_Ks = (torch.zeros_like(viewmats), torch.zeros_like(Ks)) if cameras else (viewmats.new_empty(0, 4, 4), Ks.new_empty(0, 3, 3))
    if C * N > 0:
        options = launch("project_cameras_backward" if cameras or model == "fisheye" else "project_backward")
        programs = ceil_div(N, options["BLOCK"])
        partials = means.new_empty(programs, C, SUMS) if cameras else None
        project_bwd_kernel[(programs,)](
            means, quats, scales, covars, viewmats, Ks, radii.contiguous(), v_means2d.contiguous(), _contiguous(v_depths),
            v_conics.contiguous(), _contiguous(v_compensations if antialiased else None), v_means, v_quats, v_scales, v_covars, partials, N,
            C, width, height, eps2d, MODEL=model, MARGIN=FRUSTUM_MARGIN, FLOOR=COMPENSATION_MIN, LARGEST=LARGEST, SUMS=SUMS,
            **options)
        if partials is not None:
            sums = partials.sum(0)                      # [C, SUMS]
            v_viewmats[:, :3] = sums[:, :12].view(C, 3, 4)
            v_Ks.diagonal(0, 1, 2)[:, :2] = sums[:, 12:14]
            v_Ks[:, :2, 2] = sums[:, 14:]
    return v_means, v_quats, v_scales, v_covars, v_viewmats, v_Ks


def _contiguous(tensor: Tensor | None) -> Tensor | None:
    return None if tensor is None else tensor.contiguous()
