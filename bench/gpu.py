"""Everything that only a GPU can tell, in one command.

    python bench/gpu.py                                # tests, timings, gsplat on the same inputs if it is installed; JSON and markdown
    python bench/gpu.py --quick --parts scenes         # a first look
    python bench/gpu.py --parts scenes --minutes 8     # where a command may take 10 minutes: again and again, until nothing is left

(a) runs the test suite on CUDA; (b) times each stage and the whole (forward, backward, both) with CUDA events on fixed scenes; (c) times
gsplat, if it can be imported (a wheel that compiles itself with nvcc and ninja at first), on the very same inputs in the same process, and
checks that images and gradients agree; (d) measures the card's copy bandwidth and puts each stage beside the floor that memory sets, with
peak memory and the effect of CUDA graphs; (e) writes all that after each scene. What an earlier call of the same day and commit measured is
kept, and not measured again with `--minutes`.

Status 1 if a test failed, or images or gradients disagree. Without a GPU it says so and exits with 2.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import shlex
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from gpu_scenes import fixed_scenes
from output import add_json, environment, print_json, printing
from scenes import Scene
from torch import Tensor

import tsplat
from tsplat import ops
from tsplat.ops.blending import blend_backward_op
from tsplat.ops.harmonics import harmonics_backward_op
from tsplat.ops.projection import project_backward_op

ROOT = Path(__file__).resolve().parents[1]
GSPLAT_ALPHA_MAX = 0.999
NAMES = ("means", "quats", "scales", "opacities", "colors")
DEVICE = "cuda"
IMAGE_AGREES, GRADIENT_AGREES = 1e-5, 1e-2
"""Mean difference of images, and relative norm of that of gradients, by gsplat's rule for the end of a pixel: a few pixels in 1e5, in which
rounding takes a splat across a threshold (alpha 1/255, transmittance 1e-4) in one of the two only. Any other rule is off by far more."""
MEMORY_GOAL = 0.5
"""Of gsplat's peak."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "bench" / "results", help="folder for <date>-gpu-<card>.json and .md")
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("TSPLAT_DATA", ROOT.parent / "shared")),
                        help="folder with data/garden and data/splats; scenes that are not there are left out, and named")
    parser.add_argument("--parts", nargs="+", choices=("tests", "scenes"), default=["tests", "scenes"], help="default: both")
    parser.add_argument("--pytest", default="-n 4", metavar="ARGUMENTS", help="of the tests, in one word: default %(default)r")
    parser.add_argument("--scenes", nargs="+", metavar="TEXT", help="only scenes in whose name one of these is")
    parser.add_argument("--quick", action="store_true", help="1080p, up to 1M splats, 3 channels only")
    parser.add_argument("--minutes", type=float, help="begin no scene after this time, and only those that are not in the JSON yet")
    parser.add_argument("--profile", action="store_true", help="only print the kernels of a forward and backward, with their times")
    add_json(parser)
    args = parser.parse_args()
    if not torch.cuda.is_available():
        print("bench/gpu.py: no GPU: torch.cuda.is_available() is False. Run it where there is one; for a CPU there is bench/cpu.py",
              file=sys.stderr)
        return 2
    if args.profile:
        for name, channels, make in chosen_scenes(args):
            print(f"{name}, {channels} channels\n{profile(make().to(DEVICE))}", flush=True)
        return 0
    with printing(args.json):
        report = measure_all(args)
    if args.json:
        print_json(report)
    return 1 if report.get("failed") else 0


def chosen_scenes(args: argparse.Namespace) -> list[tuple[str, int, Callable[[], Scene]]]:
    return [s for s in fixed_scenes(args.data, args.quick) if not args.scenes or any(text in s[0] for text in args.scenes)]


