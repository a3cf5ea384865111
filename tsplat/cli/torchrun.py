"""Commands under `torchrun`, which starts several processes of one, and tells each by environment variables which it is."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from torch.distributed import ProcessGroup  # some builds of torch have none


class Ended(ConnectionError):
    """torchrun ends this process (SIGTERM), as it does where another one has ended, or when it is told to end."""


def ranks() -> int:
    """How many processes torchrun started; 1 without it."""
    return int(os.environ["WORLD_SIZE"]) if "RANK" in os.environ and "WORLD_SIZE" in os.environ else 1


def rank() -> int:
    """Which of them this is."""
    return int(os.environ["RANK"]) if ranks() > 1 else 0


def restarted() -> bool:
    """Whether torchrun has started the processes anew, after one of them had ended (`--max-restarts`)."""
    return ranks() > 1 and os.environ.get("TORCHELASTIC_RESTART_COUNT", "0") != "0"


@contextmanager
def joined(device: torch.device) -> Iterator[tuple[ProcessGroup | None, torch.device]]:
    """Join the processes of torchrun: their group, over gloo on CPUs and NCCL on GPUs of which each process has its own, and this one's device.

    Without torchrun, or with one process, the group is None and the device is the given one.

    Raises:
        ValueError: the device is no CPU or GPU, or names one GPU for all, or there are fewer GPUs than processes.
        Ended: in the block, on SIGTERM.
    """
    if ranks() == 1:
        yield None, device
        return
    import torch.distributed as dist

    if device.type not in ("cpu", "cuda") or device.index is not None:
        raise ValueError(f"--device: expected cpu or cuda with more than one process, each of which takes the GPU of its number; got {str(device)!r}")
    if device.type == "cuda":
        local, gpus = int(os.environ["LOCAL_RANK"]), torch.cuda.device_count()
        if local >= gpus:
            raise ValueError(f"--device: expected a GPU for each process; got {gpus} for {os.environ.get('LOCAL_WORLD_SIZE', 'more')} here")
        device = torch.device("cuda", local)
        torch.cuda.set_device(device)                    # also where torch.distributed puts what it pickles
    previous = signal.signal(signal.SIGTERM, _end)
    try:
        # torchrun 2.13 keeps its store over a restart: without a prefix, processes would look for each other where the ended ones were
        store, here, count = next(dist.rendezvous("env://"))
        store = dist.PrefixStore(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"), store)
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo", store=store, rank=here, world_size=count)
        yield dist.group.WORLD, device
        dist.destroy_process_group()                     # not after an error: others may wait for this process
    finally:
        signal.signal(signal.SIGTERM, previous)


def is_loss(error: BaseException) -> bool:
    """Whether an error says that another process of the group has ended. gloo has no class for that, but names its source file."""
    import torch.distributed as dist
    return isinstance(error, dist.DistError) or (isinstance(error, RuntimeError) and "gloo" in str(error))


def _end(_signal: int, _frame: FrameType | None) -> None:
    raise Ended("ended by torchrun, as where another process has ended (SIGTERM)")
