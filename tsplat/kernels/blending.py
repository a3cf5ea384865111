"""Blending of up to 4 channels: a warp takes 4 tiles of 8 x 8 pixels, a lane a row of its tile, front to back; forward and backward.

Loads, row terms and reductions are shared by the 8 pixels of a lane; there is no shared memory and no barrier. Small tiles halve the pairs
of splat and pixel in vain, and a warp that takes 4 of them still works in all lanes, as the 4 lists are of about the same length. More
channels go through matrix products, in `feature_blending.py`.
"""

from __future__ import annotations

import functools

import torch
import triton
import triton.language as tl
from torch import Tensor

from tsplat.kernels import footprint
from tsplat.kernels.feature_blending import feature_bwd_kernel, feature_colors_bwd_kernel, feature_fwd_kernel
from tsplat.kernels.footprint import LOG2_MIN, SUMS, T_MIN, TILE
from tsplat.kernels.launch import Launcher, ceil_div, current_target, launch

CHANNELS = 4
"""Up to here a splat's colour is in its record and a pixel's in registers."""


@triton.jit
def load4(p):
    """Four consecutive numbers at each pointer `[LANES, 1]`, each `[LANES, 1]`: one 16-byte load, no shuffles."""
    a, b = tl.split(tl.reshape(tl.load(p + tl.arange(0, 4)[None, :]), (p.shape[0], 2, 2)))
    v0, v2 = tl.split(a)
    v1, v3 = tl.split(b)
    return v0[:, None], v1[:, None], v2[:, None], v3[:, None]


@triton.jit
def glue(a, b):
    """A lane's 8 pixels `[LANES, 8]`: even ones from a, odd ones from b. (A load gives a thread 4 numbers at the most; only so are 8 of them
    in the registers of one thread.)"""
    return tl.reshape(tl.join(a, b), (a.shape[0], 8))


@triton.jit
def tile_pixels(block, lane_x, tiles_x, tiles_y, W, H, LANES: tl.constexpr):
    """The tiles of a block, 2 in each row of it, and a lane's pixels: camera, tile, whether it exists, its left and its top `[LANES, 1]`,
    x `[LANES, 8]` and y `[LANES, 1]` about its centre, and of every second pixel the column and the index `[LANES, 4]`.

    x is loaded rather than made by tl.arange: that anchors the layout with a lane's pixels in its own registers, and all state is derived
    from it (tl.zeros would get another layout and the compiler would run the loop twice).
    """
    HIGH: tl.constexpr = LANES // (2 * TILE)
    blocks_x = (tiles_x + 1) // 2
    blocks_y = (tiles_y + HIGH - 1) // HIGH
    view = block // (blocks_x * blocks_y)
    x4 = tl.load(lane_x + tl.arange(0, LANES)[:, None] * 4 + tl.arange(0, 4)[None, :])
    lane = tl.arange(0, LANES)[:, None]
    tile_x = block % blocks_x * 2 + lane // TILE % 2
    tile_y = block // blocks_x % blocks_y * HIGH + lane // (2 * TILE)
    row = lane % TILE
    half: tl.constexpr = TILE / 2
    y = tile_y * TILE + row
    column4 = tile_x * TILE + (x4 + (half - 0.5)).to(tl.int32)
    column4 = tl.where(y < H, column4, W)               # beyond the border, if the row is
    pixel4 = (view.to(tl.int64) * H + y) * W + column4
    exists = (tile_x < tiles_x) & (tile_y < tiles_y)
    tile = (view.to(tl.int64) * tiles_y + tile_y) * tiles_x + tile_x
    dt: tl.constexpr = x4.dtype
    return view, tile, exists, tile_x * TILE, tile_y * TILE, glue(x4, x4 + 1.0), row.to(dt) - (half - 0.5), column4, pixel4


@triton.jit
def load_pixels(p, pixel4, column4, W, D: tl.constexpr, c: tl.constexpr):
    """Channel c of an image `[C, H, W, D]` at a tile's pixels; zeros beyond the border and for channels that do not exist."""
    a = tl.load(p + pixel4 * D + c, mask=(column4 < W) & (c < D), other=0.0)
    return glue(a, tl.load(p + pixel4 * D + (D + c), mask=(column4 + 1 < W) & (c < D), other=0.0))


