"""Normals of what a depth map shows, by finite differences: they need nothing but depth, whatever the scene is made of."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

from tsplat.camera import Camera
from tsplat.checks import check_tensor

EDGE = 2.0
"""A step to the next pixel that is this many times as long as the one to the other side crosses an edge."""


def camera_points(depth: Tensor, camera: Camera) -> Tensor:
    """The points `[H, W, 3]` in the camera's axes that pixels of depth (camera z) `[H, W]` show: the inverse of the projection.

    NaN where a fisheye sees more than 90 degrees off its axis, which has no such depth.

    Raises:
        ValueError: for a batch of cameras, and for depth of another size than the camera's.
    """
    if camera.batched:
        raise ValueError(f"camera: expected one camera; got a batch of {len(camera)}")
    check_tensor("depth", depth, (camera.height, camera.width))
    rows, columns = (torch.arange(n, dtype=depth.dtype, device=depth.device) + 0.5 for n in (camera.height, camera.width))
    K = camera.Ks.to(depth)
    x, y = (columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1]
    xy = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)                          # [H, W, 2]
    if camera.model == "orthographic":
        return torch.cat([xy, depth[..., None]], -1)
    if camera.model == "fisheye":
        angle = xy.norm(dim=-1, keepdim=True)
        xy = xy * torch.where(angle < math.pi / 2, angle.tan() / angle.clamp(min=1e-6), torch.nan)
    return torch.cat([xy, torch.ones_like(xy[..., :1])], -1) * depth[..., None]


def normals(depth: Tensor, solid: Tensor, camera: Camera) -> Tensor:
    """Unit normals `[H, W, 3]` in the camera's axes (x right, y down, z forward), towards the camera; NaN where there are none.

    The cross product of the differences of `camera_points` along columns and rows: central ones inside a surface, and at an edge,
    where the step to one side is much longer (or leads to what is not solid), those to the other side.

    Args:
        depth: `[H, W]` camera z.
        solid: bool `[H, W]`, where it means something.
        camera: with which it was rendered, not a batch.
    """
    points = camera_points(depth, camera).where(solid[..., None], torch.inf)
    across, down = _slope(points), _slope(points.transpose(0, 1)).transpose(0, 1)
    normal = normalize(torch.linalg.cross(down, across), dim=-1, eps=0.0)
    return normal.where(normal.isfinite().all(-1, keepdim=True) & solid[..., None], torch.nan)


def _slope(points: Tensor) -> Tensor:
    """Differences `[H, W, 3]` per column, of points that are infinite where there is nothing; not finite where no neighbour is."""
    steps = points.diff(dim=1)
    steps = steps.where(steps.isfinite().all(-1, keepdim=True), torch.inf)
    before, after = pad(steps, (0, 0, 1, 0), value=torch.inf), pad(steps, (0, 0, 0, 1), value=torch.inf)       # [H, W, 3]
    lengths = torch.stack([before.norm(dim=-1, keepdim=True), after.norm(dim=-1, keepdim=True)])
    slope = torch.where(lengths[0] > EDGE * lengths[1], after, (before + after) / 2)
    return torch.where(lengths[1] > EDGE * lengths[0], before, slope)
