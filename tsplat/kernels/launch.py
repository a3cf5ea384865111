"""Launch constants and what the launchers share. No autotune: constants are measured by `bench/sweep.py` and stand here."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import triton
from torch import Tensor
from triton.compiler import CompiledKernel

FAMILIES = ("nvidia", "cdna", "rdna")


@dataclass(frozen=True)
class Target:
    """What a kernel is launched for."""

    lanes: int      # threads of a warp (64 on CDNA)
    ptx: bool       # whether NVIDIA's inline assembly is understood
    predicates: bool = False    # whether the compiler makes a predicated instruction of a sum and a select

    @property
    def family(self) -> str:
        """The column of `LAUNCHES`."""
        return "nvidia" if self.ptx else "cdna" if self.lanes == 64 else "rdna"


_RUNTIME = triton.knobs.runtime
INTERPRETED = bool(_RUNTIME.interpret)
"""Whether kernels run in the interpreter: settled, as in `triton.jit`, on import."""


def current_target() -> Target:
    """The current device's target; the interpreter counts as a portable one of 32 lanes."""
    if INTERPRETED:
        return Target(32, False)
    driver = triton.runtime.driver.active
    return _target(driver, driver.get_current_device())


@functools.cache
def _target(driver: Any, device: Any) -> Target:
    """Held, as to ask for a device's properties takes 5 us, and is done some ten times in a forward and backward."""
    target = driver.get_current_target()
    nvidia = target.backend == "cuda"
    return Target(target.warp_size, nvidia, nvidia and target.arch == 90)


class Launcher:
    """A kernel whose launches, `kernel[grid](*arguments, **constants)`, take 4 to 7 us of Python instead of 7 to 19.

    `JITFunction.run` makes a text of all that a binary is compiled for, and looks that up. Here the same, as it is, is the key of a binary
    that an earlier launch returned: dtypes, alignment of pointers, width of integers, constants and the device. It is complete if no
    integer's value matters (`do_not_specialize`) and constants come last, on NVIDIA (AMD's binaries depend on sizes of tensors, too).
    Launches of which that is not so, all in the interpreter, those that a profiler has hooked, and where what came back is not what is
    known (a compiler that does not launch) are Triton's own. Other knobs of Triton that are turned after the first launch do not act.
    """

    def __init__(self, kernel: Any) -> None:
        self.kernel = kernel
        self.binaries: dict[tuple[Any, ...], tuple[Any, ...]] = {}

    def __getitem__(self, grid: tuple[int, ...]) -> Callable[..., None]:
        return self.kernel[grid] if INTERPRETED else functools.partial(self._launch, grid)

    def _launch(self, grid: tuple[int, ...], *args: Any, **constants: Any) -> None:
        driver = triton.runtime.driver.active
        device = driver.get_current_device()
        # addresses, not tensors: the driver is not asked about each of them (it is a kernel of ours, so they are on the device)
        passed = [a.data_ptr() if isinstance(a, Tensor) else a for a in args]
        kinds = [(a.dtype, p % 16) if isinstance(a, Tensor) else -2**31 <= a < 2**31 if type(a) is int else type(a)
                 for a, p in zip(args, passed, strict=True)]
        key = (device, *kinds, *constants, *constants.values())
        found = self.binaries.get(key)
        if found is not None and not _hooked():
            run, function, metadata, values, _ = found
            run(*grid, *(1,) * (3 - len(grid)), driver.get_current_stream(device), function, metadata, None, None, None, *passed, *values)
            return
        binary = self.kernel[grid](*args, **constants)
        if isinstance(binary, CompiledKernel) and self._known_by_key(args, constants):
            values = tuple(constants[name] for name in self.kernel.arg_names[len(args):])
            self.binaries[key] = binary.run, binary.function, binary.packed_metadata, values, binary       # which unloads itself when let go

    def _known_by_key(self, args: tuple[Any, ...], constants: dict[str, Any]) -> bool:
        """Whether the key has all that a binary is compiled for."""
        params = self.kernel.params
        return (current_target().ptx
                and all(a is None or isinstance(a, Tensor | float) or (type(a) is int and (p.do_not_specialize or p.annotation_type == "fp64"))
                    for a, p in zip(args, params, strict=False))
                and all(p.is_constexpr and p.name in constants for p in params[len(args):]))


def _hooked() -> bool:
    """Whether a profiler wants to hear of launches."""
    enter, exit = _RUNTIME.launch_enter_hook, _RUNTIME.launch_exit_hook
    return bool(getattr(enter, "calls", enter) or getattr(exit, "calls", exit))


