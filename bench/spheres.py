"""Speed and memory of `tsplat.render_spheres` on the set-ups of Pulsar's Table 2 and Figure 3, on a CPU or a GPU.

    python bench/spheres.py                   # Table 2, Figure 3 up to 1M spheres; JSON, markdown and the figure in bench/results
    python bench/spheres.py --large           # only 2M and 5M spheres, and 4.4M at 4K (12 GB of memory); joins the earlier results
    python bench/spheres.py --quick --out .   # a first look

The paper does not publish its scenes. Here the spheres lie on the surface of a unit sphere, at random, which fills nine tenths of the
image's height. In Table 2 their numbers and the image's size are the paper's; in Figure 3 their radius is in proportion to 1/sqrt(number), so
that a ray hits as many of them (50 in the mean) in each scene; and gamma is 1e-2, near and far just enclose the object.

Forward: no gradients are wanted. Backward: to positions, features, radii and opacities, of all hits. Both: end to end. Median wall time, and
CPU time of all threads, which a busy machine does not change as much; CUDA events on a GPU, the host's time included. Hits: pairs of sphere
and tile (8x8 pixels) in the lists. Pairs: of sphere and pixel in these, up to the end of each tile. Memory: the peak beyond that before the
first call, of a process for each row; on a CPU, resident.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from output import add_json, environment, peak_memory, print_json, printing
from torch import Tensor

import tsplat
from tsplat import ops
from tsplat.rasterize import TILE

ROOT = Path(__file__).resolve().parents[1]
GAMMA = 1e-2
FOV = 40.0
DISTANCE = 1 / math.sin(math.atan(0.9 * math.tan(math.radians(FOV / 2))))
"""Of camera and centre: tangents to the unit sphere reach nine tenths of the image's height."""
MARGIN = 0.1                # of near and far
GOAL_S: dict[str, dict[int, dict[str, float]]] = {
    "cpu": {15_099: {"forward": 1.3, "backward": 2.6}, 233_872: {"forward": 10.0}},
    "cuda": {15_099: {"both": 1e-3}, 233_872: {"both": 2e-3}, 1_000_000: {"both": 5e-3}}}
"""By number of spheres, float32: 2 cores of a CPU; one H100."""

BUSY = "The machine was busy: only the CPU times, of all threads, tell something; pairs/s and the figure are of these. "


@dataclass(frozen=True)
class Setup:
    """One row of the results."""

    part: str
    spheres: int
    radius: float
    width: int
    height: int
    tolerance: float = 1e-4


def of_figure(spheres: int, width: int = 1024, height: int = 1024) -> Setup:
    """As many hits of each ray as in the smaller scene of Table 2."""
    part = "Figure 3" if width == height else "4K"
    return Setup(part, spheres, 0.06 * math.sqrt(15_099 / spheres), width, height)


TABLE = [Setup("Table 2", n, radius, 1000, 1000, tolerance) for n, radius in ((15_099, 0.06), (233_872, 0.02)) for tolerance in (1e-4, 0.0)]
FIGURE = [of_figure(n) for n in (10_000, 30_000, 100_000, 300_000, 1_000_000)]
LARGE = [of_figure(2_000_000), of_figure(5_000_000), of_figure(4_400_000, 3840, 2160)]


@dataclass(frozen=True)
class Scene:
    """The arguments of `render_spheres` that stay."""

    leaves: tuple[Tensor, Tensor, Tensor, Tensor]           # positions, features, radii, opacities
    camera: tsplat.Camera
    tolerance: float

    @property
    def planes(self) -> tuple[float, float]:
        """Near and far."""
        return DISTANCE - 1 - MARGIN, DISTANCE + 1 + MARGIN

    def render(self) -> Tensor:
        """The image `[H, W, 3]`."""
        positions, features, radii, opacities = self.leaves
        near, far = self.planes
        return tsplat.render_spheres(positions, features, radii, self.camera, opacities=opacities, gamma=GAMMA, near=near, far=far,
                                     percent_allowed_difference=self.tolerance).image


def surface(setup: Setup, device: str) -> Scene:
    """Spheres at random on the unit sphere, opaque, seen from `DISTANCE`."""
    g = torch.Generator().manual_seed(0)
    n = setup.spheres
    positions = torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=1)
    leaves = positions, torch.rand(n, 3, generator=g), torch.full((n,), setup.radius), torch.ones(n)
    fov = 2 * math.degrees(math.atan(math.tan(math.radians(FOV / 2)) * setup.width / setup.height))
    camera = tsplat.Camera.look_at((0, 0, -DISTANCE), (0, 0, 0), width=setup.width, height=setup.height, fov=fov)
    p, f, r, o = (x.to(device).requires_grad_() for x in leaves)
    return Scene((p, f, r, o), camera.to(device), setup.tolerance)


