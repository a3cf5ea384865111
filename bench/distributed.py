"""`tsplat.rasterize(..., group=...)`: bytes sent per step, scaling on the cores of this machine, and a model of what GPUs would do.

    python bench/distributed.py               # all tables; --quick: small scenes; --json: as a document
    python bench/distributed.py --model       # the model alone, which needs no other process

**Bytes.** A step, forward and backward, sends between ranks

    2 v (7 + D) 4 + o,    o = W (W - 1) (2 25 4 C + 8 C + 8 values that are compared)

bytes in all, where v is the number of (camera, visible splat) with the splat on another rank than the camera, each a record of
means2d (2), conic (3), opacity, depth and D channels in float32 (and 2 more with `absgrad`) and then its gradient, and o is for cameras and their
gradients, counts, and what the ranks compare. Measured are the bytes that the collectives are given for other ranks, and what goes over the loopback
device, with TCP's headers and whatever else uses it.

**Scaling.** Of a row of blocks of 50,000 splats with two cameras of 640x360 each. Splats are dealt out to ranks one by one, so that
(W - 1) / W of what a camera sees comes from elsewhere. Strong: two blocks on 1 and on 2 processes. Weak: one block on 1 process and two on 2,
of one thread each. Given are the shortest of 7 steps; CPU time of all processes (median), which other work on the machine changes less; and the
shortest time in collectives, with waiting for the other rank, in steps that are counted apart. This says what the exchange costs beside rendering
on a CPU, where rendering is slow and memory is shared; it says nothing of links.

**Memory.** Of a row of 32 such blocks, of 40,000 splats each, dealt out one by one, in 4 and in 16 cameras of 320x180, one per rank: the peak of
the resident memory in a step, above what there is before it, on the rank with the most, divided by own splats and cameras. Gradients of the own
splats and the drawing of the own image are in it. (Linux only, for `VmHWM`; memory is given back to the system at once.)

**Model.** One camera of 1920x1080 per rank, N splats, W ranks, V splats visible per camera (a camera in a city sees a part that does not
grow with the city), SH of degree 3, float32. Per rank and step, without any overlap, in ms, with N and V in millions:

    frusta         0.004 N      each rank asks for N / W splats in W cameras: a byte written and read twice, 80 operations
    host           0.1 W        launches, forward and backward, of projection for each camera; an assumption
    pairs          0.45 V       projection [1], and picking rows and adding up their gradients, 1100 bytes each at 2983 GB/s [1]
    colours        0.26 V + 0.16 N / W    SH coefficients: 192 bytes, read twice and their gradient added; gradients are made dense
    exchange       0.27 V       picking, packing and spreading: 20 passes over records of 40 bytes
    link           80 V (1 / 360 (w - 1) / W + 1 / 40 (W - w) / W)    w = min(W, 8) GPUs in a node; both directions of the step [2]
    latency        6 (0.03 + 0.001 (W - 1))     header, cameras, counts, records and 2 gradients; an assumption
    drawing        2.14 V P     binning and blending, forward and backward: all other kernels of [1]; P of 1 for 1920x1080, else in proportion
    Adam           0.55 N / W   59 floats, 7 times read or written

One rank alone has no frusta, pairs, exchange and links, and projects all: 0.12 N.

[1] bench/results/2026-11-22-h100.md: kernels of 1M random splats, all visible, at 1920x1080, and the copy rate. [2] NVLink 4: 900 GB/s per H100,
450 in each direction; ConnectX-7: 400 Gb/s per GPU, 50 GB/s (NVIDIA's data sheets of H100 and DGX H100); 80 % of both.

Memory of a rank, in bytes: 59 x 4 x 4 N / W (parameter, gradient, two moments), N (one for each splat and camera, for a moment), 8 N where density
control has a probe, 1000 V of rows and drawing; and 24 N instead of 9 N, for a moment, where it acts (scores of all splats, sorted). With V = 1M,
40M splats on 16 ranks are 3.7 GB, and 1B on 64 are 24.8 GB (40 where density control acts), of which 14.8 are the splats. Before pairs were
chosen, all N were projected, 120 N: 135 GB, which an H100 does not have, and 136 ms, where it is 27 now. From 256 ranks on, the launches for each
camera are most of a step, and on 64 more than projecting all 40M took (4.8 ms): one launch for the pairs of all cameras is what would come next.

**The published points**, beside the model for the same numbers of splats, ranks and pixels, with at least one photo per rank and V of 4M, as V is
not published. Ours is a model of kernels on H100s, without photos to load, loss, densification and waiting for the slowest; theirs are runs.

| who | splats | GPUs | photos a step | pixels | published | model |
| --- | --- | --- | --- | --- | --- | --- |
| Grendel, bicycle [3] | 6M | 1 | 1 | 4946x3286 | 5.27 photos/s | 14 photos/s |
| Grendel, bicycle [3] | 6M | 4 | 1 | 4946x3286 | 16.7 photos/s | 55 photos/s |
| Grendel, Rubble [4] | 40.4M | 4 | 1 | 4591x3436 | 5.55 photos/s | 52 photos/s |
| Grendel, Rubble [4] | 40.4M | 4 | 4 | 4591x3436 | 7.28 photos/s | 52 photos/s |
| Grendel, Rubble [4] | 40.4M | 16 | 32 | 4591x3436 | 25.18 photos/s | 210 photos/s |
| Grendel, Rubble [4] | 40.4M | 32 | 64 | 4591x3436 | 38.03 photos/s | 404 photos/s |

[3] Grendel (Zhao et al. 2024, arXiv 2406.18533), README of its repository, "Significantly Speed up and Reduce per-GPU memory usage on Mip360 at 4K
Resolution": bicycle, 50,000 photos in 2 h 38 min on one A100 of 40 GB (37.2 GB used), in 50 min on 4 (10.4 GB each). N is not given: 6M, as 3DGS
makes of bicycle. [4] The same, Table 7: Rubble, A100s of 40 GB, 4 per node. These four we have from a summary of the paper, not from the table
itself; what else that summary gives agrees with abstract and README. N of the table is not in it: 40.4M are taken, the abstract's for 16 GPUs (one
held 11.2M).

That theirs take 3 to 11 times as long is no surprise: an A100 has half the memory bandwidth of an H100; blending as 3DGS does takes 3 (forward) to 5
times (backward) as long as these kernels ([1], against gsplat); 16 Mpixel of a photo are loaded, and SSIM is taken of them, which the model does not
have; links are slower; and an aerial view may see more than 4M. From 4 GPUs with 4 photos to 32 with 64, Grendel gains 5.2, the model 7.8, of 8.
Grendel divides images into blocks of pixels among ranks, which balances views of different cost, and lets all ranks draw one photo; here an image is
drawn by one rank.

RetinaGS (Li et al. 2024, arXiv 2406.11836, abstract and Figure 1): above 1B splats of MatrixCity on 64 GPUs, of 140,000 photos (its project page);
its README has 217.3M of the aerial part, at 1920x1080. We found no time of a step or of a training that its authors have published, so that the 1B
rows of the model stand alone. (Others measured over 3800 s for a training on 128 A100s, of small scenes, and found communication of Grendel to rise
from 64 on: Sewell et al. 2026, doi 10.1145/3820022, by its project page.) RetinaGS gives each rank a convex part of space, and moves partial images:
about 16 bytes x pixels x ranks that a view meets, rather than 80 bytes x V. For V = 1M and 2 Mpixel that is 33 MB per rank met against 80 MB in all:
the fewer for views that meet one or two parts.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from output import add_json, environment, memory, peak_memory, print_json, printing
from scenes import random_scene
from torch.utils._python_dispatch import TorchDispatchMode

import tsplat
from tsplat.camera import Camera

PUBLISHED = (("Grendel, bicycle [3]", 6, 1, 1, (4946, 3286), 5.27), ("Grendel, bicycle [3]", 6, 4, 1, (4946, 3286), 16.7),
             ("Grendel, Rubble [4]", 40.4, 4, 1, (4591, 3436), 5.55), ("Grendel, Rubble [4]", 40.4, 4, 4, (4591, 3436), 7.28),
             ("Grendel, Rubble [4]", 40.4, 16, 32, (4591, 3436), 25.18), ("Grendel, Rubble [4]", 40.4, 32, 64, (4591, 3436), 38.03))
"""Who, millions of splats, GPUs, photos a step, their size, photos per second: see above."""
COMPARED = 14
"""Values that the ranks compare."""
CHANNELS = 3
CORES = 2
"""More processes than these are not timed."""


class Collectives(TorchDispatchMode):
    """Bytes given to all-to-alls for other ranks, and seconds in them, with waiting for others."""

    def __init__(self, rank: int) -> None:
        super().__init__()
        self.rank, self.bytes, self.seconds = rank, 0, 0.0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run the function and count."""
        start = time.perf_counter()
        result = function(*args, **(kwargs or {}))
        name = function.name()
        if "all_to_all_single" in name or "wait_tensor" in name:
            self.seconds += time.perf_counter() - start
        if "all_to_all_single" in name:
            rows, _, send = args[:3]
            self.bytes += (sum(send) - send[self.rank]) * rows.element_size() * (rows[0].numel() if len(rows) else 0)
        return result


