"""The cameras of all ranks on each rank, once it is sure that the ranks agree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor
from torch.distributed import ProcessGroup

from tsplat.distributed.collectives import all_gather, check_device

AGREE = "the ranks of the group differ in the number or size of cameras or in options: run without torch.compile to see in what"


def gather_cameras(viewmats: Tensor, Ks: Tensor, group: ProcessGroup, same: Mapping[str, float], inputs: Sequence[Tensor | None]
                   ) -> tuple[Tensor, Tensor]:
    """`[W C, 4, 4]` and `[W C, 3, 3]`: the cameras of rank 0, of rank 1, ...; their gradients come back, added up over ranks.

    Args:
        viewmats, Ks: `[C, 4, 4]` and `[C, 3, 3]`, with C equal on all ranks.
        same: what else has to be equal, by the names of the arguments.
        inputs: what the splats depend on: backward communicates, so that either all ranks need gradients or none.

    Raises:
        ValueError: on all ranks, naming what differs, and on which ranks. (While compiling: RuntimeError from the compiled code.)
    """
    check_device(group, viewmats.device)
    graph = torch.is_grad_enabled()
    cameras = graph and (viewmats.requires_grad or Ks.requires_grad)
    splats = graph and any(x is not None and x.requires_grad for x in inputs)
    _check_agreement({"number of cameras": len(viewmats), "dtype (bits of a number)": viewmats.element_size() * 8, **same,
                      "requires_grad of the cameras (1: yes, 0: no or no_grad)": cameras,
                      "requires_grad of the splats (1: yes, 0: no or no_grad)": splats}, viewmats, group)
    packed = torch.cat([viewmats.flatten(1), Ks.flatten(1)], 1)                             # [C, 25]: one collective, backward too
    viewmats, Ks = torch.split(all_gather(packed, group).flatten(0, 1), [16, 9], 1)
    return viewmats.reshape(-1, 4, 4), Ks.reshape(-1, 3, 3)


def _check_agreement(same: Mapping[str, float], like: Tensor, group: ProcessGroup) -> None:
    mine = torch.tensor([float(v) for v in same.values()], dtype=torch.float64, device=like.device)
    everyone = all_gather(mine, group)                                                      # [W, values]
    if torch.compiler.is_compiling():
        torch._assert_async((everyone == mine).all(), AGREE)
        return
    for name, values in zip(same, everyone.T.tolist(), strict=True):
        rank = next((r for r, v in enumerate(values) if v != values[0]), 0)
        if rank:
            raise ValueError(f"{name}: expected the same on all ranks of the group; got {values[0]:.12g} on rank 0 and "
                             f"{values[rank]:.12g} on rank {rank}")
