"""Projection of 3D Gaussians to 2D splats (EWA splatting; 3DGS, section 4 and equations 5 and 6), and its closed-form backward."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from tsplat_reference.camera import Point, project_points, project_points_backward, split_intrinsics
from tsplat_reference.constants import ALPHA_MIN, COMPENSATION_MIN, LARGEST
from tsplat_reference.parallel import map_chunks
from tsplat_reference.planes import Matrix, Plane, Vector, cross, dot, join, matmul, split, total, transpose

CHUNK = 1 << 17
"""Splats projected at a time where no graph is recorded: about 100 planes per camera, 50 MB in float32. Fewer would cost more calls, which
wait for each other in Python: 2^15 takes 1.3 to 1.8 times as long."""


class Projection(NamedTuple):
    """2D splats of N Gaussians in C cameras. Culled ones have radii 0 and zeros everywhere.

    radii `[C, N, 2]` int32, half size in pixels per axis of the box outside which alpha < 1/255; means2d `[C, N, 2]` in pixels; depths
    `[C, N]`; conics `[C, N, 3]`, (a, b, c) of a dx^2 + 2 b dx dy + c dy^2; compensations `[C, N]`, by which antialiasing
    scales the opacity (ones if it is off).
    """

    radii: Tensor
    means2d: Tensor
    depths: Tensor
    conics: Tensor
    compensations: Tensor


def rotation_matrix(quat: Vector) -> Matrix:
    """The rotation of unit quaternions (w, x, y, z)."""
    w, x, y, z = quat
    x2, y2, z2 = 2 * x, 2 * y, 2 * z
    xx, yy, zz, xy, yz, zx, wx, wy, wz = x * x2, y * y2, z * z2, x * y2, y * z2, z * x2, w * x2, w * y2, w * z2
    return [[1 - (yy + zz), xy - wz, zx + wy],
            [xy + wz, 1 - (xx + zz), yz - wx],
            [zx - wy, yz + wx, 1 - (xx + yy)]]


def covariances(quats: Tensor, scales: Tensor) -> Tensor:
    """Sigma = R S S^T R^T `[N, 3, 3]` (3DGS, equation 6) of quaternions `[N, 4]`, not zero, and scales `[N, 3]`."""
    F = _factor([*split(quats), *split(scales)]).F
    return torch.stack([join(row, quats[:, 0]) for row in matmul(F, transpose(F))], -2)


class _Factor(NamedTuple):
    """F = R S, so that Sigma = F F^T, the rotation R of the unit quaternion, and the norm of the raw one."""

    F: Matrix
    R: Matrix
    unit: Vector
    norm: Tensor


def _factor(shape: Sequence[Tensor]) -> _Factor:
    """Of planes of quaternion and scales."""
    norm = torch.as_tensor(dot(shape[:4], shape[:4])).sqrt()
    unit = [q / norm for q in shape[:4]]
    R = rotation_matrix(unit)
    return _Factor(_times(R, shape[4:]), R, unit, norm)


def _factor_backward(factor: _Factor, scales: Vector, v_F: Matrix) -> tuple[list[Plane], list[Plane]]:
    """Gradients with respect to the raw quaternion and the scales."""
    v_scale = [dot(v, r) for v, r in zip(transpose(v_F), transpose(factor.R), strict=True)]
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = _times(v_F, [2 * s for s in scales])
    a, b, c = r21 - r12, r02 - r20, r10 - r01            # the antisymmetric part of v_R, and sums of its symmetric part
    xy, zx, yz = r01 + r10, r02 + r20, r12 + r21
    w, x, y, z = unit = factor.unit
    v_unit = [dot((x, y, z), (a, b, c)), dot((x, y, z, w), (-2 * (r11 + r22), xy, zx, a)),
              dot((x, y, z, w), (xy, -2 * (r00 + r22), yz, b)), dot((x, y, z, w), (zx, yz, -2 * (r00 + r11), c))]
    along = dot(unit, v_unit)
    return [(v - u * along) / factor.norm for u, v in zip(unit, v_unit, strict=True)], v_scale


def _times(A: Matrix, diagonal: Vector) -> list[list[Plane]]:
    """A times a diagonal matrix."""
    return [[a * d for a, d in zip(row, diagonal, strict=True)] for row in A]


def project(means: Tensor, quats: Tensor | None, scales: Tensor | None, covars: Tensor | None, opacities: Tensor, viewmats: Tensor,
            Ks: Tensor, width: int, height: int, model: str, near: float, far: float, eps2d: float, antialiased: bool) -> Projection:
    """Project Gaussians to 2D splats: Sigma' = J W Sigma W^T J^T + eps2d I (3DGS, equation 5), and cull.

    Args:
        means: `[N, 3]`.
        quats, scales: `[N, 4]` (wxyz) and `[N, 3]`, or None if `covars` `[N, 3, 3]` (symmetric) is given.
        opacities: `[N]`; only used for the extents, without gradient.
        viewmats, Ks: `[C, 4, 4]` world to camera and `[C, 3, 3]`.
        width, height, model, near, far: as in `tsplat.Camera`.
        eps2d: blur in pixels squared.
        antialiased: whether to compute compensations.
    """
    if means.shape[0] > CHUNK and not torch.is_grad_enabled():
        parts = map_chunks(lambda rows: project(
            means[rows], _at(quats, rows), _at(scales, rows), _at(covars, rows), opacities[rows], viewmats, Ks, width, height, model, near,
            far, eps2d, antialiased), means.shape[0], CHUNK)
        return Projection(*(torch.cat(p, 1) for p in zip(*parts, strict=True)))
    mean, shape = split(means), _shape(quats, scales, covars)
    sane = _sane(mean, shape, opacities)
    mean, shape = _or_harmless(sane, mean, shape)
    W, t = _pose(viewmats)
    p, valid = _in_range(_to_camera(mean, W, t), sane, model, near, far)
    u, v, J = project_points(p, split_intrinsics(Ks), width, height, model)
    F = _factor(shape).F if covars is None else _rows(shape)
    _, a0, b, c0, det_sharp = _covariance2d(matmul(J, W), F, covars is None)
    a, c, det = a0 + eps2d, c0 + eps2d, det_sharp + eps2d * (a0 + c0 + eps2d)
    valid = valid & (det > 0) & (det < math.inf)
    a, b, c, det, det_sharp = _or(valid, (a, b, c, det, det_sharp), [1.0] * 5)

    compensations = torch.ones_like(det)
    if antialiased:
        compensations = (det_sharp / det).clamp_min(COMPENSATION_MIN**2).sqrt()
    rx, ry = _extents(a.detach(), c.detach(), opacities.detach() * compensations.detach())
    valid = valid & _on_screen(u.detach(), v.detach(), rx, ry, width, height)
    rx, ry, u, v, depths, inverse, compensations = _or(valid, (rx, ry, u, v, p[2], det.reciprocal(), compensations), [0.0] * 7)
    return Projection(join([rx, ry], rx).to(torch.int32), join([u, v], u), depths, join([c * inverse, -b * inverse, a * inverse], det),
                      compensations)


class ProjectionGradients(NamedTuple):
    """Gradients of the arguments of `project`, None where the argument is None; `[0, 4, 4]` and `[0, 3, 3]` of cameras if not asked for."""

    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    covars: Tensor | None
    viewmats: Tensor
    Ks: Tensor


def project_backward(means: Tensor, quats: Tensor | None, scales: Tensor | None, covars: Tensor | None, viewmats: Tensor, Ks: Tensor,
                     width: int, height: int, model: str, eps2d: float, antialiased: bool, radii: Tensor, v_means2d: Tensor,
                     v_depths: Tensor | None, v_conics: Tensor, v_compensations: Tensor | None, cameras: bool = True
                     ) -> ProjectionGradients:
    """Closed-form gradients of `project`, of which `radii` says what was culled; those of viewmats and Ks if `cameras`. None is zeros."""
    if means.shape[0] > CHUNK:
        parts = map_chunks(lambda rows: project_backward(
            means[rows], _at(quats, rows), _at(scales, rows), _at(covars, rows), viewmats, Ks, width, height, model, eps2d, antialiased,
            radii[:, rows], v_means2d[:, rows], None if v_depths is None else v_depths[:, rows], v_conics[:, rows],
            None if v_compensations is None else v_compensations[:, rows], cameras), means.shape[0], CHUNK)
        return ProjectionGradients(torch.cat([p.means for p in parts]), _cat([p.quats for p in parts]), _cat([p.scales for p in parts]),
                                   _cat([p.covars for p in parts]), torch.stack([p.viewmats for p in parts]).sum(0),
                                   torch.stack([p.Ks for p in parts]).sum(0))
    valid = (radii[..., 0] > 0) & (radii[..., 1] > 0)                                       # [C, N]
    mean, shape = _or_harmless(valid.any(0), split(means), _shape(quats, scales, covars))
    W, t = _pose(viewmats)
    p = _or_ahead(valid, _to_camera(mean, W, t))
    intrinsics = split_intrinsics(Ks)
    _, _, J = project_points(p, intrinsics, width, height, model)
    factor = _factor(shape) if covars is None else None
    M, F = matmul(J, W), factor.F if factor else _rows(shape)
    T, a0, b, c0, det_sharp = _covariance2d(M, F, covars is None)
    trace = a0 + c0 + eps2d
    a, c, det = a0 + eps2d, c0 + eps2d, det_sharp + eps2d * trace

    # conic Q = (A, B, C) = (c, -b, a)/det, the inverse of Sigma': v_Sigma' = -Q v_Q Q, where B stands for both entries off the diagonal.
    # What is needed is G = 2 v_Sigma' T, or 2 v_Sigma' M if Sigma is given, by way of X = adj(Sigma' before blur) T/det and Q T, not of
    # v_Sigma', of which most cancels in the product with a long T
    inverse = det.reciprocal()
    blur = eps2d * inverse
    v_A, v_B, v_C = v_conics.unbind(-1)
    V, Q = [[-2 * v_A, -v_B], [-v_B, -2 * v_C]], [[c * inverse, -b * inverse], [-b * inverse, a * inverse]]
    if covars is None:
        normal = [n * inverse for n in cross(*T)]
        X: Matrix = [cross(T[1], normal), cross(normal, T[0])]
    else:
        T, X = M, matmul([[c0 * inverse, Q[0][1]], [Q[1][0], a0 * inverse]], M)
    G = matmul(Q, matmul(V, _combine(X, blur, T)))
    if antialiased and v_compensations is not None:     # ratio = det_sharp/(det_sharp + eps2d trace)
        ratio = det_sharp * inverse
        v_ratio = torch.where(ratio >= COMPENSATION_MIN**2, v_compensations / ratio.sqrt(), 0.0) * blur
        G = _combine(_combine(G, v_ratio * trace, X), -v_ratio * ratio, T)
    G = [[*_or(valid, [torch.as_tensor(g) for g in row], [0.0] * 3)] for row in G]

    # Sigma' = T T^T, T = M F; or M Sigma M^T
    v_F = [_over_cameras(row) for row in matmul(transpose(M), G)]
    v_M = matmul(G, transpose(F))

    # M = J W
    v_W = matmul(transpose(J), v_M) if cameras else []
    v_u, v_v = _or(valid, v_means2d.unbind(-1), [0.0] * 2)
    v_J = matmul(v_M, transpose(W))
    (v_x, v_y, v_z), v_Ks = project_points_backward(p, intrinsics, width, height, model, v_u, v_v, v_J)
    v_p = [torch.as_tensor(v, dtype=det.dtype) for v in (v_x, v_y, v_z)]
    if v_depths is not None:
        v_p[2] = v_p[2] + _or(valid, [v_depths], [0.0])[0]
    v_p = [v.expand_as(det) for v in v_p]

    # p = W mean + t
    v_viewmats, v_Ks = (torch.zeros_like(viewmats), v_Ks) if cameras else (viewmats.new_empty(0, 4, 4), Ks.new_empty(0, 3, 3))
    for i, v in enumerate(v_p if cameras else ()):
        for j in range(3):
            v_viewmats[:, i, j] = total(v_W[i][j], det) + v @ mean[j]
        v_viewmats[:, i, 3] = v.sum(1)
    v_means = join(_over_cameras([dot(column, v_p) for column in transpose(W)]), mean[0])
    if factor is None:
        v_covars = join([0.5 * v for row in v_F for v in row], mean[0]).view(-1, 3, 3)
        return ProjectionGradients(v_means, None, None, v_covars, v_viewmats, v_Ks)
    v_quat, v_scale = _factor_backward(factor, shape[4:], v_F)
    return ProjectionGradients(v_means, join(v_quat, mean[0]), join(v_scale, mean[0]), None, v_viewmats, v_Ks)


def _at(tensor: Tensor | None, rows: slice) -> Tensor | None:
    return None if tensor is None else tensor[rows]


def _cat(parts: list[Tensor | None]) -> Tensor | None:
    present = [p for p in parts if p is not None]
    return torch.cat(present) if present else None


def _shape(quats: Tensor | None, scales: Tensor | None, covars: Tensor | None) -> list[Tensor]:
    """Planes: of quaternion and scales (7), or of Sigma row by row (9)."""
    if covars is not None:
        return split(covars.flatten(-2))
    if quats is None or scales is None:
        raise ValueError("quats, scales: expected both, or covars instead; got None")
    return split(quats) + split(scales)


def _or_harmless(keep: Tensor, mean: Sequence[Tensor], shape: Sequence[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
    """Harmless numbers in place of splats that are not kept, so that nothing of them (NaN, say) reaches a sum over splats."""
    harmless = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0) if len(shape) == 9 else (1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0)
    return _or(keep, mean, [0.0] * 3), _or(keep, shape, harmless)


def _or(keep: Tensor, planes: Sequence[Tensor], others: Sequence[float]) -> list[Tensor]:
    """The planes where `keep`, and elsewhere the others. A choice takes as long as four products, so that none is made where all are kept."""
    return list(planes) if bool(keep.all()) else [torch.where(keep, p, other) for p, other in zip(planes, others, strict=True)]


def _sane(mean: Sequence[Tensor], shape: Sequence[Tensor], opacities: Tensor) -> Tensor:
    """Which splats are finite, not huge, and have a rotation and an extent `[N]`."""
    sane = (_largest(mean) < LARGEST) & (opacities.abs() < math.inf)                        # false for NaN, too
    if len(shape) == 9:
        return sane & (_largest(shape) < LARGEST**2) & (torch.maximum(torch.maximum(shape[0], shape[4]), shape[8]) > 0)
    quat, extent = shape[:4], _largest(shape[4:])
    return sane & (_largest(quat) < LARGEST) & (torch.as_tensor(dot(quat, quat)) > 0) & (extent < LARGEST) & (extent > 0)


def _largest(planes: Sequence[Tensor]) -> Tensor:
    """The largest magnitude, NaN if one is."""
    return functools.reduce(torch.maximum, [p.abs() for p in planes])


def _rows(planes: Sequence[Tensor]) -> Matrix:
    """A 3 x 3 matrix of its entries, row by row."""
    return [planes[i:i + 3] for i in (0, 3, 6)]


def _pose(viewmats: Tensor) -> tuple[Matrix, Sequence[Tensor]]:
    """W and t, with planes `[C, 1]`."""
    rows = [row.unbind(1) for row in viewmats[:, :3, :, None].unbind(1)]
    return [row[:3] for row in rows], [row[3] for row in rows]


def _to_camera(mean: Vector, W: Matrix, t: Sequence[Tensor]) -> Point:
    x, y, z = (dot(row, mean) + shift for row, shift in zip(W, t, strict=True))
    return x, y, z


def _or_ahead(valid: Tensor, p: Point) -> Point:
    """The points, with (0, 0, 1) for those that are not valid."""
    x, y, z = _or(valid, p, (0.0, 0.0, 1.0))
    return x, y, z


def _in_range(p: Point, sane: Tensor, model: str, near: float, far: float) -> tuple[Point, Tensor]:
    """The points with those that are culled by depth moved ahead, and which are left `[C, N]`."""
    valid = sane & (p[2] > near) & (p[2] < far)
    if model != "orthographic":
        valid = valid & (p[2] > 0)
    return _or_ahead(valid, p), valid


def _covariance2d(M: Matrix, F: Matrix, factored: bool) -> tuple[list[list[Plane]], Tensor, Tensor, Tensor, Tensor]:
    """T = M F, and of Sigma' = M Sigma M^T (3DGS, equation 5), without blur, the entries xx, xy, yy and the determinant `[C, N]`.

    With Sigma = F F^T, Sigma' = T T^T, whose determinant is |T0 x T1|^2: exact to rounding for needles, where xx yy - xy^2 cancels.
    """
    T = matmul(M, F)
    (x0, x1), (y0, y1) = (T, T) if factored else (T, M)
    a, b, c = (torch.as_tensor(dot(x, y)) for x, y in ((x0, y0), (x0, y1), (x1, y1)))
    if not factored:
        return T, a, b, c, a * c - b * b
    normal = cross(*T)
    return T, a, b, c, torch.as_tensor(dot(normal, normal))


def _combine(A: Matrix, b: Tensor, B: Matrix) -> list[list[Plane]]:
    """A + b B."""
    return [[torch.addcmul(torch.as_tensor(x), b, torch.as_tensor(y)) for x, y in zip(*rows, strict=True)] for rows in zip(A, B, strict=True)]


def _over_cameras(planes: Vector) -> list[Tensor]:
    """Planes `[C, N]` summed to `[N]`."""
    return [v[0] if len(v) == 1 else v.sum(0) for v in map(torch.as_tensor, planes)]


def _extents(a: Tensor, c: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
    """Half sizes of the box in which alpha can reach ALPHA_MIN: ceil(e sigma), e = sqrt(2 ln(255 o)), which is 3.33 for an opaque splat."""
    e = (2 * torch.log(opacities.clamp_min(ALPHA_MIN) / ALPHA_MIN)).sqrt()
    e = torch.where(opacities >= ALPHA_MIN, e, 0.0)
    largest = torch.finfo(a.dtype).max                       # of float16 less than these
    rx, ry = ((e * v.clamp(0.0, min(1e18, largest)).sqrt()).ceil().clamp_max(min(2.0**30, largest)) for v in (a, c))
    return rx, ry


def _on_screen(u: Tensor, v: Tensor, rx: Tensor, ry: Tensor, width: int, height: int) -> Tensor:
    return (rx > 0) & (ry > 0) & (u + rx > 0) & (u - rx < width) & (v + ry > 0) & (v - ry < height)
