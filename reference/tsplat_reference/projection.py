"""Projection of 3D Gaussians to 2D splats (EWA splatting; 3DGS, section 4 and equations 5 and 6), and its closed-form backward."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from tsplat_reference.camera import Point, project_points, project_points_backward, split_intrinsics
from tsplat_reference.constants import ALPHA_MIN, COMPENSATION_MIN, EXTENT_MAX, LARGEST
from tsplat_reference.parallel import map_chunks
from tsplat_reference.planes import Matrix, Plane, Vector, dot, gram, join, matmul, split, total, transpose

CHUNK = 1 << 14
"""Splats projected at a time where no graph is recorded, so that the planes (about 100 per camera) stay in the cache."""


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
    return [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]


def covariances(quats: Tensor, scales: Tensor) -> Tensor:
    """Sigma = R S S^T R^T `[N, 3, 3]` (3DGS, equation 6) of quaternions `[N, 4]`, not zero, and scales `[N, 3]`."""
    return torch.stack([join(row, quats[:, 0]) for row in _covariance(split(quats), split(scales))], -2)


def _covariance(quat: Vector, scale: Vector) -> Matrix:
    return gram([[r * s for r, s in zip(row, scale, strict=True)] for row in rotation_matrix(_normalise(quat)[0])])


def _covariance_backward(quat: Vector, scale: Vector, v_covar: Matrix) -> tuple[list[Plane], list[Plane]]:
    """Gradients with respect to the raw quaternions and the scales; `v_covar` is symmetric."""
    unit, norm = _normalise(quat)
    R = rotation_matrix(unit)
    L = [[r * s for r, s in zip(row, scale, strict=True)] for row in R]
    v_L = [[2 * v for v in row] for row in matmul(v_covar, L)]
    v_scale = [dot(v, r) for v, r in zip(transpose(v_L), transpose(R), strict=True)]
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = [[v * s for v, s in zip(row, scale, strict=True)] for row in v_L]
    w, x, y, z = unit
    v_unit = [2 * (x * (r21 - r12) + y * (r02 - r20) + z * (r10 - r01)),
              2 * (-2 * x * (r11 + r22) + y * (r01 + r10) + z * (r02 + r20) + w * (r21 - r12)),
              2 * (x * (r01 + r10) - 2 * y * (r00 + r22) + z * (r12 + r21) + w * (r02 - r20)),
              2 * (x * (r02 + r20) + y * (r12 + r21) - 2 * z * (r00 + r11) + w * (r10 - r01))]
    along = dot(unit, v_unit)
    return [(v - u * along) / norm for u, v in zip(unit, v_unit, strict=True)], v_scale


def _normalise(quat: Vector) -> tuple[list[Plane], Tensor]:
    norm = torch.as_tensor(dot(quat, quat)).sqrt()
    return [q / norm for q in quat], norm


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
    sane, means, quats, scales, covars = _sanitise(means, quats, scales, covars, opacities)
    W = _rotation(viewmats)
    p, valid = _in_range(_to_camera(split(means), W, viewmats), sane, model, near, far)
    u, v, J = project_points(p, split_intrinsics(Ks), width, height, model)
    a0, b, c0 = _covariance2d(matmul(J, W), _world_covariance(quats, scales, covars))
    a, c = a0 + eps2d, c0 + eps2d
    det = a * c - b * b
    valid = valid & (det > 0) & det.isfinite()
    a0, b, c0, a, c, det = (torch.where(valid, v, 1.0) for v in (a0, b, c0, a, c, det))
    ratio = (a0 * c0 - b * b) / det

    compensations = ratio.clamp_min(COMPENSATION_MIN**2).sqrt() if antialiased else torch.ones_like(det)
    rx, ry = _extents(a.detach(), c.detach(), opacities.detach() * compensations.detach())
    valid = valid & _on_screen(u.detach(), v.detach(), rx, ry, width, height)
    inverse = torch.where(valid, 1 / det, 0.0)
    return Projection(
        torch.stack([torch.where(valid, rx, 0.0), torch.where(valid, ry, 0.0)], -1).to(torch.int32),
        torch.stack([torch.where(valid, u, 0.0), torch.where(valid, v, 0.0)], -1),
        torch.where(valid, p[2], 0.0),
        torch.stack([c * inverse, -b * inverse, a * inverse], -1),
        torch.where(valid, compensations, 0.0))


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
    valid = (radii > 0).all(-1)                                                             # [C, N]
    means, quats, scales, covars = _replace(valid.any(0), means, quats, scales, covars)
    W = _rotation(viewmats)
    S = _world_covariance(quats, scales, covars)
    p = _or_ahead(valid, _to_camera(split(means), W, viewmats))
    intrinsics = split_intrinsics(Ks)
    _, _, J = project_points(p, intrinsics, width, height, model)
    M = [[torch.where(valid, m, 0.0) for m in row] for row in matmul(J, W)]                 # a huge splat may overflow where it is culled
    a0, b, c0 = _covariance2d(M, S)
    a, c = a0 + eps2d, c0 + eps2d
    det = torch.where(valid, a * c - b * b, 1.0)

    # conic (A, B, C) = (c, -b, a)/det
    v_A, v_B, v_C = (torch.where(valid, v, 0.0) for v in v_conics.unbind(-1))
    inverse = 1 / det
    v_det = (v_B * b - v_A * c - v_C * a) * inverse * inverse
    v_a, v_b, v_c = v_C * inverse + v_det * c, -v_B * inverse - 2 * v_det * b, v_A * inverse + v_det * a
    if antialiased and v_compensations is not None:
        ratio = (a0 * c0 - b * b) * inverse
        root = ratio.clamp_min(COMPENSATION_MIN**2).sqrt()
        v_ratio = torch.where(valid & (ratio >= COMPENSATION_MIN**2), v_compensations / (2 * root), 0.0) * inverse
        v_a, v_b, v_c = v_a + v_ratio * (c0 - ratio * c), v_b + v_ratio * 2 * b * (ratio - 1), v_c + v_ratio * (a0 - ratio * a)

    # Sigma' = M Sigma M^T, M = J W
    VM = matmul([[v_a, 0.5 * v_b], [0.5 * v_b, v_c]], M)
    v_S = [[torch.as_tensor(v).sum(0) for v in row] for row in matmul(transpose(M), VM)]
    v_M = [[2 * v for v in row] for row in matmul(VM, S)]
    v_W = matmul(transpose(J), v_M)
    v_u, v_v = (torch.where(valid, v, 0.0) for v in v_means2d.unbind(-1))
    v_p, v_Ks = project_points_backward(p, intrinsics, width, height, model, v_u, v_v, matmul(v_M, transpose(W)))
    zero = det.new_zeros(())                            # of the right dtype, as v_p[2] may be the number 0.0
    v_x, v_y, v_z = (torch.where(valid, v, zero) for v in (*v_p[:2], v_p[2] if v_depths is None else v_p[2] + v_depths))

    # p = W mean + t
    v_viewmats, v_Ks = (torch.zeros_like(viewmats), v_Ks) if cameras else (viewmats.new_empty(0, 4, 4), Ks.new_empty(0, 3, 3))
    for i, v in enumerate((v_x, v_y, v_z) if cameras else ()):
        for j in range(3):
            v_viewmats[:, i, j] = total(v_W[i][j], det) + v @ means[:, j]
        v_viewmats[:, i, 3] = v.sum(1)
    v_means = join([torch.as_tensor(dot(column, (v_x, v_y, v_z))).sum(0) for column in transpose(W)], means[:, 0])
    if covars is not None:
        return ProjectionGradients(v_means, None, None, torch.stack([join(row, means[:, 0]) for row in v_S], -2), v_viewmats, v_Ks)
    quats, scales = _given(quats, scales)
    v_quats, v_scales = _covariance_backward(split(quats), split(scales), v_S)
    return ProjectionGradients(v_means, join(v_quats, means[:, 0]), join(v_scales, means[:, 0]), None, v_viewmats, v_Ks)


def _given(quats: Tensor | None, scales: Tensor | None) -> tuple[Tensor, Tensor]:
    if quats is None or scales is None:
        raise ValueError("quats, scales: expected both, or covars instead; got None")
    return quats, scales


def _at(tensor: Tensor | None, rows: slice) -> Tensor | None:
    return None if tensor is None else tensor[rows]


def _cat(parts: list[Tensor | None]) -> Tensor | None:
    present = [p for p in parts if p is not None]
    return torch.cat(present) if present else None


def _replace(keep: Tensor, means: Tensor, quats: Tensor | None, scales: Tensor | None, covars: Tensor | None
             ) -> tuple[Tensor, Tensor | None, Tensor | None, Tensor | None]:
    """Put harmless numbers in place of splats that are not kept, so that nothing of them (NaN, say) reaches a sum over splats."""
    rows = keep[:, None]
    means = torch.where(rows, means, 0.0)
    if covars is not None:
        return means, None, None, torch.where(rows[..., None], covars, torch.eye(3, dtype=covars.dtype, device=covars.device))
    quats, scales = _given(quats, scales)
    return means, torch.where(rows, quats, quats.new_tensor([1.0, 0.0, 0.0, 0.0])), torch.where(rows, scales, 1.0), None


def _sanitise(means: Tensor, quats: Tensor | None, scales: Tensor | None, covars: Tensor | None, opacities: Tensor
              ) -> tuple[Tensor, Tensor, Tensor | None, Tensor | None, Tensor | None]:
    """Which splats are sane `[N]`, and the inputs with the others replaced: finite, not huge, a rotation, an extent."""
    sane = (means.abs() < LARGEST).all(-1) & opacities.isfinite()                           # false for NaN, too
    if covars is not None:
        sane = sane & (covars.abs() < LARGEST**2).all(-1).all(-1) & (covars.diagonal(dim1=-2, dim2=-1).amax(-1) > 0)
    else:
        quats, scales = _given(quats, scales)
        sane = sane & (quats.abs() < LARGEST).all(-1) & ((quats * quats).sum(-1) > 0)
        sane = sane & (scales.abs() < LARGEST).all(-1) & (scales.abs().amax(-1) > 0)
    return sane, *_replace(sane, means, quats, scales, covars)


def _rotation(viewmats: Tensor) -> Matrix:
    """W, with planes `[C, 1]`."""
    return [[viewmats[:, i, j, None] for j in range(3)] for i in range(3)]


def _to_camera(mean: Vector, W: Matrix, viewmats: Tensor) -> Point:
    x, y, z = (dot(row, mean) + viewmats[:, i, 3, None] for i, row in enumerate(W))
    return x, y, z


def _or_ahead(valid: Tensor, p: Point) -> Point:
    """The points, with (0, 0, 1) for those that are not valid."""
    return torch.where(valid, p[0], 0.0), torch.where(valid, p[1], 0.0), torch.where(valid, p[2], 1.0)


def _in_range(p: Point, sane: Tensor, model: str, near: float, far: float) -> tuple[Point, Tensor]:
    """The points with those that are culled by depth moved ahead, and which are left `[C, N]`."""
    valid = sane & (p[2] > near) & (p[2] < far)
    if model != "orthographic":
        valid = valid & (p[2] > 0)
    return _or_ahead(valid, p), valid


def _world_covariance(quats: Tensor | None, scales: Tensor | None, covars: Tensor | None) -> Matrix:
    if covars is not None:
        return [split(row) for row in covars.unbind(-2)]
    quats, scales = _given(quats, scales)
    return _covariance(split(quats), split(scales))


def _covariance2d(M: Matrix, S: Matrix) -> tuple[Tensor, Tensor, Tensor]:
    """The entries xx, xy, yy `[C, N]` of M Sigma M^T (3DGS, equation 5)."""
    MS = matmul(M, S)
    a, b, c = dot(MS[0], M[0]), dot(MS[0], M[1]), dot(MS[1], M[1])
    return torch.as_tensor(a), torch.as_tensor(b), torch.as_tensor(c)


def _extents(a: Tensor, c: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
    """Half sizes of the box in which alpha can reach ALPHA_MIN: ceil(e sigma), e = min(3.33, sqrt(2 ln(255 o)))."""
    e = (2 * torch.log(opacities.clamp_min(ALPHA_MIN) / ALPHA_MIN)).sqrt().clamp_max(EXTENT_MAX)
    e = torch.where(opacities >= ALPHA_MIN, e, 0.0)
    rx, ry = ((e * v.clamp(0.0, 1e18).sqrt()).ceil().nan_to_num(0.0).clamp_max(2.0**30) for v in (a, c))
    return rx, ry


def _on_screen(u: Tensor, v: Tensor, rx: Tensor, ry: Tensor, width: int, height: int) -> Tensor:
    return (rx > 0) & (ry > 0) & (u + rx > 0) & (u - rx < width) & (v + ry > 0) & (v - ry < height)
