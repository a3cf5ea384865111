"""What the compiler makes of the kernels, without a GPU: registers, spills, and instructions per (pixel, splat) pair of each inner loop.

    python bench/sass.py                      # every kernel for every target, as a markdown table
    python bench/sass.py --targets sm_90 --loops    # with the instruction mix of the blending loops

The real launchers run on meta tensors under a stand-in driver that only compiles. Occupancy is what registers, shared memory and the number of
blocks allow. All is float32: in float64, which is for checking gradients, kernels may spill.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import functools
import itertools
import os
import re
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

os.environ.pop("TRITON_INTERPRET", None)

import torch
import triton
from output import add_json, print_json
from triton.backends.compiler import GPUTarget
from triton.runtime.jit import JITFunction

TOOLS = Path(triton.__file__).parent / "backends/nvidia/bin"
TARGETS = {**{f"sm_{n}": GPUTarget("cuda", n, 32) for n in (80, 86, 89, 90, 100, 120)},
           "gfx942": GPUTarget("hip", "gfx942", 64), "gfx1100": GPUTarget("hip", "gfx1100", 32)}
DETERMINISTIC = ("sm_90", "gfx942")
"""Targets for which `--quick` has deterministic variants, too: for all, a test of each target takes half a minute more of CPU time in sum."""
LIMITS = {"sm_80": (64, 32, 164), "sm_86": (48, 16, 100), "sm_89": (48, 24, 100), "sm_90": (64, 32, 228), "sm_100": (64, 32, 228),
          "sm_120": (48, 24, 100)}
"""Warps, blocks and KiB of shared memory of a multiprocessor: `cuda_occupancy.h`, and the CUDA programming guide's table of compute capabilities."""
PIXELS_PER_THREAD = dict.fromkeys(("blend_fwd_kernel", "blend_bwd_kernel", "sphere_fwd_kernel", "sphere_bwd_kernel"), 8)


class _Driver:
    """As much of a driver as compiling asks for."""

    def __init__(self, target: GPUTarget) -> None:
        self.target = target

    def get_current_target(self) -> GPUTarget:
        return self.target

    def get_current_device(self) -> str:
        return str(self.target)

    def get_current_stream(self, device: object) -> int:
        return 0

    def get_active_torch_device(self) -> torch.device:
        return torch.device("meta")


@contextlib.contextmanager
def compile_only(target: GPUTarget) -> Iterator[list[Any]]:
    """Launches compile for `target` and are collected instead of run."""
    kernels: list[Any] = []
    run = JITFunction.run

    def warm(self: Any, *args: Any, warmup: bool, **options: Any) -> None:
        kernels.append(run(self, *args, warmup=True, **options))

    triton.runtime.driver.set_active(_Driver(target))
    JITFunction.run = warm
    try:
        yield kernels
    finally:
        JITFunction.run = run