@torch.no_grad()
def count(scene: Scene) -> dict[str, int]:
    """Hits, and pairs that are blended."""
    positions, features, radii, opacities = scene.leaves
    camera, (near, far) = scene.camera, scene.planes
    viewmats, Ks, size = camera.viewmats[None], camera.Ks[None], (camera.width, camera.height)
    centers = (positions @ viewmats[0, :3, :3].T + viewmats[0, :3, 3])[None]
    o = ops.outlines(centers, radii[None], Ks, *size, camera.model, near, far)
    bins = ops.bin_splats(o.means2d, o.radii, o.conics, o.opacities, o.depths, *size, TILE)
    images = ops.blend_spheres(centers, radii[None], opacities[None], features[None], features.new_ones(1, 3), features.new_tensor(GAMMA), Ks,
                               *bins, None, *size, TILE, camera.model, near, far, 1e-6, False, False, scene.tolerance)
    return {"visible": int((o.radii[..., 0] > 0).sum()), "hits": len(bins.ids), "pairs": int(images.used.sum()) * TILE**2}


def seconds(run: Callable[[], object], times: int, device: str) -> dict[str, float]:
    """Median wall and CPU seconds of a call; for a GPU, of CUDA events. The first call of the process does not count."""
    samples = []
    for _ in range(times):
        if device == "cuda":
            start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            start.record()
            run()
            end.record()
            torch.cuda.synchronize()
            samples.append((start.elapsed_time(end) / 1e3, 0.0))
        else:
            wall, cpu = time.perf_counter(), time.process_time()
            run()
            samples.append((time.perf_counter() - wall, time.process_time() - cpu))
    return {name: statistics.median(values) for name, values in zip(("wall", "cpu"), zip(*samples, strict=True), strict=True)}


def peak_bytes(device: str) -> int:
    """Of this process so far."""
    if device == "cuda":
        return torch.cuda.max_memory_allocated()
    return peak_memory()


def measure(setup: Setup, device: str, threads: int, times: int) -> dict[str, Any]:
    """One row; run in a process of its own."""
    torch.set_num_threads(threads)
    render = surface(Setup("warm-up", 100, 0.1, 64, 64), device).render                     # loads libraries, compiles kernels
    torch.autograd.grad(render().sum(), surface(Setup("warm-up", 100, 0.1, 64, 64), device).leaves, allow_unused=True)
    scene = surface(setup, device)
    v_image = torch.randn(setup.height, setup.width, 3, generator=torch.Generator().manual_seed(0)).to(device)
    before = peak_bytes(device)

    def forward() -> None:
        with torch.no_grad():
            scene.render()

    row: dict[str, Any] = asdict(setup)
    row["forward"] = seconds(forward, times, device)
    row["forward_MiB"] = (peak_bytes(device) - before) / 2**20
    image = scene.render()
    row["backward"] = seconds(partial(torch.autograd.grad, image, scene.leaves, v_image, retain_graph=True), times, device)
    del image
    row["both"] = seconds(lambda: torch.autograd.grad(scene.render(), scene.leaves, v_image), times, device)
    row["both_MiB"] = (peak_bytes(device) - before) / 2**20
    return row | count(scene)


