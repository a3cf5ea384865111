"""Blending of 5 to 512 and more channels as matrix products: weights [pixels, splats] times features [splats, channels].

The arithmetic of 16 channels and more is in the products, which the tensor cores do; peers loop over the channels on the scalar units.
A program takes the 64 pixels of a tile and, in the forward, a block of channels.
"""

from __future__ import annotations

import triton
import triton.language as tl

from tsplat.kernels.footprint import LOG2_MIN, SUMS, T_MIN
from tsplat.kernels.launch import Launcher
from tsplat.kernels.tiles import TILE


@triton.jit
def tile_pixels(tile, tiles_x, tiles_y, W, H, like, P: tl.constexpr):
    """The P pixels of a tile: the camera, x and y `[P, 1]` about the tile's centre, that centre, the index of its first pixel and of the others
    from there (32 bits, which halves the registers of addresses), and which exist."""
    p = tl.arange(0, P)
    view = tile // (tiles_x * tiles_y)
    left = (tile % tiles_x) * TILE
    top = (tile // tiles_x) % tiles_y * TILE
    half: tl.constexpr = TILE / 2
    x = ((p % TILE).to(like) + (0.5 - half))[:, None]
    y = ((p // TILE).to(like) + (0.5 - half))[:, None]
    first = (view.to(tl.int64) * H + top) * W + left
    inside = (left + p % TILE < W) & (top + p // TILE < H)
    return view, x, y, left.to(like) + half, top.to(like) + half, first, p // TILE * W + p % TILE, inside


@triton.jit
def chunk_weights(records, ids, i, end, null, x, y, cx, cy, T, log2_alpha: tl.constexpr, ALPHA_MAX: tl.constexpr, DROP_LAST: tl.constexpr,
                  K: tl.constexpr):
    """K splats at P pixels: indices `[K]`, record fields `[1, K]`, alpha (0 where it does not count), weight, and T behind them `[P]`."""
    j = i + tl.arange(0, K)
    splat = tl.load(ids + j, mask=j < end, other=null).to(tl.int64)
    p = (records + splat * 12)[None, :]
    mx = tl.load(p) - cx
    my = tl.load(p + 1) - cy
    l00 = tl.load(p + 2)
    l10 = tl.load(p + 3)
    l11 = tl.load(p + 4)
    power = log2_alpha(mx, my, l00, l10, l11, tl.load(p + 5), x, y)
    alpha = tl.minimum(tl.exp2(power), tl.full((), ALPHA_MAX, x.dtype))
    alpha = tl.where(power >= LOG2_MIN, alpha, 0.0)                     # [P, K]
    behind = T[:, None] * tl.cumprod(1.0 - alpha, 1)
    front = behind / (1.0 - alpha)
    counts = (behind if DROP_LAST else front) > T_MIN
    after = tl.min(tl.where(counts, behind, T[:, None]), 1)
    if DROP_LAST:                                                       # negative: finished by a splat that does not count
        after = tl.where((tl.min(behind, 1) <= T_MIN) & (T > T_MIN), -after, after)
    alpha = tl.where(counts, alpha, 0.0)
    return splat, mx, my, l00, l10, l11, alpha, front * alpha, after


@triton.jit
def add_moments(sums, index, s0, s1, s2, s3, s4, s5, real):
    """Six sums `[1, K]` to the rows `[K]` of sums, by atomics."""
    q = (sums + index * SUMS)[None, :]
    mask = real[None, :]
    tl.atomic_add(q, s0, mask=mask, sem="relaxed")
    tl.atomic_add(q + 1, s1, mask=mask, sem="relaxed")
    tl.atomic_add(q + 2, s2, mask=mask, sem="relaxed")
    tl.atomic_add(q + 3, s3, mask=mask, sem="relaxed")
    tl.atomic_add(q + 4, s4, mask=mask, sem="relaxed")
    tl.atomic_add(q + 5, s5, mask=mask, sem="relaxed")


@Launcher
@triton.jit(do_not_specialize=["W", "H", "tiles_x", "tiles_y", "null", "N", "D"])
def feature_fwd_kernel(records, colors, ids, offsets, backgrounds, image, alphas, W, H, tiles_x, tiles_y, null, N, D,
                       BACKGROUND: tl.constexpr, ALPHA_MAX: tl.constexpr, DROP_LAST: tl.constexpr, log2_alpha: tl.constexpr,
                       P: tl.constexpr, K: tl.constexpr, DB: tl.constexpr, PRECISION: tl.constexpr):
    """DB channels of the image of a tile."""
    dt: tl.constexpr = records.dtype.element_ty
    tile = tl.program_id(0)
    view, x, y, cx, cy, first, pixel, inside = tile_pixels(tile, tiles_x, tiles_y, W, H, dt, P)
    d = tl.program_id(1) * DB + tl.arange(0, DB)
    T = inside.to(dt)
    total = tl.zeros([P, DB], dt)
    i = tl.load(offsets + tile)
    end = tl.load(offsets + tile + 1)
    alive = True
    while (i < end) & alive:
        chunk = chunk_weights(records, ids, i, end, null, x, y, cx, cy, T, log2_alpha, ALPHA_MAX, DROP_LAST, K)
        splat = chunk[0]
        w = chunk[7]
        T = chunk[8]
        real = (i + tl.arange(0, K) < end)[:, None] & (d < D)[None, :]
        F = tl.load(colors + (splat % N)[:, None] * D + d[None, :], mask=real, other=0.0)
        total = tl.dot(w, F, total, input_precision=PRECISION, out_dtype=dt)
        i += K
        alive = tl.max(T, 0) > T_MIN
    mask = inside[:, None] & (d < D)[None, :]
    if DROP_LAST:
        T = tl.abs(T)
    if BACKGROUND:
        total += T[:, None] * tl.load(backgrounds + view * D + d, mask=d < D, other=0.0)[None, :]
    tl.store(image + first * D + (pixel[:, None] * D + d[None, :]), total, mask=mask)
    if tl.program_id(1) == 0:
        tl.store(alphas + first + pixel, 1.0 - T, mask=inside)


@Launcher
@triton.jit(do_not_specialize=["W", "H", "tiles_x", "tiles_y", "null", "N", "D"])
def feature_colors_bwd_kernel(records, ids, offsets, v_image, v_colors, W, H, tiles_x, tiles_y, null, N, D, ALPHA_MAX: tl.constexpr,
                              DROP_LAST: tl.constexpr, log2_alpha: tl.constexpr, P: tl.constexpr, K: tl.constexpr, DB: tl.constexpr,
                              PRECISION: tl.constexpr):
    """DB channels of the gradient of the features, by atomics: weights^T times the image's gradient, which stays at hand for all splats."""
    dt: tl.constexpr = records.dtype.element_ty
    tile = tl.program_id(0)
    _, x, y, cx, cy, first, pixel, inside = tile_pixels(tile, tiles_x, tiles_y, W, H, dt, P)
    d = tl.program_id(1) * DB + tl.arange(0, DB)
    real_d = (d < D)[:, None]
    V = tl.load(v_image + first * D + (pixel[None, :] * D + d[:, None]), mask=inside[None, :] & real_d, other=0.0)             # [DB, P]
    T = inside.to(dt)
    i = tl.load(offsets + tile)
    end = tl.load(offsets + tile + 1)
    alive = True
    while (i < end) & alive:
        chunk = chunk_weights(records, ids, i, end, null, x, y, cx, cy, T, log2_alpha, ALPHA_MAX, DROP_LAST, K)
        splat = chunk[0]
        w = chunk[7]
        T = chunk[8]
        v_F = tl.dot(V, w, input_precision=PRECISION, out_dtype=dt)                                                            # [DB, K]
        real = (i + tl.arange(0, K) < end)[None, :] & real_d
        tl.atomic_add(v_colors + (splat % N)[None, :] * D + d[:, None], v_F, mask=real, sem="relaxed")
        i += K
        alive = tl.max(T, 0) > T_MIN


@Launcher
@triton.jit(do_not_specialize=["W", "H", "tiles_x", "tiles_y", "null", "N", "D"])
def feature_bwd_kernel(records, colors, ids, offsets, rest_image, v_weights, v_image, sums, W, H, tiles_x, tiles_y, null, N, D,
                       ABSGRAD: tl.constexpr, ALPHA_MAX: tl.constexpr, DROP_LAST: tl.constexpr, log2_alpha: tl.constexpr, block_moments: tl.constexpr,
                       mean_slopes: tl.constexpr, P: tl.constexpr, K: tl.constexpr, DB: tl.constexpr, PRECISION: tl.constexpr):
    """Sums `[R, SUMS]` of the geometry, by atomics; as `blend_bwd_kernel`, with K splats at a time. (With the gradient of the features in the
    same loop, it spilled.)"""
    dt: tl.constexpr = records.dtype.element_ty
    tile = tl.program_id(0)
    _, x, y, cx, cy, first, pixel, inside = tile_pixels(tile, tiles_x, tiles_y, W, H, dt, P)
    T = inside.to(dt)
    rest = tl.load(rest_image + first + pixel, mask=inside, other=0.0)
    v_weight = tl.load(v_weights + first + pixel, mask=inside, other=0.0)
    i = tl.load(offsets + tile)
    end = tl.load(offsets + tile + 1)
    alive = True
    while (i < end) & alive:
        chunk = chunk_weights(records, ids, i, end, null, x, y, cx, cy, T, log2_alpha, ALPHA_MAX, DROP_LAST, K)
        splat, mx, my, l00, l10, l11, alpha, w, T = chunk
        real = i + tl.arange(0, K) < end
        row = (splat % N) * D
        g = tl.zeros([P, K], dt) + v_weight[:, None]
        begin = 0
        while begin < D:
            d = begin + tl.arange(0, DB)
            V = tl.load(v_image + first * D + (pixel[:, None] * D + d[None, :]), mask=inside[:, None] & (d < D)[None, :], other=0.0)
            F = tl.load(colors + row[None, :] + d[:, None], mask=real[None, :] & (d < D)[:, None], other=0.0)        # [DB, K]
            g = tl.dot(V, F, g, input_precision=PRECISION, out_dtype=dt)
            begin += DB
        wg = w * g
        v = wg - alpha / (1.0 - alpha) * (rest[:, None] - tl.cumsum(wg, 1))
        v = tl.where(alpha < tl.full((), ALPHA_MAX, dt), v, 0.0)
        rest -= tl.sum(wg, 1)
        s0, sx, sy, sxx, sxy, syy = block_moments(v, mx, my, l00, l10, l11, x, y)
        add_moments(sums, splat, s0, sx, sy, sxx, sxy, syy, real)
        if ABSGRAD:
            q = (sums + splat * SUMS)[None, :]
            mask = real[None, :]
            slope_x, slope_y = mean_slopes(mx, my, l00, l10, l11, x, y)
            tl.atomic_add(q + 10, tl.sum(tl.abs(v * slope_x), 0, keep_dims=True), mask=mask, sem="relaxed")
            tl.atomic_add(q + 11, tl.sum(tl.abs(v * slope_y), 0, keep_dims=True), mask=mask, sem="relaxed")
        i += K
        alive = tl.max(T, 0) > T_MIN
