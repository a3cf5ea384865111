"""What splats need of `torch.distributed`: one collective, with gradients, that torch.compile can trace.

The functional collectives are PyTorch's own for this, and have no public module yet; of these names, all of which torch 2.11 and 2.13 have,
the rest of tsplat knows nothing.
"""

from __future__ import annotations

import torch
import torch.distributed as dist
import torch.distributed._functional_collectives as functional
from torch import Tensor
from torch.distributed import ProcessGroup


def all_to_all(rows: Tensor, send: list[int], receive: list[int], group: ProcessGroup) -> Tensor:
    """Send the first `send[0]` rows to rank 0 and so on, and get `receive[0]` rows of rank 0 and so on; gradients go back."""
    received = functional.all_to_all_single_autograd(rows.contiguous(), receive, send, group)
    return functional.wait_tensor(received)  # type: ignore[no-any-return, no-untyped-call]


def all_gather(values: Tensor, group: ProcessGroup) -> Tensor:
    """`[W, ...]`, the values of all ranks; the gradients of all ranks are added up.

    (An all-to-all of copies: for a few numbers, and one collective to rely on; the names of all-gathers differ between 2.11 and 2.13.)
    """
    ones = [1] * group.size()
    return all_to_all(values.expand(len(ones), *values.shape), ones, ones, group)


def check_group(group: object) -> int:
    """The number of ranks in `group`.

    Raises:
        TypeError: if it is not a process group, or this process is not a member.
    """
    if not isinstance(group, ProcessGroup):
        raise TypeError("group: expected a torch.distributed.ProcessGroup of which this process is a member, as torch.distributed.group.WORLD "
                        f"after init_process_group, or mesh.get_group(); got {type(group).__name__}")
    return group.size()


def check_device(group: ProcessGroup, device: torch.device) -> None:
    """Check that `group` moves tensors of `device`.

    Raises:
        ValueError: otherwise.
    """
    if torch.compiler.is_compiling():                   # the configuration cannot be traced
        return
    config = dist.get_backend_config(group)             # "cpu:gloo,cuda:nccl"
    backend = dict(entry.split(":", 1) for entry in config.split(",")).get(device.type)
    if backend is None or (backend, device.type) == ("gloo", "cuda"):                       # gloo would take it through the CPU, some of it
        raise ValueError(f"group: expected a backend for tensors on {device.type!r} (nccl for 'cuda', gloo for 'cpu'); got {config!r}")
