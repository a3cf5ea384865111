"""Tile intersection in depth order: a thread per splat counts and then writes its hits; torch's radix sorts do the rest."""

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor
from tsplat_reference.constants import ALPHA_MIN, BIN_SLACK, BIN_SLACK_RELATIVE, EXTENT_MAX

from tsplat.kernels.launch import ceil_div, launch

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
def ellipse(means2d, conics, opacities, splat, real, H, EPS: tl.constexpr, TILE: tl.constexpr):
    """The ellipse a dx^2 + 2 b dx dy + c dy^2 = level in which alpha reaches 1/255, with a slack for rounding, and its rows of tiles."""
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
    first, last = span(my - half, my + half, H, TILE)
    return mx, my, a, b, c, level, det, half, first, tl.where(real, last, first - 1)


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


@triton.jit(do_not_specialize=["R", "W", "H"])
def count_kernel(order, visible, means2d, conics, opacities, counts, R, W, H, EPS: tl.constexpr, TILE: tl.constexpr,
                 BLOCK: tl.constexpr):
    """Number of tiles that each splat hits, in depth order."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    splat = tl.load(order + i, mask=i < R, other=0).to(tl.int64)
    real = (i < R) & (tl.load(visible + splat, mask=i < R, other=0) != 0)
    mx, my, a, b, c, level, det, half, first, last = ellipse(means2d, conics, opacities, splat, real, H, EPS, TILE)
    count = tl.zeros([BLOCK], tl.int32)
    row = first
    while tl.max((row <= last).to(tl.int32), 0) > 0:
        left, right = row_span(row, mx, my, a, b, c, level, det, half, W, H, TILE)
        count += tl.where(row <= last, tl.maximum(right - left + 1, 0), 0)
        row += 1
    tl.store(counts + i, count, mask=i < R)


@triton.jit(do_not_specialize=["R", "N", "W", "H", "tiles_x", "tiles_y", "capacity"])
def emit_kernel(order, visible, means2d, conics, opacities, ends, counts, keys, ids, R, N, W, H, tiles_x, tiles_y, capacity,
                EPS: tl.constexpr, TILE: tl.constexpr, BLOCK: tl.constexpr):
    """Tile and splat of each hit, splat after splat; hits beyond the capacity are not written."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    splat = tl.load(order + i, mask=i < R, other=0).to(tl.int64)
    real = (i < R) & (tl.load(visible + splat, mask=i < R, other=0) != 0)
    mx, my, a, b, c, level, det, half, first, last = ellipse(means2d, conics, opacities, splat, real, H, EPS, TILE)
    at = tl.load(ends + i, mask=i < R, other=0) - tl.load(counts + i, mask=i < R, other=0)
    row = first
    while tl.max((row <= last).to(tl.int32), 0) > 0:
        left, right = row_span(row, mx, my, a, b, c, level, det, half, W, H, TILE)
        right = tl.where(row <= last, right, left - 1)
        base = (splat // N * tiles_y + row) * tiles_x
        column = left
        while tl.max((column <= right).to(tl.int32), 0) > 0:
            mask = (column <= right) & (at < capacity)
            tl.store(keys + at, (base + column).to(keys.dtype.element_ty), mask=mask)
            tl.store(ids + at, splat.to(tl.int32), mask=mask)
            at += (column <= right).to(tl.int64)
            column += 1
        row += 1


def bin_splats(means2d: Tensor, radii: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, width: int, height: int, tile: int
               ) -> tuple[Tensor, Tensor]:
    """Launcher; see `tsplat_reference.bin_splats`. One host sync, for the number of hits."""
    splats = _Splats(means2d, radii, conics, opacities, depths, width, height, tile)
    return splats.bins(int(splats.ends[-1]) if len(splats.ends) else 0)


def bin_splats_fixed(means2d: Tensor, radii: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, width: int, height: int, tile: int,
                     capacity: int) -> tuple[Tensor, Tensor, Tensor]:
    """As `bin_splats` without a host sync, for CUDA graphs: room for `capacity` hits.

    Returns:
        ids `[capacity]`, of which the first offsets[-1] count; offsets; and the number of hits there are, int64 `[]` on the device. If
        that is more than `capacity`, hits of the farthest splats are missing: bin again with more.
    """
    splats = _Splats(means2d, radii, conics, opacities, depths, width, height, tile)
    hits = splats.ends[-1] if len(splats.ends) else splats.ends.sum()
    return *splats.bins(capacity), hits


class _Splats:
    """Splats in depth order, with their hits counted."""

    def __init__(self, means2d: Tensor, radii: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, width: int, height: int, tile: int
                 ) -> None:
        (C, self.N), self.R = opacities.shape, opacities.numel()
        self.size, self.grid = (width, height), (ceil_div(width, tile), ceil_div(height, tile))
        self.tiles = C * self.grid[0] * self.grid[1]
        order = depths.flatten().sort(stable=True).indices.to(torch.int32)                  # a radix sort of 4 passes
        visible = (radii > 0).all(-1).flatten().to(torch.uint8)
        self.splats = order, visible, means2d.contiguous(), conics.contiguous(), opacities.contiguous()
        self.options = {"EPS": torch.finfo(means2d.dtype).eps, "TILE": tile, **launch("bin"), "enable_fp_fusion": True}
        self.programs = ceil_div(self.R, self.options["BLOCK"])
        self.counts = torch.empty(self.R, dtype=torch.int32, device=means2d.device)
        if self.R:
            count_kernel[(self.programs,)](*self.splats, self.counts, self.R, *self.size, **self.options)
        self.ends = self.counts.cumsum(0)                                                   # int64: more than 2^31 hits are counted right

    def bins(self, capacity: int) -> tuple[Tensor, Tensor]:
        """Ids and offsets; hits beyond the capacity are left out, and room beyond the hits goes to a tile after the last."""
        device = self.counts.device
        narrow = next(d for d in (torch.int16, torch.int32, torch.int64) if self.tiles <= torch.iinfo(d).max)
        keys = torch.full((capacity,), self.tiles, dtype=narrow, device=device)
        ids = torch.zeros(capacity, dtype=torch.int32, device=device)
        if self.R and capacity:
            emit_kernel[(self.programs,)](*self.splats, self.ends, self.counts, keys, ids, self.R, self.N, *self.size, *self.grid,
                                                    capacity, **self.options)
        keys, by_tile = keys.sort(stable=True)                                              # int16 keys: 2 passes
        offsets = torch.searchsorted(keys, torch.arange(self.tiles + 1, device=device, dtype=narrow))
        return ids[by_tile], offsets
