"""View-dependent colour: real spherical harmonics of degree 0 to 4 (3DGS, section 5.1), and the closed-form backward.

Every basis function is a polynomial in the unit direction (x, y, z). The table below is the whole definition: the values are
monomials times the table, and so are the derivatives, with the table differentiated.
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

from tsplat_reference.parallel import map_chunks

MAX_DEGREE = 4
CHUNK = 1 << 14
"""Splats evaluated at a time where no graph is recorded."""


def _c(numerator: float, denominator: float, factor: float = 1.0) -> float:
    return factor * math.sqrt(numerator / (denominator * math.pi))


# One row per function, in the order of the coefficients: (constant, {exponents of x, y, z: factor}).
_BASIS: list[tuple[float, dict[tuple[int, int, int], float]]] = [
    (_c(1, 4), {(0, 0, 0): 1}),

    (-_c(3, 4), {(0, 1, 0): 1}),
    (_c(3, 4), {(0, 0, 1): 1}),
    (-_c(3, 4), {(1, 0, 0): 1}),

    (_c(15, 4), {(1, 1, 0): 1}),
    (-_c(15, 4), {(0, 1, 1): 1}),
    (_c(5, 16), {(0, 0, 2): 2, (2, 0, 0): -1, (0, 2, 0): -1}),
    (-_c(15, 4), {(1, 0, 1): 1}),
    (_c(15, 16), {(2, 0, 0): 1, (0, 2, 0): -1}),

    (-_c(35, 32), {(2, 1, 0): 3, (0, 3, 0): -1}),
    (_c(105, 4), {(1, 1, 1): 1}),
    (-_c(21, 32), {(0, 1, 2): 4, (2, 1, 0): -1, (0, 3, 0): -1}),
    (_c(7, 16), {(0, 0, 3): 2, (2, 0, 1): -3, (0, 2, 1): -3}),
    (-_c(21, 32), {(1, 0, 2): 4, (3, 0, 0): -1, (1, 2, 0): -1}),
    (_c(105, 16), {(2, 0, 1): 1, (0, 2, 1): -1}),
    (-_c(35, 32), {(3, 0, 0): 1, (1, 2, 0): -3}),

    (_c(35, 16, 3), {(3, 1, 0): 1, (1, 3, 0): -1}),
    (-_c(35, 32, 3), {(2, 1, 1): 3, (0, 3, 1): -1}),
    (_c(5, 16, 3), {(1, 1, 2): 7, (1, 1, 0): -1}),
    (-_c(5, 32, 3), {(0, 1, 3): 7, (0, 1, 1): -3}),
    (_c(1, 256, 3), {(0, 0, 4): 35, (0, 0, 2): -30, (0, 0, 0): 3}),
    (-_c(5, 32, 3), {(1, 0, 3): 7, (1, 0, 1): -3}),
    (_c(5, 64, 3), {(2, 0, 2): 7, (0, 2, 2): -7, (2, 0, 0): -1, (0, 2, 0): 1}),
    (-_c(35, 32, 3), {(3, 0, 1): 1, (1, 2, 1): -3}),
    (_c(35, 256, 3), {(4, 0, 0): 1, (2, 2, 0): -6, (0, 4, 0): 1}),
]


def harmonics(means: Tensor, centers: Tensor, coeffs: Tensor, degree: int, mask: Tensor) -> Tensor:
    """Sum of SH coefficients times basis, in the direction from each camera centre to each mean.

    Args:
        means: `[N, 3]`. A mean at a camera centre has no direction; it is seen along z, with zero gradient.
        centers: `[C, 3]` camera centres in world space.
        coeffs: `[N, K, D]`, K >= (degree + 1)^2; the coefficients beyond that are not used.
        degree: 0 to 4.
        mask: bool `[C, N]`, which pairs to evaluate; the others give 0, and no gradient.

    Returns:
        `[C, N, D]`, without the 0.5 that a colour adds and without its clamp at 0.
    """
    if means.shape[0] > CHUNK and not torch.is_grad_enabled():
        return torch.cat(map_chunks(lambda rows: harmonics(means[rows], centers, coeffs[rows], degree, mask[:, rows]),
                                    means.shape[0], CHUNK), 1)
    coeffs = torch.where(mask.any(0)[:, None, None], coeffs[:, :(degree + 1) ** 2], 0.0)
    unit, _ = _directions(means, centers, mask)
    return torch.where(mask[..., None], torch.einsum("cnk,nkd->cnd", _evaluate(unit, degree), coeffs), 0.0)


def harmonics_backward(means: Tensor, centers: Tensor, coeffs: Tensor, degree: int, mask: Tensor, v_out: Tensor
                       ) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients with respect to means, centers and coeffs."""
    if means.shape[0] > CHUNK:
        parts = map_chunks(lambda rows: harmonics_backward(means[rows], centers, coeffs[rows], degree, mask[:, rows], v_out[:, rows]),
                           means.shape[0], CHUNK)
        return (torch.cat([p[0] for p in parts]), torch.stack([p[1] for p in parts]).sum(0), torch.cat([p[2] for p in parts]))
    v_out = torch.where(mask[..., None], v_out, 0.0)
    used = (degree + 1) ** 2
    kept = torch.where(mask.any(0)[:, None, None], coeffs[:, :used], 0.0).nan_to_num(0.0, 0.0, 0.0)     # 0 v_out, not NaN
    unit, length = _directions(means, centers, mask)
    v_coeffs = torch.zeros_like(coeffs)
    v_coeffs[:, :used] = torch.einsum("cnk,cnd->nkd", _evaluate(unit, degree), v_out)
    if degree == 0:
        return torch.zeros_like(means), torch.zeros_like(centers), v_coeffs
    v_basis = torch.einsum("cnd,nkd->cnk", v_out, kept)                                     # [C, N, K]
    v_unit = torch.stack([(_evaluate(unit, degree, axis) * v_basis).sum(-1) for axis in range(3)], -1)
    v_dirs = (v_unit - unit * (unit * v_unit).sum(-1, keepdim=True)) / length
    v_dirs = torch.where(mask[..., None], v_dirs, 0.0)
    return v_dirs.sum(0), -v_dirs.sum(1), v_coeffs


