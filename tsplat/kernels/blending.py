"""Blending of up to 4 channels: a warp takes 4 tiles of 8 x 8 pixels, a lane a row of its tile, front to back; forward and backward.

Loads, row terms and reductions are shared by the 8 pixels of a lane; there is no shared memory and no barrier. Small tiles halve the pairs
of splat and pixel in vain, and a warp that takes 4 of them still works in all lanes, as the 4 lists are of about the same length. More
channels go through matrix products, in `feature_blending.py`.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from tsplat.kernels import footprint
from tsplat.kernels.feature_blending import feature_bwd_kernel, feature_colors_bwd_kernel, feature_fwd_kernel
from tsplat.kernels.footprint import LOG2_MIN, SUMS, T_MIN
from tsplat.kernels.launch import Launcher, ceil_div, current_target, launch
from tsplat.kernels.tiles import (
    TILE,
    add_tile_sums,
    block_pixels,
    blocks,
    glue,
    halves,
    lane_x,
    load_batch,
    load_pixels,
    load_record,
    of_batch,
    prefetch_records,
    row_dot,
    store_half,
    tile_list,
)

CHANNELS = 4
"""Up to here a splat's colour is in its record and a pixel's in registers."""
T_ONE = tl.constexpr(2.0**-126 / T_MIN.value)
T_END = tl.constexpr(2.0**-126)
BOOST = tl.constexpr(8)
"""Units of the forward, which so needs no test of T: a transmittance of 1 is T_ONE, and a pixel is finished below T_END, the least number in
float32 that `mul.ftz` does not take for 0. Weights are 2^BOOST times as large, so that none that counts is below T_END."""


@triton.jit
def both_or_zero(value, a, a_min: tl.constexpr, b, b_min: tl.constexpr):
    """The value where a >= a_min and b > b_min, else 0, in three instructions: the compiler makes a select of each condition (4)."""
    a_min = tl.full(value.shape, a_min, tl.float32)
    b_min = tl.full(value.shape, b_min, tl.float32)
    return tl.inline_asm_elementwise("{.reg .pred p; setp.ge.f32 p, $2, $3; setp.gt.and.f32 p, $4, $5, p; selp.f32 $0, $1, 0f00000000, p;}",
                                     "=f,f,f,f,f,f", [value, a, a_min, b, b_min], dtype=tl.float32, is_pure=True, pack=1)


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
def forward_weight(mx, my, l00, l10, l11, log2_opacity, x, y, T, log2_alpha: tl.constexpr, ALPHA_MAX: tl.constexpr, FLUSH: tl.constexpr,
                   PREDICATES: tl.constexpr):
    """T alpha in the forward's units, and where alpha is not below 1/255: elsewhere the weight is 0, or anything with PREDICATES."""
    power = log2_alpha(mx, my, l00, l10, l11, log2_opacity + BOOST, x, y)
    alpha = tl.minimum(tl.exp2(power), tl.full((), ALPHA_MAX * 2**BOOST, x.dtype))
    shown = power >= LOG2_MIN + BOOST
    if not PREDICATES:
        alpha = tl.where(shown, alpha, 0.0)
    if FLUSH:                                           # an instruction less of 14 than a test
        w = tl.inline_asm_elementwise("mul.ftz.f32 $0, $1, $2;", "=f,f,f", [T, alpha], dtype=tl.float32, is_pure=True, pack=1)
    else:
        w = tl.where(T >= T_END, T, 0.0) * alpha
    return w, shown


@triton.jit
def add_where(shown, total, value, PREDICATES: tl.constexpr):
    """The total and the value, where it is shown. Where that is one instruction, as on sm_90, it saves the select of weights, 1 of 13; in what
    the compiler makes of it for others, it costs more than that."""
    return tl.where(shown, total + value, total) if PREDICATES else total + value


