"""Projected splats from the ranks that own them to the ranks whose cameras see them."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.distributed import ProcessGroup

from tsplat.distributed.collectives import all_to_all
from tsplat.drawn import Drawn


def send(rows: Drawn, counts: Tensor, group: ProcessGroup) -> Drawn:
    """Rows `[V, ...]` of visible splats, camera by camera, to the ranks of these cameras.

    Args:
        rows: visible splats; the radii are not read.
        counts: int64 `[W C]`, how many of the rows each camera has.

    Returns:
        `[C, M, ...]` for the own cameras: the splats of rank 0, of rank 1, ..., and zeros, as cameras see different numbers. Radii are 1 for
        splats: binning asks only whether a splat is drawn, and takes its extent from the conic.
    """
    ranks = group.size()
    counts, ones = counts.view(ranks, -1), [1] * ranks                                      # [W, C], destination and its cameras
    theirs = all_to_all(counts, ones, ones, group)                                          # [W, C], origin and own cameras
    per_camera = theirs.sum(0)
    *numbers, most = torch.cat([counts.sum(1), theirs.sum(1), per_camera.amax(0, keepdim=True)]).tolist()       # one wait for a GPU, not three
    fields = rows.means2d, rows.conics, rows.opacities[:, None], rows.colors, rows.depths[:, None], rows.absgrad
    record = [f for f in fields if f is not None]
    received = all_to_all(torch.cat(record, 1), numbers[:ranks], numbers[ranks:], group)

    cameras, origin = len(per_camera), theirs.flatten()
    first = torch.arange(cameras, device=origin.device) * most + theirs.cumsum(0) - theirs  # [W, C], where these splats go
    shift = first.flatten() - (origin.cumsum(0) - origin)
    slots = shift.repeat_interleave(origin, output_size=len(received)) + torch.arange(len(received), device=origin.device)
    padded = received.new_zeros(cameras * most, received.shape[1]).index_copy(0, slots, received)
    padded = torch.unflatten(padded, 0, (cameras, most))                                    # not view(.., -1), of which [] leaves the -1 open
    means2d, conics, opacities, colors, depths, *absgrad = torch.split(padded, [f.shape[1] for f in record], -1)
    drawn = (torch.arange(most, device=origin.device) < per_camera[:, None]).to(torch.int32)                    # [C, M]
    return Drawn(drawn[..., None].expand(-1, -1, 2), means2d, conics, opacities[..., 0], colors, depths[..., 0], absgrad[0] if absgrad else None)
