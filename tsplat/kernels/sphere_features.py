"""Blending of spheres with 5 to 512 and more features as matrix products: terms [pixels, spheres] times features [spheres, channels].

This is attention, with the pixels of a tile for queries, and goes as flash attention does: sums relative to the largest term so far, and a
backward that computes the terms again. A program takes the 64 pixels of a tile and, where the features are, a block of channels.
"""

from __future__ import annotations

import triton
import triton.language as tl

from tsplat.kernels.feature_blending import add_moments, tile_pixels
from tsplat.kernels.launch import Launcher
from tsplat.kernels.sphere_geometry import LOG2E, NO_TERM, depth_slope, enter, far_off, opacity_bound, rays, reciprocal, term, term_gradients


@triton.jit
def load_spheres(records, ids, i, end, null, K: tl.constexpr):
    """K spheres from i on, the null sphere beyond the end: indices `[K]`, and x, y, z, R and opacity `[1, K]`."""
    j = i + tl.arange(0, K)
    index = tl.load(ids + j, mask=j < end, other=null).to(tl.int64)
    p = (records + index * 8)[None, :]
    return index, tl.load(p), tl.load(p + 1), tl.load(p + 2), tl.load(p + 3), tl.load(p + 4)


@Launcher
@triton.jit(do_not_specialize=["W", "H", "tiles_x", "tiles_y", "null", "N", "D"])
def sphere_feature_fwd_kernel(records, features, ids, offsets, backgrounds, gamma, Ks, image, depths, logsumexp, used, largest, W, H, tiles_x,
                              tiles_y, null, N, D, near: tl.float64, far: tl.float64, background_depth: tl.float64, tolerance: tl.float64,
                              ORTHO: tl.constexpr, CHORD: tl.constexpr, DEPTH: tl.constexpr, CHECK: tl.constexpr, PTX: tl.constexpr,
                              P: tl.constexpr, K: tl.constexpr, DB: tl.constexpr, PRECISION: tl.constexpr):
    """DB channels of the image of a tile, and in the first block of these the rest; as `sphere_fwd_kernel`."""
    dt: tl.constexpr = records.dtype.element_ty
    tile = tl.program_id(0)
    view, x, y, cx, cy, first, pixel, inside = tile_pixels(tile, tiles_x, tiles_y, W, H, dt, P)
    mx, my, w, w2 = rays(Ks, view, x + cx, y + cy, ORTHO)
    n, f, level, slope, rest, scale = depth_slope(gamma, near, far, background_depth, dt)
    d = tl.program_id(1) * DB + tl.arange(0, DB)
    peak = tl.sum(x * 0.0, 1)
    total = tl.sum(x * 0.0, 1) + 1.0
    Z = tl.sum(x * 0.0, 1)
    C = tl.zeros([P, DB], dt) + tl.load(backgrounds + view * D + d, mask=d < D, other=0.0)[None, :]
    start = tl.load(offsets + tile)
    end = tl.load(offsets + tile + 1)
    i = start
    while i < end:
        index, X, Y, depth, R, o = load_spheres(records, ids, i, end, null, K)
        distance = far_off(X, Y, depth)
        _, s, _, _, distance_in = enter(mx, my, w, w2, X, Y, depth, R, reciprocal(R, PTX), distance, ORTHO, CHORD, PTX)
        hit = (s < 1.0) & (distance_in >= n) & (distance_in <= f)
        logit = tl.where(hit, (o * level - rest) - (o * slope) * distance_in, float("-inf"))
        highest = tl.maximum(peak, tl.max(logit, 1))
        shrink = tl.exp2(peak - highest)
        peak = highest
        e = tl.exp2(logit - peak[:, None]) * (o - o * s)
        total = total * shrink + tl.sum(e, 1)
        real = (i + tl.arange(0, K) < end)[:, None] & (d < D)[None, :]
        F = tl.load(features + (index % N)[:, None] * D + d[None, :], mask=real, other=0.0)
        C = tl.dot(e, F, C * shrink[:, None], input_precision=PRECISION, out_dtype=dt)
        if DEPTH:
            Z = Z * shrink + tl.sum(e * distance_in, 1)
        i += K
        if ((i - start) % CHECK == 0) & (i < end):
            p = records + tl.load(ids + i).to(tl.int64) * 8
            z = tl.load(p + 2)
            nearest = (z if ORTHO else far_off(tl.load(p), tl.load(p + 1), z)) - tl.load(p + 3)
            most = opacity_bound(largest)
            z = 1.0 - tl.minimum(tl.maximum((nearest - n) / (f - n), 0.0), 1.0)
            bound = tl.log2((end - i).to(dt)) + tl.log2(most) + (most * z * scale - rest)
            end = tl.where(bound > tl.log2(tl.full((), tolerance, dt)) + tl.min(peak + tl.log2(total), 0), end, i)
    tl.store(image + first * D + (pixel[:, None] * D + d[None, :]), C / total[:, None], mask=inside[:, None] & (d < D)[None, :])
    if tl.program_id(1) == 0:
        tl.store(logsumexp + first + pixel, (peak + tl.log2(total)) / tl.full((), LOG2E, dt), mask=inside)
        tl.store(used + tile, (end - start).to(tl.int32))
        if DEPTH:
            tl.store(depths + first + pixel, Z / total, mask=inside)