@Launcher
@triton.jit(do_not_specialize=["W", "H", "tiles_x", "tiles_y", "null"])
def blend_fwd_kernel(records, ids, offsets, backgrounds, image, alphas, lane_x, W, H, tiles_x, tiles_y, null, D: tl.constexpr,
                     BACKGROUND: tl.constexpr, ALPHA_MAX: tl.constexpr, DROP_LAST: tl.constexpr, log2_alpha: tl.constexpr,
                     LANES: tl.constexpr, PTX: tl.constexpr, PREDICATES: tl.constexpr):
    """Image `[C, H, W, D]` and alpha `[C, H, W]` of a block of tiles.

    DROP_LAST: T takes in the splat that finishes a pixel, too, but nothing else does, so alpha is the sum of the weights instead of 1 - T.
    """
    view, tile, exists, left, top, x, y, column4, pixel4 = block_pixels(tl.program_id(0), lane_x, tiles_x, tiles_y, W, H, LANES)
    cx = left.to(x.dtype) + TILE / 2
    T = glue(tl.where(column4 < W, T_ONE, 0.0), tl.where(column4 + 1 < W, T_ONE, 0.0)) + x * 0.0     # beyond the border finished
    C0 = x * 0.0
    C1 = x * 0.0
    C2 = x * 0.0
    C3 = x * 0.0
    A = x * 0.0
    start, hits, longest = tile_list(offsets, tile, exists)
    i = 0
    batch = load_batch(ids, start, 0, hits, null)
    following = load_batch(ids, start, TILE, hits, null)
    while i < longest:
        later = load_batch(ids, start, i + 2 * TILE, hits, null)        # two batches ahead, so that nothing waits for it
        prefetch_records(records, following, 12, PTX)
        u = 0
        while u < TILE:                                                 # a loop: unrolled, it takes more registers and is no faster
            splat = of_batch(batch, u, ids, start, i, hits, null, PTX)
            r = load_record(records, splat, D)
            w, shown = forward_weight(r[0] - cx, r[1], r[2], r[3], r[4], r[5], x, y, T, log2_alpha, ALPHA_MAX, PTX, PREDICATES)
            T = add_where(shown, T, w * -2**-BOOST, PREDICATES)
            if DROP_LAST:
                if PREDICATES:
                    shown = shown & (T > T_END)
                else:
                    w = tl.where(T > T_END, w, 0.0)
                A = add_where(shown, A, w, PREDICATES)
            C0 = add_where(shown, C0, r[6] * w, PREDICATES)
            if D > 1:
                C1 = add_where(shown, C1, r[7] * w, PREDICATES)
            if D > 2:
                C2 = add_where(shown, C2, r[8] * w, PREDICATES)
            if D > 3:
                C3 = add_where(shown, C3, r[9] * w, PREDICATES)
            u += 1
        i += TILE
        batch = following
        following = later
        longest = tl.where(tl.max(tl.max(T, 1), 0) > T_END, longest, 0)     # finished tiles are only looked for once per batch
    if DROP_LAST:
        T = T_ONE - A * 2**-BOOST
    T *= tl.full((), 1 / T_ONE, x.dtype)                # in float32, too, 1 where no splat is
    unit = tl.full((), 2**-BOOST / T_ONE, x.dtype)
    C0 *= unit
    C1 *= unit
    C2 *= unit
    C3 *= unit
    if BACKGROUND:
        b = backgrounds + view * D
        C0 += T * tl.load(b)
        C1 += T * tl.load(b + 1, mask=D > 1, other=0.0)
        C2 += T * tl.load(b + 2, mask=D > 2, other=0.0)
        C3 += T * tl.load(b + 3, mask=D > 3, other=0.0)
    C0, D0 = halves(C0)
    C1, D1 = halves(C1)
    C2, D2 = halves(C2)
    C3, D3 = halves(C3)
    T, U = halves(T)
    store_half(image, alphas, None, C0, C1, C2, C3, 1.0 - T, None, view, left, top, W, H, 0, D)
    store_half(image, alphas, None, D0, D1, D2, D3, 1.0 - U, None, view, left, top, W, H, 4, D)


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
    view, tile, exists, left, top, x, y, column4, pixel4 = block_pixels(tl.program_id(0), lane_x, tiles_x, tiles_y, W, H, LANES)
    cx = left.to(x.dtype) + TILE / 2
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
        prefetch_records(records, following, 12, PTX)
        stop = tl.minimum(TILE, longest - i)
        u = 0
        while u < stop:
            splat = of_batch(batch, u, ids, start, i, hits, null, PTX)
            r = load_record(records, splat, D)
            mx = r[0] - cx
            my = r[1]
            l00, l10, l11 = r[2:5]
            alpha = splat_alpha(mx, my, l00, l10, l11, r[5], x, y, T, log2_alpha, ALPHA_MAX, PTX)
            w = alpha * T
            T -= w
            if DROP_LAST:
                w = tl.where(T > T_MIN, w, 0.0)
            g = v_weight + r[6] * v0
            if D > 1:
                g += r[7] * v1
            if D > 2:
                g += r[8] * v2
            if D > 3:
                g += r[9] * v3
            rest -= w * g
            if PTX:
                reciprocal = tl.inline_asm_elementwise("rcp.approx.ftz.f32 $0, $1;", "=f,f", [T], dtype=tl.float32, is_pure=True, pack=1)
            else:
                reciprocal = 1.0 / T
            v = w * (g - rest * reciprocal)
            v = tl.where(alpha < tl.full((), ALPHA_MAX, x.dtype), v, 0.0)
            s0, sx, sy, sxx, sxy, syy = lane_moments(v, mx, my, l00, l10, l11, x, y)
            w0 = row_dot(w, v0)
            w1 = row_dot(w, v1) if D > 1 else none
            w2 = row_dot(w, v2) if D > 2 else none
            w3 = row_dot(w, v3) if D > 3 else none
            ax = none
            ay = none
            if ABSGRAD:
                slope_x, slope_y = mean_slopes(mx, my, l00, l10, l11, x, y)
                ax = tl.sum(tl.abs(v * slope_x), 1, keep_dims=True)
                ay = tl.sum(tl.abs(v * slope_y), 1, keep_dims=True)
            COUNT: tl.constexpr = 12 if ABSGRAD or D > 3 else 9
            row = start + i + u if PER_HIT else splat.to(tl.int64)
            add_tile_sums(sums + row * SUMS, s0, sx, sy, sxx, sxy, syy, w0, w1, w2, w3, ax, ay, splat != null, COUNT, PER_HIT, PTX)
            u += 1
        i += TILE
        batch = following
        following = later
        longest = tl.where(tl.max(tl.max(T, 1), 0) > T_MIN, longest, 0)


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
        self.common = {"ALPHA_MAX": alpha_max, "DROP_LAST": drop_last, "log2_alpha": footprint.log2_alpha}
        lanes, ptx = target.lanes, target.ptx and means2d.dtype == torch.float32
        self.predicates = target.predicates
        self.lane_x, self.blocks = lane_x(lanes, means2d), self.C * blocks(self.grid, lanes)
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
                                     BACKGROUND=has_background, PREDICATES=s.predicates, **launch("blend"), **s.warp)
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
    v_colors = None if few else torch.zeros_like(s.colors)
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
    v_colors = colors.new_empty(s.C, s.N, s.D) if v_colors is None else v_colors
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
