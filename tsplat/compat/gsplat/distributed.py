"""gsplat's `distributed=True`: the visible splats of `rasterization` go to the ranks that render them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor
from torch.distributed import ProcessGroup

from tsplat.distributed import check_group, gather_cameras, send
from tsplat.drawn import Drawn


def gather(viewmats: Tensor, Ks: Tensor, inputs: Sequence[Tensor | None], same: Mapping[str, float]
           ) -> tuple[ProcessGroup | None, Tensor, Tensor]:
    """The default group, or None if it has one rank only, and the cameras of all its ranks: see `tsplat.distributed.gather_cameras`."""
    group = torch.distributed.group.WORLD
    if check_group(group) == 1 or group is None:
        return None, viewmats, Ks
    return group, *gather_cameras(viewmats, Ks, group, same, inputs)


def send_visible(camera_ids: Tensor | None, radii: Tensor, means2d: Tensor, conics: Tensor, opacities: Tensor, color: Tensor, depths: Tensor,
                 cameras: int, absgrad: bool, group: ProcessGroup) -> Drawn:
    """The splats that the own cameras see, of those that all ranks have projected.

    Args:
        camera_ids: `[nnz]`, or None where the others are `[W C, N, ...]` instead of `[nnz, ...]`.
        cameras: W C.
        absgrad: in backward, `means2d.absgrad` is set, on the rank that projected.
    """
    probe = None
    if absgrad:
        probe = torch.zeros_like(means2d, requires_grad=True)
        probe.register_hook(lambda v: setattr(means2d, "absgrad", v))  # type: ignore[no-untyped-call]
    drawn = (radii > 0).all(-1) & color.isfinite().all(-1)
    counts = drawn.sum(1) if camera_ids is None else torch.bincount(camera_ids[drawn], minlength=cameras)
    rows = Drawn(radii[drawn], means2d[drawn], conics[drawn], opacities[drawn], color[drawn], depths[drawn],
                 None if probe is None else probe[drawn])
    return send(rows, counts, group)
