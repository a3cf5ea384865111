"""Tile intersection in depth order, on two levels: a radix sort of the few hits of splats and bins of 8 x 8 tiles, then each tile picks its
own from the list of its bin, by counting.

A thread per splat counts and writes its hits of bins. Each of these gets 8 bytes, a bit per tile of the bin, and a program per tile counts and
then copies the splats that have its bit. Against sorting the hits of tiles, of which there are 4 times as many, that saves most of the
memory (torch's sort takes 8 bytes of index per key, twice) and of its traffic.
"""

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor
from tsplat_reference.constants import ALPHA_MIN, BIN_SLACK, BIN_SLACK_RELATIVE, EXTENT_MAX

from tsplat.kernels.footprint import TILE
from tsplat.kernels.launch import Launcher, ceil_div, launch

SIDE = tl.constexpr(8)
"""Tiles along the side of a bin: a row of them is a byte."""
LOG_MIN = tl.constexpr(math.log(ALPHA_MIN))
LEVEL_MAX = tl.constexpr(EXTENT_MAX**2)
SLACK = tl.constexpr(BIN_SLACK)
SLACK_RELATIVE = tl.constexpr(BIN_SLACK_RELATIVE)


@triton.jit
def span(low, high, size, TILE: tl.constexpr):
    """First and last tile whose pixel centres (at + 0.5) lie in [low, high]; last < first if there is none."""
    first = tl.minimum(tl.maximum(tl.ceil(low - 0.5), 0.0), size.to(low.dtype)).to(tl.int32)
    last = tl.minimum(tl.maximum(tl.floor(high - 0.5), -1.0), (size - 1).to(low.dtype)).to(tl.int32)
    return first // TILE, tl.where(last < first, first // TILE - 1, last // TILE)


@triton.jit
def visible(radii, splat, real):
    """Whether splats were not culled."""
    return real & (tl.load(radii + 2 * splat, mask=real, other=0) > 0) & (tl.load(radii + 2 * splat + 1, mask=real, other=0) > 0)


@triton.jit
def ellipse(means2d, conics, opacities, splat, real, H, EPS: tl.constexpr):
    """The ellipse a dx^2 + 2 b dx dy + c dy^2 = level in which alpha reaches 1/255, with a slack for rounding."""
    mx = tl.load(means2d + 2 * splat, mask=real, other=0.0)
    my = tl.load(means2d + 2 * splat + 1, mask=real, other=0.0)
    a = tl.load(conics + 3 * splat, mask=real, other=1.0)
    b = tl.load(conics + 3 * splat + 1, mask=real, other=0.0)
    c = tl.load(conics + 3 * splat + 2, mask=real, other=1.0)
    opacity = tl.load(opacities + splat, mask=real, other=1.0)
    dt: tl.constexpr = mx.dtype
    level = 2.0 * (tl.log(opacity) - tl.full((), LOG_MIN, dt))
    level = tl.minimum(tl.maximum(level, 0.0), tl.full((), LEVEL_MAX, dt)) * (1.0 + SLACK_RELATIVE) + SLACK
    det = tl.maximum(a * c - b * b, EPS * a * c)
    half = tl.sqrt(level * a / det)
    return mx, my, a, b, c, level, det, half


@triton.jit
def rows(my, half, real, H, TILE: tl.constexpr):
    """First and last row of tiles of an ellipse; last < first if there is none."""
    first, last = span(my - half, my + half, H, TILE)
    return first, tl.where(real, last, first - 1)


@triton.jit
def row_span(row, mx, my, a, b, c, level, det, half, W, H, TILE: tl.constexpr):
    """First and last tile of a row of tiles that the ellipse touches, where its pixel centres are."""
    low = tl.maximum((row * TILE).to(mx.dtype) + 0.5 - my, -half)
    high = tl.minimum(tl.minimum((row + 1) * TILE, H).to(mx.dtype) - 0.5 - my, half)
    rightmost = -(b / c) * tl.sqrt(level * c / det)
    y = tl.minimum(tl.maximum(rightmost, low), high)
    x_high = (-b * y + tl.sqrt(tl.maximum(a * level - det * y * y, 0.0))) / a
    y = tl.minimum(tl.maximum(-rightmost, low), high)
    x_low = (-b * y - tl.sqrt(tl.maximum(a * level - det * y * y, 0.0))) / a
    return span(mx + x_low, mx + x_high, W, TILE)