@triton.jit
def half_pixels(view, left, top, W, H, first: tl.constexpr):
    """Index of the block's first pixel, of 4 pixels of each lane's row, from `first`, `[LANES, 4]` from there, and which exist."""
    column = left + (tl.arange(0, 4)[None, :] + first)
    y = top + tl.arange(0, left.shape[0])[:, None] % TILE
    x0 = tl.min(tl.min(left, 1), 0)
    y0 = tl.min(tl.min(top, 1), 0)
    return (view.to(tl.int64) * H + y0) * W + x0, (y - y0) * W + (column - x0), (column < W) & (y < H)


@triton.jit
def halves(v):
    """The left and the right 4 pixels of each lane's row, each `[LANES, 4]`."""
    return tl.split(tl.permute(tl.reshape(v, (v.shape[0], 2, 4)), (0, 2, 1)))


@triton.jit
def store_channels(p, v0, v1, v2, v3, pixel, inside, D: tl.constexpr):
    """D channels at the pixels of an image `[C, H, W, D]`, as one block whose layout the compiler chooses so that neighbouring threads write
    neighbouring numbers: a store per channel from the layout of the loop wrote 8 times as many sectors, 0.1 ms of a forward."""
    if D == 1:
        tl.store(p + pixel, v0, mask=inside)
    elif D == 2:
        tl.store(p + pixel[:, :, None] * 2 + tl.arange(0, 2)[None, None, :], tl.join(v0, v1), mask=inside[:, :, None])
    else:
        every = tl.reshape(tl.join(tl.join(v0, v2), tl.join(v1, v3)), (v0.shape[0], v0.shape[1], 4))
        channel = tl.arange(0, 4)[None, None, :]
        tl.store(p + pixel[:, :, None] * D + channel, every, mask=inside[:, :, None] & (channel < D))


@triton.jit
def tile_list(offsets, tile, exists):
    """Where each lane's list begins, its length, and the length of the longest of the block."""
    start = tl.load(offsets + tile, mask=exists, other=0)
    hits = (tl.load(offsets + tile + 1, mask=exists, other=0) - start).to(tl.int32)      # 64 bits are for the start only
    return start, hits, tl.max(tl.max(hits, 1), 0)


@triton.jit
def both_or_zero(value, a, a_min: tl.constexpr, b, b_min: tl.constexpr):
    """The value where a >= a_min and b > b_min, else 0, in three instructions: the compiler makes a select of each condition (4)."""
    a_min = tl.full(value.shape, a_min, tl.float32)
    b_min = tl.full(value.shape, b_min, tl.float32)
    return tl.inline_asm_elementwise("{.reg .pred p; setp.ge.f32 p, $2, $3; setp.gt.and.f32 p, $4, $5, p; selp.f32 $0, $1, 0f00000000, p;}",
                                     "=f,f,f,f,f,f", [value, a, a_min, b, b_min], dtype=tl.float32, is_pure=True, pack=1)


@triton.jit
def load_batch(ids, start, i, hits, null):
    """Splats i to i + 7 of each tile, one in each of its lanes; the null splat beyond its list."""
    j = i + tl.arange(0, start.shape[0])[:, None] % TILE
    return tl.load(ids + start + j, mask=j < hits, other=null)


@triton.jit
def of_batch(batch, u, ids, start, i, hits, null, PTX: tl.constexpr):
    """Splat u of each tile's batch, in all of its lanes: a shuffle, where a load would take a mask and an address."""
    if PTX:
        return tl.inline_asm_elementwise("shfl.sync.idx.b32 $0, $1, $2, 0x181f, 0xffffffff;", "=r,r,r", [batch, tl.zeros_like(batch) + u],
                                         dtype=tl.int32, is_pure=False, pack=1)
    else:
        return tl.load(ids + start + i + u, mask=i + u < hits, other=null)