def loopback() -> int:
    """Bytes that this machine has sent to itself over TCP/IP."""
    lines = Path("/proc/net/dev").read_text().splitlines()
    return next(int(line.split()[9]) for line in lines if line.strip().startswith("lo:"))


def city(blocks: int, splats: int, size: tuple[int, int]) -> tuple[list[torch.Tensor], Camera]:
    """Blocks side by side, as wide as an image at the middle depth, each of so many splats and with two cameras."""
    scenes = [random_scene(splats, *size, seed=block) for block in range(blocks)]
    for block, scene in enumerate(scenes):
        scene.means[:, 0] += 6 * block
    viewmats = torch.eye(4).repeat(2 * blocks, 1, 1)
    viewmats[:, 0, 3] = -6 * (torch.arange(2 * blocks) // 2) + torch.tensor([0.7, -0.7]).repeat(blocks)
    camera = Camera(viewmats, scenes[0].camera.Ks.repeat(2 * blocks, 1, 1), *size)
    return [torch.cat(values) for values in zip(*(scene[:5] for scene in scenes), strict=True)], camera


def work(rank: int, ranks: int, folder: str, blocks: int, splats: int, size: tuple[int, int], threads: int, times: int) -> None:
    """Steps of one process: every so-manieth splat of a city, wherever it is, and its part of the cameras."""
    torch.set_num_threads(threads)
    dist.init_process_group("gloo", init_method=f"file://{folder}/store", rank=rank, world_size=ranks, timeout=datetime.timedelta(seconds=300))
    scene, cameras = city(blocks, splats, size)
    own = len(cameras) // ranks
    camera = cameras[rank * own:(rank + 1) * own]
    leaves = [v[rank::ranks].clone().requires_grad_() for v in scene]
    weights = torch.randn(own, *reversed(size), 3, generator=torch.Generator().manual_seed(rank))

    def step() -> tsplat.Meta:
        poses = camera.viewmats.clone().requires_grad_()
        rendering = tsplat.rasterize(*leaves, replace(camera, viewmats=poses), group=dist.group.WORLD)
        torch.autograd.grad((rendering.image * weights).sum(), [*leaves, poses])
        return rendering.meta

    visible = step().visible.view(ranks, -1)
    elsewhere = visible.sum(1).tolist()
    counter = Collectives(rank)
    dist.barrier()
    before = loopback()
    with counter:
        step()
    dist.barrier()
    sent = loopback() - before
    seconds, cpu, waiting = [], [], []
    for _ in range(times):
        dist.barrier()
        start, cpu_start = time.perf_counter(), time.process_time()
        step()
        cpu.append(time.process_time() - cpu_start)
        dist.barrier()                                                                      # the slowest rank's time
        seconds.append(time.perf_counter() - start)
        with Collectives(rank) as timer:
            step()
        waiting.append(timer.seconds)
    found = {"elsewhere": sum(elsewhere) - elsewhere[rank], "visible": sum(elsewhere), "bytes": counter.bytes, "loopback": sent,
             "seconds": min(seconds), "cpu": statistics.median(cpu), "collectives": min(waiting)}
    Path(folder, f"{rank}.json").write_text(json.dumps(found))
    dist.barrier()
    dist.destroy_process_group()


def hold(rank: int, ranks: int, folder: str, splats: int) -> None:
    """The peak of memory in a step of one process, with one camera on each."""
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/store", rank=rank, world_size=ranks, timeout=datetime.timedelta(seconds=300))
    scene, cameras = city(32, splats, (320, 180))
    camera = cameras[::len(cameras) // ranks][rank:rank + 1]
    leaves = [v[rank::ranks].clone().requires_grad_() for v in scene]
    del scene
    for _ in range(2):
        before = memory("VmRSS")
        Path("/proc/self/clear_refs").write_text("5")                                       # the peak begins anew
        torch.autograd.grad(tsplat.rasterize(*leaves, camera, group=dist.group.WORLD).image.sum(), leaves)
        dist.barrier()
    Path(folder, f"{rank}.json").write_text(json.dumps((peak_memory() - before) / len(leaves[0]) / ranks))
    dist.barrier()
    dist.destroy_process_group()


def measure_memory(ranks: int, splats: int) -> dict[str, Any]:
    """Start the processes, and take the most."""
    given_back = mock.patch.dict(os.environ, MALLOC_MMAP_THRESHOLD_="65536")               # by glibc: what is free
    with given_back, tempfile.TemporaryDirectory() as folder:
        mp.spawn(hold, args=(ranks, folder, splats), nprocs=ranks)
        found = [json.loads(Path(folder, f"{rank}.json").read_text()) for rank in range(ranks)]
    return {"ranks": ranks, "own_splats": 32 * splats // ranks, "bytes": max(found)}


def measure(ranks: int, blocks: int, splats: int, size: tuple[int, int], threads: int, times: int) -> dict[str, Any]:
    """Start the processes and join what they found."""
    with tempfile.TemporaryDirectory() as folder:
        mp.spawn(work, args=(ranks, folder, blocks, splats, size, threads, times), nprocs=ranks)
        found = [json.loads(Path(folder, f"{rank}.json").read_text()) for rank in range(ranks)]
    cameras = 2 * blocks
    own = cameras // ranks
    overhead = ranks * (ranks - 1) * (2 * 25 * 4 * own + 8 * own + 8 * COMPARED)
    total = {key: sum(f[key] for f in found) for key in ("elsewhere", "visible", "bytes")}
    return {"ranks": ranks, "threads": threads, "splats": blocks * splats, "cameras": cameras, "size": f"{size[0]}x{size[1]}", **total,
            "formula": 2 * total["elsewhere"] * (7 + CHANNELS) * 4 + overhead * (ranks > 1), "loopback": found[0]["loopback"] * (ranks > 1),
            "ms": 1e3 * max(f["seconds"] for f in found), "cpu_ms": 1e3 * sum(f["cpu"] for f in found),
            "collectives_ms": 1e3 * min(f["collectives"] for f in found)}


def predict(splats: float, ranks: int, visible: float, pixels: float = 1.0, photos: float = 1.0) -> dict[str, float]:
    """The model of the docstring; splats and visible in millions, pixels in those of 1920x1080, photos of a rank and step."""
    N, W, node, many = splats, ranks, min(ranks, 8), ranks > 1
    V, C = visible * photos, photos
    parts = {"frusta": 0.004 * N * C * many, "host": 0.1 * W * C * many, "projection": 0.45 * V if many else 0.120 * N * C,
             "colours": 0.26 * V + 0.16 * N / W, "exchange": 0.27 * V * many,
             "link": 80 * V * ((node - 1) / W / 360 + (W - node) / W / 40), "latency": 6 * (0.03 + 0.001 * (W - 1)) * many,
             "drawing": 2.14 * V * pixels, "Adam": 0.55 * N / W}
    total = sum(parts.values())
    return {"splats": N, "ranks": W, "visible": visible, **parts, "ms": total, "images_per_s": 1e3 * W * C / total,
            "GB": 1e-3 * (59 * 4 * 4 * N / W + (9 if many else 120) * N * C + 1000 * V)}


def header(*names: str) -> None:
    print(f"| {' | '.join(names)} |\n|{' --- |' * len(names)}")


def print_model() -> list[dict[str, float]]:
    rows = [predict(n, w, v) for n, ranks in ((40, (1, 8, 16, 64)), (1000, (64, 256, 1024))) for w in ranks for v in (1.0, 4.0)]
    header("splats (M)", "ranks", "visible (M)", "frusta", "host", "projection", "colours", "exchange", "link", "latency", "drawing", "Adam",
           "ms per step", "images/s", "GB per rank")
    for r in rows:
        values = list(r.values())
        print(f"| {values[0]:g} | {values[1]:g} | {values[2]:g} | " + " | ".join(f"{v:.2f}" for v in values[3:12]) +
              f" | **{r['ms']:.1f}** | {r['images_per_s']:.0f} | {r['GB']:.1f} |")
    return rows


def print_published() -> list[dict[str, float]]:
    """The model beside what others have published."""
    print()
    header("who", "splats", "GPUs", "photos a step", "pixels", "published", "model")
    rows = []
    for who, splats, ranks, photos, (width, height), rate in PUBLISHED:
        r = predict(splats, ranks, 4.0, width * height / (1920 * 1080), max(1.0, photos / ranks))
        print(f"| {who} | {splats:g}M | {ranks} | {photos} | {width}x{height} | {rate:g} photos/s | {r['images_per_s']:.0f} photos/s |")
        rows.append({"published_images_per_s": rate, **r})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small scenes")
    parser.add_argument("--model", action="store_true", help="only the model")
    add_json(parser)
    args = parser.parse_args()
    with printing(args.json):
        found = measure_all(args)
    if args.json:
        print_json(found)


def measure_all(args: argparse.Namespace) -> dict[str, Any]:
    """The tables."""
    rows: list[dict[str, Any]] = []
    memory: list[dict[str, Any]] = []
    if not args.model:
        n, size, times = (2_000, (160, 90), 2) if args.quick else (50_000, (640, 360), 7)
        cases = [(1, 1, 1), (1, 2, 1), (1, 2, 2), (2, 2, 1), (3, 3, 1), (4, 4, 1)]
        print(f"torch {torch.__version__}, {platform.machine()}, {size[0]}x{size[1]}, RGB, gloo\n")
        header("processes", "threads of each", "splats", "cameras", "seen", "seen elsewhere", "bytes sent", "formula", "loopback", "ms", "CPU ms",
               "in collectives")
        for ranks, blocks, threads in cases:
            timed = ranks <= CORES
            r = measure(ranks, blocks, n, size, threads, times if timed else 1)
            rows.append(r)
            timing = f"{r['ms']:.0f} | {r['cpu_ms']:.0f} | {r['collectives_ms']:.0f}" if timed else "- | - | -"
            sizes = " | ".join(f"{r[key]:,}" for key in ("splats", "cameras", "visible", "elsewhere", "bytes", "formula", "loopback"))
            print(f"| {ranks} | {threads} | {sizes} | {timing} |", flush=True)
        print()
        header("processes", "cameras", "own splats", "bytes per own splat and camera")
        for ranks in (4,) if args.quick else (4, 16):
            r = measure_memory(ranks, 2_000 if args.quick else 40_000)
            memory.append(r)
            print(f"| {ranks} | {ranks} | {r['own_splats']:,} | {r['bytes']:.0f} |", flush=True)
        print()
    return {**environment("cpu"), "rows": rows, "memory": memory, "model": print_model(), "published": print_published()}


if __name__ == "__main__":
    main()