def in_own_process(setup: Setup, device: str, threads: int, times: int) -> dict[str, Any]:
    """`measure`, whose peak of memory is then that of this row alone."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(measure, setup, device, threads, times).result()


def draw(rows: list[dict[str, Any]], clock: str, title: str, path: Path) -> None:
    """Time over number of spheres, log-log (Figure 3). clock: `"wall"` or `"cpu"`."""
    from matplotlib.figure import Figure

    rows = sorted((row for row in rows if row["part"] == "Figure 3"), key=lambda row: row["spheres"])
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.subplots()
    spheres = [row["spheres"] for row in rows]
    for name, marker in (("forward", "o"), ("backward", "s")):
        axes.loglog(spheres, [1e3 * row[name][clock] for row in rows], marker=marker, label=name)
    axes.set(xlabel="spheres", ylabel="CPU time of all threads, ms" if clock == "cpu" else "ms", title=title)
    decades = [math.log10(1e3 * row[name][clock]) for row in rows for name in ("forward", "backward")]
    axes.set_ylim(10 ** math.floor(min(decades)), 10 ** math.ceil(max(decades)))
    axes.grid(True, which="both", alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=100)


def goals(row: dict[str, Any], device: str) -> str:
    """Of forward, backward or both, in ms, and whether they are met."""
    texts = []
    for name, limit in GOAL_S[device].get(row["spheres"], {}).items():
        took = row.get(name)
        texts.append(f"{name} {1e3 * limit:g}" + ("" if took is None else f": {'met' if took['wall'] <= limit else 'missed'}"))
    return ", ".join(texts) if row["width"] == row["height"] else ""


def markdown(report: dict[str, Any], figure: str | None) -> str:
    """The report as a table."""
    gpu, clock = report["device"] != "cpu", report["clock"]
    lines = [f"# Spheres: {report['machine']}, {report['date']}, commit {report['commit']}", "",
             f"`{report['command']}`, torch {report['torch']}, float32, {'CUDA events' if gpu else str(report['threads']) + ' threads'}. "
             f"{BUSY if clock == 'cpu' else ''}What is measured stands at the head of `bench/spheres.py`.", "",
             "| set-up | spheres | radius | size | tolerance | hits (M) | pairs (M) | repetitions | fwd ms | bwd ms | both ms | CPU ms, fwd / bwd "
             "| goals, wall ms | fwd M pairs/s | bwd M pairs/s | fwd MiB | fwd+bwd MiB |", "| --- " * 17 + "|"]
    for row in report["rows"]:
        forward, backward = row["forward"], row["backward"]
        cpu = "" if gpu else f"{1e3 * forward['cpu']:.0f} / {1e3 * backward['cpu']:.0f}"
        fwd, bwd, both = (f"{1e3 * row[name]['wall']:.{2 if gpu else 0}f}" if name in row else "" for name in ("forward", "backward", "both"))
        lines.append(f"| {row['part']} | {row['spheres']:,} | {row['radius']:.4g} | {row['width']}x{row['height']} | {row['tolerance']:g} | "
                     f"{row['hits'] / 1e6:.2f} | {row['pairs'] / 1e6:.0f} | {row['times']} | {fwd} | {bwd} | {both} | {cpu} | "
                     f"{goals(row, report['device'])} | {row['pairs'] / forward[clock] / 1e6:.0f} | {row['pairs'] / backward[clock] / 1e6:.0f} | "
                     f"{row['forward_MiB']:.0f} | {row['both_MiB']:.0f} |")
    return "\n".join([*lines, *(["", f"![time over number of spheres]({figure})"] if figure else [])]) + "\n"


def main() -> None:
    """Measure, then write JSON, markdown and the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--quick", action="store_true", help="Table 2 with the default tolerance, and 10k and 100k spheres")
    size.add_argument("--large", action="store_true", help="only what needs much memory, added to the JSON of an earlier run of this commit")
    parser.add_argument("--times", type=int, help="repetitions (default 3; 20 on a GPU; 1 with --large on a CPU)")
    parser.add_argument("--busy", action="store_true", help="the machine is busy: pairs/s and the figure are to be of CPU time (CPU only)")
    parser.add_argument("--no-figure", action="store_true", help="draw none (matplotlib is not needed then)")
    parser.add_argument("--out", type=Path, default=ROOT / "bench" / "results", help="folder to write to")
    add_json(parser)
    args = parser.parse_args()
    if args.device == "cuda" and not torch.cuda.is_available():
        parser.error("--device cuda: torch.cuda.is_available() is False; use --device cpu")
    if not args.no_figure:
        try:
            import matplotlib  # noqa: F401
        except ImportError:
            parser.error("matplotlib, which draws the figure, cannot be imported: pip install 'tsplat[bench]', or give --no-figure")
    with printing(args.json):
        report = measure_all(args)
    if args.json:
        print_json(report)


def measure_all(args: argparse.Namespace) -> dict[str, Any]:
    """The report, which is also written."""
    args.out.mkdir(parents=True, exist_ok=True)
    times = args.times or (20 if args.device == "cuda" else 1 if args.large else 3)
    report = environment(args.device) | {"threads": args.threads}
    report["clock"] = "cpu" if args.busy and args.device == "cpu" else "wall"
    report["rows"] = []
    name = "cpu" if args.device == "cpu" else report["machine"].removeprefix("NVIDIA ").lower().replace(" ", "-")
    stem = args.out / f"{report['date']}-spheres-{name}"
    if args.large and stem.with_suffix(".json").is_file():
        earlier = json.loads(stem.with_suffix(".json").read_text())
        if earlier["commit"] == report["commit"]:
            report["rows"], report["command"] = earlier["rows"], f"{earlier['command']}` and `{report['command']}"
    setups = LARGE if args.large else [TABLE[0], TABLE[2], FIGURE[0], FIGURE[2]] if args.quick else [*TABLE, *FIGURE]
    measured = {(setup.part, setup.spheres) for setup in setups}
    report["rows"] = [row for row in report["rows"] if (row["part"], row["spheres"]) not in measured]
    figure = None if args.no_figure else stem.with_suffix(".png")
    for setup in setups:
        report["rows"].append(in_own_process(setup, args.device, args.threads, times) | {"times": times})
        print(json.dumps(report["rows"][-1]), flush=True)
        stem.with_suffix(".json").write_text(json.dumps(report, indent=1) + "\n")         # after each, should the next not end
        stem.with_suffix(".md").write_text(markdown(report, figure and figure.name))
    if figure:
        draw(report["rows"], report["clock"], f"{report['machine']}, 1024x1024, gamma {GAMMA:g}", figure)
    print(markdown(report, figure and figure.name))
    return report


if __name__ == "__main__":
    main()