@triton.jit
def prefetch_records(records, batch, PTX: tl.constexpr):
    """Have the records of the next batch fetched into L1 while this one is blended, each lane one: 2 sectors of 32 bytes. Half of the cycles
    of a warp were waiting for them."""
    if PTX:
        p = (records + batch.to(tl.int64) * 12).to(tl.int64)
        for word in tl.static_range(2):
            tl.inline_asm_elementwise("prefetch.global.L1 [$1]; mov.b32 $0, 0;", "=r,l", [p + 44 * word], dtype=tl.int32, is_pure=False, pack=1)


@triton.jit
def load_record(records, splat, D: tl.constexpr):
    """Each lane's splat: mean, shape (3), log2 opacity, and D colours or more."""
    p = records + splat.to(tl.int64) * 12
    if D <= 2:
        return load4(p) + load4(p + 4)
    else:
        return load4(p) + load4(p + 4) + load4(p + 8)


@triton.jit
def splat_alpha(mx, my, l00, l10, l11, log2_opacity, x, y, T, log2_alpha: tl.constexpr, ALPHA_MAX: tl.constexpr, PTX: tl.constexpr):
    """Alpha at the pixels: 0 below 1/255, and where the pixel is finished."""
    power = log2_alpha(mx, my, l00, l10, l11, log2_opacity, x, y)
    alpha = tl.minimum(tl.exp2(power), tl.full((), ALPHA_MAX, x.dtype))    # a literal would be rounded to float32
    if PTX:
        alpha = both_or_zero(alpha, power, LOG2_MIN, T, T_MIN)
    else:
        alpha = tl.where((power >= LOG2_MIN) & (T > T_MIN), alpha, 0.0)
    return alpha


@triton.jit
def without_last(w, T):
    """Without the splat that would take the transmittance to T_MIN or below: there the pixel is finished, with T negative as a sign of it."""
    last = (w > 0) & (T - w <= T_MIN)
    return tl.where(last, 0.0, w), tl.where(last, -T, T)


@Launcher
@triton.jit(do_not_specialize=["W", "H", "tiles_x", "tiles_y", "null"])
def blend_fwd_kernel(records, ids, offsets, backgrounds, image, alphas, lane_x, W, H, tiles_x, tiles_y, null, D: tl.constexpr,
                     BACKGROUND: tl.constexpr, ALPHA_MAX: tl.constexpr, DROP_LAST: tl.constexpr, log2_alpha: tl.constexpr,
                     LANES: tl.constexpr, PTX: tl.constexpr):
    """Image `[C, H, W, D]` and alpha `[C, H, W]` of a block of tiles."""
    view, tile, exists, left, top, x, y, column4, pixel4 = tile_pixels(tl.program_id(0), lane_x, tiles_x, tiles_y, W, H, LANES)
    cx = left.to(x.dtype) + TILE / 2
    cy = top.to(x.dtype) + TILE / 2
    T = glue(tl.where(column4 < W, 1.0, 0.0), tl.where(column4 + 1 < W, 1.0, 0.0)) + x * 0.0     # beyond the border finished
    C0 = x * 0.0
    C1 = x * 0.0
    C2 = x * 0.0
    C3 = x * 0.0
    start, hits, longest = tile_list(offsets, tile, exists)
    i = 0
    batch = load_batch(ids, start, 0, hits, null)
    following = load_batch(ids, start, TILE, hits, null)
    while i < longest:
        later = load_batch(ids, start, i + 2 * TILE, hits, null)        # two batches ahead, so that nothing waits for it
        prefetch_records(records, following, PTX)
        u = 0
        while u < TILE:                                                 # a loop: unrolled, it takes more registers and is no faster
            splat = of_batch(batch, u, ids, start, i, hits, null, PTX)
            r = load_record(records, splat, D)
            w = T * splat_alpha(r[0] - cx, r[1] - cy, r[2], r[3], r[4], r[5], x, y, T, log2_alpha, ALPHA_MAX, PTX)
            if DROP_LAST:
                w, T = without_last(w, T)
            C0 += r[6] * w
            if D > 1:
                C1 += r[7] * w
            if D > 2:
                C2 += r[8] * w
            if D > 3:
                C3 += r[9] * w
            T -= w
            u += 1
        i += TILE
        batch = following
        following = later
        longest = tl.where(tl.max(tl.max(T, 1), 0) > T_MIN, longest, 0)     # finished tiles are only looked for once per batch
    if DROP_LAST:
        T = tl.abs(T)
    if BACKGROUND:
        b = backgrounds + view * D
        C0 += T * tl.load(b)
        C1 += T * tl.load(b + 1, mask=D > 1, other=0.0)
        C2 += T * tl.load(b + 2, mask=D > 2, other=0.0)
        C3 += T * tl.load(b + 3, mask=D > 3, other=0.0)
    # in halves, as all at once would take more registers than the loop
    first, pixel, inside = half_pixels(view, left, top, W, H, 0)
    C0, D0 = halves(C0)
    C1, D1 = halves(C1)
    C2, D2 = halves(C2)
    C3, D3 = halves(C3)
    T, U = halves(T)
    store_channels(image + first * D, C0, C1, C2, C3, pixel, inside, D)
    tl.store(alphas + first + pixel, 1.0 - T, mask=inside)
    first, pixel, inside = half_pixels(view, left, top, W, H, 4)
    store_channels(image + first * D, D0, D1, D2, D3, pixel, inside, D)
    tl.store(alphas + first + pixel, 1.0 - U, mask=inside)


