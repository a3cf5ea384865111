"""What a warp does with its 4 tiles: their pixels, their lists, the records of their splats, and sums over the lanes of each."""

from __future__ import annotations

import functools

import torch
import triton
import triton.language as tl
from torch import Tensor

from tsplat.kernels.launch import ceil_div

TILE = tl.constexpr(8)
"""Side of a tile: a lane takes a row."""


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
def block_pixels(block, lane_x, tiles_x, tiles_y, W, H, LANES: tl.constexpr):
    """The tiles of a block, 2 in each row of it, and a lane's pixels: camera, tile, whether it exists, its left and its top `[LANES, 1]`,
    x about its centre `[LANES, 8]`, y `[LANES, 1]`, and of every second pixel the column and the index `[LANES, 4]`.

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
    return view, tile, exists, tile_x * TILE, tile_y * TILE, glue(x4, x4 + 1.0), y.to(dt) + 0.5, column4, pixel4


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
def eighths(v):
    """Each of a lane's 8 pixels, as `[LANES, 1]`."""
    even, odd = tl.split(tl.reshape(v, (v.shape[0], 4, 2)))
    v04, v26 = tl.split(tl.reshape(even, (v.shape[0], 2, 2)))
    v15, v37 = tl.split(tl.reshape(odd, (v.shape[0], 2, 2)))
    v0, v4 = tl.split(v04)
    v1, v5 = tl.split(v15)
    v2, v6 = tl.split(v26)
    v3, v7 = tl.split(v37)
    return v0[:, None], v1[:, None], v2[:, None], v3[:, None], v4[:, None], v5[:, None], v6[:, None], v7[:, None]


@triton.jit
def row_dot(a, b):
    """Sum of a b over a lane's pixels in 8 operations: tl.sum adds them up as a tree, in which only half of the products can be fused (12)."""
    a = eighths(a)
    b = eighths(b)
    total = a[0] * b[0]
    for k in tl.static_range(1, 8):
        total += a[k] * b[k]
    return total


@triton.jit
def row_moments(v):
    """Sums over a lane's pixels of v, v x and v x^2, x about the tile's centre, in 19 operations: sums and differences of the pixels that
    mirror each other, as x and x^2 are the same constants for both (with x in registers 31)."""
    v0, v1, v2, v3, v4, v5, v6, v7 = eighths(v)
    s0 = v4 + v3
    s1 = v5 + v2
    s2 = v6 + v1
    s3 = v7 + v0
    x = 0.5 * (v4 - v3) + 1.5 * (v5 - v2) + 2.5 * (v6 - v1) + 3.5 * (v7 - v0)
    return s0 + s1 + s2 + s3, x, 0.25 * s0 + 2.25 * s1 + 6.25 * s2 + 12.25 * s3


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
def store_half(image, plane, other, C0, C1, C2, C3, value, other_value, view, left, top, W, H, begin: tl.constexpr, D: tl.constexpr):
    """4 pixels of each lane's row, from `begin`: D channels of an image `[C, H, W, D]`, and a number of a plane `[C, H, W]`, or two (other: or
    None). All 8 pixels at once would take more registers than the loops do."""
    first, pixel, inside = half_pixels(view, left, top, W, H, begin)
    store_channels(image + first * D, C0, C1, C2, C3, pixel, inside, D)
    tl.store(plane + first + pixel, value, mask=inside)
    if other is not None:
        tl.store(other + first + pixel, other_value, mask=inside)


@triton.jit
def tile_list(offsets, tile, exists):
    """Where each lane's list begins, its length, and the length of the longest of the block."""
    start = tl.load(offsets + tile, mask=exists, other=0)
    hits = (tl.load(offsets + tile + 1, mask=exists, other=0) - start).to(tl.int32)      # 64 bits are for the start only
    return start, hits, tl.max(tl.max(hits, 1), 0)


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
def prefetch_records(records, batch, RECORD: tl.constexpr, PTX: tl.constexpr):
    """Have the records, of 8 or 12 numbers, of the next batch fetched into L1 while this one is blended, each lane one: 1 or 2 sectors of 32
    bytes. Half of the cycles of a warp were waiting for them."""
    if PTX:
        p = (records + batch.to(tl.int64) * RECORD).to(tl.int64)
        for word in tl.static_range((RECORD + 7) // 8):
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


@triton.jit
def add_tile_sums(p, s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, s10, s11, real, COUNT: tl.constexpr, PER_HIT: tl.constexpr, PTX: tl.constexpr):
    """Add `tile_sums` to those at p of each tile, where `real`; or store them, if each tile and splat has a place of its own (PER_HIT)."""
    first, slot, second, second_slot, has_second = tile_sums(s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, s10, s11, COUNT, PTX)
    if PER_HIT:
        tl.store(p + slot, first, mask=real)
        tl.store(p + second_slot, second, mask=real & has_second)
    else:
        tl.atomic_add(p + slot, first, mask=real, sem="relaxed")
        tl.atomic_add(p + second_slot, second, mask=real & has_second, sem="relaxed")


@triton.jit
def tile_min(v):
    """Least of the lanes of each tile, in every lane of it (portable)."""
    groups: tl.constexpr = v.shape[0] // TILE
    least = tl.min(tl.reshape(v, (groups, TILE)), 1, keep_dims=True)
    return tl.reshape(tl.broadcast_to(least, (groups, TILE)), (v.shape[0], 1))


def blocks(tiles: tuple[int, int], lanes: int) -> int:
    """How many programs `block_pixels` makes of the tiles (columns, rows) of a camera."""
    return ceil_div(tiles[0], 2) * ceil_div(tiles[1], lanes // (2 * int(TILE.value)))


def lane_x(lanes: int, like: Tensor) -> Tensor:
    """`[lanes, 4]`: x about the tile's centre of every second pixel of each lane's row."""
    # what is made while a CUDA graph is captured has no numbers until its replay: not to be kept
    capturing = like.is_cuda and torch.cuda.is_current_stream_capturing()
    return (_lane_x.__wrapped__ if capturing else _lane_x)(lanes, like.dtype, like.device)


@functools.cache
def _lane_x(lanes: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    tile = int(TILE.value)
    return (torch.arange(0, tile, 2, device=device).to(dtype) - (tile / 2 - 0.5)).repeat(lanes, 1)
