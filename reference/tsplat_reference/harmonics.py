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
from tsplat_reference.planes import split

MAX_DEGREE = 4
CHUNK = 1 << 15
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
    unit, _ = _directions(means, centers, mask)
    basis = _monomials(unit, degree) @ _table(degree, unit)[0]           # [C, N, K]
    return torch.where(mask[..., None], torch.einsum("cnk,nkd->cnd", basis, coeffs[:, :(degree + 1) ** 2]), 0.0)


def harmonics_backward(means: Tensor, centers: Tensor, coeffs: Tensor, degree: int, mask: Tensor, v_out: Tensor
                       ) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients with respect to means, centers and coeffs."""
    if means.shape[0] > CHUNK:
        parts = map_chunks(lambda rows: harmonics_backward(means[rows], centers, coeffs[rows], degree, mask[:, rows], v_out[:, rows]),
                           means.shape[0], CHUNK)
        return (torch.cat([p[0] for p in parts]), torch.stack([p[1] for p in parts]).sum(0), torch.cat([p[2] for p in parts]))
    v_out = torch.where(mask[..., None], v_out, 0.0)
    used = (degree + 1) ** 2
    unit, length = _directions(means, centers, mask)
    both = (_monomials(unit, degree) @ _table(degree, unit).movedim(0, 1).reshape(-1, 4 * used)).view(*mask.shape, 4, used)
    basis, slopes = both[..., 0, :], both[..., 1:, :]
    v_coeffs = torch.einsum("cnk,cnd->nkd", basis, v_out)
    if used < coeffs.shape[1]:
        v_coeffs = torch.nn.functional.pad(v_coeffs, (0, 0, 0, coeffs.shape[1] - used))
    v_basis = coeffs[:, :used] @ v_out[..., None]
    v_unit = (slopes @ v_basis)[..., 0]
    v_dirs = (v_unit - unit * (unit * v_unit).sum(-1, keepdim=True)) / length
    v_dirs = torch.where((v_out != 0).any(-1, keepdim=True), v_dirs, 0.0)                   # 0 also where the coefficients are NaN
    return v_dirs.sum(0), -v_dirs.sum(1), v_coeffs


def _directions(means: Tensor, centers: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Unit directions `[C, N, 3]` and lengths `[C, N, 1]`; along z, with length infinite, where there is none."""
    dirs = torch.where(mask[..., None], means - centers[:, None], 0.0)
    nowhere = (dirs == 0).all(-1, keepdim=True)
    dirs = torch.where(nowhere, dirs.new_tensor([0.0, 0.0, 1.0]), dirs)
    length = dirs.norm(dim=-1, keepdim=True)
    return dirs / length, torch.where(nowhere, math.inf, length)


def _exponents(degree: int) -> list[tuple[int, int, int]]:
    """Of all monomials up to the degree; each after the one that it is a multiple of."""
    n = degree + 1
    return [(i, j, k) for i in range(n) for j in range(n) for k in range(n) if i + j + k <= degree]


def _monomials(unit: Tensor, degree: int) -> Tensor:
    """All monomials `[..., M]` at unit directions `[..., 3]`, stored as planes."""
    axes = split(unit)
    planes = {(0, 0, 0): torch.ones_like(unit[..., 0])}
    for e in _exponents(degree)[1:]:
        axis = next(a for a in range(3) if e[a])
        planes[e] = planes[e[0] - (axis == 0), e[1] - (axis == 1), e[2] - (axis == 2)] * axes[axis]
    return torch.stack(list(planes.values())).movedim(0, -1)


def _table(degree: int, like: Tensor) -> Tensor:
    """`[4, M, (degree + 1)^2]`: the basis, and its derivatives along x, y and z, over the monomials."""
    return torch.tensor(_entries(degree), dtype=like.dtype, device=like.device)


@functools.cache
def _entries(degree: int) -> list[list[list[float]]]:
    """Of the table: numbers, as a tensor that was made and cached in inference mode or fake mode would not serve elsewhere."""
    row = {e: i for i, e in enumerate(_exponents(degree))}
    table = [[[0.0] * (degree + 1) ** 2 for _ in row] for _ in range(4)]
    for column, (constant, polynomial) in enumerate(_BASIS[:(degree + 1) ** 2]):
        for e, factor in polynomial.items():
            table[0][row[e]][column] += constant * factor
            for axis in range(3):
                if e[axis]:
                    lower = e[0] - (axis == 0), e[1] - (axis == 1), e[2] - (axis == 2)
                    table[1 + axis][row[lower]][column] += constant * factor * e[axis]
    return table