@triton.jit
def backward_tile(tile, Ks, gamma, near, far, background_depth, cutoff, logsumexp, tiles_x, tiles_y, W, H, dt: tl.constexpr, ORTHO: tl.constexpr,
                  P: tl.constexpr):
    """Of a tile's pixels: x `[P, 1]`, the index of the first and of the others from there, which exist, and their rays; near, far, the line that
    takes depth to the logarithm of a term, to base 2; that of the background; that of the sum `[P, 1]`, so large beyond the border that all terms are
    0 there; and the farthest depth of a hit."""
    view, x, y, cx, cy, first, pixel, inside = tile_pixels(tile, tiles_x, tiles_y, W, H, dt, P)
    mx, my, w, w2 = rays(Ks, view, x + cx, y + cy, ORTHO)
    n, f, level, slope, rest, scale = depth_slope(gamma, near, far, background_depth, dt)
    lse = (tl.load(logsumexp + first + pixel, mask=inside, other=NO_TERM) * tl.full((), LOG2E, dt))[:, None]
    last = f
    if cutoff is not None:
        last = tl.minimum(tl.load(cutoff + first + pixel, mask=inside, other=0.0), f)[:, None]
    return x, first, pixel, inside, mx, my, w, w2, n, f, level, slope, rest, lse, last


@Launcher
@triton.jit(do_not_specialize=["W", "H", "tiles_x", "tiles_y", "null", "N", "D"])
def sphere_features_bwd_kernel(records, ids, offsets, used, gamma, Ks, cutoff, logsumexp, v_image, v_features, W, H, tiles_x, tiles_y, null, N, D,
                               near: tl.float64, far: tl.float64, background_depth: tl.float64, ORTHO: tl.constexpr, CHORD: tl.constexpr,
                               PTX: tl.constexpr, P: tl.constexpr, K: tl.constexpr, DB: tl.constexpr, PRECISION: tl.constexpr):
    """DB channels of the gradient of the features, by atomics: weights^T times the image's gradient, which stays at hand for all spheres."""
    dt: tl.constexpr = records.dtype.element_ty
    tile = tl.program_id(0)
    x, first, pixel, inside, mx, my, w, w2, n, f, level, slope, rest, lse, last = backward_tile(
        tile, Ks, gamma, near, far, background_depth, cutoff, logsumexp, tiles_x, tiles_y, W, H, dt, ORTHO, P)
    d = tl.program_id(1) * DB + tl.arange(0, DB)
    real_d = (d < D)[:, None]
    V = tl.load(v_image + first * D + (pixel[None, :] * D + d[:, None]), mask=inside[None, :] & real_d, other=0.0)             # [DB, P]
    i = tl.load(offsets + tile)
    end = i + tl.load(used + tile)
    while i < end:
        index, X, Y, depth, R, o = load_spheres(records, ids, i, end, null, K)
        distance = far_off(X, Y, depth)
        _, s, _, _, distance_in = enter(mx, my, w, w2, X, Y, depth, R, reciprocal(R, PTX), distance, ORTHO, CHORD, PTX)
        hit = (s < 1.0) & (distance_in >= n) & (distance_in <= last)
        weight = term((o * level - rest) - (o * slope) * distance_in - lse, hit, o) * (o - o * s)
        v_F = tl.dot(V, weight, input_precision=PRECISION, out_dtype=dt)                                                       # [DB, K]
        real = (i + tl.arange(0, K) < end)[None, :] & real_d
        tl.atomic_add(v_features + (index % N)[None, :] * D + d[:, None], v_F, mask=real, sem="relaxed")
        i += K