def measure_all(args: argparse.Namespace) -> dict[str, Any]:
    """The report, which is also written, after each scene."""
    start = time.monotonic()
    report: dict[str, Any] = {**environment(DEVICE), "gsplat": version("gsplat"), "copy_GBps": copy_bandwidth()}
    print(json.dumps(report, indent=1))
    card = report["machine"].removeprefix("NVIDIA ").lower().replace(" ", "-")
    stem = args.out / f"{report['date']}-gpu-{card}"
    earlier = json.loads(stem.with_suffix(".json").read_text()) if stem.with_suffix(".json").is_file() else {}
    same = earlier if earlier.get("commit") == report["commit"] else {}
    report |= {"tests": same.get("tests"), "rows": same.get("rows", [])}
    args.out.mkdir(parents=True, exist_ok=True)

    def write() -> None:
        report["failed"] = [f"tests: {report['tests']['summary']}"] if report["tests"] and report["tests"]["status"] else []
        report["failed"] += [f"{row['scene']}, {row['channels']} channels" for row in report["rows"] if row.get("gsplat", {}).get("agrees") is False]
        stem.with_suffix(".json").write_text(json.dumps(report, indent=1, allow_nan=False) + "\n")
        stem.with_suffix(".md").write_text(markdown(report))

    if "tests" in args.parts:
        report["tests"] = run_tests(args.pytest)
        write()
    for name, channels, make in chosen_scenes(args) if "scenes" in args.parts else []:
        there = [row for row in report["rows"] if (row["scene"], row["channels"]) == (name, channels)]
        if args.minutes is not None and (there or time.monotonic() - start > 60 * args.minutes):
            print(f"{name}, {channels} channels: {'measured before' if there else 'left for another call'}", flush=True)
            continue
        scene = make().to(DEVICE)
        row = {"scene": name, "channels": channels, "splats": len(scene.means), "width": scene.camera.width, "height": scene.camera.height}
        try:
            row |= measure(scene, report["copy_GBps"])
        except torch.OutOfMemoryError:
            row["error"] = "out of memory"
        report["rows"] = [other for other in report["rows"] if other not in there] + [row]
        write()
        print(json.dumps(row), flush=True)
        del scene
        torch.cuda.empty_cache()
    print(markdown(report))
    return report


def version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def run_tests(arguments: str) -> dict[str, Any]:
    """Exit status and last line of pytest, whose output goes where print goes."""
    line = summary = ""
    with subprocess.Popen([sys.executable, "-m", "pytest", "-q", *shlex.split(arguments)], cwd=ROOT, stdout=subprocess.PIPE,
                          stderr=subprocess.STDOUT, text=True) as run:
        for line in run.stdout or ():
            print(line, end="", flush=True)
            summary = line.strip() or summary
    return {"arguments": arguments, "status": run.returncode, "summary": summary}


def copy_bandwidth() -> float:
    """GB/s, read and written, of a copy of 1 GiB."""
    a = torch.empty(1 << 28, device=DEVICE)
    b = torch.empty_like(a)
    return 2 * a.nbytes / milliseconds(lambda: b.copy_(a))[0] / 1e6


def milliseconds(run: Callable[[], object], times: int = 20) -> tuple[float, float]:
    """Median and spread (quartile distance) of CUDA-event times, after a warm-up."""
    for _ in range(3):
        run()
    samples = []
    for _ in range(times):
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        run()
        end.record()
        torch.cuda.synchronize()
        samples.append(start.elapsed_time(end))
    quartiles = statistics.quantiles(samples, n=4)
    return statistics.median(samples), quartiles[2] - quartiles[0]


def peak_MiB(run: Callable[[], object]) -> float:
    """The most memory that a call takes beyond what there is."""
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    run()
    return (torch.cuda.max_memory_allocated() - before) / 2**20


def graph_time(run: Callable[[], object]) -> float:
    """The same launches replayed from a CUDA graph."""
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        run()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        run()
    return milliseconds(graph.replay)[0]


