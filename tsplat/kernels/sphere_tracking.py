"""The nearest hits of each pixel: sorted lists in registers, a warp to 4 tiles of 8 x 8 pixels and a lane to a row, as in `spheres.py`."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from tsplat.kernels.launch import Launcher, current_target, launch
from tsplat.kernels.sphere_geometry import Spheres, enter, far_off, load_sphere, rays, reciprocal
from tsplat.kernels.tiles import TILE, block_pixels, blocks, glue, lane_x, load_batch, of_batch, prefetch_records, tile_list, tile_min

SLOTS = 5
"""Hits that a pass over the spheres finds: as many as all targets have registers for."""


@triton.jit
def insert(depths, places, depth, place):
    """Sorted lists, tuples of their first, second.., with one more hit each and without what is then last. Of equals the former stays first."""
    new_depths = depths[:0]
    new_places = places[:0]
    for j in tl.static_range(len(depths)):
        closer = depth < depths[j]
        new_depths += (tl.where(closer, depth, depths[j]),)
        new_places += (tl.where(closer, place, places[j]),)
        depth = tl.where(closer, depths[j], depth)
        place = tl.where(closer, places[j], place)
    return new_depths, new_places


@Launcher
@triton.jit(do_not_specialize=["W", "H", "tiles_x", "tiles_y", "null", "N", "count"])
def nearest_kernel(records, ids, offsets, Ks, found, lane_x, W, H, tiles_x, tiles_y, null, N, count, near: tl.float64, far: tl.float64,
                   SLOTS: tl.constexpr, AGAIN: tl.constexpr, ORTHO: tl.constexpr, CHORD: tl.constexpr, RECORD: tl.constexpr,
                   LANES: tl.constexpr, PTX: tl.constexpr):
    """The `count` nearest hits `[C, H, W, count]`, SLOTS at a time; AGAIN: whether these are fewer, so that there are more passes."""
    view, tile, exists, left, top, x, y, column4, pixel4 = block_pixels(tl.program_id(0), lane_x, tiles_x, tiles_y, W, H, LANES)
    dt: tl.constexpr = x.dtype
    half: tl.constexpr = TILE / 2
    mx, my, w, w2 = rays(Ks, view, x + (left.to(dt) + half), y, ORTHO)
    n = tl.full((), near, dt)
    f = tl.full((), far, dt)
    column = glue(column4, column4 + 1)
    start, hits, longest = tile_list(offsets, tile, exists)
    last_depth = x * 0.0 + float("-inf")                # the last hit that an earlier pass found, and its place in the list
    last_place = column * 0 - 1
    begin = 0
    while begin < count:
        depths = (x * 0.0 + float("inf"),) * SLOTS
        places = (column * 0 - 1,) * SLOTS
        i = 0
        stop = longest
        left_hits = hits
        batch = load_batch(ids, start, 0, left_hits, null)
        while i < stop:
            following = load_batch(ids, start, i + TILE, left_hits, null)
            prefetch_records(records, following, RECORD, PTX)
            u = 0
            while u < TILE:
                sphere = load_sphere(records, of_batch(batch, u, ids, start, i, left_hits, null, PTX), RECORD)
                X, Y, Z, R = sphere[:4]
                distance = far_off(X, Y, Z)
                _, s, _, _, depth = enter(mx, my, w, w2, X, Y, Z, R, reciprocal(R, PTX), distance, ORTHO, CHORD, PTX)
                hit = (s < 1.0) & (depth >= n) & (depth <= f)
                place = column * 0 + (i + u)
                if AGAIN:
                    hit &= (depth > last_depth) | ((depth == last_depth) & (place > last_place))
                depths, places = insert(depths, places, tl.where(hit, depth, float("inf")), place)
                u += 1
            i += TILE
            # a tile ends when no hit of the next sphere can be nearer than the last of any of its pixels
            sphere = load_sphere(records, tl.load(ids + start + i, mask=i < left_hits, other=null), RECORD)
            nearest = (sphere[2] if ORTHO else far_off(sphere[0], sphere[1], sphere[2])) - sphere[3]
            farthest = -tile_min(tl.min(-depths[SLOTS - 1], 1, keep_dims=True))
            left_hits = tl.where(nearest < farthest, left_hits, tl.minimum(left_hits, i))
            stop = tl.minimum(stop, tl.max(tl.max(left_hits, 1), 0))      # of itself, too: what only bounds a loop crashes Triton 3.6
            batch = tl.where(i + tl.arange(0, LANES)[:, None] % TILE < left_hits, following, null)
        last_depth = depths[SLOTS - 1]
        last_place = places[SLOTS - 1]
        row = top + tl.arange(0, LANES)[:, None] % TILE
        pixel = (view.to(tl.int64) * H + row) * W + column
        for j in tl.static_range(SLOTS):
            some = places[j]
            index = tl.load(ids + start + some, mask=some >= 0, other=0) % N
            inside = column < tl.where(begin + j < count, W, 0)
            tl.store(found + pixel * count + (begin + j), tl.where(some >= 0, index, -1), mask=inside)
        begin += SLOTS


def nearest_hits(centers: Tensor, radii: Tensor, Ks: Tensor, ids: Tensor, offsets: Tensor, count: int, width: int, height: int, tile: int,
                 model: str, near: float, far: float, chord: bool) -> Tensor:
    """Launcher; see `tsplat_reference.nearest_hits`. Tiles are 8 pixels wide."""
    s = Spheres(centers, radii, radii, radii[..., None], Ks, ids, offsets, width, height, tile)
    found = ids.new_empty(s.C, height, width, count)
    target = current_target()
    nearest_kernel[(s.C * blocks(s.grid, target.lanes),)](
        s.records, s.ids, s.offsets, s.Ks, found, lane_x(target.lanes, centers), width, height, *s.grid, s.R, max(s.N, 1), count, near, far,
        SLOTS=min(count, SLOTS), AGAIN=count > SLOTS, ORTHO=model == "orthographic", CHORD=chord and model == "pinhole", RECORD=s.record,
        LANES=target.lanes, PTX=target.ptx and centers.dtype == torch.float32, **launch("nearest_hits"))
    return found
