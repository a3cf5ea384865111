"""Tile intersection: which splats touch which tile, in depth order (3DGS, section 6, with exact ellipses in place of boxes)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from tsplat_reference.constants import ALPHA_MIN, BIN_ROUNDING, BIN_SLACK, BIN_SLACK_RELATIVE, FLATTEST

RADIX = 1 << 15
"""Numbers that torch sorts by radix on a CPU."""


class Bins(NamedTuple):
    """ids: int32 `[M]`, index c N + n of the splat of each hit, tile by tile, front to back within a tile.
    offsets: int64 `[C tiles_y tiles_x + 1]`, where each tile's hits begin; the last is M.
    """

    ids: Tensor
    offsets: Tensor


def tile_counts(width: int, height: int, tile: int) -> tuple[int, int]:
    """Tiles along x and along y."""
    return -(-width // tile), -(-height // tile)


def bin_splats(means2d: Tensor, radii: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, width: int, height: int, tile: int
               ) -> Bins:
    """Hits of splats and tiles: a tile is hit only if the ellipse alpha >= 1/255 touches the rectangle of its pixel centres, and always
    if one of these centres lies in it.

    Both hold up to rounding, which may add a hit, but never lose one. The conic is taken as in `footprint`, a (dx + s dy)^2 + w dy^2, with
    w = c - b^2/a lowered by more than its rounding error, 1.5 eps c (b^2/a is rounded twice, the slack and the difference once each),
    and that of `footprint`, eps c: all that is left of w for a needle may be error. The rest is as if the pixel were elsewhere. Positions,
    slope and edges are rounded about a dozen times, each time by at most eps/2 of |mean| + size in x or of what is that in x by the
    slope from y; and a shift by d pixels is one by at most sqrt(a + c) d in the norm of the conic, of which `level` is the square.

    Args:
        means2d, radii, conics, depths: `[C, N, 2]`, `[C, N, 2]`, `[C, N, 3]`, `[C, N]`, as `project` gives them; radii 0 is culled.
        opacities: `[C, N]`.
        width, height, tile: in pixels.
    """
    tiles_x, tiles_y = tile_counts(width, height, tile)
    n, tiles = max(means2d.shape[1], 1), len(means2d) * tiles_x * tiles_y
    visible = (radii > 0).all(-1).flatten().nonzero().squeeze(-1)                           # [V]
    visible = visible[_sort(_sortable(depths.flatten()[visible]))[1]]                       # front to back
    mx, my = means2d.reshape(-1, 2).index_select(0, visible).unbind(-1)
    a, b, c = conics.reshape(-1, 3).index_select(0, visible).unbind(-1)
    a, c, eps = a.clamp_min(FLATTEST), c.clamp_min(FLATTEST), torch.finfo(a.dtype).eps
    s = b / a
    w = (c * (1 - BIN_ROUNDING * eps) - b * s).clamp_min(FLATTEST)                          # a (dx + s dy)^2 + w dy^2: w must not be too large
    distance = (2 * torch.log(opacities.flatten().index_select(0, visible).clamp_min(ALPHA_MIN) / ALPHA_MIN)).sqrt()
    distance = distance + 2 * BIN_ROUNDING * eps * (mx.abs() + my.abs() + (width + height)) * (a + c).sqrt()
    level = distance * distance * (1 + BIN_SLACK_RELATIVE) + BIN_SLACK

    half_height = (level / w).sqrt()
    rightmost = -s * (a / c).sqrt() * half_height                                           # dy of the ellipse's rightmost point
    first, count = _span(my - half_height, my + half_height, height, tile)
    strip = torch.repeat_interleave(count)                                                  # [R] the splat of each tile row of each splat
    row = _numbers(first, count, strip)
    mx, my, s, reach, shrink, half_height, rightmost = (
        v.index_select(0, strip) for v in (mx, my, s, level / a, w / a, half_height, rightmost))
    top = (row * tile).to(my.dtype)
    low = torch.maximum(top + 0.5 - my, -half_height)                                       # the strip's pixel centres, about the mean
    high = torch.minimum((top + tile).clamp_max(height) - 0.5 - my, half_height)
    x_high = _edge(torch.minimum(torch.maximum(rightmost, low), high), s, reach, shrink, 1.0)
    x_low = _edge(torch.minimum(torch.maximum(-rightmost, low), high), s, reach, shrink, -1.0)
    first, count = _span(mx + x_low, mx + x_high, width, tile)

    splat = visible.index_select(0, strip)                                                  # [R]
    hit = torch.repeat_interleave(count)                                                    # [M] the strip of each hit
    key = _numbers((splat // n * tiles_y + row) * tiles_x + first, count, hit)              # its tile
    key, order = _sort(key.to(_narrowest(tiles)))
    offsets = torch.searchsorted(key, torch.arange(tiles + 1, device=key.device, dtype=key.dtype))
    return Bins(splat.to(torch.int32).index_select(0, hit).index_select(0, order), offsets)


def _edge(dy: Tensor, s: Tensor, reach: Tensor, shrink: Tensor, side: float) -> Tensor:
    """Dx of the ellipse's right (side 1) or left (side -1) edge at height dy from its centre: (dx + s dy)^2 = reach - shrink dy^2."""
    return side * (reach - shrink * dy * dy).clamp_min(0.0).sqrt() - s * dy


def _span(low: Tensor, high: Tensor, size: int, tile: int) -> tuple[Tensor, Tensor]:
    """First tile whose pixel centres (at + 0.5) lie in [low, high], and how many."""
    first = (low - 0.5).ceil_().clamp_(0, size)
    last = (high - 0.5).floor_().clamp_(-1, size - 1)
    first_tile, last_tile = ((v / tile).floor_() for v in (first, last))                    # exact: sizes are far below 2^24
    return first_tile.long(), (last_tile - first_tile + 1).mul_(last >= first).long()


def _numbers(first: Tensor, count: Tensor, owner: Tensor) -> Tensor:
    """The integers of ranges, one range after the other: first, first + 1, .. first + count - 1; `owner` says which range each is of."""
    return (first - count.cumsum(0) + count).index_select(0, owner).add_(torch.arange(len(owner), device=owner.device))


def _sortable(depths: Tensor) -> Tensor:
    """The same order as integers, which torch sorts by radix (12 times faster on a CPU)."""
    if depths.dtype not in (torch.float32, torch.float64):
        depths = depths.float()
    integer, bits = (torch.int32, 31) if depths.dtype == torch.float32 else (torch.int64, 63)
    key = (depths + 0.0).view(integer)                                                      # -0.0 is 0.0
    return key ^ ((key >> bits) & torch.iinfo(integer).max)


def _sort(keys: Tensor) -> tuple[Tensor, Tensor]:
    """Integers in ascending order, those that are equal in the order in which they come, and where they were.

    torch sorts by radix from 32,768 on, else by comparison: some thousands take a half to a sixth of the time if they are padded.
    """
    n = len(keys)
    if RADIX // 4 <= n < RADIX:
        keys = torch.cat([keys, keys.new_full((RADIX - n,), torch.iinfo(keys.dtype).max)])     # which come last, behind any that are equal
    values, order = keys.sort(stable=True)
    return values[:n], order[:n]


def _narrowest(count: int) -> torch.dtype:
    """The narrowest integer for 0..count: radix sort makes a pass per byte."""
    return next(d for d in (torch.int16, torch.int32, torch.int64) if count <= torch.iinfo(d).max)
