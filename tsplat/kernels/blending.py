"""Blending of up to 4 channels: one warp per tile, several pixels per thread, front to back; forward and backward.

Loads, row terms and reductions are shared by the pixels of a thread; there is no shared memory and no barrier. More channels go through
matrix products, in `feature_blending.py`.
"""

from __future__ import annotations

import functools
import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from tsplat.kernels import footprint
from tsplat.kernels.feature_blending import feature_bwd_kernel, feature_fwd_kernel
from tsplat.kernels.footprint import LOG2_MIN, T_MIN, TILE
from tsplat.kernels.launch import ceil_div, current_target, launch

CHANNELS = 4
"""Up to here a splat's colour is in its record and a pixel's in registers."""
SUMS = 16
"""Row of sums per splat in the backward: 6 moments, 4 colours, 2 absolute gradients, 4 that pad it to 64 bytes."""


@triton.jit
def load4(p):
    """Four consecutive numbers as scalars: one 16-byte load, no shuffles."""
    a, b = tl.split(tl.reshape(tl.load(p + tl.arange(0, 4)), (2, 2)))
    v0, v2 = tl.split(a)
    v1, v3 = tl.split(b)
    return v0, v1, v2, v3


@triton.jit
def glue(a, b, PX: tl.constexpr):
    """The pixels of a lane `[LANES, PX]`: even ones from a, odd ones from b, or all from a if a lane has 4.

    A load gives a thread 4 numbers at the most; only so are 8 of them in the registers of one thread.
    """
    if PX == 8:
        return tl.reshape(tl.join(a, b), (a.shape[0], 8))
    else:
        return a


