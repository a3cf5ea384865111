"""Everything that only a GPU can tell, in one command.

    python bench/gpu.py --out bench/results            # tests, timings, gsplat on the same inputs if it is installed; JSON and markdown
    python bench/gpu.py --quick --no-tests             # a first look

(a) runs the test suite on CUDA; (b) times each stage and the whole with CUDA events on fixed scenes; (c) times gsplat, if it can be
imported (a wheel that compiles itself with nvcc and ninja at first), on the very same inputs in the same process, and compares images and
gradients; (d) measures the card's copy bandwidth and puts each stage beside the floor that memory sets, with peak memory and the effect
of CUDA graphs.
Without a GPU it says so and exits with 2.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import statistics
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from output import add_json, print_json, printing
from scenes import Scene, random_scene
from torch import Tensor

import tsplat
from tsplat import ops
from tsplat.ops.blending import blend_backward_op
from tsplat.ops.projection import project_backward_op

ROOT = Path(__file__).resolve().parents[1]
SIZES = {"1080p": (1920, 1080), "4K": (3840, 2160)}
GSPLAT_ALPHA_MAX = 0.999
NAMES = ("means", "quats", "scales", "opacities", "colors")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "bench" / "results", help="folder for gpu_<card>.json and .md")
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("TSPLAT_DATA", ROOT.parent / "shared")),
                        help="folder with data/garden and data/splats; scenes that are not there are left out, and named")
    parser.add_argument("--quick", action="store_true", help="1080p, up to 1M splats, 3 channels only")
    parser.add_argument("--no-tests", action="store_true", help="leave out the test suite")
    parser.add_argument("--profile", action="store_true", help="only print the kernels of a forward and backward, with their times")
    add_json(parser)
    args = parser.parse_args()
    if not torch.cuda.is_available():
        print("bench/gpu.py: no GPU: torch.cuda.is_available() is False. Run it where there is one; for a CPU there is bench/cpu.py",
              file=sys.stderr)
        return 2
    if args.profile:
        for name, scene, channels in fixed_scenes(args.data, True):
            print(f"{name}, {channels} channels\n{profile(to(scene, torch.device('cuda')))}", flush=True)
        return 0
    with printing(args.json):
        report = measure_all(args)
    if args.json:
        print_json(report)
    return 1 if report.get("tests") else 0


def measure_all(args: argparse.Namespace) -> dict[str, Any]:
    """The report, which is also written."""
    device = torch.device("cuda")
    report: dict[str, Any] = {**environment(), "copy_GBps": copy_bandwidth(device)}
    print(json.dumps(report, indent=1))
    if not args.no_tests:
        report["tests"] = subprocess.run([sys.executable, "-m", "pytest", "-q"], cwd=ROOT, stdout=sys.stdout).returncode    # where print goes
    report["rows"] = []
    for name, scene, channels in fixed_scenes(args.data, args.quick):
        row = {"scene": name, "channels": channels, "splats": len(scene.means), "width": scene.camera.width, "height": scene.camera.height}
        try:
            row |= measure(to(scene, device), report["copy_GBps"])
        except torch.cuda.OutOfMemoryError:
            row["error"] = "out of memory"
        report["rows"].append(row)
        print(json.dumps(row), flush=True)
        torch.cuda.empty_cache()
    args.out.mkdir(parents=True, exist_ok=True)
    stem = args.out / f"gpu_{torch.cuda.get_device_name().replace(' ', '_')}"
    stem.with_suffix(".json").write_text(json.dumps(report, indent=1) + "\n")
    stem.with_suffix(".md").write_text(markdown(report))
    print(markdown(report))
    return report


def environment() -> dict[str, Any]:
    """Device, versions, commit and date."""
    import triton

    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True).stdout.strip()
    return {"device": torch.cuda.get_device_name(), "torch": torch.__version__, "triton": triton.__version__, "commit": commit,
            "date": datetime.date.today().isoformat()}


def fixed_scenes(data: Path, quick: bool) -> list[tuple[str, Scene, int]]:
    """Name, scene (on the CPU) and channels of every row."""
    scenes = []
    for n in (100_000, 1_000_000) if quick else (100_000, 1_000_000, 5_000_000):
        for size, (width, height) in list(SIZES.items())[:1 if quick else None]:
            for channels in (3,) if quick or n > 1_000_000 else (3, 32, 128):
                scene = random_scene(n, width, height)
                g = torch.Generator().manual_seed(0)
                scene = scene._replace(colors=torch.rand(n, channels, generator=g), background=torch.rand(channels, generator=g))
                scenes.append((f"random {n // 1000}k, {size}", scene, channels))
    for path in sorted((data / "data" / "splats").glob("*.ply")):
        if ".compressed" not in path.name:
            scenes.append((path.stem, trained(path), 3))
    garden = data / "data" / "garden" / "test_garden.npz"
    if garden.exists():
        scenes.append(("garden points", garden_points(garden), 3))
    else:
        print(f"no {garden}: left out")
    return scenes


def trained(path: Path) -> Scene:
    """A trained scene, seen from in front of it, with the colours of SH degree 0."""
    g = tsplat.Gaussians.load(path)
    with torch.no_grad():
        centre = g.means.median(0).values
        reach = float((g.means - centre).norm(dim=1).quantile(0.9))
        eye = centre + torch.tensor([0.5, -0.4, -1.0]) * 2 * reach
        camera = tsplat.Camera.look_at(eye, centre, width=1920, height=1080)
        colors = (g.sh[:, 0] * 0.28209479177387814 + 0.5).clamp(0, 1)
        return Scene(g.means.detach(), g.quats.detach(), g.scales.detach(), g.opacities.detach(), colors, torch.ones(3), camera)


def garden_points(path: Path) -> Scene:
    """Coloured points of a photographed garden as small random Gaussians."""
    d = np.load(path)
    means = torch.from_numpy(d["means3d"])
    inside = (means.abs() <= 2).all(1)
    means, n, g = means[inside], int(inside.sum()), torch.Generator().manual_seed(0)
    K = torch.from_numpy(d["Ks"][0]) * torch.tensor([[1920 / 648], [1080 / 420], [1.0]])
    return Scene(means, torch.randn(n, 4, generator=g), torch.rand(n, 3, generator=g) * 0.02 + 1e-4, torch.rand(n, generator=g),
                 torch.from_numpy(d["colors"])[inside].float() / 255, torch.zeros(3),
                 tsplat.Camera(torch.from_numpy(d["viewmats"][0]), K, 1920, 1080))


def to(scene: Scene, device: torch.device) -> Scene:
    return Scene(*(x.to(device) for x in scene[:6]), scene.camera.to(device))


def copy_bandwidth(device: torch.device) -> float:
    """GB/s, read and written, of a copy of 1 GiB."""
    a = torch.empty(1 << 28, device=device)
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


def measure(scene: Scene, copy_GBps: float) -> dict[str, Any]:
    """Times in ms, memory in MiB, share of the floor that memory traffic sets, and gsplat beside it."""
    camera, width, height = scene.camera, scene.camera.width, scene.camera.height
    leaves = [x.clone().requires_grad_() for x in scene[:5]]
    v_image = torch.randn(height, width, scene.colors.shape[1], device=scene.means.device)

    def forward() -> Tensor:
        return tsplat.rasterize(*leaves, camera, background=scene.background, alpha_max=GSPLAT_ALPHA_MAX).image

    def both() -> tuple[Tensor, ...]:
        return torch.autograd.grad(forward(), leaves, v_image)

    stages, visible, hits = stage_calls(scene)
    with torch.no_grad():
        ms = {name: milliseconds(call) for name, call in stages.items()}
        ms["forward"] = milliseconds(forward)
    ms["both"] = milliseconds(both)
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    both()
    N = len(scene.means)
    floors = {"project": 4 * (14 * N + 11 * visible), "bin": 40 * visible + 4 * hits,
              "blend": 52 * hits + 4 * (scene.colors.shape[1] + 1) * width * height}
    row: dict[str, Any] = {"ms": ms, "peak_MiB": (torch.cuda.max_memory_allocated() - before) / 2**20, "visible": visible, "hits": hits,
                           "share_of_memory_floor": {k: v / copy_GBps / 1e6 / ms[k][0] for k, v in floors.items()}}
    row["graph_ms"] = {name: graph_time(stages[name]) for name in ("project", "blend", "blend_backward")}
    row["gsplat"] = measure_gsplat(scene, leaves, v_image, forward().detach(), both())
    return row


def stage_calls(scene: Scene) -> tuple[dict[str, Callable[[], object]], int, int]:
    """Each stage as a call on fixed inputs, and the numbers of visible splats and of hits."""
    camera, width, height = scene.camera, scene.camera.width, scene.camera.height
    shape = scene.means, scene.quats, scene.scales, None
    matrices, planes = (camera.viewmats[None], camera.Ks[None], width, height, camera.model), (camera.near, camera.far, 0.3, False)
    with torch.no_grad():
        p = ops.project(*shape, scene.opacities, *matrices, *planes)
        to_bin = p.means2d, p.radii, p.conics, scene.opacities[None], p.depths, width, height, 8
        bins = ops.bin_splats(*to_bin)
        splats = p.means2d, p.conics, scene.opacities[None], scene.colors[None], scene.background[None]
        lists, options = (bins.ids, bins.offsets), (width, height, 8, GSPLAT_ALPHA_MAX, False)
        outputs = ops.blend(*splats, None, *lists, *options)
        upstream = [torch.randn_like(x) for x in outputs]
        v = [torch.randn_like(x) for x in (p.means2d, p.depths, p.conics, p.compensations)]
    calls: dict[str, Callable[[], object]] = {
        "project": lambda: ops.project(*shape, scene.opacities, *matrices, *planes),
        "bin": lambda: ops.bin_splats(*to_bin),
        "blend": lambda: ops.blend(*splats, None, *lists, *options),
        "blend_backward": lambda: blend_backward_op(*splats, *lists, *outputs, *upstream, *options, False),
        "project_backward": lambda: project_backward_op(*shape, scene.opacities, *matrices, *planes, p.radii, v[0], None, v[2], None, False),
    }
    return calls, int((p.radii > 0).all(-1).sum()), len(bins.ids)


def profile(scene: Scene) -> str:
    """The kernels of a forward and backward, ours and gsplat's, with their times."""
    leaves = [x.clone().requires_grad_() for x in scene[:5]]
    renderers: dict[str, Callable[[], Tensor]] = {
        "tsplat": lambda: tsplat.rasterize(*leaves, scene.camera, background=scene.background, alpha_max=GSPLAT_ALPHA_MAX).image}
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


