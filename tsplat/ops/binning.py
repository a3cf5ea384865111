"""Tile intersection and depth order as a custom op: CPU tensors run the reference, others the Triton kernels. Not differentiable."""

from __future__ import annotations

import torch
import tsplat_reference as reference
from torch import Tensor
from tsplat_reference import Bins

from tsplat.ops.common import Op, run_kernel


def bin_splats(means2d: Tensor, radii: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, width: int, height: int, tile: int
               ) -> Bins:
    """`tsplat_reference.bin_splats` as an op; its number of hits depends on the data."""
    return Bins(*bin_splats_op(means2d, radii, conics, opacities, depths, width, height, tile))


def bin_splats_fixed(means2d: Tensor, radii: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, width: int, height: int, tile: int,
                     capacity: int) -> tuple[Bins, Tensor]:
    """As `bin_splats`, with room for `capacity` hits: no shape depends on the data and no result is waited for, as CUDA graphs need.

    Returns:
        The lists, whose ids beyond the last offset mean nothing; and the capacity needed, int64 `[]`. If that is more than `capacity`, hits
        are missing: bin again with more.
    """
    ids, offsets, needed = bin_splats_fixed_op(means2d, radii, conics, opacities, depths, width, height, tile, capacity)
    return Bins(ids, offsets), needed


def _bin_splats(means2d: Tensor, radii: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, width: int, height: int, tile: int
                ) -> tuple[Tensor, Tensor]:
    """Ids and offsets."""
    ids, offsets = run_kernel("binning", "bin_splats", means2d, means2d, radii, conics, opacities, depths, width, height, tile)
    return ids, offsets


def _bin_splats_cpu(means2d: Tensor, radii: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, width: int, height: int, tile: int
                    ) -> tuple[Tensor, Tensor]:
    ids, offsets = reference.bin_splats(means2d, radii, conics, opacities, depths, width, height, tile)
    return ids, offsets


def _bin_splats_fake(means2d: Tensor, radii: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, width: int, height: int, tile: int
                     ) -> tuple[Tensor, Tensor]:
    hits = torch.library.get_ctx().new_dynamic_size()
    tiles_x, tiles_y = reference.tile_counts(width, height, tile)
    return (means2d.new_empty(hits, dtype=torch.int32),
            means2d.new_empty(means2d.shape[0] * tiles_x * tiles_y + 1, dtype=torch.int64))


bin_splats_op = Op("tsplat::bin_splats", _bin_splats, cpu=_bin_splats_cpu, fake=_bin_splats_fake)


def _bin_splats_fixed(means2d: Tensor, radii: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, width: int, height: int, tile: int,
                      capacity: int) -> tuple[Tensor, Tensor, Tensor]:
    """Ids, offsets and the capacity needed."""
    ids, offsets, needed = run_kernel("binning", "bin_splats_fixed", means2d, means2d, radii, conics, opacities, depths, width, height, tile,
                                      capacity)
    return ids, offsets, needed


def _bin_splats_fixed_cpu(means2d: Tensor, radii: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, width: int, height: int,
                          tile: int, capacity: int) -> tuple[Tensor, Tensor, Tensor]:
    ids, offsets = reference.bin_splats(means2d, radii, conics, opacities, depths, width, height, tile)
    room = ids.new_zeros(capacity)
    room[:len(ids)] = ids[:capacity]
    return room, offsets.clamp(max=capacity), offsets[-1].clone()


def _bin_splats_fixed_fake(means2d: Tensor, radii: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, width: int, height: int,
                           tile: int, capacity: int) -> tuple[Tensor, Tensor, Tensor]:
    tiles_x, tiles_y = reference.tile_counts(width, height, tile)
    return (means2d.new_empty(capacity, dtype=torch.int32), means2d.new_empty(means2d.shape[0] * tiles_x * tiles_y + 1, dtype=torch.int64),
            means2d.new_empty((), dtype=torch.int64))


bin_splats_fixed_op = Op("tsplat::bin_splats_fixed", _bin_splats_fixed, cpu=_bin_splats_fixed_cpu, fake=_bin_splats_fixed_fake)