@Launcher
@triton.jit(do_not_specialize=["W", "H", "tiles_x", "tiles_y", "null", "N", "D"])
def sphere_feature_bwd_kernel(records, features, ids, offsets, used, gamma, Ks, cutoff, logsumexp, common, v_image, v_depth, sums, v_rays, W, H,
                              tiles_x, tiles_y, null, N, D, near: tl.float64, far: tl.float64, background_depth: tl.float64,
                              ORTHO: tl.constexpr, CHORD: tl.constexpr, EPS: tl.constexpr, PTX: tl.constexpr, P: tl.constexpr,
                              K: tl.constexpr, DB: tl.constexpr, PRECISION: tl.constexpr):
    """Sums `[R + 1, SUMS]` of the geometry, by atomics, and v_rays (or None) `[tiles, 4]`; as `sphere_bwd_kernel`, with K spheres at a time."""
    dt: tl.constexpr = records.dtype.element_ty
    tile = tl.program_id(0)
    x, first, pixel, inside, mx, my, w, w2, n, f, level, slope, rest, lse, last = backward_tile(
        tile, Ks, gamma, near, far, background_depth, cutoff, logsumexp, tiles_x, tiles_y, W, H, dt, ORTHO, P)
    inv_gamma = 1.0 / tl.load(gamma)
    depth1 = 1.0 / (f - n)
    depth0 = 1.0 + n * depth1
    base = tl.load(common + first + pixel, mask=inside, other=0.0)[:, None]
    v_z = None
    if v_depth is not None:
        v_z = tl.load(v_depth + first + pixel, mask=inside, other=0.0)[:, None]
    v_mx = x * 0.0
    v_my = x * 0.0
    i = tl.load(offsets + tile)
    end = i + tl.load(used + tile)
    while i < end:
        index, X, Y, depth, R, o = load_spheres(records, ids, i, end, null, K)
        real = i + tl.arange(0, K) < end
        row = (index % N) * D
        g = tl.zeros([P, K], dt) + base
        begin = 0
        while begin < D:
            d = begin + tl.arange(0, DB)
            V = tl.load(v_image + first * D + (pixel[:, None] * D + d[None, :]), mask=inside[:, None] & (d < D)[None, :], other=0.0)
            F = tl.load(features + row[None, :] + d[:, None], mask=real[None, :] & (d < D)[:, None], other=0.0)                # [DB, K]
            g = tl.dot(V, F, g, input_precision=PRECISION, out_dtype=dt)
            begin += DB
        distance = far_off(X, Y, depth)
        r = reciprocal(R, PTX)
        t, s, h, a, distance_in = enter(mx, my, w, w2, X, Y, depth, R, r, distance, ORTHO, CHORD, PTX)
        hit = (s < 1.0) & (distance_in >= n) & (distance_in <= last)
        logit = (o * level - rest) - (o * slope) * distance_in - lse
        e = term(logit, hit, o)
        if cutoff is not None:                          # as in `sphere_bwd_kernel`
            logit = o * level - (o * slope) * distance_in
        if v_depth is not None:
            g += distance_in * v_z
        s0, s1, s2, s3, s4, s5, pixel_mx, pixel_my = term_gradients(
            g, e, logit, v_z, t, s, h, a, distance_in, mx, my, w, w2, X, Y, depth, R, r, o, distance, -(o * depth1) * inv_gamma, inv_gamma,
            depth0, depth1, EPS, 0, ORTHO, CHORD, PTX)
        if v_rays is not None:
            v_mx += tl.sum(pixel_mx, 1, keep_dims=True)
            v_my += tl.sum(pixel_my, 1, keep_dims=True)
        add_moments(sums, index, s0, s1, s2, s3, s4, s5, real)
        i += K
    if v_rays is not None:
        q = v_rays + tile.to(tl.int64) * 4
        tl.store(q, tl.sum(tl.sum(v_mx, 1), 0))
        tl.store(q + 1, tl.sum(tl.sum(v_my, 1), 0))
        tl.store(q + 2, tl.sum(tl.sum(v_mx * mx, 1), 0))
        tl.store(q + 3, tl.sum(tl.sum(v_my * my, 1), 0))
