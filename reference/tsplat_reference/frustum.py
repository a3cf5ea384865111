"""Which splats cameras may see: a test of bounds, in half the time of projecting them, that never loses one."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from tsplat_reference.constants import ALPHA_MIN, FRUSTUM_MARGIN, VIEW_SLACK
from tsplat_reference.parallel import map_chunks

CHUNK = 1 << 15       # splats asked at a time, so that what is computed of them stays in the cache
ROUNDING = 32         # errors of eps/2 that a coordinate, here and in the projection, can have at most, with room


@torch.no_grad()
def may_see(means: Tensor, sizes: Tensor, opacities: Tensor, planes: Tensor) -> Tensor:
    """Bool `[C, N]`, the splats that each camera may see: all that the projection keeps, and few others.

    A splat is drawn where alpha reaches 1/255: up to e = sqrt(2 ln(255 o)) standard deviations from its mean, on the screen and, before
    that, in space, where none is longer than its largest scale s. The projection stretches that by at most the norm of its Jacobian, blurs by
    `eps2d` and rounds up to whole pixels. So the mean is no farther than e s |J| from a frustum of that many pixels more on each side. All
    sides are planes in space: a splat may be seen if it is on the inner side of each, by -e s |J| at least.

    Fisheye cameras, which see half of space and more, are asked for near and far alone; so is what has an opacity above 1, which the blur
    takes farther than those pixels.

    Args:
        means: `[N, 3]`.
        sizes: `[N]`, the largest scale of each, or more.
        opacities: `[N]`; antialiasing can only lower them.
        planes: `[C, P, 6]`, see `frustum_planes`.
    """
    cameras, count = planes.shape[:2]
    flat = planes.flatten(0, 1).T.to(means)                                  # [6, C P]

    def seen(rows: slice) -> Tensor:
        mean, opacity = means[rows], opacities[rows]
        e = (2 * torch.log(opacity / ALPHA_MIN) + VIEW_SLACK).clamp(min=0).sqrt()
        features = torch.cat([mean, torch.ones_like(mean[:, :1]), mean.abs().sum(1, keepdim=True), (e * sizes[rows])[:, None]], 1)       # [n, 6]
        inside = (features @ flat > 0).view(-1, cameras, count)              # not so where anything is NaN, which is not drawn either
        inside = inside[..., :2].all(-1) & (inside[..., 2:].all(-1) | (opacity > 1)[:, None])
        return (inside & (opacity > (1 - VIEW_SLACK) * ALPHA_MIN)[:, None]).T

    return torch.cat([means.new_empty(cameras, 0, dtype=torch.bool), *map_chunks(seen, len(means), CHUNK)], 1)


@torch.no_grad()
def frustum_planes(viewmats: Tensor, Ks: Tensor, width: int, height: int, model: str, near: float, far: float, eps2d: float) -> Tensor:
    """`[C, 2 or 6, 6]` float64 on the CPU, near and far first: the factors of a mean's x, y, z, of 1, of |x| + |y| + |z|, and of e s, in what is
    positive inside of a plane.

    Args:
        viewmats, Ks: `[C, 4, 4]` and `[C, 3, 3]`.
        width, height, model, near, far: as in `tsplat.Camera`.
        eps2d: blur in pixels squared.
    """
    eps = ROUNDING * torch.finfo(viewmats.dtype).eps / 2
    matrices, K = viewmats.detach().cpu().double(), Ks.detach().cpu().double()
    X, Y, Z = matrices[:, :3].unbind(1)                                      # [C, 4]: a coordinate in the camera's axes
    one = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand_as(Z)
    stretch = torch.linalg.matrix_norm(matrices[:, :3, :3], 2) * (1 + VIEW_SLACK)        # [C], 1 up to rounding

    def plane(row: Tensor, parts: Tensor, gain: Tensor) -> Tensor:
        """`[C, 6]` of `row` `[C, 4]`, of which `parts` `[2, C, 4]` are the terms that are rounded on their own."""
        size = parts.abs().sum(0)
        return torch.cat([row[:, :3], torch.stack([row[:, 3] + eps * size[:, 3], eps * size[:, :3].amax(1), gain * stretch], 1)], 1)

    near = near if model == "orthographic" else max(near, 0.0)
    planes = [plane(sign * (Z - z * one), torch.stack([Z, z * one]), torch.zeros_like(stretch)) for sign, z in ((1, near), (-1, far))]
    if model == "fisheye":
        return torch.stack(planes, 1)
    pixels = math.sqrt(2 * math.log(1 / ALPHA_MIN) * eps2d) + 1              # of blur and of rounding up
    w = Z if model == "pinhole" else one                                     # u = (f X + c w) / w
    for f, c, size, axis in ((K[:, 0, 0], K[:, 0, 2], width, X), (K[:, 1, 1], K[:, 1, 2], height, Y)):
        steepest = torch.maximum(c.abs(), (size - c).abs()) + FRUSTUM_MARGIN * size / 2              # |f x/z| at most, in the Jacobian
        gain = torch.hypot(f, steepest) if model == "pinhole" else f.abs()                           # |J| w
        for sign, edge in ((1, -pixels), (-1, size + pixels)):
            along, across = f[:, None] * axis, (c - edge)[:, None] * w
            planes.append(plane(sign * (along + across), torch.stack([along, (c.abs() + abs(edge))[:, None] * w]), gain))
    return torch.stack(planes, 1)