@triton.jit
def butterfly(v, OFFSET: tl.constexpr):
    """The value of the lane OFFSET away (PTX)."""
    return tl.inline_asm_elementwise("shfl.sync.bfly.b32 $0, $1, $2, 0x1f, 0xffffffff;", "=r,r,r", [v, tl.full(v.shape, OFFSET, tl.int32)],
                                     dtype=tl.float32, is_pure=False, pack=1)


@triton.jit
def fold2(a, b, bit, OFFSET: tl.constexpr):
    """Half of two reductions with one shuffle: lanes whose bit is 0 keep the partial sum of a, the others that of b."""
    return tl.where(bit, b, a) + butterfly(tl.where(bit, a, b), OFFSET)


@triton.jit
def fold1(a, OFFSET: tl.constexpr):
    """Half of one reduction."""
    return a + butterfly(a, OFFSET)


@triton.jit
def tile_sum(v):
    """Sum over the lanes of each tile, in every lane of it (portable)."""
    groups: tl.constexpr = v.shape[0] // TILE
    total = tl.sum(tl.reshape(v, (groups, TILE)), 1, keep_dims=True)
    return tl.reshape(tl.broadcast_to(total, (groups, TILE)), (v.shape[0], 1))


@triton.jit
def tile_sums(s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, s10, s11, COUNT: tl.constexpr, PTX: tl.constexpr):
    """COUNT (9 or 12) sums over the 8 lanes of each tile, spread over these lanes for two atomic instructions: one of the first 8 sums with
    its slot, and one of the others with its slot, and whether the lane has one of these."""
    lane = tl.arange(0, s0.shape[0])[:, None]
    if PTX:
        b2 = (lane & 4) != 0
        b1 = (lane & 2) != 0
        b0 = (lane & 1) != 0
        slot = ((lane & 1) * 4) + (lane & 2) + ((lane >> 2) & 1)
        a = fold2(fold2(s0, s1, b2, 4), fold2(s2, s3, b2, 4), b1, 2)
        first = fold2(a, fold2(fold2(s4, s5, b2, 4), fold2(s6, s7, b2, 4), b1, 2), b0, 1)
        if COUNT == 9:
            return first, slot, fold1(fold1(fold1(s8, 4), 2), 1), lane * 0 + 8, (lane & 7) == 0
        else:
            return first, slot, fold1(fold2(fold2(s8, s9, b2, 4), fold2(s10, s11, b2, 4), b1, 2), 1), slot + 8, (lane & 1) == 0
    else:
        row = lane % TILE
        first = tl.where(row == 0, tile_sum(s0), tile_sum(s1))
        first = tl.where(row == 2, tile_sum(s2), first)
        first = tl.where(row == 3, tile_sum(s3), first)
        first = tl.where(row == 4, tile_sum(s4), first)
        first = tl.where(row == 5, tile_sum(s5), first)
        first = tl.where(row == 6, tile_sum(s6), first)
        first = tl.where(row == 7, tile_sum(s7), first)
        second = tile_sum(s8)
        if COUNT > 9:
            second = tl.where(row == 1, tile_sum(s9), second)
            second = tl.where(row == 2, tile_sum(s10), second)
            second = tl.where(row == 3, tile_sum(s11), second)
        return first, row, second, row + 8, row < COUNT - 8


