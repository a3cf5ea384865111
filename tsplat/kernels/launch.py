"""Launch constants and what the launchers share. No autotune: constants are measured in `bench/` and stand here."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import NamedTuple

import torch
import triton
from torch import Tensor


@dataclass(frozen=True)
class Target:
    """What a kernel is launched for."""

    lanes: int      # threads of a warp (64 on CDNA)
    ptx: bool       # whether NVIDIA's inline assembly is understood

    @property
    def family(self) -> str:
        """The column of `LAUNCHES`."""
        return "nvidia" if self.ptx else "cdna" if self.lanes == 64 else "rdna"


def current_target() -> Target:
    """The current device's target; the interpreter counts as a portable one of 32 lanes."""
    if triton.knobs.runtime.interpret:
        return Target(32, False)
    target = triton.runtime.driver.active.get_current_target()
    return Target(target.warp_size, target.backend == "cuda")


def ceil_div(a: int, b: int) -> int:
    """a / b, rounded up."""
    return -(-a // b)


class Launch(NamedTuple):
    """Splats per program, and warps."""

    block: int
    num_warps: int


# A splat per thread in all of these, so that no thread repeats another's work. As few warps as can be where there are sums over the block:
# one needs no step from warp to warp, and sums of more blocks to add up are a percent or two of what is read anyway. (project_backward in one
# warp is compiled for 96 registers on sm_89, and spills.)
LAUNCHES = {
    "project": {"nvidia": Launch(128, 4), "cdna": Launch(128, 2), "rdna": Launch(128, 4)},
    "project_backward": {"nvidia": Launch(64, 2), "cdna": Launch(64, 1), "rdna": Launch(32, 1)},
    "harmonics": {"nvidia": Launch(128, 4), "cdna": Launch(128, 2), "rdna": Launch(128, 4)},
    "harmonics_backward": {"nvidia": Launch(32, 1), "cdna": Launch(64, 1), "rdna": Launch(32, 1)},
}


def launch(kernel: str) -> Launch:
    """The constants of a kernel for the current target."""
    return LAUNCHES[kernel][current_target().family]


def on_device_of(tensor: Tensor) -> contextlib.AbstractContextManager[object]:
    """Triton launches on the current device: make it that of the tensor."""
    return torch.cuda.device(tensor.device) if tensor.is_cuda else contextlib.nullcontext()