@triton.jit
def count_hits(mx, my, a, b, c, level, det, half, real, W, H, TILE: tl.constexpr):
    """Number of tiles that each splat hits."""
    row, last = rows(my, half, real, H, TILE)
    count = row * 0
    while tl.max((row <= last).to(tl.int32), 0) > 0:
        left, right = row_span(row, mx, my, a, b, c, level, det, half, W, H, TILE)
        count += tl.where(row <= last, tl.maximum(right - left + 1, 0), 0)
        row += 1
    return count


@Launcher
@triton.jit(do_not_specialize=["R", "W", "H"])
def count_kernel(radii, means2d, conics, opacities, counts, totals, R, W, H, EPS: tl.constexpr, TILE: tl.constexpr, SIDE: tl.constexpr,
                 BLOCK: tl.constexpr):
    """Number of bins that each splat hits, counts `[R]`, and of bins and of tiles that all do, added to totals `[2]`."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    real = visible(radii, i, i < R)
    mx, my, a, b, c, level, det, half = ellipse(means2d, conics, opacities, i, real, H, EPS)
    bins = count_hits(mx, my, a, b, c, level, det, half, real, W, H, TILE * SIDE)
    tl.store(counts + i, bins, mask=i < R)
    tiles = count_hits(mx, my, a, b, c, level, det, half, real, W, H, TILE)
    tl.atomic_add(totals, tl.sum(bins.to(tl.int64), 0), sem="relaxed")
    tl.atomic_add(totals + 1, tl.sum(tiles.to(tl.int64), 0), sem="relaxed")


@Launcher
@triton.jit(do_not_specialize=["R", "N", "W", "H", "bins_x", "bins_y", "capacity"])
def emit_kernel(order, radii, means2d, conics, opacities, counts, ends, keys, ids, R, N, W, H, bins_x, bins_y, capacity,
                EPS: tl.constexpr, TILE: tl.constexpr, SIDE: tl.constexpr, BLOCK: tl.constexpr):
    """Bin and splat of each hit of bins, splat after splat; hits beyond the capacity are not written."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    splat = tl.load(order + i, mask=i < R, other=0)
    real = visible(radii, splat, i < R)
    mx, my, a, b, c, level, det, half = ellipse(means2d, conics, opacities, splat, real, H, EPS)
    row, last = rows(my, half, real, H, TILE * SIDE)
    at = tl.load(ends + i, mask=i < R, other=0) - tl.load(counts + i, mask=i < R, other=0)
    while tl.max((row <= last).to(tl.int32), 0) > 0:
        left, right = row_span(row, mx, my, a, b, c, level, det, half, W, H, TILE * SIDE)
        right = tl.where(row <= last, right, left - 1)
        base = (splat // N * bins_y + row) * bins_x
        column = left
        while tl.max((column <= right).to(tl.int32), 0) > 0:
            mask = (column <= right) & (at < capacity)
            tl.store(keys + at, (base + column).to(keys.dtype.element_ty), mask=mask)
            tl.store(ids + at, splat.to(tl.int32), mask=mask)
            at += (column <= right).to(tl.int64)
            column += 1
        row += 1


@Launcher
@triton.jit(do_not_specialize=["M", "bins", "bins_x", "bins_y", "W", "H"])
def mask_kernel(keys, by_bin, ids, means2d, conics, opacities, sorted_ids, masks, M, bins, bins_x, bins_y, W, H, EPS: tl.constexpr,
                TILE: tl.constexpr, SIDE: tl.constexpr, BLOCK: tl.constexpr):
    """Which tiles of the bin a splat hits: masks `[SIDE, M]`, a bit per tile of a row. Room beyond the hits has bin `bins`."""
    j = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    bin = tl.load(keys + j, mask=j < M, other=bins).to(tl.int64)
    real = bin < bins
    splat = tl.load(ids + tl.load(by_bin + j, mask=real, other=0), mask=real, other=0)
    tl.store(sorted_ids + j, splat, mask=real)
    mx, my, a, b, c, level, det, half = ellipse(means2d, conics, opacities, splat.to(tl.int64), real, H, EPS)
    first, last = rows(my, half, real, H, TILE)
    low = (bin % bins_x).to(tl.int32) * SIDE
    row = (bin // bins_x % bins_y).to(tl.int32) * SIDE
    for r in tl.static_range(SIDE):
        left, right = row_span(row, mx, my, a, b, c, level, det, half, W, H, TILE)
        left = tl.maximum(left - low, 0)
        right = tl.minimum(right - low, SIDE - 1)
        hit = (row >= first) & (row <= last) & (left <= right)
        bits = tl.where(hit, ((2 << tl.maximum(right, 0)) - 1) & ~((1 << tl.minimum(left, SIDE)) - 1), 0)
        tl.store(masks + r * M.to(tl.int64) + j, bits.to(tl.uint8), mask=real)
        row += 1


@Launcher
@triton.jit(do_not_specialize=["M", "bins_x", "bins_y", "tiles_x", "tiles_y", "capacity"])
def pick_kernel(edges, sorted_ids, masks, offsets, counts, ids, M, bins_x, bins_y, tiles_x, tiles_y, capacity, WRITE: tl.constexpr,
                SIDE: tl.constexpr, BLOCK: tl.constexpr):
    """A program per bin and row of tiles in it. The numbers of their splats, after a first 0: counts `[tiles + 1]`; or (WRITE) the splats
    themselves, in the order of the bin's list.

    The 8 tiles are counted in the 8 bytes of one integer, whose running sum is the rank of each hit in its tile; BLOCK is below 256.
    """
    bin = tl.program_id(0).to(tl.int64)
    r = tl.program_id(1)
    t = tl.arange(0, SIDE)[None, :]
    row = (bin // bins_x % bins_y).to(tl.int32) * SIDE + r
    column = (bin % bins_x).to(tl.int32) * SIDE + t
    inside = column < tl.where(row < tiles_y, tiles_x, 0)
    tile = (bin // (bins_x.to(tl.int64) * bins_y) * tiles_y + row) * tiles_x + column
    i = tl.load(edges + bin)
    end = tl.where(row < tiles_y, tl.load(edges + bin + 1), i)
    at = tl.load(offsets + tile, mask=inside, other=0) if WRITE else tile * 0                           # [1, 8]
    while i < end:
        j = i + tl.arange(0, BLOCK)[:, None]
        mask = tl.load(masks + r * M.to(tl.int64) + j, mask=j < end, other=0).to(tl.int64)              # [BLOCK, 1]
        # bit t to byte t, and any bit in a byte to 1: 0x0101.. copies the mask, 0x8040201008040201 picks, 0x7f7f.. carries to the top bit
        ones = (((mask * 0x0101010101010101) & -0x7fbfdfeff7fbfdff) + 0x7f7f7f7f7f7f7f7f >> 7) & 0x0101010101010101
        if WRITE:
            to = at + ((tl.cumsum(ones, 0) >> (8 * t)) & 255) - 1                                       # [BLOCK, 8]
            hit = (((mask >> t) & 1) != 0) & (to < capacity)
            tl.store(ids + to, tl.load(sorted_ids + j, mask=mask != 0, other=0), mask=hit)
        at += (tl.sum(ones, 0, keep_dims=True) >> (8 * t)) & 255
        i += BLOCK
    if not WRITE:
        tl.store(counts + 1 + tile, at.to(tl.int32), mask=inside)
        tl.store(counts + tile, tl.zeros_like(tile).to(tl.int32), mask=tile == 0)


def bin_splats(means2d: Tensor, radii: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, width: int, height: int, tile: int
               ) -> tuple[Tensor, Tensor]:
    """Launcher; see `tsplat_reference.bin_splats`. One host sync, for the number of hits."""
    splats = _Splats(means2d, radii, conics, opacities, depths, width, height, tile)
    return splats.lists(*splats.totals.tolist())


def bin_splats_fixed(means2d: Tensor, radii: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, width: int, height: int, tile: int,
                     capacity: int) -> tuple[Tensor, Tensor, Tensor]:
    """As `bin_splats` without a host sync, for CUDA graphs: room for `capacity` hits.

    Returns:
        ids `[capacity]`, of which the first offsets[-1] count; offsets; and the capacity that was needed, int64 `[]` on the device. If
        that is more than `capacity`, hits are missing, and tiles at the end may have none: bin again with more.
    """
    splats = _Splats(means2d, radii, conics, opacities, depths, width, height, tile)
    ids, offsets = splats.lists(capacity, capacity)
    return ids, offsets.clamp_(max=capacity), splats.totals.amax()


class _Splats:
    """Splats with their hits of bins and of tiles counted."""

    def __init__(self, means2d: Tensor, radii: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, width: int, height: int, tile: int
                 ) -> None:
        if tile != TILE.value:
            raise ValueError(f"tile: expected {TILE.value}, the tile of the Triton kernels; got {tile}")
        (self.C, self.N), self.R = opacities.shape, opacities.numel()
        self.size, self.tiles = (width, height), (ceil_div(width, tile), ceil_div(height, tile))
        self.bins = ceil_div(self.tiles[0], SIDE.value), ceil_div(self.tiles[1], SIDE.value)
        self.radii, self.shapes = radii.contiguous(), (means2d.contiguous(), conics.contiguous(), opacities.contiguous())
        self.options = {"EPS": torch.finfo(means2d.dtype).eps, "TILE": tile, "SIDE": SIDE.value, **launch("bin"), "enable_fp_fusion": True}
        self.programs = ceil_div(self.R, self.options["BLOCK"])
        self.counts = torch.empty(self.R, dtype=torch.int32, device=means2d.device)
        self.totals = torch.zeros(2, dtype=torch.int64, device=means2d.device)
        if self.R:
            count_kernel[(self.programs,)](self.radii, *self.shapes, self.counts, self.totals, self.R, *self.size, **self.options)
        self.depth_order = depths.flatten().sort(stable=True).indices                       # a radix sort of 4 passes

    def lists(self, coarse: int, fine: int) -> tuple[Tensor, Tensor]:
        """Ids and offsets, with room for so many hits of bins and of tiles; hits beyond are left out."""
        device, bins = self.counts.device, self.C * self.bins[0] * self.bins[1]
        tile_counts = torch.empty(self.C * self.tiles[0] * self.tiles[1] + 1, dtype=torch.int32, device=device)
        # zeros, as deterministic blending reads ids beyond the last offset, which there are in a fixed capacity
        ids = torch.zeros(fine, dtype=torch.int32, device=device)
        if not (self.R and coarse):
            return ids, tile_counts.zero_().to(torch.int64)
        counts = self.counts.index_select(0, self.depth_order)
        ends = counts.cumsum(0)                                                             # int64: more than 2^31 hits are counted right
        narrow = next(d for d in (torch.int16, torch.int32, torch.int64) if bins <= torch.iinfo(d).max)
        keys = torch.full((coarse,), bins, dtype=narrow, device=device)                     # what is not overwritten is room beyond the hits
        unsorted = torch.empty(coarse, dtype=torch.int32, device=device)
        emit_kernel[(self.programs,)](self.depth_order, self.radii, *self.shapes, counts, ends, keys, unsorted, self.R, self.N,
                                      *self.size, *self.bins, coarse, **self.options)
        keys, by_bin = keys.sort(stable=True)                                               # int16 keys: 2 passes
        edges = torch.searchsorted(keys, torch.arange(bins + 1, device=device, dtype=narrow))
        sorted_ids, masks = torch.empty_like(unsorted), torch.empty(SIDE.value, coarse, dtype=torch.uint8, device=device)
        mask_kernel[(ceil_div(coarse, self.options["BLOCK"]),)](keys, by_bin, unsorted, *self.shapes, sorted_ids, masks, coarse, bins,
                                                                *self.bins, *self.size, **self.options)
        del unsorted, by_bin, keys, counts, ends
        grid, options = (bins, SIDE.value), {"SIDE": SIDE.value, **launch("pick")}
        lists = edges, sorted_ids, masks
        pick_kernel[grid](*lists, tile_counts, tile_counts, ids, coarse, *self.bins, *self.tiles, fine, WRITE=False, **options)
        offsets = tile_counts.cumsum(0)
        pick_kernel[grid](*lists, offsets, tile_counts, ids, coarse, *self.bins, *self.tiles, fine, WRITE=True, **options)
        return ids, offsets