@Launcher
@triton.jit(do_not_specialize=["W", "H", "tiles_x", "tiles_y", "null"])
def blend_bwd_kernel(records, ids, offsets, backgrounds, image, alphas, v_image, v_alphas, sums, lane_x, W, H, tiles_x, tiles_y, null,
                     D: tl.constexpr, ALPHA_MAX: tl.constexpr, DROP_LAST: tl.constexpr, BACKGROUND: tl.constexpr, ABSGRAD: tl.constexpr,
                     PER_HIT: tl.constexpr, log2_alpha: tl.constexpr, lane_moments: tl.constexpr, mean_slopes: tl.constexpr,
                     LANES: tl.constexpr, PTX: tl.constexpr):
    """Sums `[R, SUMS]` over the pixels, per splat (atomic), or per hit `[M, SUMS]` (PER_HIT, for the same bits in every run).

    Front to back: `rest` is what is still to come, times the upstream gradient; it starts as <image, dL/dimage> + alpha dL/dalpha without
    the background's share, and loses a term at each splat. dL/dlog alpha = w (g - rest/T), T behind the splat: two operations less than
    w g - alpha/(1 - alpha) rest.
    """
    view, tile, exists, left, top, x, y, column4, pixel4 = tile_pixels(tl.program_id(0), lane_x, tiles_x, tiles_y, W, H, LANES)
    cx = left.to(x.dtype) + TILE / 2
    cy = top.to(x.dtype) + TILE / 2
    v0 = load_pixels(v_image, pixel4, column4, W, D, 0)
    v1 = load_pixels(v_image, pixel4, column4, W, D, 1)
    v2 = load_pixels(v_image, pixel4, column4, W, D, 2)
    v3 = load_pixels(v_image, pixel4, column4, W, D, 3)
    if v_alphas is None:
        v_weight = x * 0.0
        rest = v_weight
    else:
        v_weight = load_pixels(v_alphas, pixel4, column4, W, 1, 0)
        rest = v_weight * load_pixels(alphas, pixel4, column4, W, 1, 0)
    rest += v0 * load_pixels(image, pixel4, column4, W, D, 0) + v1 * load_pixels(image, pixel4, column4, W, D, 1)
    rest += v2 * load_pixels(image, pixel4, column4, W, D, 2) + v3 * load_pixels(image, pixel4, column4, W, D, 3)
    if BACKGROUND:
        b = backgrounds + view * D
        behind = v0 * tl.load(b) + v1 * tl.load(b + 1, mask=D > 1, other=0.0)
        behind += v2 * tl.load(b + 2, mask=D > 2, other=0.0) + v3 * tl.load(b + 3, mask=D > 3, other=0.0)
        rest -= behind
        v_weight -= behind
    T = glue(tl.where(column4 < W, 1.0, 1e-10), tl.where(column4 + 1 < W, 1.0, 1e-10)) + x * 0.0     # beyond the border finished, not 0
    none = tl.sum(x * 0.0, 1, keep_dims=True)
    start, hits, longest = tile_list(offsets, tile, exists)
    i = 0
    batch = load_batch(ids, start, 0, hits, null)
    following = load_batch(ids, start, TILE, hits, null)
    while i < longest:
        later = load_batch(ids, start, i + 2 * TILE, hits, null)
        prefetch_records(records, following, PTX)
        stop = tl.minimum(TILE, longest - i)
        u = 0
        while u < stop:
            splat = of_batch(batch, u, ids, start, i, hits, null, PTX)
            real = i + u < hits
            r = load_record(records, splat, D)
            mx = r[0] - cx
            my = r[1] - cy
            l00, l10, l11 = r[2:5]
            alpha = splat_alpha(mx, my, l00, l10, l11, r[5], x, y, T, log2_alpha, ALPHA_MAX, PTX)
            w = alpha * T
            if DROP_LAST:
                w, T = without_last(w, T)
            g = v_weight + r[6] * v0
            if D > 1:
                g += r[7] * v1
            if D > 2:
                g += r[8] * v2
            if D > 3:
                g += r[9] * v3
            rest -= w * g
            T -= w
            if PTX:
                reciprocal = tl.inline_asm_elementwise("rcp.approx.ftz.f32 $0, $1;", "=f,f", [T], dtype=tl.float32, is_pure=True, pack=1)
            else:
                reciprocal = 1.0 / T
            v = w * (g - rest * reciprocal)
            v = tl.where(alpha < tl.full((), ALPHA_MAX, x.dtype), v, 0.0)
            s0, sx, sy, sxx, sxy, syy = lane_moments(v, mx, my, x, y)
            w0 = tl.sum(w * v0, 1, keep_dims=True)
            w1 = tl.sum(w * v1, 1, keep_dims=True) if D > 1 else none
            w2 = tl.sum(w * v2, 1, keep_dims=True) if D > 2 else none
            w3 = tl.sum(w * v3, 1, keep_dims=True) if D > 3 else none
            ax = none
            ay = none
            if ABSGRAD:
                slope_x, slope_y = mean_slopes(mx, my, l00, l10, l11, x, y)
                ax = tl.sum(tl.abs(v * slope_x), 1, keep_dims=True)
                ay = tl.sum(tl.abs(v * slope_y), 1, keep_dims=True)
            COUNT: tl.constexpr = 12 if ABSGRAD or D > 3 else 9
            first, slot, second, second_slot, has_second = tile_sums(s0, sx, sy, sxx, sxy, syy, w0, w1, w2, w3, ax, ay, COUNT, PTX)
            if PER_HIT:
                q = sums + (start + i + u) * SUMS
                tl.store(q + slot, first, mask=real)
                tl.store(q + second_slot, second, mask=real & has_second)
            else:
                q = sums + splat.to(tl.int64) * SUMS
                tl.atomic_add(q + slot, first, mask=real, sem="relaxed")
                tl.atomic_add(q + second_slot, second, mask=real & has_second, sem="relaxed")
            u += 1
        i += TILE
        batch = following
        following = later
        longest = tl.where(tl.max(tl.max(T, 1), 0) > T_MIN, longest, 0)