@triton.jit
def tile_pixels(tile, lane_x, tiles_x, tiles_y, W, H, LANES: tl.constexpr, PX: tl.constexpr):
    """The pixels of a tile: camera, x `[LANES, PX]` and y `[LANES, 1]` about the tile's centre, that centre, and of 4 pixels of each lane
    `[LANES, 4]` (all of them, or every second of 8) the column and the index of the pixel.

    x is loaded rather than made by tl.arange: that anchors the layout with a lane's pixels in its own registers, and all state is derived
    from it (tl.zeros would get another layout and the compiler would run the loop twice).
    """
    view = tile // (tiles_x * tiles_y)
    left = (tile % tiles_x) * TILE
    top = (tile // tiles_x) % tiles_y * TILE
    half: tl.constexpr = TILE / 2
    x4 = tl.load(lane_x + tl.arange(0, LANES)[:, None] * 4 + tl.arange(0, 4)[None, :])
    row = (tl.arange(0, LANES) % TILE)[:, None]
    column4 = left + (x4 + (half - 0.5)).to(tl.int32)
    column4 = tl.where(top + row < H, column4, W)       # beyond the border, if the row is
    pixel4 = (view.to(tl.int64) * H + top + row) * W + column4
    x = glue(x4, x4 + 1.0, PX)
    return view, x, row.to(x.dtype) - (half - 0.5), left.to(x.dtype) + half, top.to(x.dtype) + half, column4, pixel4


@triton.jit
def load_pixels(p, pixel4, column4, W, D: tl.constexpr, c: tl.constexpr, PX: tl.constexpr):
    """Channel c of an image `[C, H, W, D]` at a tile's pixels; zeros beyond the border and for channels that do not exist."""
    a = tl.load(p + pixel4 * D + c, mask=(column4 < W) & (c < D), other=0.0)
    if PX == 8:
        return glue(a, tl.load(p + pixel4 * D + (D + c), mask=(column4 + 1 < W) & (c < D), other=0.0), PX)
    else:
        return a


@triton.jit
def store_pixels(p, value, pixel4, column4, W, D: tl.constexpr, c: tl.constexpr, PX: tl.constexpr):
    """The inverse of `load_pixels`."""
    if PX == 8:
        a, b = tl.split(tl.reshape(value, (value.shape[0], 4, 2)))
        tl.store(p + pixel4 * D + c, a, mask=column4 < W)
        tl.store(p + pixel4 * D + (D + c), b, mask=column4 + 1 < W)
    else:
        tl.store(p + pixel4 * D + c, value, mask=column4 < W)


@triton.jit
def both_or_zero(value, a, a_min: tl.constexpr, b, b_min: tl.constexpr):
    """The value where a >= a_min and b > b_min, else 0, in three instructions: the compiler makes a select of each condition (4)."""
    a_min = tl.full(value.shape, a_min, tl.float32)
    b_min = tl.full(value.shape, b_min, tl.float32)
    return tl.inline_asm_elementwise("{.reg .pred p; setp.ge.f32 p, $2, $3; setp.gt.and.f32 p, $4, $5, p; selp.f32 $0, $1, 0f00000000, p;}",
                                     "=f,f,f,f,f,f", [value, a, a_min, b, b_min], dtype=tl.float32, is_pure=True, pack=1)


@triton.jit
def splat_alpha(p, x, y, cx, cy, T, log2_alpha: tl.constexpr,
                ALPHA_MAX: tl.constexpr, PTX: tl.constexpr):
    """Record and alpha at the pixels: 0 below 1/255, and where the pixel is finished."""
    mx, my, l00, l10 = load4(p)
    l11, log2_opacity, c0, c1 = load4(p + 4)
    mx -= cx
    my -= cy
    power = log2_alpha(mx, my, l00, l10, l11, log2_opacity, x, y)
    alpha = tl.minimum(tl.exp2(power), tl.full((), ALPHA_MAX, x.dtype))    # a literal would be rounded to float32
    if PTX:
        alpha = both_or_zero(alpha, power, LOG2_MIN, T, T_MIN)
    else:
        alpha = tl.where((power >= LOG2_MIN) & (T > T_MIN), alpha, 0.0)
    return mx, my, l00, l10, l11, c0, c1, alpha


@triton.jit(do_not_specialize=["W", "H", "tiles_x", "tiles_y", "null"])
def blend_fwd_kernel(records, ids, offsets, backgrounds, image, alphas, lane_x, W, H, tiles_x, tiles_y, null, D: tl.constexpr,
                     BACKGROUND: tl.constexpr, ALPHA_MAX: tl.constexpr, log2_alpha: tl.constexpr, LANES: tl.constexpr, PX: tl.constexpr,
                     UNROLL: tl.constexpr, PTX: tl.constexpr):
    """Image `[C, H, W, D]` and alpha `[C, H, W]` of one tile."""
    tile = tl.program_id(0)
    view, x, y, cx, cy, column4, pixel4 = tile_pixels(tile, lane_x, tiles_x, tiles_y, W, H, LANES, PX)
    T = glue(tl.where(column4 < W, 1.0, 0.0), tl.where(column4 + 1 < W, 1.0, 0.0), PX) + x * 0.0     # beyond the border finished
    C0 = x * 0.0
    C1 = x * 0.0
    C2 = x * 0.0
    C3 = x * 0.0
    start = tl.load(offsets + tile)
    hits = (tl.load(offsets + tile + 1) - start).to(tl.int32)              # 64 bits are for the start only
    i = 0
    alive = True
    while (i < hits) & alive:
        for u in tl.static_range(UNROLL):
            splat = tl.load(ids + start + i + u, mask=i + u < hits, other=null)
            p = records + splat.to(tl.int64) * 12
            _, _, _, _, _, c0, c1, alpha = splat_alpha(p, x, y, cx, cy, T, log2_alpha, ALPHA_MAX, PTX)
            w = alpha * T
            C0 += c0 * w
            if D > 1:
                C1 += c1 * w
            if D > 2:
                c2, c3, _, _ = load4(p + 8)
                C2 += c2 * w
                if D > 3:
                    C3 += c3 * w
            T -= w
        i += UNROLL
        alive = tl.max(tl.max(T, 1), 0) > T_MIN
    if BACKGROUND:
        b = backgrounds + view * D
        C0 += T * tl.load(b)
        C1 += T * tl.load(b + 1, mask=D > 1, other=0.0)
        C2 += T * tl.load(b + 2, mask=D > 2, other=0.0)
        C3 += T * tl.load(b + 3, mask=D > 3, other=0.0)
    store_pixels(image, C0, pixel4, column4, W, D, 0, PX)
    if D > 1:
        store_pixels(image, C1, pixel4, column4, W, D, 1, PX)
    if D > 2:
        store_pixels(image, C2, pixel4, column4, W, D, 2, PX)
    if D > 3:
        store_pixels(image, C3, pixel4, column4, W, D, 3, PX)
    store_pixels(alphas, 1.0 - T, pixel4, column4, W, 1, 0, PX)


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
def lane_sums(s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, s10, s11, COUNT: tl.constexpr, LANES: tl.constexpr, PTX: tl.constexpr):
    """COUNT (9 or 12) sums over the lanes, spread over the lanes: value, slot and mask for one atomic instruction."""
    lane = tl.arange(0, LANES)[:, None]
    if PTX:
        b4 = (lane & 16) != 0
        b3 = (lane & 8) != 0
        b2 = (lane & 4) != 0
        b1 = (lane & 2) != 0
        # after fold2 with bits 4, 3, 2: lanes hold sums 4 b2 + 2 b3 + b4, and 8 + 2 b3 + b4 of the last four
        a0 = fold2(fold2(s0, s1, b4, 16), fold2(s2, s3, b4, 16), b3, 8)
        a1 = fold2(fold2(s4, s5, b4, 16), fold2(s6, s7, b4, 16), b3, 8)
        if COUNT == 9:
            a2 = fold1(fold1(s8, 16), 8)
        else:
            a2 = fold2(fold2(s8, s9, b4, 16), fold2(s10, s11, b4, 16), b3, 8)
        value = fold1(fold2(fold2(a0, a1, b2, 4), fold1(a2, 4), b1, 2), 1)
        low = (b3.to(tl.int32) * 2) + b4.to(tl.int32)
        slot = tl.where(b1, 8 + (0 if COUNT == 9 else 1) * low, b2.to(tl.int32) * 4 + low)
        first = tl.where(b1, (~b2) & ((~b3) & (~b4) if COUNT == 9 else (lane >= 0)), lane >= 0)
        return value, slot, ((lane & 1) == 0) & first
    else:
        value = s0 * 0.0
        value = tl.where(lane == 0, tl.sum(s0), value)
        value = tl.where(lane == 1, tl.sum(s1), value)
        value = tl.where(lane == 2, tl.sum(s2), value)
        value = tl.where(lane == 3, tl.sum(s3), value)
        value = tl.where(lane == 4, tl.sum(s4), value)
        value = tl.where(lane == 5, tl.sum(s5), value)
        value = tl.where(lane == 6, tl.sum(s6), value)
        value = tl.where(lane == 7, tl.sum(s7), value)
        value = tl.where(lane == 8, tl.sum(s8), value)
        if COUNT > 9:
            value = tl.where(lane == 9, tl.sum(s9), value)
            value = tl.where(lane == 10, tl.sum(s10), value)
            value = tl.where(lane == 11, tl.sum(s11), value)
        return value, lane, lane < COUNT


@triton.jit(do_not_specialize=["W", "H", "tiles_x", "tiles_y"])
def blend_bwd_kernel(records, ids, offsets, backgrounds, image, alphas, v_image, v_alphas, sums, lane_x, W, H, tiles_x, tiles_y,
                     D: tl.constexpr, ALPHA_MAX: tl.constexpr, BACKGROUND: tl.constexpr, ABSGRAD: tl.constexpr, PER_HIT: tl.constexpr,
                     log2_alpha: tl.constexpr, lane_moments: tl.constexpr, mean_slopes: tl.constexpr, LANES: tl.constexpr,
                     PX: tl.constexpr, CHECK: tl.constexpr, PTX: tl.constexpr):
    """Sums `[R, 16]` over the pixels, per splat (atomic), or per hit `[M, 16]` (PER_HIT, for the same bits in every run).

    Front to back: `rest` is what is still to come, times the upstream gradient; it starts as <image, dL/dimage> + alpha dL/dalpha without
    the background's share, and loses a term at each splat. dL/dlog alpha = w (g - rest/T), T behind the splat: two operations less than
    w g - alpha/(1 - alpha) rest.
    """
    tile = tl.program_id(0)
    view, x, y, cx, cy, column4, pixel4 = tile_pixels(tile, lane_x, tiles_x, tiles_y, W, H, LANES, PX)
    v0 = load_pixels(v_image, pixel4, column4, W, D, 0, PX)
    v1 = load_pixels(v_image, pixel4, column4, W, D, 1, PX)
    v2 = load_pixels(v_image, pixel4, column4, W, D, 2, PX)
    v3 = load_pixels(v_image, pixel4, column4, W, D, 3, PX)
    v_weight = load_pixels(v_alphas, pixel4, column4, W, 1, 0, PX)
    rest = v_weight * load_pixels(alphas, pixel4, column4, W, 1, 0, PX)
    rest += v0 * load_pixels(image, pixel4, column4, W, D, 0, PX) + v1 * load_pixels(image, pixel4, column4, W, D, 1, PX)
    rest += v2 * load_pixels(image, pixel4, column4, W, D, 2, PX) + v3 * load_pixels(image, pixel4, column4, W, D, 3, PX)
    if BACKGROUND:
        b = backgrounds + view * D
        behind = v0 * tl.load(b) + v1 * tl.load(b + 1, mask=D > 1, other=0.0)
        behind += v2 * tl.load(b + 2, mask=D > 2, other=0.0) + v3 * tl.load(b + 3, mask=D > 3, other=0.0)
        rest -= behind
        v_weight -= behind
    T = glue(tl.where(column4 < W, 1.0, 1e-10), tl.where(column4 + 1 < W, 1.0, 1e-10), PX) + x * 0.0     # beyond the border finished, not 0
    none = tl.sum(x * 0.0, 1, keep_dims=True)
    start = tl.load(offsets + tile)
    hits = (tl.load(offsets + tile + 1) - start).to(tl.int32)
    i = 0
    alive = True
    while (i < hits) & alive:
        stop = tl.minimum(i + CHECK, hits)              # whether the tile is finished is only looked at now and then
        while i < stop:
            splat = tl.load(ids + start + i).to(tl.int64)
            p = records + splat * 12
            mx, my, l00, l10, l11, c0, c1, alpha = splat_alpha(p, x, y, cx, cy, T, log2_alpha, ALPHA_MAX, PTX)
            w = alpha * T
            g = v_weight + c0 * v0
            if D > 1:
                g += c1 * v1
            if D > 2:
                c2, c3, _, _ = load4(p + 8)
                g += c2 * v2
                if D > 3:
                    g += c3 * v3
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
            value, slot, mask = lane_sums(s0, sx, sy, sxx, sxy, syy, w0, w1, w2, w3, ax, ay, 12 if ABSGRAD or D > 3 else 9, LANES, PTX)
            if PER_HIT:
                tl.store(sums + (start + i) * 16 + slot, value, mask=mask)
            else:
                tl.atomic_add(sums + splat * 16 + slot, value, mask=mask, sem="relaxed")
            i += 1
        alive = tl.max(tl.max(T, 1), 0) > T_MIN


@functools.cache
def _lane_x(tile: int, lanes: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """`[lanes, 4]`: x about the tile's centre of each lane's pixels, or of every second of 8."""
    px = tile * tile // lanes
    lane = torch.arange(lanes, device=device)[:, None] // tile * px
    return (lane + torch.arange(0, px, px // 4, device=device)).to(dtype) - (tile / 2 - 0.5)


class _Scene:
    """Arguments of the kernels, contiguous, with records packed and launch constants chosen."""

    def __init__(self, means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, backgrounds: Tensor | None, ids: Tensor,
                 offsets: Tensor, width: int, height: int, tile: int, alpha_max: float) -> None:
        if tile != TILE.value:
            raise ValueError(f"tile: expected {TILE.value}, the tile of the Triton kernels; got {tile}")
        (self.C, self.N), self.D = opacities.shape, colors.shape[2]
        self.R, self.rows = self.C * self.N, colors.shape[0] * self.N
        self.conics, self.opacities, self.colors = conics.contiguous(), opacities.contiguous(), colors.contiguous()
        self.ids, self.offsets = ids, offsets
        self.backgrounds = colors if backgrounds is None else backgrounds.contiguous()      # any pointer, if it is not read
        self.grid = ceil_div(width, tile), ceil_div(height, tile)
        self.tiles = self.C * self.grid[0] * self.grid[1]
        self.records = means2d.new_empty(self.R + 1, footprint.RECORD)
        options = launch("records")
        footprint.pack_kernel[(ceil_div(self.R + 1, options["BLOCK"]),)](
            means2d.contiguous(), self.conics, self.opacities, self.colors, self.records, self.R, max(self.rows, 1),
            D=self.D if self.D <= CHANNELS else 0, **options)
        target = current_target()
        self.common = {"ALPHA_MAX": alpha_max, "log2_alpha": footprint.log2_alpha, "enable_fp_fusion": True}
        lanes, ptx = target.lanes, target.ptx and means2d.dtype == torch.float32
        self.lane_x = _lane_x(tile, lanes, means2d.dtype, means2d.device)
        self.warp = {**self.common, "D": self.D, "LANES": lanes, "PX": tile * tile // lanes, "PTX": ptx}
        self.block = {**self.common, "PRECISION": "tf32x3" if ptx else "ieee"}


def blend(means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, backgrounds: Tensor | None, ids: Tensor, offsets: Tensor,
          width: int, height: int, tile: int, alpha_max: float) -> tuple[Tensor, Tensor]:
    """Launcher; see `tsplat_reference.blend`. Tiles are 16 pixels wide."""
    s = _Scene(means2d, conics, opacities, colors, backgrounds, ids, offsets, width, height, tile, alpha_max)
    image, alphas = colors.new_empty(s.C, height, width, s.D), colors.new_empty(s.C, height, width)
    has_background = backgrounds is not None
    if s.D <= CHANNELS:
        blend_fwd_kernel[(s.tiles,)](s.records, ids, offsets, s.backgrounds, image, alphas, s.lane_x, width, height, *s.grid, s.R,
                                     BACKGROUND=has_background, **launch("blend"), **s.warp)
    else:
        options = launch("features")
        feature_fwd_kernel[(s.tiles * (tile * tile // options["P"]), ceil_div(s.D, options["DB"]))](
            s.records, s.colors, ids, offsets, s.backgrounds, image, alphas, width, height, *s.grid, s.R, max(s.rows, 1), s.D,
            BACKGROUND=has_background, **options, **s.block)
    return image, alphas


def blend_backward(means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, backgrounds: Tensor | None, ids: Tensor,
                   offsets: Tensor, image: Tensor, alphas: Tensor, v_image: Tensor, v_alphas: Tensor, width: int, height: int, tile: int,
                   alpha_max: float, absgrad: bool) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Launcher; see `tsplat_reference.blend_blocks_backward`.

    Sums over pixels are atomic, so that their last bits differ from run to run, but not under `torch.use_deterministic_algorithms(True)`:
    then each hit has a row of sums of its own (64 bytes), added up in order; more than 4 channels take a pass per 4.
    """
    deterministic = torch.are_deterministic_algorithms_enabled()
    if deterministic and colors.shape[2] > CHANNELS:
        return _in_passes(means2d, conics, opacities, colors, backgrounds, ids, offsets, image, alphas, v_image, v_alphas, width, height,
                          tile, alpha_max, absgrad)
    s = _Scene(means2d, conics, opacities, colors, backgrounds, ids, offsets, width, height, tile, alpha_max)
    v_image, v_alphas = v_image.contiguous(), v_alphas.contiguous()
    sums = means2d.new_zeros(len(ids) if deterministic else s.R + 1, SUMS)
    v_colors = torch.zeros_like(s.colors)
    if s.D <= CHANNELS:
        blend_bwd_kernel[(s.tiles,)](s.records, ids, offsets, s.backgrounds, image, alphas, v_image, v_alphas, sums, s.lane_x, width,
                                     height, *s.grid, BACKGROUND=backgrounds is not None, ABSGRAD=absgrad, PER_HIT=deterministic,
                                     lane_moments=footprint.lane_moments, mean_slopes=footprint.mean_slopes,
                                     **launch("blend_backward"), **s.warp)
        if deterministic:
            sums = means2d.new_zeros(s.R + 1, SUMS).index_add_(0, ids.long(), sums)
        v_colors = sums[:s.R, 6:6 + s.D].view(s.C, s.N, s.D)
        v_colors = v_colors.sum(0, keepdim=True) if colors.shape[0] < s.C else v_colors.contiguous()
    else:
        behind = 0.0 if backgrounds is None else torch.einsum("chwd,cd->chw", v_image, backgrounds)
        rest = torch.einsum("chwd,chwd->chw", image, v_image) + alphas * v_alphas - behind
        options = launch("features_backward")
        feature_bwd_kernel[(s.tiles * (tile * tile // options["P"]),)](
            s.records, s.colors, ids, offsets, rest, v_alphas - behind, v_image, sums, v_colors, width, height, *s.grid, s.R,
            max(s.rows, 1), s.D, ABSGRAD=absgrad,
            block_moments=footprint.block_moments, mean_slopes=footprint.mean_slopes, **options, **s.block)
    v_means2d, v_conics, v_opacities = torch.empty_like(means2d), torch.empty_like(s.conics), torch.empty_like(s.opacities)
    options = launch("records")
    footprint.unpack_kernel[(max(1, ceil_div(s.R, options["BLOCK"])),)](sums, s.conics, s.opacities, v_means2d, v_conics, v_opacities, s.R,
                                                                        STRIDE=SUMS, **options)
    v_backgrounds = v_image.new_zeros(s.C, s.D) if backgrounds is None else torch.einsum("chwd,chw->cd", v_image, 1 - alphas)
    v_abs = (2 * math.log(2) * sums[:s.R, 10:12]).view(s.C, s.N, 2) if absgrad else means2d.new_empty(s.C, 0, 2)
    return v_means2d, v_conics, v_opacities, v_colors, v_backgrounds, v_abs


def _in_passes(means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, backgrounds: Tensor | None, ids: Tensor, offsets: Tensor,
               image: Tensor, alphas: Tensor, v_image: Tensor, v_alphas: Tensor, width: int, height: int, tile: int, alpha_max: float,
               absgrad: bool) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The backward by 4 channels at a time: it is linear in the upstream gradient, of which alpha's goes with the first pass."""
    if absgrad:
        raise NotImplementedError(f"absgrad: not deterministic for more than {CHANNELS} channels; got {colors.shape[2]}. "
                                  "Call torch.use_deterministic_algorithms(False), or render features apart from colours")
    parts = []
    for c in range(0, colors.shape[2], CHANNELS):
        some = slice(c, c + CHANNELS)
        background = None if backgrounds is None else backgrounds[:, some]
        v_some = v_alphas if c == 0 else torch.zeros_like(v_alphas)
        parts.append(blend_backward(means2d, conics, opacities, colors[..., some], background, ids, offsets, image[..., some].contiguous(),
                                    alphas, v_image[..., some], v_some, width, height, tile, alpha_max, False))
    geometry = [torch.stack(v).sum(0) for v in list(zip(*parts, strict=True))[:3]]
    return (geometry[0], geometry[1], geometry[2], torch.cat([p[3] for p in parts], -1), torch.cat([p[4] for p in parts], -1), parts[0][5])