def t(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    """A tensor without data."""
    return torch.empty(shape, dtype=dtype, device="meta")


C, N, W, H = 2, 1000, 640, 480
HITS = t(5000, dtype=torch.int32), t(C * 80 * 60 + 1, dtype=torch.int64)
"""Ids and offsets."""


def launch_everything(quick: bool, deterministic_too: bool = True) -> Iterator[tuple[str, Any]]:
    """Each launch, with the name of its variant, by what autograd may pass; `quick` gives the variants of each kernel that take the most
    registers and those of the tests, with deterministic ones or without."""
    yield from project_everything(quick)
    yield from small_kernels(quick)
    yield from blend_everything(quick, deterministic_too)
    yield from blend_all_spheres(quick, deterministic_too)


def named(*words: object) -> str:
    """The words that are not empty, with commas."""
    return ", ".join(str(w) for w in words if w)


def project_everything(quick: bool) -> Iterator[tuple[str, Any]]:
    """Projection: depths and compensations have a gradient or none, which is None, and cameras are fixed or not."""
    from tsplat.kernels import projection

    models, flags = ("pinhole", "orthographic", "fisheye"), (False, True)
    cameras, radii = (t(C, 4, 4), t(C, 3, 3)), t(C, N, 2, dtype=torch.int32)
    shapes = {"": (t(N, 4), t(N, 3), None), "covars": (None, None, t(N, 3, 3))}
    forward = itertools.product(models, shapes, flags) if not quick else [("pinhole", "", True)]
    for model, shape, antialiased in forward:
        yield named(model, shape, antialiased and "antialiased"), functools.partial(
            projection.project, t(N, 3), *shapes[shape], t(N), *cameras, W, H, model, 0.01, 1e10, 0.3, antialiased)
    # with every gradient; and what spilled on some target with no bound of registers, or one of 128
    some = [("pinhole", "", True, True, True), ("pinhole", "", False, False, True), ("pinhole", "", False, True, True),
            ("orthographic", "", False, True, True), ("fisheye", "", False, True, False)]
    for model, shape, antialiased, depths, poses in some if quick else itertools.product(models, shapes, flags, flags, flags):
        label = named(model, shape, antialiased and "antialiased", depths and "depths", poses and "cameras")
        upstream = t(C, N, 2), t(C, N) if depths else None, t(C, N, 3), t(C, N) if antialiased else None
        yield label, functools.partial(
            projection.project_backward, t(N, 3), *shapes[shape], *cameras, W, H, model, 0.3, antialiased, radii, *upstream, poses)


def small_kernels(quick: bool) -> Iterator[tuple[str, Any]]:
    """All that is neither projection nor blending."""
    from tsplat.kernels import adam, binning, frustum, harmonics

    for model in ("pinhole",) if quick else ("pinhole", "fisheye"):
        planes = t(C, 2 if model == "fisheye" else 6, 6)
        yield model, functools.partial(frustum.may_see, t(N, 3), t(N), t(N), planes)
    mask = t(C, N, dtype=torch.bool)
    rows = [(degree, (degree + 1) ** 2, 3) for degree in range(5)] + [(degree, 16, 3) for degree in range(3)] + [(3, 16, 32)]
    for degree, count, D in [(3, 16, 3)] if quick else rows:
        label = named(f"degree {degree}", count != (degree + 1) ** 2 and f"of {count} coefficients", D != 3 and f"{D} channels")
        inputs = t(N, 3), t(C, 3), t(N, count, D), degree, mask
        yield label, functools.partial(harmonics.harmonics, *inputs)
        for poses in (True,) if quick else (True, False):
            yield named(label, poses and "cameras"), functools.partial(harmonics.harmonics_backward, *inputs, t(C, N, D), poses)
    for shape in ((), (15, 3)) if quick else ((), (3,), (15, 3)):
        four = (t(N, *shape) for _ in range(4))
        yield f"rows {list(shape)}", functools.partial(adam.adam_rows, *four, t(N), t(N, dtype=torch.bool), 1e-3, 0.9, 0.999, 1e-15)
    splats = t(C, N, 2), t(C, N, 2, dtype=torch.int32), t(C, N, 3), t(C, N), t(C, N)
    yield "", functools.partial(binning.bin_splats_fixed, *splats, W, H, 8, 5000)


def blend_everything(quick: bool, deterministic_too: bool) -> Iterator[tuple[str, Any]]:
    """Blending of Gaussians: the options in words, of which some matter to the backward only."""
    from tsplat.kernels import blending

    splats = t(C, N, 2), t(C, N, 3), t(C, N)
    few = [(3, ""), (4, "absgrad, drop last"), (32, "absgrad, drop last")]
    every = [(D, "") for D in (1, 2, 3, 4, 32, 512)]
    every += [(D, words) for D in (3, 4, 32) for words in ("absgrad", "drop last", "absgrad, drop last", "no background, no gradient of alpha")]
    if deterministic_too:
        few += [(3, "deterministic")]
        every += [(D, named(words, "deterministic")) for D in (3, 4) for words in ("", "absgrad", "absgrad, drop last")]
    for D, words in few if quick else every:
        colors, images = t(1, N, D), (t(C, H, W, D), t(C, H, W))
        background, v_alphas = None if "no background" in words else t(C, D), None if "no gradient" in words else images[1]
        inputs, options = (*splats, colors, background, *HITS), (W, H, 8, 0.99, "drop last" in words)
        label = named(f"{D} channels", words)
        yield label, functools.partial(blending.blend, *inputs, *options)
        backward = functools.partial(blending.blend_backward, *inputs, *images, images[0], v_alphas, *options, "absgrad" in words)
        yield label, deterministic(backward) if "deterministic" in words else backward


def blend_all_spheres(quick: bool, deterministic_too: bool) -> Iterator[tuple[str, Any]]:
    """Blending of spheres, and what is nearest."""
    from tsplat.kernels import spheres

    geometry, tiles = (t(C, N, 3), t(1, N), t(C, 3, 3)), t(C * 80 * 60, dtype=torch.int32)
    plain, full = ("pinhole", False, False), ("pinhole", True, True)
    variants = [(3, *plain), (32, *plain)] if quick else [(D, *plain) for D in (1, 3, 4, 32, 128)] + [(3, "orthographic", False, False)]
    variants += [(4, *full), (32, *full)]               # what takes the most registers
    for D, model, chord, everything in variants:
        label = f"{D} channels{'' if model == 'pinhole' else ', ' + model}{', chord, depth, cutoff, intrinsics' if everything else ''}"
        inputs = geometry[0], geometry[1], t(1, N), t(1, N, D), t(C, D), t(), geometry[2], *HITS
        images, options = (t(C, H, W, D), t(C, H, W), t(C, H, W), tiles), (W, H, 8, model, 0.1, 9.0, 1e-6, chord)
        yield label, lambda i=inputs, o=options, e=everything: spheres.blend_spheres(*i, *o, e, 1e-4)
        yield label, lambda i=inputs, o=options, e=everything, m=images: spheres.blend_spheres_backward(
            *i, m[1] if e else None, m, m[0], m[1] if e else None, m[2], *o, e)
        if deterministic_too and label == "3 channels":
            yield f"{label}, deterministic", deterministic(lambda i=inputs, o=options, m=images: spheres.blend_spheres_backward(
                *i, None, m, m[0], None, m[2], *o, False))
    for model in ("pinhole",) if quick else ("pinhole", "orthographic"):
        yield model, lambda m=model: spheres.outlines(*geometry, W, H, m, 0.1, 9.0)
        for count in (5,) if quick else (1, 5, 6):
            yield f"{model}, {count}", lambda n=count, m=model: spheres.nearest_hits(*geometry, *HITS, n, W, H, 8, m, 0.1, 9.0, False)


def deterministic(launch: Callable[[], object]) -> Callable[[], None]:
    """The launch under `torch.use_deterministic_algorithms(True)`."""
    def launched() -> None:
        torch.use_deterministic_algorithms(True)
        try:
            launch()
        finally:
            torch.use_deterministic_algorithms(False)
    return launched


class Usage(NamedTuple):
    """A compiled kernel; `loops` are the instruction counts of its innermost loops, by class: of kernels over pairs, for NVIDIA."""

    target: str
    kernel: str
    label: str
    registers: int
    spills: int
    shared: int
    warps: int
    loops: list[dict[str, int]]


def usage(target: str, label: str, kernel: Any) -> Usage:
    name, (shared, warps) = kernel.metadata.name, (kernel.metadata.shared, kernel.metadata.num_warps)
    if "cubin" not in kernel.asm:
        asm = kernel.asm["amdgcn"]
        found = [re.search(rf"\.{key}:\s*(\d+)", asm) for key in ("vgpr_count", "vgpr_spill_count")]
        vgprs, spills = (-1 if m is None else int(m[1]) for m in found)
        return Usage(target, name, label, vgprs, spills, shared, warps, [])
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(kernel.asm["cubin"])
        file.flush()
        text = subprocess.run([TOOLS / "cuobjdump", "-res-usage", file.name], capture_output=True, text=True, check=True).stdout
        found = re.search(r"REG:(\d+) STACK:(\d+)", text)
        assert found is not None, text
        loops: list[dict[str, int]] = []
        if name in PIXELS_PER_THREAD:                                # half a second each
            loops = innermost_loops(subprocess.run([TOOLS / "nvdisasm", "-c", file.name], capture_output=True, text=True, check=True).stdout)
    return Usage(target, name, label, int(found[1]), int(found[2]), shared, warps, loops)


CLASSES = {"fp32": r"F(FMA|MUL|ADD)2?\b", "select": r"F(MNMX|SEL|SETP?)", "ex2": r"MUFU\.EX2", "rcp": r"MUFU", "load": r"LD",
           "store": r"ST", "shuffle": r"SHFL", "atomic": r"(ATOM|RED)", "tensor": r"(.MMA|WGMMA|HGMMA|UTC.MMA)", "barrier": r"BAR",
           "integer": r"(IADD|IMAD|LEA|LOP|SHF|ISETP|SEL|PRMT|IMNMX|VIADD|VIMNMX|PLOP|P2R|R2P)", "other": r""}


def innermost_loops(sass: str) -> list[dict[str, int]]:
    """Instruction classes of each innermost loop: the code between a backward branch and its target."""
    instructions: list[tuple[str, str | None]] = []
    labels: dict[str, int] = {}
    for line in sass.splitlines():
        if label := re.match(r"^\s*(\.L_\w+):", line):
            labels[label[1]] = len(instructions)
        elif found := re.match(r"^\s*/\*[0-9a-f]{4,}\*/\s+(?:@!?U?P\w+\s+)?([\w.]+)(.*);", line):
            jump = re.search(r"`\((\.L_\w+)\)", found[2])
            instructions.append((found[1], jump[1] if jump else None))
    spans = [(labels[jump], i) for i, (op, jump) in enumerate(instructions) if op.startswith("BRA") and jump in labels and labels[jump] < i]
    inner = [s for s in spans if not any(o != s and o[0] >= s[0] and o[1] <= s[1] for o in spans)]
    classes = [next(c for c, pattern in CLASSES.items() if re.match(pattern, op)) for op, _ in instructions]
    return [dict(collections.Counter(classes[a:b + 1])) for a, b in inner]


def pairs_loop(u: Usage) -> dict[str, int] | None:
    """The loop over splats of a blending kernel: the one with the most exponentials."""
    loops = [loop for loop in u.loops if loop.get("ex2")]
    return max(loops, key=lambda loop: loop["ex2"]) if loops and u.kernel in PIXELS_PER_THREAD else None


def per_pair(u: Usage) -> float | None:
    """Instructions of that loop for each pair of pixel and splat, each of which takes an exponential."""
    loop = pairs_loop(u)
    return sum(loop.values()) / loop["ex2"] if loop else None


def occupancy(u: Usage) -> int:
    """Warps of a multiprocessor that blocks of such a kernel fill: a quarter has 16,384 registers, a warp takes them by 256; a block takes shared
    memory by 128 bytes, and 1 KiB for the driver."""
    warps, blocks, shared = LIMITS[u.target]
    by_registers = 4 * (16384 // (256 * -(-max(u.registers, 1) * 32 // 256)))
    return u.warps * min(min(warps, by_registers) // u.warps, blocks, shared * 1024 // (1024 + -(-u.shared // 128) * 128))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--targets", nargs="*", default=list(TARGETS), choices=list(TARGETS))
    parser.add_argument("--kernels", default="", help="only kernels whose name contains this")
    parser.add_argument("--quick", action="store_true", help="the largest variants of each kernel, deterministic ones for a target of each vendor")
    parser.add_argument("--loops", action="store_true", help="the instruction mix of the blending loops")
    add_json(parser)
    args = parser.parse_args()
    rows: dict[tuple[str, str], Usage] = {}             # a binary that many variants share is one row, under the first one's name
    for target in args.targets:
        with compile_only(TARGETS[target]) as kernels:
            for label, launch in launch_everything(args.quick, not args.quick or target in DETERMINISTIC):
                kernels.clear()
                launch()
                for kernel in kernels:
                    if args.kernels in kernel.metadata.name and (target, kernel.hash) not in rows:
                        rows[target, kernel.hash] = usage(target, label, kernel)
    if args.json:
        print_json([{**u._asdict(), "per_pair": per_pair(u)} for u in rows.values()])
        return
    print("| target | kernel | variant | registers | spills | shared | warps/SM | instructions/pair |\n" + "| --- " * 8 + "|")
    for u in rows.values():
        each = per_pair(u)
        predicted = occupancy(u) if u.target in LIMITS else "", "" if each is None else f"{each:.1f}"
        print("|", *(f"{cell} |" for cell in (*u[:6], *predicted)))
    for u in rows.values() if args.loops else ():
        if loop := pairs_loop(u):
            print(f"- {u.target}, {u.kernel}, {u.label}: " + ", ".join(f"{kind} {count}" for kind, count in loop.items()))


if __name__ == "__main__":
    main()
