"""The Gaussian footprint as device functions: what blending knows of the shape of a splat.

A kernel gets `log2_alpha` and the sums of its derivative as constexprs and has no formula of its own, so that another footprint is another
set of these functions, as in tests/test_kernels_footprint.py. It may be any function of the record with the opacity as a factor, whose
derivatives by mean and conic are the Gaussian's times a number for each pixel: that is what `unpack_kernel` makes of the six sums.

A record is 12 numbers, three 16-byte loads: mean x, mean y, l00, l10 | l11, log2 opacity, colour 0, 1 | colour 2, 3, two that pad (colours only
up to 4 channels), with

    log2 alpha = log2 o - (l00 dx + l10 dy)^2 - (l11 dy)^2,

the Cholesky factor of the conic times sqrt(log2(e)/2): one FFMA less per pixel than the conic, and better conditioned where a long thin
splat is centred far away. Positions x are relative to the centre of the tile.
"""

import math

import triton
import triton.language as tl
from tsplat_reference.constants import ALPHA_MIN, TRANSMITTANCE_MIN

from tsplat.kernels.launch import Launcher
from tsplat.kernels.tiles import row_moments

LOG2_MIN = tl.constexpr(math.log2(ALPHA_MIN))
T_MIN = tl.constexpr(TRANSMITTANCE_MIN)
RECORD = 12
"""Numbers in a record."""
SUMS = tl.constexpr(12)
"""Numbers in a row of sums, which the backward collects per splat: 6 moments, 4 colours, 2 absolute gradients."""


@triton.jit
def log2_alpha(mx, my, l00, l10, l11, log2_opacity, x, y):
    """At positions x, y; the terms in y alone are computed once where y has fewer elements than x (a lane's pixels share a row)."""
    dy = y - my
    v = l11 * dy
    u = l00 * x + (l10 * dy - l00 * mx)
    return (log2_opacity - v * v) - u * u


@triton.jit
def mean_slopes(mx, my, l00, l10, l11, x, y):
    """dlog alpha/dmean x and y, over 2 ln 2."""
    dy = y - my
    u = l00 * x + (l10 * dy - l00 * mx)
    return l00 * u, l10 * u + l11 * (l11 * dy)


@triton.jit
def lane_moments(v, mx, my, l00, l10, l11, x, y):
    """Per lane: the six sums over the pixels of its row, at y, of v: dL/dlog alpha, times 1, dx, dy, dx^2, dx dy and dy^2."""
    s0, local_x, local_xx = row_moments(v)
    sx = local_x - mx * s0                              # shifted to the mean once per row, not per pixel
    sxx = local_xx - mx * (local_x + sx)
    dy = y - my
    sy = s0 * dy
    return s0, sx, sy, sxx, sx * dy, sy * dy


@triton.jit
def block_moments(v, mx, my, l00, l10, l11, x, y):
    """As `lane_moments`: the six sums `[1, K]` over the pixels (rows) of v `[P, K]`."""
    dx = x - mx
    dy = y - my
    vx = v * dx
    vy = v * dy
    return (tl.sum(v, 0, keep_dims=True), tl.sum(vx, 0, keep_dims=True), tl.sum(vy, 0, keep_dims=True),
            tl.sum(vx * dx, 0, keep_dims=True), tl.sum(vx * dy, 0, keep_dims=True), tl.sum(vy * dy, 0, keep_dims=True))


@triton.jit
def store4(p, v0, v1, v2, v3, mask):
    """Four consecutive numbers at each pointer: one 16-byte store."""
    every = tl.reshape(tl.join(tl.join(v0, v2), tl.join(v1, v3)), (v0.shape[0], 4))
    tl.store(p[:, None] + tl.arange(0, 4)[None, :], every, mask=mask[:, None])


