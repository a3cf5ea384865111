"""Launch constants and what the launchers share. No autotune: constants are measured by `bench/sweep.py` and stand here."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

import torch
import triton
from torch import Tensor

FAMILIES = ("nvidia", "cdna", "rdna")


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


def _splats(block: int, num_warps: int) -> dict[str, int]:
    return {"BLOCK": block, "num_warps": num_warps}


# project, harmonics: a splat per thread, so that no thread repeats another's work. As few warps as can be where there are sums over the block:
# one needs no step from warp to warp, and sums of more blocks to add up are a percent or two of what is read anyway. (project_backward in one
# warp is compiled for 96 registers on sm_89, and spills.)
# Features: pixels, splats and channels of a matrix product, the largest that
# spill on no target.
LAUNCHES: dict[str, dict[str, dict[str, int]]] = {
    "project": {"nvidia": _splats(128, 4), "cdna": _splats(128, 2), "rdna": _splats(128, 4)},
    "project_backward": {"nvidia": _splats(64, 2), "cdna": _splats(64, 1), "rdna": _splats(32, 1)},
    "harmonics": {"nvidia": _splats(128, 4), "cdna": _splats(128, 2), "rdna": _splats(128, 4)},
    "harmonics_backward": {"nvidia": _splats(32, 1), "cdna": _splats(64, 1), "rdna": _splats(32, 1)},
    "bin": {"nvidia": _splats(64, 2), "cdna": _splats(64, 1), "rdna": _splats(64, 2)},
    "pick": {family: _splats(128, 1) for family in FAMILIES},
    "records": {"nvidia": _splats(128, 4), "cdna": _splats(128, 2), "rdna": _splats(128, 4)},
    "blend": {family: {"UNROLL": 4, "num_warps": 1} for family in FAMILIES},
    "blend_backward": {family: {"num_warps": 1} for family in FAMILIES},
    "features": {family: {"P": 64, "K": 16, "DB": 32, "num_warps": 8} for family in FAMILIES},
    "features_backward": {family: {"P": 64, "K": 16, "DB": 16, "num_warps": 8} for family in FAMILIES},
}


def launch(kernel: str) -> dict[str, int]:
    """The constants of a kernel for the current target."""
    return LAUNCHES[kernel][current_target().family]


def on_device_of(tensor: Tensor) -> contextlib.AbstractContextManager[object]:
    """Triton launches on the current device: make it that of the tensor."""
    return torch.cuda.device(tensor.device) if tensor.is_cuda else contextlib.nullcontext()