def ceil_div(a: int, b: int) -> int:
    """a / b, rounded up."""
    return -(-a // b)


def _splats(block: int, num_warps: int) -> dict[str, int]:
    return {"BLOCK": block, "num_warps": num_warps}


# project, harmonics: a splat per thread, so that no thread repeats another's work. As few warps as can be where there are sums over the block:
# one needs no step from warp to warp, and sums of more blocks to add up are a percent or two of what is read anyway. (project_backward in two
# warps spills on sm_120.) project_cameras_backward: with gradients of cameras, or a fisheye one, NVIDIA's compiler aims at 80 or 96 registers and
# on all but sm_80 and sm_100 spills 8 bytes in some variant; told a bound, it takes what it needs, up to 138 on sm_90 (128 is too few on sm_100).
# pick: a count of BLOCK must fit a byte. blend: a warp takes 4 tiles (8 of 64 lanes). adam: BLOCK numbers of a program, in whole rows: 8 a
# thread, in 16-byte loads; a bound of registers, as that of 45 numbers a row has 96, and with Triton 3.7 8 bytes more on sm_120. may_see: as
# project. features: splats and channels of a matrix product; in 4 warps the forward was faster on an H100, but spills on sm_120. The backward of
# spheres with gradients of cameras has too many registers for 4 warps or 32 channels on sm_100 and sm_120, as have both backwards in 4 warps on
# gfx1100, each with some Triton of 3.6 to 3.9. All columns but NVIDIA's are untimed, and so are may_see, project_cameras_backward, spheres', and
# adam's bound.
LAUNCHES: dict[str, dict[str, dict[str, int]]] = {
    "project": {"nvidia": _splats(128, 4), "cdna": _splats(128, 2), "rdna": _splats(128, 4)},
    "project_backward": {"nvidia": _splats(128, 4), "cdna": _splats(64, 1), "rdna": _splats(32, 1)},
    "project_cameras_backward": {"nvidia": {**_splats(128, 4), "maxnreg": 168}, "cdna": _splats(64, 1), "rdna": _splats(32, 1)},
    "may_see": {family: _splats(128, 4) for family in FAMILIES},
    "harmonics": {"nvidia": _splats(128, 4), "cdna": _splats(128, 2), "rdna": _splats(128, 4)},
    "harmonics_backward": {"nvidia": _splats(32, 1), "cdna": _splats(64, 1), "rdna": _splats(32, 1)},
    "bin": {"nvidia": _splats(128, 4), "cdna": _splats(64, 1), "rdna": _splats(64, 2)},
    "pick": {family: _splats(128, 1) for family in FAMILIES},
    "records": {"nvidia": _splats(32, 1), "cdna": _splats(128, 2), "rdna": _splats(128, 4)},
    "blend": {family: {"num_warps": 1} for family in FAMILIES},
    "blend_backward": {family: {"num_warps": 1} for family in FAMILIES},
    "adam": {"nvidia": {**_splats(1024, 4), "maxnreg": 96}, "cdna": _splats(1024, 4), "rdna": _splats(1024, 4)},
    "features": {"nvidia": {"K": 16, "DB": 64, "num_warps": 8}, "cdna": {"K": 16, "DB": 32, "num_warps": 8},
                 "rdna": {"K": 16, "DB": 32, "num_warps": 8}},
    "features_colors_backward": {"nvidia": {"K": 16, "DB": 32, "num_warps": 4}, "cdna": {"K": 16, "DB": 32, "num_warps": 4},
                                 "rdna": {"K": 16, "DB": 16, "num_warps": 8}},
    "features_backward": {"nvidia": {"K": 16, "DB": 32, "num_warps": 4}, "cdna": {"K": 16, "DB": 32, "num_warps": 4},
                          "rdna": {"K": 16, "DB": 32, "num_warps": 8}},
    "outlines": {family: _splats(128, 4) for family in FAMILIES},
    "blend_spheres": {family: {"num_warps": 1} for family in FAMILIES},
    "blend_spheres_backward": {family: {"num_warps": 1} for family in FAMILIES},
    "nearest_hits": {family: {"num_warps": 1} for family in FAMILIES},
    "sphere_features": {"nvidia": {"K": 16, "DB": 32, "num_warps": 8}, "cdna": {"K": 16, "DB": 32, "num_warps": 8},
                        "rdna": {"K": 16, "DB": 32, "num_warps": 8}},
    "sphere_features_backward": {"nvidia": {"K": 16, "DB": 32, "num_warps": 4}, "cdna": {"K": 16, "DB": 32, "num_warps": 4},
                                 "rdna": {"K": 16, "DB": 16, "num_warps": 8}},
    "sphere_feature_backward": {family: {"K": 16, "DB": 32, "num_warps": 4} for family in FAMILIES},
    "sphere_feature_cameras_backward": {"nvidia": {"K": 16, "DB": 16, "num_warps": 8}, "cdna": {"K": 16, "DB": 32, "num_warps": 4},
                                        "rdna": {"K": 16, "DB": 32, "num_warps": 8}},
    "upstream": {family: {"DB": 4, **_splats(128, 4)} for family in FAMILIES},
}


def launch(kernel: str) -> dict[str, int]:
    """The constants of a kernel for the current target; products are fused into sums, which Triton 3.10 no longer does unless asked."""
    return {**LAUNCHES[kernel][current_target().family], "enable_fp_fusion": True}