def _directions(means: Tensor, centers: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Unit directions `[C, N, 3]` and lengths `[C, N, 1]`; along z, with length infinite, where there is none."""
    dirs = torch.where(mask[..., None], means - centers[:, None], 0.0)
    nowhere = (dirs == 0).all(-1, keepdim=True)
    dirs = torch.where(nowhere, dirs.new_tensor([0.0, 0.0, 1.0]), dirs)
    length = dirs.norm(dim=-1, keepdim=True)
    return dirs / length, torch.where(nowhere, math.inf, length)


def _evaluate(unit: Tensor, degree: int, derivative: int | None = None) -> Tensor:
    """The basis `[..., (degree + 1)^2]` at unit directions `[..., 3]`, or its derivative along one axis."""
    powers = [torch.ones_like(unit)]                                                        # 1, d, d^2, ... [..., 3]
    for _ in range(degree):
        powers.append(powers[-1] * unit)
    exponents = _monomials(degree)
    columns = [powers[i][..., 0] * powers[j][..., 1] * powers[k][..., 2] for i, j, k in exponents]
    return torch.stack(columns, -1) @ _table(degree, derivative, unit.dtype, unit.device)


def _monomials(degree: int) -> list[tuple[int, int, int]]:
    n = degree + 1
    return [(i, j, k) for i in range(n) for j in range(n) for k in range(n) if i + j + k <= degree]


@functools.cache
def _table(degree: int, derivative: int | None, dtype: torch.dtype, device: torch.device) -> Tensor:
    """`[monomials, (degree + 1)^2]`."""
    row = {exponents: i for i, exponents in enumerate(_monomials(degree))}
    table = torch.zeros(len(row), (degree + 1) ** 2, dtype=torch.float64)
    for column, (constant, polynomial) in enumerate(_BASIS[:(degree + 1) ** 2]):
        for exponents, factor in polynomial.items():
            e = list(exponents)
            scale = constant * factor
            if derivative is not None:
                scale *= e[derivative]
                e[derivative] = max(e[derivative] - 1, 0)
            table[row[e[0], e[1], e[2]], column] += scale
    return table.to(dtype=dtype, device=device)