def graph_time(run: Callable[[], object]) -> float:
    """The same launches replayed from a CUDA graph."""
    with torch.no_grad():
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            run()
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            run()
        return milliseconds(graph.replay)[0]


def gsplat_renderer(scene: Scene, leaves: list[Tensor]) -> Callable[[], Tensor] | None:
    """gsplat's image of the leaves, if gsplat is there."""
    try:
        from gsplat import rasterization
    except ImportError:
        return None
    camera = scene.camera
    matrices = camera.viewmats[None], camera.Ks[None], camera.width, camera.height
    return lambda: rasterization(*leaves, *matrices, backgrounds=scene.background[None], packed=False)[0][0]


def measure_gsplat(scene: Scene, leaves: list[Tensor], v_image: Tensor, image: Tensor, gradients: tuple[Tensor, ...]) -> dict[str, Any]:
    """The peer on the same inputs, and how its results differ from ours."""
    forward = gsplat_renderer(scene, leaves)
    if forward is None:
        return {"missing": "gsplat cannot be imported"}

    def both() -> tuple[Tensor, ...]:
        return torch.autograd.grad(forward(), leaves, v_image)

    try:
        with torch.no_grad():
            result: dict[str, Any] = {"forward": milliseconds(forward)}
        result["both"] = milliseconds(both)
    except (RuntimeError, AssertionError, ValueError) as error:      # e.g. a number of channels that it was not compiled for
        return {"failed": str(error).partition("\n")[0]}
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    theirs = both()
    result["peak_MiB"] = (torch.cuda.max_memory_allocated() - before) / 2**20
    result["mean_image_difference"] = float((forward().detach() - image).abs().mean())
    result["gradient_differences"] = {name: float((a - b).norm() / b.norm()) for name, a, b in zip(NAMES, gradients, theirs, strict=True)}
    return result


def markdown(report: dict[str, Any]) -> str:
    lines = [f"# {report['device']}, {report['date']}, commit {report['commit']}", "",
             f"torch {report['torch']}, Triton {report['triton']}, copy {report['copy_GBps']:.0f} GB/s. Medians of CUDA events, ms.", "",
             "| scene | channels | project | bin | blend | forward | fwd+bwd | MiB | gsplat fwd | fwd+bwd | MiB | times as fast |",
             "| --- " * 12 + "|"]
    for row in report["rows"]:
        if "error" in row:
            lines.append(f"| {row['scene']} | {row['channels']} | {row['error']} |" + " |" * 9)
            continue
        ms, peer = row["ms"], row["gsplat"]
        ours = [f"{ms[k][0]:.2f}" for k in ("project", "bin", "blend", "forward", "both")]
        theirs = ["-"] * 4
        if "both" in peer:
            ratio = peer["both"][0] / ms["both"][0]
            theirs = [f"{peer['forward'][0]:.2f}", f"{peer['both'][0]:.2f}", f"{peer['peak_MiB']:.0f}", f"{ratio:.2f}"]
        lines.append("| " + " | ".join([row["scene"], str(row["channels"]), *ours, f"{row['peak_MiB']:.0f}", *theirs]) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
