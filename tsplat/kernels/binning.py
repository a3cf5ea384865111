"""Tile intersection in depth order, on two levels: a radix sort of the few hits of splats and bins of 8 x 8 tiles, by bin and depth, then each
tile picks its own from the list of its bin, by counting.

A thread per splat counts and writes its hits of bins. Each of these gets 8 bytes, a bit per tile of the bin, and a program per row of tiles
counts and then copies the splats that have its bits. Against sorting the hits of tiles, of which there are 5 times as many, that saves most
of the memory (torch's sort takes 8 bytes of index per key, twice) and of its traffic.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor
from tsplat_reference.constants import ALPHA_MIN, BIN_ROUNDING, BIN_SLACK, BIN_SLACK_RELATIVE, FLATTEST

from tsplat.kernels.launch import Launcher, ceil_div, launch
from tsplat.kernels.tiles import TILE

SIDE = tl.constexpr(8)
"""Tiles along the side of a bin: a row of them is a byte."""
LEAST = tl.constexpr(ALPHA_MIN)
SLACK = tl.constexpr(BIN_SLACK)
SLACK_RELATIVE = tl.constexpr(BIN_SLACK_RELATIVE)
ROUNDING = tl.constexpr(BIN_ROUNDING)
FLAT = tl.constexpr(FLATTEST)


@triton.jit
def visible(radii, splat, real):
    """Whether splats were not culled."""
    return real & (tl.load(radii + 2 * splat, mask=real, other=0) > 0) & (tl.load(radii + 2 * splat + 1, mask=real, other=0) > 0)


@triton.jit
def span(low, high, size, TILE: tl.constexpr):
    """First and last tile whose pixel centres (at + 0.5) lie in [low, high]; last < first if there is none."""
    first = tl.minimum(tl.maximum(tl.ceil(low - 0.5), 0.0), size.to(low.dtype)).to(tl.int32)
    last = tl.minimum(tl.maximum(tl.floor(high - 0.5), -1.0), (size - 1).to(low.dtype)).to(tl.int32)
    return first // TILE, tl.where(last < first, first // TILE - 1, last // TILE)


@triton.jit
def ellipse(means2d, conics, opacities, splat, real, W, H, EPS: tl.constexpr):
    """Where alpha reaches 1/255, with a slack for rounding (see `tsplat_reference.bin_splats`): centre, slope, squared reach in x, by how much
    that shrinks with dy^2, half the height, and dy of the rightmost point."""
    mx = tl.load(means2d + 2 * splat, mask=real, other=0.0)
    my = tl.load(means2d + 2 * splat + 1, mask=real, other=0.0)
    a = tl.load(conics + 3 * splat, mask=real, other=1.0)
    b = tl.load(conics + 3 * splat + 1, mask=real, other=0.0)
    c = tl.load(conics + 3 * splat + 2, mask=real, other=1.0)
    opacity = tl.load(opacities + splat, mask=real, other=1.0)
    least = tl.full((), LEAST, mx.dtype)                # literals would be rounded to float32
    flat = tl.full((), FLAT, mx.dtype)
    a = tl.maximum(a, flat)
    c = tl.maximum(c, flat)
    s = b / a
    w = tl.maximum(c * tl.full((), 1.0 - ROUNDING * EPS, mx.dtype) - b * s, flat)
    distance = tl.sqrt(2.0 * tl.log(tl.maximum(opacity, least) / least))
    distance += tl.full((), 2.0 * ROUNDING * EPS, mx.dtype) * (tl.abs(mx) + tl.abs(my) + (W + H).to(mx.dtype)) * tl.sqrt(a + c)
    level = distance * distance * tl.full((), 1.0 + SLACK_RELATIVE, mx.dtype) + tl.full((), SLACK, mx.dtype)
    half = tl.sqrt(level / w)
    return mx, my, s, level / a, w / a, half, -s * tl.sqrt(a / c) * half


@triton.jit
def rows(my, half, real, H, TILE: tl.constexpr):
    """First and last row of tiles of an ellipse; last < first if there is none."""
    first, last = span(my - half, my + half, H, TILE)
    return first, tl.where(real, last, first - 1)


@triton.jit
def row_span(row, mx, my, s, reach, shrink, half, rightmost, W, H, TILE: tl.constexpr):
    """First and last tile of a row of tiles that the ellipse touches, where its pixel centres are."""
    low = tl.maximum((row * TILE).to(mx.dtype) + 0.5 - my, -half)
    high = tl.minimum(tl.minimum((row + 1) * TILE, H).to(mx.dtype) - 0.5 - my, half)
    y = tl.minimum(tl.maximum(rightmost, low), high)
    x_high = tl.sqrt(tl.maximum(reach - shrink * y * y, 0.0)) - s * y
    y = tl.minimum(tl.maximum(-rightmost, low), high)
    x_low = -tl.sqrt(tl.maximum(reach - shrink * y * y, 0.0)) - s * y
    return span(mx + x_low, mx + x_high, W, TILE)


@triton.jit
def count_hits(mx, my, s, reach, shrink, half, rightmost, real, W, H, TILE: tl.constexpr):
    """Number of tiles that each splat hits."""
    row, last = rows(my, half, real, H, TILE)
    count = row * 0
    while tl.max((row <= last).to(tl.int32), 0) > 0:
        left, right = row_span(row, mx, my, s, reach, shrink, half, rightmost, W, H, TILE)
        count += tl.where(row <= last, tl.maximum(right - left + 1, 0), 0)
        row += 1
    return count


@Launcher
@triton.jit(do_not_specialize=["R", "W", "H"])
def count_kernel(radii, means2d, conics, opacities, counts, totals, R, W, H, EPS: tl.constexpr, TILE: tl.constexpr, SIDE: tl.constexpr,
                 BLOCK: tl.constexpr):
    """Number of bins that each splat hits, counts `[R]`, and of bins and of tiles that all do, added to totals `[2]`.

    All these are int64, so that torch's running sums need no copy of another type.
    """
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    real = visible(radii, i, i < R)
    mx, my, s, reach, shrink, half, rightmost = ellipse(means2d, conics, opacities, i, real, W, H, EPS)
    bins = count_hits(mx, my, s, reach, shrink, half, rightmost, real, W, H, TILE * SIDE)
    tl.store(counts + i, bins, mask=i < R)
    tiles = count_hits(mx, my, s, reach, shrink, half, rightmost, real, W, H, TILE)
    tl.atomic_add(totals, tl.sum(bins.to(tl.int64), 0), sem="relaxed")
    tl.atomic_add(totals + 1, tl.sum(tiles.to(tl.int64), 0), sem="relaxed")


@Launcher
@triton.jit(do_not_specialize=["R", "N", "W", "H", "bins_x", "bins_y", "capacity"])
def emit_kernel(radii, means2d, conics, opacities, depth_keys, ends, keys, ids, R, N, W, H, bins_x, bins_y, capacity,
                EPS: tl.constexpr, TILE: tl.constexpr, SIDE: tl.constexpr, BLOCK: tl.constexpr):
    """Key and splat of each hit of bins, splat after splat; hits beyond the capacity are not written. A key is the bin, then the depth: the
    bits of a float, made to sort as an integer."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    real = visible(radii, i, i < R)
    mx, my, s, reach, shrink, half, rightmost = ellipse(means2d, conics, opacities, i, real, W, H, EPS)
    row, last = rows(my, half, real, H, TILE * SIDE)
    at = tl.load(ends + i - 1, mask=(i > 0) & (i < R), other=0)
    bits = tl.load(depth_keys + i, mask=real, other=0)
    bits = tl.where(bits == -2147483648, 0, bits)       # -0.0
    depth = (bits ^ ((bits >> 31) & 0x7fffffff)).to(tl.int64) + 2147483648
    while tl.max((row <= last).to(tl.int32), 0) > 0:
        left, right = row_span(row, mx, my, s, reach, shrink, half, rightmost, W, H, TILE * SIDE)
        right = tl.where(row <= last, right, left - 1)
        base = (i // N * bins_y + row) * bins_x
        column = left
        while tl.max((column <= right).to(tl.int32), 0) > 0:
            mask = (column <= right) & (at < capacity)
            tl.store(keys + at, ((base + column) << 32) + depth, mask=mask)
            tl.store(ids + at, i.to(tl.int32), mask=mask)
            at += (column <= right).to(tl.int64)
            column += 1
        row += 1


@Launcher
@triton.jit(do_not_specialize=["M", "bins", "bins_x", "bins_y", "W", "H"])
def mask_kernel(keys, by_key, ids, means2d, conics, opacities, edges, sorted_ids, masks, M, bins, bins_x, bins_y, W, H, EPS: tl.constexpr,
                TILE: tl.constexpr, SIDE: tl.constexpr, BLOCK: tl.constexpr):
    """Where the list of each bin begins: edges `[bins + 1]`; and which tiles of the bin a splat hits: masks `[SIDE, M]`, a bit per tile of a
    row. Room beyond the hits has bin `bins`."""
    j = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    bin = tl.where(j < M, tl.load(keys + j, mask=j < M, other=0) >> 32, bins)
    new = tl.where(j > 0, tl.load(keys + j - 1, mask=(j > 0) & (j <= M), other=0) >> 32, -1) + 1       # bins that begin here: most often none
    new = tl.where(j <= M, new, bin + 1)
    while tl.max((new <= bin).to(tl.int32), 0) > 0:
        tl.store(edges + new, j, mask=new <= bin)
        new += 1
    real = bin < bins
    splat = tl.load(ids + tl.load(by_key + j, mask=real, other=0), mask=real, other=0)
    tl.store(sorted_ids + j, splat, mask=real)
    mx, my, s, reach, shrink, half, rightmost = ellipse(means2d, conics, opacities, splat.to(tl.int64), real, W, H, EPS)
    first, last = rows(my, half, real, H, TILE)
    low = (bin % bins_x).to(tl.int32) * SIDE
    row = (bin // bins_x % bins_y).to(tl.int32) * SIDE
    for r in tl.static_range(SIDE):
        left, right = row_span(row, mx, my, s, reach, shrink, half, rightmost, W, H, TILE)
        left = tl.maximum(left - low, 0)
        right = tl.minimum(right - low, SIDE - 1)
        hit = (row >= first) & (row <= last) & (left <= right)
        bits = tl.where(hit, ((2 << tl.maximum(right, 0)) - 1) & ~((1 << tl.minimum(left, SIDE)) - 1), 0)
        tl.store(masks + r * M.to(tl.int64) + j, bits.to(tl.uint8), mask=real)
        row += 1


@Launcher
@triton.jit(do_not_specialize=["M", "bins_x", "bins_y", "tiles_x", "tiles_y", "capacity"])
def pick_kernel(edges, sorted_ids, masks, offsets, ids, M, bins_x, bins_y, tiles_x, tiles_y, capacity, WRITE: tl.constexpr,
                SIDE: tl.constexpr, BLOCK: tl.constexpr):
    """A program per bin and row of tiles in it. The numbers of their splats, after a first 0, to offsets `[tiles + 1]`; or (WRITE), with
    offsets their running sum, the splats themselves, in the order of the bin's list.

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
        tl.store(offsets + 1 + tile, at, mask=inside)
        tl.store(offsets + tile, tl.zeros_like(tile), mask=tile == 0)


def bin_splats(means2d: Tensor, radii: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, width: int, height: int, tile: int
               ) -> tuple[Tensor, Tensor]:
    """Launcher; see `tsplat_reference.bin_splats`. One host sync, for the number of hits."""
    splats = _Splats(means2d, radii, conics, opacities, width, height, tile)
    return splats.lists(depths, *splats.totals.tolist())


def bin_splats_fixed(means2d: Tensor, radii: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, width: int, height: int, tile: int,
                     capacity: int) -> tuple[Tensor, Tensor, Tensor]:
    """As `bin_splats` without a host sync, for CUDA graphs: room for `capacity` hits.

    Returns:
        ids `[capacity]`, of which the first offsets[-1] count; offsets; and the capacity that was needed, int64 `[]` on the device. If
        that is more than `capacity`, hits are missing, and tiles at the end may have none: bin again with more.
    """
    splats = _Splats(means2d, radii, conics, opacities, width, height, tile)
    ids, offsets = splats.lists(depths, capacity, capacity)
    return ids, offsets.clamp_(max=capacity), splats.totals.amax()


class _Splats:
    """Splats with their hits of bins and of tiles counted."""

    def __init__(self, means2d: Tensor, radii: Tensor, conics: Tensor, opacities: Tensor, width: int, height: int, tile: int) -> None:
        if tile != TILE.value:
            raise ValueError(f"tile: expected {TILE.value}, the tile of the Triton kernels; got {tile}")
        (self.C, self.N), self.R = opacities.shape, opacities.numel()
        self.size, self.tiles = (width, height), (ceil_div(width, tile), ceil_div(height, tile))
        self.bins = ceil_div(self.tiles[0], int(SIDE.value)), ceil_div(self.tiles[1], int(SIDE.value))
        self.shapes = means2d.contiguous(), conics.contiguous(), opacities.contiguous()
        self.radii = radii.contiguous()
        self.options = {"EPS": torch.finfo(means2d.dtype).eps, "TILE": tile, "SIDE": SIDE.value, **launch("bin")}
        self.programs = ceil_div(self.R, self.options["BLOCK"])
        ends = torch.empty(self.R, dtype=torch.int64, device=means2d.device)     # more than 2^31 hits are counted right
        self.totals = torch.zeros(2, dtype=torch.int64, device=means2d.device)
        if self.R:
            count_kernel[(self.programs,)](self.radii, *self.shapes, ends, self.totals, self.R, *self.size, **self.options)
        self.ends = ends.cumsum_(0)

    def lists(self, depths: Tensor, coarse: int, fine: int) -> tuple[Tensor, Tensor]:
        """Ids and offsets, with room for so many hits of bins and of tiles; hits beyond are left out."""
        device, bins = self.ends.device, self.C * self.bins[0] * self.bins[1]
        offsets = torch.empty(self.C * self.tiles[0] * self.tiles[1] + 1, dtype=torch.int64, device=device)
        # zeros, as deterministic blending reads ids beyond the last offset, which there are in a fixed capacity
        ids = torch.zeros(fine, dtype=torch.int32, device=device)
        if not (self.R and coarse):
            return ids, offsets.zero_()
        keys = torch.full((coarse,), bins << 32, dtype=torch.int64, device=device)      # what is not overwritten is room beyond the hits
        unsorted = torch.empty(coarse, dtype=torch.int32, device=device)
        emit_kernel[(self.programs,)](self.radii, *self.shapes, _depth_keys(depths), self.ends, keys, unsorted, self.R, self.N,
                                      *self.size, *self.bins, coarse, **self.options)
        keys, by_key = keys.sort(stable=True)
        edges = torch.empty(bins + 1, dtype=torch.int64, device=device)
        sorted_ids, masks = torch.empty_like(unsorted), torch.empty(SIDE.value, coarse, dtype=torch.uint8, device=device)
        mask_kernel[(ceil_div(coarse + 1, self.options["BLOCK"]),)](keys, by_key, unsorted, *self.shapes, edges, sorted_ids, masks, coarse,
                                                                     bins, *self.bins, *self.size, **self.options)
        del unsorted, by_key, keys
        grid, options = (bins, SIDE.value), {"SIDE": SIDE.value, **launch("pick")}
        lists = edges, sorted_ids, masks
        pick_kernel[grid](*lists, offsets, ids, coarse, *self.bins, *self.tiles, fine, WRITE=False, **options)
        offsets.cumsum_(0)
        pick_kernel[grid](*lists, offsets, ids, coarse, *self.bins, *self.tiles, fine, WRITE=True, **options)
        return ids, offsets


def _depth_keys(depths: Tensor) -> Tensor:
    """32 bits that sort as the depths do: those of a float32, or else the ranks."""
    if depths.dtype == torch.float32:
        return depths.contiguous().view(torch.int32)
    order = (depths.flatten() + 0.0).sort(stable=True).indices
    return torch.empty_like(order, dtype=torch.int32).index_copy_(0, order, torch.arange(len(order), dtype=torch.int32, device=order.device))