@Launcher
@triton.jit(do_not_specialize=["R", "N"])
def pack_kernel(means2d, conics, opacities, colors, records, R, N, D: tl.constexpr, BLOCK: tl.constexpr):
    """Records of splats; culled ones (conic 0) get finite numbers. Record R is the null splat, which is nowhere.

    Colours have N rows, of which splat i takes i mod N: here once per splat, so that blending need not.
    """
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    real = i < R
    dt: tl.constexpr = records.dtype.element_ty
    scale = tl.full((), 0.8493218002880191, dt)         # sqrt(log2(e) / 2); a literal would be rounded to float32
    a = tl.load(conics + 3 * i, mask=real, other=0.0)
    b = tl.load(conics + 3 * i + 1, mask=real, other=0.0)
    c = tl.load(conics + 3 * i + 2, mask=real, other=0.0)
    some = a > 0
    l00 = tl.sqrt(tl.where(some, a, 1.0))
    l10 = tl.where(some, b / l00, 0.0)
    l11 = tl.sqrt(tl.maximum(c - l10 * l10, 0.0))
    opacity = tl.load(opacities + i, mask=real, other=0.0)
    log2_opacity = tl.where(opacity > 0, tl.log2(tl.where(opacity > 0, opacity, 1.0)), -1e9)
    row = (i % N) * D
    p = records + 12 * i
    inside = i <= R
    store4(p, tl.load(means2d + 2 * i, mask=real, other=0.0), tl.load(means2d + 2 * i + 1, mask=real, other=0.0),
           tl.where(some, l00 * scale, 0.0), l10 * scale, inside)
    store4(p + 4, l11 * scale, log2_opacity, tl.load(colors + row, mask=real & (D > 0), other=0.0),
           tl.load(colors + row + 1, mask=real & (D > 1), other=0.0), inside)
    if D > 2:
        c2 = tl.load(colors + row + 2, mask=real, other=0.0)
        store4(p + 8, c2, tl.load(colors + row + 3, mask=real & (D > 3), other=0.0), c2, c2, inside)


@Launcher
@triton.jit(do_not_specialize=["R"])
def unpack_kernel(sums, conics, opacities, v_means2d, v_conics, v_opacities, v_colors, v_abs, R, D: tl.constexpr, ABSGRAD: tl.constexpr,
                  BLOCK: tl.constexpr):
    """Sums `[R, SUMS]` to the gradients of means2d, conics, opacities and D colours, and the absolute gradient."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    real = i < R
    a = tl.load(conics + 3 * i, mask=real, other=0.0)
    b = tl.load(conics + 3 * i + 1, mask=real, other=0.0)
    c = tl.load(conics + 3 * i + 2, mask=real, other=0.0)
    opacity = tl.load(opacities + i, mask=real, other=0.0)
    p = sums + SUMS * i
    s0 = tl.load(p, mask=real, other=0.0)
    sx = tl.load(p + 1, mask=real, other=0.0)
    sy = tl.load(p + 2, mask=real, other=0.0)
    tl.store(v_means2d + 2 * i, a * sx + b * sy, mask=real)
    tl.store(v_means2d + 2 * i + 1, b * sx + c * sy, mask=real)
    tl.store(v_conics + 3 * i, -0.5 * tl.load(p + 3, mask=real, other=0.0), mask=real)
    tl.store(v_conics + 3 * i + 1, -tl.load(p + 4, mask=real, other=0.0), mask=real)
    tl.store(v_conics + 3 * i + 2, -0.5 * tl.load(p + 5, mask=real, other=0.0), mask=real)
    tl.store(v_opacities + i, tl.where(opacity > 0, s0 / tl.where(opacity > 0, opacity, 1.0), 0.0), mask=real)
    for channel in tl.static_range(D):
        tl.store(v_colors + i * D + channel, tl.load(p + 6 + channel, mask=real, other=0.0), mask=real)
    if ABSGRAD:
        scale = tl.full((), 1.3862943611198906, a.dtype)    # 2 ln 2
        tl.store(v_abs + 2 * i, scale * tl.load(p + 10, mask=real, other=0.0), mask=real)
        tl.store(v_abs + 2 * i + 1, scale * tl.load(p + 11, mask=real, other=0.0), mask=real)
