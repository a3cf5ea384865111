"""The parameters of Gaussians as arrays, on their way from or to a file: codes of opacities and rotations, turned axes."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
import tsplat_reference as reference
from numpy.typing import NDArray
from torch import Tensor

from tsplat.scene.gaussians import Gaussians
from tsplat.scene.ply import MAX_LOGIT

Floats = NDArray[np.floating[Any]]
UP_AND_FRONT = np.diag([-1.0, -1.0, 1.0])       # a half turn about z: from x right, y down, z front to x left, y up, z front, and back
UP_AND_BACK = np.diag([1.0, -1.0, -1.0])        # a half turn about x: from x right, y down, z front to x right, y up, z back, and back


@dataclass(frozen=True)
class Fields:
    """Arrays: means `[N, 3]`, quats `[N, 4]` wxyz, log_scales `[N, 3]`, logits `[N]` of opacities, sh0 `[N, 3]`, sh_rest `[N, K - 1, 3]`."""

    means: Floats
    quats: Floats
    log_scales: Floats
    logits: Floats
    sh0: Floats
    sh_rest: Floats

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """Of the spherical harmonics."""
        return math.isqrt(self.sh_rest.shape[1] + 1) - 1

    @classmethod
    def of(cls, path: str | os.PathLike[str], gaussians: Gaussians, max_degree: int) -> Fields:
        """What of `gaussians` a file of unit quaternions and bounded numbers can hold; what it cannot hold is left out with a warning.

        Splats that no renderer draws are left out (NaN or infinity in the mean, the rotation or a colour, NaN elsewhere, a zero
        quaternion), and so are coefficients beyond `max_degree`. Quaternions are normalised, logits clamped to +-16.
        """
        means, quats, log_scales, logits, sh0, sh_rest = (_array(getattr(gaussians, name)) for name in Gaussians.NAMES)
        finite = [np.isfinite(values).all(tuple(range(1, values.ndim))) for values in (means, quats, sh0, sh_rest)]
        lengths = np.linalg.norm(quats.astype(np.float64), axis=1, keepdims=True)     # float32 would overflow at 1e19
        keep = np.logical_and.reduce([*finite, lengths[:, 0] > 0, ~np.isnan(log_scales).any(1), ~np.isnan(logits)])
        if not keep.all():
            warnings.warn(f"{os.fspath(path)}: {int((~keep).sum())} of {len(keep)} splats with NaN, infinity or no rotation are left out")
        if gaussians.sh_degree > max_degree:
            warnings.warn(f"{os.fspath(path)}: this format holds spherical harmonics up to degree {max_degree}; those beyond are left out")
        with np.errstate(invalid="ignore", divide="ignore"):
            quats = (quats / lengths).astype(np.float32)
        return cls(means[keep], quats[keep], log_scales[keep], logits[keep].clip(-MAX_LOGIT, MAX_LOGIT), sh0[keep, 0],
                   sh_rest[keep, :(max_degree + 1) ** 2 - 1])

    @classmethod
    def joined(cls, parts: Sequence[Fields]) -> Fields:
        """One after the other, with the highest degree of theirs."""
        most = max(part.sh_rest.shape[1] for part in parts)
        padded = [replace(part, sh_rest=np.pad(part.sh_rest, ((0, 0), (0, most - part.sh_rest.shape[1]), (0, 0)))) for part in parts]
        return cls(*(np.concatenate([getattr(part, item.name) for part in padded]) for item in fields(cls)))

    def gaussians(self) -> Gaussians:
        """As a module."""
        return Gaussians(*(torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32)) for values in (
            self.means, self.quats, self.log_scales, self.logits, self.sh0[:, None], self.sh_rest)))

    def turned(self, rotation: NDArray[np.float64]) -> Fields:
        """The same splats after a rotation `[3, 3]` of the world.

        Half turns about an axis are exact, and turn the own axes of the splats, too: signs change, as in what other programs write.
        """
        if np.count_nonzero(rotation) == 3:
            quats = self.quats * np.array([1, *rotation.diagonal()], np.float32)
        else:
            w, x, y, z = (self.quats[:, i] for i in range(4))
            a, b, c, d = _quaternion(rotation)
            quats = np.stack([a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y,
                              a * y - b * z + c * w + d * x, a * z + b * y - c * x + d * w], axis=1)
        matrix = _harmonics_rotation(self.degree, rotation)[1:, 1:].astype(np.float32)
        with np.errstate(invalid="ignore", over="ignore"):                            # means and coefficients may be infinite
            return replace(self, means=self.means @ rotation.T.astype(np.float32), quats=quats,
                           sh_rest=np.einsum("jk,nkc->njc", matrix, self.sh_rest))


def _array(parameter: Tensor) -> Floats:
    values: Floats = parameter.detach().to("cpu", torch.float32).numpy()
    return values


def _quaternion(rotation: NDArray[np.float64]) -> list[np.float32]:
    """wxyz of a rotation matrix (Shepperd's method: divide by the largest component)."""
    m = rotation
    squares = np.array([1 + m[0, 0] + m[1, 1] + m[2, 2], 1 + m[0, 0] - m[1, 1] - m[2, 2],
                        1 - m[0, 0] + m[1, 1] - m[2, 2], 1 - m[0, 0] - m[1, 1] + m[2, 2]])      # 4 q_i^2
    products = np.array([[squares[0], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
                         [m[2, 1] - m[1, 2], squares[1], m[1, 0] + m[0, 1], m[0, 2] + m[2, 0]],
                         [m[0, 2] - m[2, 0], m[1, 0] + m[0, 1], squares[2], m[2, 1] + m[1, 2]],
                         [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2], squares[3]]])   # 4 q_i q_j
    row = products[squares.argmax()]
    return list((row / np.linalg.norm(row)).astype(np.float32))


def _harmonics_rotation(degree: int, rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """`[K, K]`, by which the coefficients of a function on the sphere are multiplied when it is rotated.

    With Y the basis, Y(R d) c' = Y(d) c for all directions d, which a handful of them determine.
    """
    count = (degree + 1) ** 2
    directions = np.random.default_rng(0).normal(size=(4 * count, 3))
    basis, rotated = (_basis(degree, d) for d in (directions, directions @ rotation.T))
    matrix = np.linalg.lstsq(rotated, basis, rcond=None)[0]
    nearest = np.round(matrix)
    return np.where(abs(matrix - nearest) < 1e-9, nearest, matrix)                    # so that signs are flipped exactly


def _basis(degree: int, directions: NDArray[np.float64]) -> NDArray[np.float64]:
    n, count = len(directions), (degree + 1) ** 2
    points = torch.from_numpy(directions)
    each = torch.eye(count, dtype=torch.float64).expand(n, count, count)
    mask = torch.ones(1, n, dtype=torch.bool)
    with torch.no_grad():
        values: NDArray[np.float64] = reference.harmonics(points, points.new_zeros(1, 3), each, degree, mask)[0].numpy()
    return values


def logits_of(opacities: Floats) -> Floats:
    """The logit of opacities in 0..1, at most 16: 0 and 1, which codes of 8 bits have, would be infinite. NaN stays."""
    with np.errstate(divide="ignore", invalid="ignore"):
        opacities = np.asarray(opacities, dtype=np.float64).clip(0, 1)
        logits: Floats = (np.log(opacities) - np.log1p(-opacities)).clip(-MAX_LOGIT, MAX_LOGIT)
    return logits


def opacities_of(logits: Floats) -> NDArray[np.float64]:
    """In 0..1."""
    opacities: NDArray[np.float64] = 1 / (1 + np.exp(-logits.astype(np.float64)))
    return opacities


def log_scales_of(scales: Floats) -> Floats:
    """Logarithms of scales of at least the smallest normal number, as flat splats have a scale of 0. NaN stays."""
    with np.errstate(invalid="ignore"):
        logarithms: Floats = np.log(np.maximum(scales, np.finfo(np.float32).tiny))
    return logarithms


def rounded(values: Floats, largest: int) -> NDArray[np.uint32]:
    """The nearest of 0, 1, ..., `largest`."""
    return np.floor(values.clip(0, largest) + 0.5).astype(np.uint32)


def smallest_three(quats: Floats) -> tuple[NDArray[np.uint32], NDArray[np.float64]]:
    """Unit quaternions `[N, 4]` as the index `[N]` of the largest component and the others `[N, 3]` in their order, within +-sqrt(1/2).

    The largest is made positive (q and -q are the same rotation), so that it follows from the others.
    """
    largest = abs(quats).argmax(1)
    value = np.take_along_axis(quats, largest[:, None], 1)
    others = np.nonzero(np.arange(4) != largest[:, None])[1].reshape(-1, 3)
    small = np.take_along_axis(quats, others, 1).astype(np.float64)
    return largest.astype(np.uint32), np.where(value < 0, -small, small)


def from_smallest_three(largest: NDArray[np.integer[Any]], small: Floats) -> Floats:
    """The inverse of `smallest_three`."""
    quats = np.empty((len(small), 4), np.float32)
    others = np.nonzero(np.arange(4) != largest[:, None])[1].reshape(-1, 3)
    np.put_along_axis(quats, others, small.astype(np.float32), 1)
    value = np.sqrt((1 - np.square(small).sum(1)).clip(0, None))
    np.put_along_axis(quats, largest[:, None].astype(np.int64), value[:, None].astype(np.float32), 1)
    return quats


