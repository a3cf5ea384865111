"""A smooth path through poses, in a good order: what `capture_path` is made of."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

STEPS = 32                  # of each piece of a path, between which its length is taken for straight


class Poses(NamedTuple):
    """Where cameras are and how they are turned, in float64.

    eyes: `[n, 3]` world. quats: `[n, 4]` unit (w, x, y, z), camera to world.
    """

    eyes: Tensor
    quats: Tensor

    @staticmethod
    def of(viewmats: Tensor) -> Poses:
        """Of `[n, 4, 4]`, world to camera."""
        from kornia.geometry.conversions import rotation_matrix_to_quaternion

        turns = viewmats[:, :3, :3].double().mT
        return Poses(-(turns @ viewmats[:, :3, 3:].double())[..., 0], rotation_matrix_to_quaternion(turns.contiguous()))

    def viewmats(self) -> Tensor:
        """`[n, 4, 4]` float64, world to camera."""
        from kornia.geometry.conversions import quaternion_to_rotation_matrix

        rotations = quaternion_to_rotation_matrix(self.quats).mT
        matrices = torch.eye(4, dtype=torch.float64).repeat(len(rotations), 1, 1)
        matrices[:, :3, :3], matrices[:, :3, 3] = rotations, -(rotations @ self.eyes[..., None])[..., 0]
        return matrices

    def at(self, index: Tensor) -> Poses:
        """Those of these indices."""
        return Poses(self.eyes[index], self.quats[index])

    def mixed(self, other: Poses, part: Tensor) -> Poses:
        """Between two lists of poses, or beyond: `part` `[n]` is 0 at these and 1 at the others. Rotations by slerp (Shoemake 1985)."""
        from kornia.geometry.conversions import axis_angle_to_quaternion, quaternion_to_axis_angle
        from kornia.geometry.quaternion import Quaternion

        start = Quaternion(self.quats)              # its slerp takes a list of parts from kornia 0.9 on only, which is not for Python 3.10
        turn = quaternion_to_axis_angle((start.conj() * Quaternion(other.quats)).data)
        turned: Quaternion = start * Quaternion(axis_angle_to_quaternion(part[:, None] * turn))
        return Poses(torch.lerp(self.eyes, other.eyes, part[:, None]), turned.data)

    def distance(self, other: Poses, unit: float) -> Tensor:
        """How far the eyes are from each other, in units of `unit`, plus the angle between the views in radians. Broadcasts."""
        cosine = (self.quats * other.quats).sum(-1).abs().clamp(max=1)
        apart: Tensor = (self.eyes - other.eyes).norm(dim=-1)
        return apart / unit + 2 * cosine.acos()


def round_trip(distances: Tensor, *, closed: bool) -> Tensor:
    """A short way through all places: int64 `[n]`, their order.

    It begins as the order in which they are given and is improved by turning around pieces of it as long as that makes it shorter
    (2-opt, Croes 1958).

    Args:
        distances: `[n, n]`, symmetric.
        closed: whether the way back to the first counts.
    """
    n = len(distances)
    if not closed:                               # by way of a place that is near to all: where it is, the way is open
        distances = torch.nn.functional.pad(distances, (0, 1, 0, 1))
    D, tour = distances.numpy(), np.arange(len(distances))
    while True:
        here, following = tour, np.roll(tour, -1)
        gain = D[here[:, None], here] + D[following[:, None], following] - D[here, following][:, None] - D[here, following]
        i, j = divmod(int(np.triu(gain, 1).argmin()), len(tour))
        if i == j or gain[i, j] > -1e-9 * D.max():
            break
        tour[i + 1:j + 1] = tour[i + 1:j + 1][::-1].copy()
    tour = np.roll(tour, -int(np.flatnonzero(tour == (0 if closed else n))[0]))
    order = tour if closed else tour[1:]
    return torch.from_numpy(order[::-1].copy() if order[0] > order[-1] and not closed else order.copy())


def spline(keys: Poses, frames: int, unit: float, *, closed: bool) -> Poses:
    """`frames` poses at an even speed along a centripetal Catmull-Rom spline through `keys`.

    The construction is Barry and Goldman's (1988), a pyramid of linear interpolations, which holds for rotations with slerp in their
    place (Schlag 1991). Centripetal knots (Yuksel et al. 2011) keep it from loops and cusps where keys are unevenly spread.

    Args:
        keys: at least one.
        frames: at least one.
        unit: of length, that weighs as much as a radian.
        closed: whether the path goes on from the last key to the first, which the last frame stops short of.
    """
    if len(keys.eyes) == 1:
        return keys.at(torch.zeros(frames, dtype=torch.long))
    keys, spacing = _with_ends(keys, unit, closed=closed)
    pieces = len(keys.eyes) - 3
    at = torch.arange(pieces * STEPS + 1, dtype=torch.float64) / STEPS
    fine = _on_spline(keys, spacing, at)
    length = torch.cat([at.new_zeros(1), fine.at(torch.arange(len(at) - 1)).distance(fine.at(torch.arange(1, len(at))), unit).cumsum(0)])
    wanted = torch.arange(frames) * (length[-1] / max(1, frames if closed else frames - 1))
    return _on_spline(keys, spacing, torch.from_numpy(np.interp(wanted.numpy(), length.numpy(), at.numpy())))


def _with_ends(keys: Poses, unit: float, *, closed: bool) -> tuple[Poses, Tensor]:
    """The keys with one more at each end (and the first once more, if closed), and the spacing of their knots."""
    n = len(keys.eyes)
    if closed:
        keys = keys.at(torch.arange(-1, n + 2) % n)
    else:                                                    # the ends mirrored: a path begins and ends straight
        one = torch.full((1,), -1.0, dtype=torch.float64)
        ends = keys.at(torch.tensor([0])).mixed(keys.at(torch.tensor([1])), one), keys.at(torch.tensor([-1])).mixed(keys.at(torch.tensor([-2])), one)
        keys = Poses(*(torch.cat(parts) for parts in zip(ends[0], keys, ends[1], strict=True)))
    gaps = keys.at(torch.arange(len(keys.eyes) - 1)).distance(keys.at(torch.arange(1, len(keys.eyes))), unit).sqrt()
    return keys, gaps.clamp(min=1e-3 * (float(gaps.max()) or 1.0))


def _on_spline(keys: Poses, spacing: Tensor, at: Tensor) -> Poses:
    """The poses at `at`, in pieces: at i + f, the part f of piece i, which goes from key i + 1 to key i + 2."""
    piece = at.long().clamp(max=len(keys.eyes) - 4)
    knots = torch.cat([spacing.new_zeros(1), spacing.cumsum(0)])
    k = [knots[piece + i] for i in range(4)]
    t = k[1] + (at - piece) * (k[2] - k[1])
    row = [keys.at(piece + i) for i in range(4)]
    for level in (1, 2):
        row = [row[i].mixed(row[i + 1], (t - k[i]) / (k[i + level] - k[i])) for i in range(4 - level)]
    return row[0].mixed(row[1], (t - k[1]) / (k[2] - k[1]))
