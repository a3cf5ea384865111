"""What the compiler makes of the kernels, without a GPU: registers, spills, and instructions per (pixel, splat) pair of each inner loop.

    python bench/sass.py                      # every kernel for every target, as a markdown table
    python bench/sass.py --targets sm_90 --loops    # with the instruction mix of the blending loops

The real launchers run on meta tensors under a stand-in driver that only compiles. Occupancy is what the registers allow.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
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
REGISTERS, WARPS = 65536, 64
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


def launch_everything(quick: bool, deterministic_too: bool = True) -> Iterator[tuple[str, Any]]:
    """Each launch, with the name of its variant; `quick` gives one or two variants of each kernel, with deterministic ones or without."""
    from tsplat.kernels import adam, binning, blending, frustum, harmonics, projection, spheres

    C, N, W, H = 2, 1000, 640, 480

    def t(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        return torch.empty(shape, dtype=dtype, device="meta")

    cameras = t(C, 4, 4), t(C, 3, 3)
    radii, splats = t(C, N, 2, dtype=torch.int32), (t(C, N, 2), t(C, N, 3), t(C, N))
    ids, offsets = t(5000, dtype=torch.int32), t(C * 80 * 60 + 1, dtype=torch.int64)
    for model in ("pinhole",) if quick else ("pinhole", "orthographic", "fisheye"):
        for covars in (None,) if quick else (None, t(N, 3, 3)):
            shape = (None, None, covars) if covars is not None else (t(N, 4), t(N, 3), None)
            label = f"{model}{', covars' if covars is not None else ''}"
            yield label, lambda shape=shape, model=model: projection.project(
                t(N, 3), *shape, t(N), *cameras, W, H, model, 0.01, 1e10, 0.3, True)
            yield label, lambda shape=shape, model=model: projection.project_backward(
                t(N, 3), *shape, *cameras, W, H, model, 0.3, True, radii, t(C, N, 2), t(C, N), t(C, N, 3), t(C, N))
        planes = t(C, 2 if model == "fisheye" else 6, 6)
        yield model, lambda p=planes: frustum.may_see(t(N, 3), t(N), t(N), p)
    for degree in (3,) if quick else range(5):
        mask = t(C, N, dtype=torch.bool)
        coeffs = t(N, (degree + 1) ** 2, 3)
        yield f"degree {degree}", lambda d=degree, k=coeffs, m=mask: harmonics.harmonics(t(N, 3), t(C, 3), k, d, m)
        yield f"degree {degree}", lambda d=degree, k=coeffs, m=mask: harmonics.harmonics_backward(t(N, 3), t(C, 3), k, d, m, t(C, N, 3))
    for shape in ((), (3,), (15, 3)) if not quick else ((), (15, 3)):
        rows = [t(N, *shape) for _ in range(4)]
        yield f"rows {list(shape)}", lambda r=rows: adam.adam_rows(*r, t(N), t(N, dtype=torch.bool), 1e-3, 0.9, 0.999, 1e-15)
    yield "", lambda: binning.bin_splats_fixed(splats[0], radii, splats[1], splats[2], t(C, N), W, H, 8, 5000)
    every = ((1, False), (3, False), (3, True), (4, False), (32, False), (128, False))
    for D, absgrad in (every[1], every[4]) if quick else every:
        colors, images = t(1, N, D), (t(C, H, W, D), t(C, H, W))
        label = f"{D} channels{', absgrad' if absgrad else ''}"
        yield label, lambda c=colors, D=D: blending.blend(*splats, c, t(C, D), ids, offsets, W, H, 8, 0.99, False)
        yield label, lambda c=colors, D=D, i=images, a=absgrad: blending.blend_backward(
            *splats, c, t(C, D), ids, offsets, *i, *i, W, H, 8, 0.99, False, a)
    rgb = t(1, N, 3), t(C, 3), ids, offsets, *((t(C, H, W, 3), t(C, H, W)) * 2)
    if deterministic_too:
        yield "3 channels, deterministic", deterministic(lambda: blending.blend_backward(*splats, *rgb, W, H, 8, 0.99, False, False))
    geometry, tiles = (t(C, N, 3), t(1, N), t(C, 3, 3)), t(C * 80 * 60, dtype=torch.int32)
    plain, full = ("pinhole", False, False), ("pinhole", True, True)
    variants = [(3, *plain), (32, *plain)] if quick else [(D, *plain) for D in (1, 3, 4, 32, 128)] + [(3, "orthographic", False, False)]
    variants += [(4, *full), (32, *full)]               # what takes the most registers
    for D, model, chord, everything in variants:
        label = f"{D} channels{'' if model == 'pinhole' else ', ' + model}{', chord, depth, cutoff, intrinsics' if everything else ''}"
        inputs = geometry[0], geometry[1], t(1, N), t(1, N, D), t(C, D), t(), geometry[2], ids, offsets
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
            yield f"{model}, {count}", lambda n=count, m=model: spheres.nearest_hits(*geometry, ids, offsets, n, W, H, 8, m, 0.1, 9.0, False)


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
    loops: list[dict[str, int]]


def usage(target: str, label: str, kernel: Any) -> Usage:
    name = kernel.metadata.name
    if "cubin" not in kernel.asm:
        asm = kernel.asm["amdgcn"]
        found = [re.search(rf"\.{key}:\s*(\d+)", asm) for key in ("vgpr_count", "vgpr_spill_count")]
        vgprs, spills = (-1 if m is None else int(m[1]) for m in found)
        return Usage(target, name, label, vgprs, spills, kernel.metadata.shared, [])
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(kernel.asm["cubin"])
        file.flush()
        text = subprocess.run([TOOLS / "cuobjdump", "-res-usage", file.name], capture_output=True, text=True, check=True).stdout
        found = re.search(r"REG:(\d+) STACK:(\d+)", text)
        assert found is not None, text
        loops: list[dict[str, int]] = []
        if name in PIXELS_PER_THREAD:                                # half a second each
            loops = innermost_loops(subprocess.run([TOOLS / "nvdisasm", "-c", file.name], capture_output=True, text=True, check=True).stdout)
    return Usage(target, name, label, int(found[1]), int(found[2]), kernel.metadata.shared, loops)


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--targets", nargs="*", default=list(TARGETS), choices=list(TARGETS))
    parser.add_argument("--kernels", default="", help="only kernels whose name contains this")
    parser.add_argument("--quick", action="store_true", help="one or two variants of each kernel, deterministic ones for a target of each vendor")
    parser.add_argument("--loops", action="store_true", help="the instruction mix of the blending loops")
    add_json(parser)
    args = parser.parse_args()
    rows: list[Usage] = []
    for target in args.targets:
        with compile_only(TARGETS[target]) as kernels:
            for label, launch in launch_everything(args.quick, not args.quick or target in DETERMINISTIC):
                kernels.clear()
                launch()
                rows += [usage(target, label, k) for k in kernels if args.kernels in k.metadata.name]
    rows = list({u[:3]: u for u in rows}.values())
    if args.json:
        print_json([u._asdict() for u in rows])
        return
    print("| target | kernel | variant | registers | spills | shared | warps/SM | instructions/pair |\n" + "| --- " * 8 + "|")
    for u in rows:
        loop = pairs_loop(u)
        per_pair = f"{sum(loop.values()) / loop['ex2']:.1f}" if loop else ""
        occupancy = str(min(WARPS, REGISTERS // (32 * u.registers) if u.registers else WARPS)) if u.target.startswith("sm") else ""
        print(f"| {u.target} | {u.kernel} | {u.label} | {u.registers} | {u.spills} | {u.shared} | {occupancy} | {per_pair} |")
        if args.loops and loop:
            print(f"    {loop}")


if __name__ == "__main__":
    main()
