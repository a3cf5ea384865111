"""Projected splats from the ranks that own them to the ranks whose cameras see them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributed import ProcessGroup

from tsplat.distributed.collectives import all_to_all


class Drawn(NamedTuple):
    """What binning and blending take of N splats in C cameras.

    radii: int32 `[C, N, 2]`, 0 for splats that are not drawn. means2d: `[C, N, 2]`. conics: `[C, N, 3]`. opacities: `[C, N]`.
    colors: `[C, N, D]`. depths: `[C, N]`. absgrad: `[C, N, 2]` or None. Opacities and colors may have 1 for C, if all cameras share them.
    """

    radii: Tensor
    means2d: Tensor
    conics: Tensor
    opacities: Tensor
    colors: Tensor
    depths: Tensor
    absgrad: Tensor | None


def exchange(own: Drawn, group: ProcessGroup) -> Drawn:
    """From own splats in the cameras of all ranks, `[W C, N, ...]`, to visible splats of all ranks in the own cameras, `[C, M, ...]`."""
    visible = (own.radii > 0).all(-1)                                                       # [W C, N]
    index = visible.flatten().nonzero().squeeze(1)                                          # [V], camera by camera

    def rows(values: Tensor) -> Tensor:
        flat = values.flatten(0, 1)                                                         # [W C N, ...], or [N, ...] if cameras share them
        return flat.index_select(0, index % len(flat))                                      # its gradient is an index_add; that of [] sorts

    return send(Drawn(own.radii, rows(own.means2d), rows(own.conics), rows(own.opacities[..., None])[:, 0], rows(own.colors),
                      rows(own.depths[..., None])[:, 0], None if own.absgrad is None else rows(own.absgrad)), visible.sum(1), group)


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
