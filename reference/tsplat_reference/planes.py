"""Small matrices for many splats at once: each entry is a tensor over the splats (a plane), or 0.0 where it is always zero.

Operations on whole planes run at the speed of memory; torch's batched products of 3 x 3 matrices take ten times as long.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

Plane = Tensor | float
Vector = Sequence[Plane]
Matrix = Sequence[Vector]


def dot(a: Vector, b: Vector) -> Plane:
    """Sum of products, without those that are always zero."""
    total: Plane = 0.0
    for x, y in zip(a, b, strict=True):
        if isinstance(x, Tensor) and isinstance(y, Tensor):
            total = torch.addcmul(total, x, y) if isinstance(total, Tensor) else x * y
    return total


def matmul(a: Matrix, b: Matrix) -> list[list[Plane]]:
    """Matrix product."""
    columns = transpose(b)
    return [[dot(row, column) for column in columns] for row in a]


def transpose(a: Matrix) -> list[list[Plane]]:
    """Matrix transpose."""
    return [list(column) for column in zip(*a, strict=True)]


def cross(a: Vector, b: Vector) -> list[Tensor]:
    """Vector product of 3-vectors."""
    x, y, z = ([torch.as_tensor(p) for p in pair] for pair in zip(a, b, strict=True))
    return [torch.addcmul(p[0] * q[1], q[0], p[1], value=-1) for p, q in ((y, z), (z, x), (x, y))]


def split(tensor: Tensor) -> list[Tensor]:
    """The planes `[...]` of a tensor `[..., D]`, each contiguous."""
    return [plane.contiguous() for plane in tensor.unbind(-1)]      # four times as fast as a transposed copy of the whole


def total(plane: Plane, like: Tensor) -> Tensor:
    """Sum over the splats, the last dimension of `like`; zeros if the plane is 0.0."""
    return plane.sum(-1) if isinstance(plane, Tensor) else like.new_zeros(like.shape[:-1])


def join(planes: Vector, like: Tensor) -> Tensor:
    """Planes to one tensor `[..., D]`, where `like` `[...]` is any plane of full shape."""
    return torch.stack([p if isinstance(p, Tensor) else torch.zeros_like(like) for p in planes], -1)