def measure(scene: Scene, copy_GBps: float) -> dict[str, Any]:
    """Times in ms, memory in MiB, share of the floor that memory traffic sets, and gsplat beside it."""
    camera = scene.camera
    leaves = [x.clone().requires_grad_() for x in scene[:5]]
    v_image = torch.randn(camera.height, camera.width, scene.colors.shape[-1], device=scene.means.device)

    def render(**options: Any) -> Tensor:
        return tsplat.rasterize(*leaves, camera, sh_degree=scene.sh_degree, background=scene.background, alpha_max=GSPLAT_ALPHA_MAX, **options).image

    stages, visible, hits = stage_calls(scene)
    with torch.no_grad():
        ms: dict[str, Any] = {name: milliseconds(call) for name, call in stages.items()}
        graph_ms: dict[str, Any] = {name: graph_time(stages[name]) for name in ("project", "blend", "blend_backward")}
    del stages
    ms |= whole(render, leaves, v_image)
    row: dict[str, Any] = {"ms": ms, "peak_MiB": peak_MiB(lambda: torch.autograd.grad(render(), leaves, v_image)), "visible": visible, "hits": hits,
                           "share_of_memory_floor": {k: v / copy_GBps / 1e6 / ms[k][0] for k, v in floors(scene, visible, hits).items()},
                           "gsplat": measure_gsplat(scene, leaves, v_image, lambda: render(drop_last=True))}
    try:                # last, as a capture that fails may leave the device unusable; room for a quarter more hits than there are
        graph_ms["both"] = graph_time(lambda: torch.autograd.grad(render(capacity=hits * 5 // 4 + 1), leaves, v_image))
    except RuntimeError as error:
        graph_ms["failed"] = str(error).partition("\n")[0]
    return row | {"graph_ms": graph_ms}


def whole(render: Callable[[], Tensor], leaves: list[Tensor], v_image: Tensor) -> dict[str, tuple[float, float]]:
    """Forward without gradients, backward, and forward with backward."""
    with torch.no_grad():
        forward = milliseconds(render)
    backward = milliseconds(partial(torch.autograd.grad, render(), leaves, v_image, retain_graph=True))
    return {"forward": forward, "backward": backward, "both": milliseconds(lambda: torch.autograd.grad(render(), leaves, v_image))}


def floors(scene: Scene, visible: int, hits: int) -> dict[str, int]:
    """Bytes that each stage has to read and write at least."""
    N, D, pixels = len(scene.means), scene.colors.shape[-1], scene.camera.width * scene.camera.height
    lists = (52 + (4 * D if D > 4 else 0)) * hits       # index, record and more features than this holds
    bytes_ = {"project": 4 * (14 * N + 11 * visible), "bin": 40 * visible + 4 * hits, "blend": lists + 4 * (D + 1) * pixels,
              "blend_backward": lists + 8 * (D + 1) * pixels + 4 * (6 + D) * visible, "project_backward": 4 * (24 * N + 6 * visible)}
    if scene.sh_degree is not None:
        numbers = 4 * (scene.sh_degree + 1) ** 2 * D
        bytes_ |= {"harmonics": (numbers + 4 * (3 + D)) * visible, "harmonics_backward": (numbers + 4 * (3 + D)) * visible + (numbers + 12) * N}
    return bytes_


def stage_calls(scene: Scene) -> tuple[dict[str, Callable[[], object]], int, int]:
    """Each stage as a call on fixed inputs, and the numbers of visible splats and of hits."""
    camera, width, height, degree = scene.camera, scene.camera.width, scene.camera.height, scene.sh_degree
    shape = scene.means, scene.quats, scene.scales, None
    matrices, planes = (camera.viewmats[None], camera.Ks[None], width, height, camera.model), (camera.near, camera.far, 0.3, False)
    colors = scene.colors[None]
    with torch.no_grad():
        p = ops.project(*shape, scene.opacities, *matrices, *planes)
        seen = (p.radii > 0).all(-1)
        if degree is not None:
            sh = scene.means, -(camera.viewmats[:3, :3].T @ camera.viewmats[:3, 3])[None], scene.colors, degree, seen
            colors = (ops.harmonics(*sh) + 0.5).clamp_min(0)
            v_colors = torch.randn_like(colors)
        to_bin = p.means2d, p.radii, p.conics, scene.opacities[None], p.depths, width, height, 8
        bins = ops.bin_splats(*to_bin)
        splats = p.means2d, p.conics, scene.opacities[None], colors, scene.background[None]
        lists, options = (bins.ids, bins.offsets), (width, height, 8, GSPLAT_ALPHA_MAX, False)
        outputs = ops.blend(*splats, None, *lists, *options)
        upstream = [torch.randn_like(x) for x in outputs]
        v_means2d, v_conics = torch.randn_like(p.means2d), torch.randn_like(p.conics)
    calls: dict[str, Callable[[], object]] = {
        "project": lambda: ops.project(*shape, scene.opacities, *matrices, *planes),
        "bin": lambda: ops.bin_splats(*to_bin),
        "blend": lambda: ops.blend(*splats, None, *lists, *options),
        "blend_backward": lambda: blend_backward_op(*splats, *lists, *outputs, *upstream, *options, False),
        "project_backward": lambda: project_backward_op(*shape, scene.opacities, *matrices, *planes, p.radii, v_means2d, None, v_conics, None, False),
    }
    if degree is not None:
        calls |= {"harmonics": lambda: ops.harmonics(*sh), "harmonics_backward": lambda: harmonics_backward_op(*sh, v_colors, False)}
    return calls, int(seen.sum()), len(bins.ids)


def profile(scene: Scene) -> str:
    """The kernels of a forward and backward, ours and gsplat's, with their times."""
    leaves = [x.clone().requires_grad_() for x in scene[:5]]
    renderers: dict[str, Callable[[], Tensor]] = {
        "tsplat": lambda: tsplat.rasterize(*leaves, scene.camera, sh_degree=scene.sh_degree, background=scene.background,
                                           alpha_max=GSPLAT_ALPHA_MAX).image}
    if (peer := gsplat_renderer(scene, leaves)) is not None:
        renderers["gsplat"] = peer
    text = ""
    for name, render in renderers.items():
        for _ in range(3):
            torch.autograd.grad(render().sum(), leaves)
        with torch.profiler.profile() as p:
            for _ in range(5):
                torch.autograd.grad(render().sum(), leaves)
            torch.cuda.synchronize()
        rows = sorted((e for e in p.key_averages() if e.device_type.name == "CUDA"), key=lambda e: -e.self_device_time_total)
        text += f"{name}\n" + "".join(f"{e.self_device_time_total / 5e3:9.4f} ms {e.count // 5:3d}x {e.key[:110]}\n" for e in rows[:24])
    return text


def gsplat_renderer(scene: Scene, leaves: list[Tensor]) -> Callable[[], Tensor] | None:
    """gsplat's image of the leaves, if gsplat is there."""
    try:
        from gsplat import rasterization
    except ImportError:
        return None
    camera = scene.camera
    matrices = camera.viewmats[None], camera.Ks[None], camera.width, camera.height
    return lambda: rasterization(*leaves, *matrices, backgrounds=scene.background[None], sh_degree=scene.sh_degree, packed=False)[0][0]


def measure_gsplat(scene: Scene, leaves: list[Tensor], v_image: Tensor, ours: Callable[[], Tensor]) -> dict[str, Any]:
    """The peer on the same inputs, and whether its results are ours by its rule for the end of a pixel."""
    theirs = gsplat_renderer(scene, leaves)
    if theirs is None:
        return {"missing": "gsplat cannot be imported"}
    try:
        result: dict[str, Any] = whole(theirs, leaves, v_image)
        result["peak_MiB"] = peak_MiB(lambda: torch.autograd.grad(theirs(), leaves, v_image))
        with torch.no_grad():
            result["mean_image_difference"] = float((ours() - theirs()).abs().mean())
        pairs = zip(NAMES, *(torch.autograd.grad(render(), leaves, v_image) for render in (ours, theirs)), strict=True)
    except Exception as error:      # whatever it has against it: a number of channels that it was not compiled for, memory, no compiler
        torch.cuda.empty_cache()
        return {"failed": str(error).partition("\n")[0]}
    result["gradient_differences"] = {name: float((a - b).norm() / b.norm().clamp_min(1e-30)) for name, a, b in pairs}
    result["agrees"] = result["mean_image_difference"] <= IMAGE_AGREES and max(result["gradient_differences"].values()) <= GRADIENT_AGREES
    return result


def speed_goal(row: dict[str, Any]) -> int:
    """Times gsplat's speed of forward and backward."""
    return 8 if row["channels"] >= 128 else 3 if row["splats"] >= 1_000_000 else 1


def markdown(report: dict[str, Any]) -> str:
    """All rows, and which goals they meet."""
    tests = report["tests"]
    lines = [f"# {report['machine']}, {report['date']}, commit {report['commit']}", "",
             f"torch {report['torch']}, Triton {report['triton']}, gsplat {report['gsplat'] or 'missing'}, copy {report['copy_GBps']:.0f} GB/s. "
             "Medians of CUDA events, ms, the host's time included; peak memory in MiB. In a CUDA graph: forward and backward with a capacity.", "",
             f"Tests on this device: {tests['summary'] + ' (pytest ' + tests['arguments'] + ')' if tests else 'not run'}.", "",
             "| scene | channels | project | harmonics | bin | blend | its bwd | forward | backward | both | in a graph | MiB | gsplat's forward "
             "| backward | both | MiB | times as fast (goal) | memory, of gsplat's (goal) | results agree |", "| --- " * 19 + "|"]
    for row in report["rows"]:
        if "error" in row:
            lines.append(f"| {row['scene']} | {row['channels']} | {row['error']} |" + " |" * 16)
            continue
        ms, peer, graph = row["ms"], row["gsplat"], row["graph_ms"].get("both")
        columns = "project", "harmonics", "bin", "blend", "blend_backward", "forward", "backward", "both"
        ours = [f"{ms[k][0]:.2f}" if k in ms else "" for k in columns]
        theirs = [peer.get("failed", "missing"), *[""] * 6]
        if "both" in peer:
            speed, memory = peer["both"][0] / ms["both"][0], row["peak_MiB"] / peer["peak_MiB"]
            theirs = [*(f"{peer[k][0]:.2f}" for k in ("forward", "backward", "both")), f"{peer['peak_MiB']:.0f}",
                      f"{speed:.2f} ({speed_goal(row)}: {'met' if speed >= speed_goal(row) else 'missed'})",
                      f"{memory:.2f} ({MEMORY_GOAL}: {'met' if memory <= MEMORY_GOAL else 'missed'})", "yes" if peer["agrees"] else "NO"]
        lines.append("| " + " | ".join([row["scene"], str(row["channels"]), *ours, "" if graph is None else f"{graph:.2f}",
                                        f"{row['peak_MiB']:.0f}", *theirs]) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
