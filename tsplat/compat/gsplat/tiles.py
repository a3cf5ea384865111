"""gsplat's lists of tile intersections, for those who read them or make their own."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from tsplat_reference import tile_counts

from tsplat.checks import check_size, check_tensor
from tsplat.rasterize import TILE


@torch.no_grad()
def isect_tiles(means2d: Tensor, radii: Tensor, depths: Tensor, tile_size: int, tile_width: int, tile_height: int, sort: bool = True,
                segmented: bool = False, packed: bool = False, n_images: int | None = None, image_ids: Tensor | None = None,
                gaussian_ids: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """The tiles that each splat's box touches.

    Args:
        means2d, radii, depths: `[..., N, 2]`, int32 `[..., N, 2]` and `[..., N]`, or with `packed` `[nnz, ...]`.
        tile_size, tile_width, tile_height: pixels of a tile, and tiles along x and y.
        sort: whether to sort by image, tile and depth.
        segmented: no difference.
        n_images, image_ids: with `packed`, the number of images and each splat's, int64 `[nnz]`. gaussian_ids: not used.

    Returns:
        int32 `[..., N]` or `[nnz]`, tiles per splat; int64 `[M]`, image | tile | 32 bits of depth of each hit, where image and tile take so many
        bits as their number needs; int32 `[M]`, the hit's splat, as an index into the flat images and splats or into nnz.
    """
    check_tensor("means2d", means2d, ("nnz", 2) if packed else (..., "N", 2))
    for name, size in (("tile_size", tile_size), ("tile_width", tile_width), ("tile_height", tile_height)):
        check_size(name, size)
    if packed and (image_ids is None or n_images is None):
        raise ValueError("n_images, image_ids: expected both with packed=True; got None")
    count = means2d.shape[-2]
    images = torch.arange(math.prod(means2d.shape[:-2]), device=means2d.device).repeat_interleave(count) if image_ids is None else image_ids.long()
    center, half = means2d.reshape(-1, 2) / tile_size, radii.reshape(-1, 2) / tile_size
    last = torch.tensor([tile_width, tile_height], device=means2d.device)
    low = torch.minimum((center - half).floor().clamp_min(0).long(), last)
    high = torch.minimum((center + half).ceil().clamp_min(0).long(), last)
    span = (high - low).clamp_min(0) * (radii.reshape(-1, 2) > 0).all(-1, keepdim=True)
    tiles = span.prod(-1)

    owner = torch.repeat_interleave(tiles)
    k = torch.arange(len(owner), device=owner.device) - (tiles.cumsum(0) - tiles)[owner]        # which of its splat's tiles
    columns = span[owner, 0]
    tile = (low[owner, 1] + k // columns) * tile_width + low[owner, 0] + k % columns
    bits = depths.reshape(-1).float().view(torch.int32).long() & 0xFFFFFFFF
    isect_ids = (((images[owner] << _bits(tile_width * tile_height)) | tile) << 32) | bits[owner]
    if sort:
        isect_ids, order = isect_ids.sort(stable=True)
        owner = owner[order]
    return tiles.to(torch.int32).view(means2d.shape[:-1]), isect_ids, owner.to(torch.int32)


@torch.no_grad()
def isect_offset_encode(isect_ids: Tensor, n_images: int, tile_width: int, tile_height: int) -> Tensor:
    """Where each tile's hits begin in the sorted ids of `isect_tiles`: int32 `[n_images, tile_height, tile_width]`."""
    tiles, bits = tile_width * tile_height, _bits(tile_width * tile_height)
    key = isect_ids >> 32
    flat = (key >> bits) * tiles + (key & ((1 << bits) - 1))
    offsets = torch.searchsorted(flat, torch.arange(n_images * tiles, device=flat.device))
    return offsets.to(torch.int32).view(n_images, tile_height, tile_width)


def _bits(tiles: int) -> int:
    return tiles.bit_length()


def core_lists(isect_offsets: Tensor, flatten_ids: Tensor, masks: Tensor | None, width: int, height: int, tile_size: int
               ) -> tuple[Tensor, Tensor, int]:
    """gsplat's lists as the core takes them: ids, offsets with an end, and tiles of a size that it has.

    A tile of 16 pixels is four of 8, each with its whole list.
    """
    tile_height, tile_width = isect_offsets.shape[-2:]
    tile = TILE if tile_size % TILE == 0 else tile_size
    starts = isect_offsets.reshape(-1).long()
    counts = torch.cat([starts, starts.new_tensor([len(flatten_ids)])]).diff()
    if masks is not None:
        counts = counts * masks.reshape(-1)
    columns, rows = tile_counts(width, height, tile)
    image, row, column = (torch.arange(n, device=starts.device) for n in (len(starts) // (tile_height * tile_width), rows, columns))
    parent = (image[:, None, None] * tile_height + row[:, None] * tile // tile_size) * tile_width + column * tile // tile_size
    counts, starts = counts[parent.flatten()], starts[parent.flatten()]
    offsets = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    owner = torch.repeat_interleave(counts)
    k = torch.arange(len(owner), device=owner.device) - offsets[owner]
    return flatten_ids[starts[owner] + k], offsets, tile
