"""Speed and memory of `tsplat.rasterize` on a CPU, as a ratio that can be compared between machines.

    python bench/cpu.py               # the table of all scenes, how time grows, and the memory of 1M splats at 1920x1080
    python bench/cpu.py --quick       # two rows

Each row gives forward and forward+backward in ms (median of 25, float32; backward to means, scales, quats, colours and opacities), blended
pairs per second over `torch.exp` per second, measured in cache, in the same process and with the same threads, and the time of the best C++ rival
(OpenSplat 2026, 2 threads) scaled by the exp rates of its machine (3.4 G/s) and of this one. How fast a shared machine is changes by half within
seconds, so that the rate is measured right before and right after each sample, what is compared is the median of time times rate, and samples are
taken in rounds: five of each row, then of each row again.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from output import add_json, environment, peak_memory, print_json, printing
from scenes import Scene, count_pairs, random_scene

import tsplat

RIVAL_EXP_RATE = 3.4e9
RIVAL_MS = {(256, 256, 1_000): (7, 11), (256, 256, 10_000): (31, 54), (512, 512, 10_000): (41, 83), (256, 256, 100_000): (110, 201),
            (512, 512, 100_000): (390, 560), (1280, 720, 100_000): (710, 958), (512, 512, 500_000): (821, 1141),
            (1280, 720, 500_000): (2382, 3458)}
QUICK = [(256, 256, 10_000), (512, 512, 100_000)]
LARGE = 1_000_000, 1920, 1080


def exp_rate() -> float:
    """`torch.exp` per second on arguments that stay in the cache."""
    x = torch.rand(1 << 16) - 5
    out = torch.empty_like(x)
    torch.exp(x, out=out)
    return x.numel() / statistics.median(seconds(lambda: [torch.exp(x, out=out) for _ in range(50)]) for _ in range(3)) * 50


def seconds(run: Callable[[], object]) -> float:
    """Of one call."""
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def samples(run: Callable[[], object], times: int) -> list[tuple[float, float]]:
    """Milliseconds of a call, and as many `torch.exp` as the machine made in that time."""
    run()
    taken = []
    for _ in range(times):
        before, duration = exp_rate(), seconds(run)
        taken.append((1e3 * duration, duration * (before + exp_rate()) / 2))
    return taken


def forward(scene: Scene) -> None:
    with torch.no_grad():
        tsplat.rasterize(*scene[:5], scene.camera, background=scene.background)


def forward_backward(scene: Scene, v_image: torch.Tensor) -> None:
    leaves = [x.requires_grad_() for x in scene[:5]]
    image = tsplat.rasterize(*leaves, scene.camera, background=scene.background).image
    torch.autograd.grad(image, leaves, v_image)


def measure(sizes: list[tuple[int, int, int]], rounds: int, times: int) -> list[dict[str, float]]:
    """Medians of rounds over all sizes (width, height, splats), with so many samples of each."""
    taken: list[tuple[list[tuple[float, float]], list[tuple[float, float]]]] = [([], []) for _ in sizes]
    for _ in range(rounds):
        for (width, height, n), (alone, both) in zip(sizes, taken, strict=True):
            scene = random_scene(n, width, height)
            v_image = torch.randn(height, width, 3, generator=torch.Generator().manual_seed(0))
            alone += samples(partial(forward, scene), times)
            both += samples(partial(forward_backward, scene, v_image), times)
    results = []
    for (width, height, n), each in zip(sizes, taken, strict=True):
        (forward_ms, forward_exps), (both_ms, both_exps) = (map(statistics.median, zip(*some, strict=True)) for some in each)
        results.append({"width": width, "height": height, "n": n, "forward_ms": forward_ms, "both_ms": both_ms, "forward_exps": forward_exps,
                        "both_exps": both_exps})
    return results


def table(sizes: list[tuple[int, int, int]]) -> list[dict[str, float]]:
    print("| size | splats | pairs (M) | fwd ms | fwd+bwd ms | fwd M pairs/s | fwd+bwd | fwd pairs/exp | fwd+bwd | rival's ms | ratio |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |", flush=True)
    results = measure(sizes, rounds=5, times=5)
    for row, (width, height, n) in zip(results, sizes, strict=True):
        pairs = row["pairs"] = count_pairs(random_scene(n, width, height))
        ms, exps = (row["forward_ms"], row["both_ms"]), (row["forward_exps"], row["both_exps"])
        ratios = [ours / (1e-3 * rival * RIVAL_EXP_RATE) for ours, rival in zip(exps, RIVAL_MS[width, height, n], strict=True)]
        row["rival_ms"] = rival = [ours / ratio for ours, ratio in zip(ms, ratios, strict=True)]
        print(f"| {width}x{height} | {n:,} | {pairs / 1e6:.2f} | {ms[0]:.0f} | {ms[1]:.0f} | {pairs / ms[0] / 1e3:.0f} | {pairs / ms[1] / 1e3:.0f} | "
              f"{pairs / exps[0]:.4f} | {pairs / exps[1]:.4f} | {rival[0]:.0f} / {rival[1]:.0f} | {ratios[0]:.2f} / {ratios[1]:.2f} |")
    return results


def growth() -> list[dict[str, float]]:
    """How time grows with splats (at 512x512) and with pixels (at 100k splats)."""
    print("\n| size | splats | fwd ms | fwd+bwd ms |\n| --- | --- | --- | --- |", flush=True)
    sizes = [(512, 512, n) for n in (1_000, 10_000, 100_000, 1_000_000)] + [(w, h, 100_000) for w, h in (
        (128, 128), (256, 256), (1024, 1024), (1920, 1080), (3840, 2160))]
    results = measure(sizes, rounds=1, times=3)
    for row, (width, height, n) in zip(results, sizes, strict=True):
        print(f"| {width}x{height} | {n:,} | {row['forward_ms']:.0f} | {row['both_ms']:.0f} |")
    return results


def large() -> dict[str, float]:
    """Forward and backward of 1M splats at 1920x1080: the peak memory of a process that does nothing else."""
    n, width, height = LARGE
    before = peak_memory()
    scene = random_scene(n, width, height)
    start = time.perf_counter()
    forward_backward(scene, torch.ones(height, width, 3))
    seconds, peak = time.perf_counter() - start, peak_memory()
    print(f"\n{n:,} splats at {width}x{height}, forward+backward: {seconds:.1f} s, peak memory of the process {peak / 2**30:.2f} GiB "
          f"({before / 2**30:.2f} GiB of it before the first call)", flush=True)
    return {"width": width, "height": height, "n": n, "seconds": seconds, "peak_bytes": peak, "before_bytes": before}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two rows only")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--large-only", action="store_true", help="only the memory of 1M splats (run in a fresh process)")
    add_json(parser)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    with printing(args.json):
        results = large() if args.large_only else measure_all(args.threads, quick=args.quick)
    if args.json:
        print_json(results)


def measure_all(threads: int, *, quick: bool) -> dict[str, Any]:
    results = environment("cpu")
    print(f"torch {results['torch']}, {threads} threads, {results['machine']}, exp {exp_rate() / 1e9:.2f} G/s\n")
    results["rows"] = table(QUICK if quick else list(RIVAL_MS))
    if not quick:
        results["growth"] = growth()
        command = [sys.executable, __file__, "--large-only", "--json", "--threads", str(threads)]
        results["large"] = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
    return results


if __name__ == "__main__":
    main()
