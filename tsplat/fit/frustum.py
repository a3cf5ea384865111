"""Which splats a camera may see: a test of bounds, in half the time of projecting them, that never loses one."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from tsplat_reference.constants import ALPHA_MIN, EPS2D, FRUSTUM_MARGIN
from tsplat_reference.parallel import map_chunks

from tsplat.camera import Camera

CHUNK = 1 << 15       # splats asked at a time, so that what is computed of them stays in the cache
ROUNDING = 32         # errors of eps/2 that a coordinate, here and in the projection, can have at most, with room
SLACK = 1e-4          # relative, of sizes and opacities


@torch.no_grad()
def may_see(means: Tensor, sizes: Tensor, opacities: Tensor, camera: Camera) -> Tensor:
    """The splats that `camera` may see, int64 `[V]`, ascending: all that `tsplat.rasterize` draws (at its default blur), and few others.

    A splat is drawn where alpha reaches 1/255: up to e = sqrt(2 ln(255 o)) standard deviations from its mean, on the screen and, before
    that, in space, where none is longer than its largest scale s. The projection stretches that by at most the norm of its Jacobian, blurs by
    `EPS2D` and rounds up to whole pixels. So the mean is no farther than e s |J| from a frustum of that many pixels more on each side. All
    sides are planes in space: a splat may be seen if it is on the inner side of each, by -e s |J| at least.

    Fisheye cameras, which see half of space and more, are asked for near and far alone.

    Args:
        means: `[N, 3]`.
        sizes: `[N]`, the largest scale of each.
        opacities: `[N]` in 0..1; antialiasing can only lower them.
        camera: a single one, on the same device.
    """
    planes = _planes(camera).to(means)

    def chosen(rows: slice) -> Tensor:
        mean, opacity = means[rows], opacities[rows]
        e = (2 * torch.log(opacity / ALPHA_MIN) + SLACK).clamp(min=0).sqrt()
        features = torch.cat([mean, torch.ones_like(mean[:, :1]), mean.abs().sum(1, keepdim=True), (e * sizes[rows])[:, None]], 1)       # [n, 6]
        inside = (features @ planes.T > 0).all(1)                            # not so where anything is NaN, which is not drawn either
        inside &= opacity > (1 - SLACK) * ALPHA_MIN
        return inside.nonzero()[:, 0] + int(rows.start)

    return torch.cat([means.new_empty(0, dtype=torch.int64), *map_chunks(chosen, len(means), CHUNK)])


def _planes(camera: Camera) -> Tensor:
    """`[2 or 6, 6]` float64: the factors of a mean's x, y, z, of 1, of |x| + |y| + |z|, and of e s, in what is positive inside of a plane."""
    viewmat, (K0, K1, _) = camera.viewmats.detach().double().cpu(), camera.Ks.tolist()
    X, Y, Z = viewmat[:3]                                                    # [4]: a coordinate in the camera's axes
    one = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    stretch = float(torch.linalg.matrix_norm(viewmat[:3, :3], 2)) * (1 + SLACK)          # 1, up to rounding
    eps = ROUNDING * torch.finfo(camera.viewmats.dtype).eps / 2
    near = camera.near if camera.model == "orthographic" else max(camera.near, 0.0)

    def plane(row: Tensor, parts: Tensor, gain: float) -> Tensor:
        """`row` `[4]`, of which `parts` `[2, 4]` are the terms that are rounded on their own."""
        size = parts.abs().sum(0)
        return torch.cat([row[:3], torch.stack([row[3] + eps * size[3], eps * size[:3].max(), row.new_tensor(gain * stretch)])])

    planes = [plane(sign * (Z - z * one), torch.stack([Z, z * one]), 0.0) for sign, z in ((1, near), (-1, camera.far))]
    if camera.model == "fisheye":
        return torch.stack(planes)
    pixels = math.sqrt(2 * math.log(1 / ALPHA_MIN) * EPS2D) + 1              # of blur and of rounding up
    pinhole = camera.model == "pinhole"
    w = Z if pinhole else one                                                # u = (f X + c w) / w
    for f, c, size, axis in ((K0[0], K0[2], camera.width, X), (K1[1], K1[2], camera.height, Y)):
        steepest = max(abs(c), abs(size - c)) + FRUSTUM_MARGIN * size / 2    # |f x/z| at most, in the Jacobian
        gain = math.hypot(f, steepest) if pinhole else abs(f)                # |J| w
        for sign, edge in ((1, -pixels), (-1, size + pixels)):
            planes.append(plane(sign * (f * axis + (c - edge) * w), torch.stack([f * axis, (abs(c) + abs(edge)) * w]), gain))
    return torch.stack(planes)
