"""The outline of each sphere in the image, a sphere and camera to a thread."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor
from tsplat_reference.constants import EVERYWHERE, ON_OUTLINE

from tsplat.kernels.launch import Launcher, ceil_div, launch

ANYWHERE = tl.constexpr(EVERYWHERE)
OUTLINE = tl.constexpr(ON_OUTLINE)


@Launcher
@triton.jit(do_not_specialize=["R", "N", "rows", "W", "H"])
def outlines_kernel(centers, radii, Ks, radii2d, means2d, conics, opacities, depths, R, N, rows, W, H, near: tl.float64, far: tl.float64,
                    ORTHO: tl.constexpr, BLOCK: tl.constexpr):
    """See `tsplat_reference.outlines`."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    real = i < R
    x = tl.load(centers + 3 * i, mask=real, other=0.0)
    y = tl.load(centers + 3 * i + 1, mask=real, other=0.0)
    z = tl.load(centers + 3 * i + 2, mask=real, other=0.0)
    r = tl.load(radii + i % rows, mask=real, other=1.0)
    dt: tl.constexpr = x.dtype
    nearest = tl.full((), near, dt)
    farthest = tl.full((), far, dt)
    K = Ks + i // N * 9
    fx = tl.load(K, mask=real, other=1.0)
    fy = tl.load(K + 4, mask=real, other=1.0)
    cx = tl.load(K + 2, mask=real, other=0.0)
    cy = tl.load(K + 5, mask=real, other=0.0)
    finite = (tl.abs(x + y + z + r) < float("inf")) & (r > 0)
    x = tl.where(finite, x, 1.0)
    y = tl.where(finite, y, 1.0)
    z = tl.where(finite, z, 1.0)
    r = tl.where(finite, r, 1.0)
    if ORTHO:
        depth = z - r
        seen = finite & (z > nearest) & (depth < farthest)
        u = fx * x + cx
        v = fy * y + cy
        a = 1.0 / ((fx * r) * (fx * r))
        b = x * 0.0
        c = 1.0 / ((fy * r) * (fy * r))
    else:
        distance = tl.sqrt(x * x + y * y + z * z)
        depth = distance - r
        tangent2 = depth * (distance + r)               # squared length of a tangent
        seen = finite & (depth > 0) & (tl.sqrt(tl.maximum(tangent2, 0.0)) > nearest) & (depth < farthest) & (z > -r)
        ellipse = seen & (z > r)
        before = tl.where(ellipse, (z - r) * (z + r), 1.0)
        scale = before / (r * r * tl.where(ellipse, tangent2, 1.0))
        u = tl.where(ellipse, fx * (x * z / before) + cx, W.to(dt) / 2)
        v = tl.where(ellipse, fy * (y * z / before) + cy, H.to(dt) / 2)
        anywhere = tl.full((), ANYWHERE, dt)
        a = tl.where(ellipse, scale * (y * y + before) / (fx * fx), anywhere)
        b = tl.where(ellipse, -scale * x * y / (fx * fy), 0.0)
        c = tl.where(ellipse, scale * (x * x + before) / (fy * fy), anywhere)
    tl.store(radii2d + 2 * i, seen.to(tl.int32), mask=real)
    tl.store(radii2d + 2 * i + 1, seen.to(tl.int32), mask=real)
    tl.store(means2d + 2 * i, u, mask=real)
    tl.store(means2d + 2 * i + 1, v, mask=real)
    tl.store(conics + 3 * i, a, mask=real)
    tl.store(conics + 3 * i + 1, b, mask=real)
    tl.store(conics + 3 * i + 2, c, mask=real)
    tl.store(opacities + i, tl.full((BLOCK,), OUTLINE, dt), mask=real)
    tl.store(depths + i, depth, mask=real)


def outlines(centers: Tensor, radii: Tensor, Ks: Tensor, width: int, height: int, model: str, near: float, far: float
             ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Launcher; see `tsplat_reference.outlines`."""
    C, N = centers.shape[:2]
    out = (centers.new_empty(C, N, 2, dtype=torch.int32), centers.new_empty(C, N, 2), centers.new_empty(C, N, 3), centers.new_empty(C, N),
           centers.new_empty(C, N))
    if C * N:
        options = launch("outlines")
        outlines_kernel[(ceil_div(C * N, options["BLOCK"]),)](centers.contiguous(), radii.contiguous(), Ks.contiguous(), *out, C * N, N,
                                                              radii.shape[0] * N, width, height, near, far, ORTHO=model == "orthographic",
                                                              **options)
    return out