@functools.cache
def _lane_x(lanes: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """`[lanes, 4]`: x about the tile's centre of every second pixel of each lane's row."""
    tile = int(TILE.value)
    return (torch.arange(0, tile, 2, device=device).to(dtype) - (tile / 2 - 0.5)).repeat(lanes, 1)


class _Scene:
    """Arguments of the kernels, contiguous, with records packed and launch constants chosen."""

    def __init__(self, means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, backgrounds: Tensor | None, ids: Tensor,
                 offsets: Tensor, width: int, height: int, tile: int, alpha_max: float, drop_last: bool) -> None:
        if tile != TILE.value:
            raise ValueError(f"tile: expected {TILE.value}, the tile of the Triton kernels; got {tile}")
        (self.C, self.N), self.D = opacities.shape, colors.shape[2]
        self.R, self.rows = self.C * self.N, colors.shape[0] * self.N
        self.conics, self.opacities, self.colors = conics.contiguous(), opacities.contiguous(), colors.contiguous()
        self.ids, self.offsets = ids.contiguous(), offsets.contiguous()
        self.backgrounds = colors if backgrounds is None else backgrounds.contiguous()      # any pointer, if it is not read
        self.grid = ceil_div(width, tile), ceil_div(height, tile)
        self.tiles = self.C * self.grid[0] * self.grid[1]
        self.records = means2d.new_empty(self.R + 1, footprint.RECORD)
        options = launch("records")
        footprint.pack_kernel[(ceil_div(self.R + 1, options["BLOCK"]),)](
            means2d.contiguous(), self.conics, self.opacities, self.colors, self.records, self.R, max(self.rows, 1),
            D=self.D if self.D <= CHANNELS else 0, **options)
        target = current_target()
        self.common = {"ALPHA_MAX": alpha_max, "DROP_LAST": drop_last, "log2_alpha": footprint.log2_alpha, "enable_fp_fusion": True}
        lanes, ptx = target.lanes, target.ptx and means2d.dtype == torch.float32
        # what is made while a CUDA graph is captured has no numbers until its replay: not to be kept
        capturing = means2d.is_cuda and torch.cuda.is_current_stream_capturing()
        self.lane_x = (_lane_x.__wrapped__ if capturing else _lane_x)(lanes, means2d.dtype, means2d.device)
        self.blocks = self.C * ceil_div(self.grid[0], 2) * ceil_div(self.grid[1], lanes // (2 * tile))
        self.warp = {**self.common, "D": self.D, "LANES": lanes, "PTX": ptx}
        self.block = {**self.common, "P": tile * tile, "PRECISION": "tf32x3" if ptx else "ieee"}


def blend(means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, backgrounds: Tensor | None, ids: Tensor, offsets: Tensor,
          width: int, height: int, tile: int, alpha_max: float, drop_last: bool) -> tuple[Tensor, Tensor]:
    """Launcher; see `tsplat_reference.blend`. Tiles are 8 pixels wide."""
    s = _Scene(means2d, conics, opacities, colors, backgrounds, ids, offsets, width, height, tile, alpha_max, drop_last)
    image, alphas = colors.new_empty(s.C, height, width, s.D), colors.new_empty(s.C, height, width)
    has_background = backgrounds is not None
    if s.D <= CHANNELS:
        blend_fwd_kernel[(s.blocks,)](s.records, s.ids, s.offsets, s.backgrounds, image, alphas, s.lane_x, width, height, *s.grid, s.R,
                                     BACKGROUND=has_background, **launch("blend"), **s.warp)
    else:
        options = launch("features")
        feature_fwd_kernel[(s.tiles, ceil_div(s.D, options["DB"]))](
            s.records, s.colors, s.ids, s.offsets, s.backgrounds, image, alphas, width, height, *s.grid, s.R, max(s.rows, 1), s.D,
            BACKGROUND=has_background, **options, **s.block)
    return image, alphas


def blend_backward(means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, backgrounds: Tensor | None, ids: Tensor,
                   offsets: Tensor, image: Tensor, alphas: Tensor, v_image: Tensor, v_alphas: Tensor | None, width: int, height: int, tile: int,
                   alpha_max: float, drop_last: bool, absgrad: bool) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Launcher; see `tsplat_reference.blend_blocks_backward`.

    Sums over pixels are atomic, so that their last bits differ from run to run, but not under `torch.use_deterministic_algorithms(True)`:
    then each hit has a row of sums of its own (48 bytes), added up in order; more than 4 channels take a pass per 4.
    """
    deterministic = torch.are_deterministic_algorithms_enabled()
    if deterministic and colors.shape[2] > CHANNELS:
        return _in_passes(means2d, conics, opacities, colors, backgrounds, ids, offsets, image, alphas, v_image, v_alphas, width, height,
                          tile, alpha_max, drop_last, absgrad)
    s = _Scene(means2d, conics, opacities, colors, backgrounds, ids, offsets, width, height, tile, alpha_max, drop_last)
    image, alphas, v_image = image.contiguous(), alphas.contiguous(), v_image.contiguous()
    v_alphas = None if v_alphas is None else v_alphas.contiguous()
    sums = means2d.new_zeros(len(ids) if deterministic else s.R + 1, SUMS.value)
    few = s.D <= CHANNELS
    v_colors = colors.new_empty(s.C, s.N, s.D) if few else torch.zeros_like(s.colors)
    if few:
        blend_bwd_kernel[(s.blocks,)](s.records, s.ids, s.offsets, s.backgrounds, image, alphas, v_image, v_alphas, sums, s.lane_x, width,
                                      height, *s.grid, s.R, BACKGROUND=backgrounds is not None, ABSGRAD=absgrad, PER_HIT=deterministic,
                                      lane_moments=footprint.lane_moments, mean_slopes=footprint.mean_slopes,
                                      **launch("blend_backward"), **s.warp)
        if deterministic:
            sums = means2d.new_zeros(s.R + 1, SUMS.value).index_add_(0, s.ids.long(), sums)
    else:
        # not einsum: a setting of torch may round its products to TF32, and the kernel takes small differences of these
        v_weights, rest = torch.zeros_like(alphas) if v_alphas is None else v_alphas, (image * v_image).sum(-1)
        if backgrounds is not None:
            behind = (v_image * backgrounds[:, None, None]).sum(-1)
            v_weights, rest = v_weights - behind, rest - behind
        if v_alphas is not None:
            rest = rest + alphas * v_alphas
        options = launch("features_colors_backward")
        feature_colors_bwd_kernel[(s.tiles, ceil_div(s.D, options["DB"]))](
            s.records, s.ids, s.offsets, v_image, v_colors, width, height, *s.grid, s.R, max(s.rows, 1), s.D, **options, **s.block)
        feature_bwd_kernel[(s.tiles,)](
            s.records, s.colors, s.ids, s.offsets, rest, v_weights, v_image, sums, width, height, *s.grid, s.R, max(s.rows, 1), s.D,
            ABSGRAD=absgrad, block_moments=footprint.block_moments, mean_slopes=footprint.mean_slopes, **launch("features_backward"),
            **s.block)
    del s.records                                       # its memory is enough for what comes now
    v_means2d, v_conics, v_opacities = means2d.new_empty(means2d.shape), torch.empty_like(s.conics), torch.empty_like(s.opacities)
    v_abs = means2d.new_empty(s.C, s.N if absgrad else 0, 2)
    if s.R:
        options = launch("records")
        footprint.unpack_kernel[(ceil_div(s.R, options["BLOCK"]),)](sums, s.conics, s.opacities, v_means2d, v_conics, v_opacities, v_colors,
                                                                    v_abs, s.R, D=s.D if few else 0, ABSGRAD=absgrad, **options)
    if few and colors.shape[0] < s.C:
        v_colors = v_colors.sum(0, keepdim=True)
    return v_means2d, v_conics, v_opacities, v_colors, v_abs


def _in_passes(means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, backgrounds: Tensor | None, ids: Tensor, offsets: Tensor,
               image: Tensor, alphas: Tensor, v_image: Tensor, v_alphas: Tensor | None, width: int, height: int, tile: int, alpha_max: float,
               drop_last: bool, absgrad: bool) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The backward by 4 channels at a time: it is linear in the upstream gradient, of which alpha's goes with the first pass."""
    if absgrad:
        raise NotImplementedError(f"absgrad: not deterministic for more than {CHANNELS} channels; got {colors.shape[2]}. "
                                  "Call torch.use_deterministic_algorithms(False), or render features apart from colours")
    parts = []
    for c in range(0, colors.shape[2], CHANNELS):
        some = slice(c, c + CHANNELS)
        background = None if backgrounds is None else backgrounds[:, some]
        v_some = v_alphas if c == 0 else None
        parts.append(blend_backward(means2d, conics, opacities, colors[..., some], background, ids, offsets, image[..., some].contiguous(),
                                    alphas, v_image[..., some], v_some, width, height, tile, alpha_max, drop_last, False))
    geometry = [torch.stack(v).sum(0) for v in list(zip(*parts, strict=True))[:3]]
    return geometry[0], geometry[1], geometry[2], torch.cat([p[3] for p in parts], -1), parts[0][4]
