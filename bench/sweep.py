"""Times of each kernel's stage over candidates for its launch constants, for the table in `tsplat/kernels/launch.py`.

    python bench/sweep.py                    # all but the harmonics; `*` marks what stands in the table, `!` what is faster
    python bench/sweep.py --kernels blend features --splats 1000000 --size 4K

Without a GPU it says so and exits with 2.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from typing import Any

import torch
from gpu import milliseconds, stage_calls
from gpu_scenes import SIZES, of_channels

SPLATS = [{"BLOCK": block, "num_warps": warps} for block, warps in itertools.product((32, 64, 128, 256), (1, 2, 4)) if block >= 32 * warps]
PRODUCTS = [{"K": k, "DB": d, "num_warps": w} for k, d, w in itertools.product((16, 32), (32, 64, 128), (4, 8))]
CANDIDATES: dict[str, tuple[str, int, list[dict[str, int]]]] = {
    "project": ("project", 3, SPLATS),
    "project_backward": ("project_backward", 3, SPLATS),
    "bin": ("bin", 3, SPLATS),
    "pick": ("bin", 3, [{"BLOCK": b, "num_warps": w} for b in (32, 64, 128) for w in (1, 2) if b >= 32 * w]),
    "records": ("blend", 3, SPLATS),
    "blend": ("blend", 3, [{"num_warps": 1}, {"num_warps": 1, "maxnreg": 72}]),
    "blend_backward": ("blend_backward", 3, [{"num_warps": 1}, {"num_warps": 1, "maxnreg": 88}]),
    "features": ("blend", 128, PRODUCTS),
    "features_colors_backward": ("blend_backward", 128, PRODUCTS),
    "features_backward": ("blend_backward", 128, PRODUCTS),
}
"""Per kernel: the stage that it is timed in, the channels of the scene, and what to try."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kernels", nargs="*", default=list(CANDIDATES), choices=list(CANDIDATES))
    parser.add_argument("--splats", type=int, default=1_000_000)
    parser.add_argument("--size", default="1080p", choices=list(SIZES))
    parser.add_argument("--times", type=int, default=10)
    parser.add_argument("--only", nargs="*", default=[], metavar="NAME=VALUE", help="only candidates with these constants: num_warps=4")
    args = parser.parse_args()
    if not torch.cuda.is_available():
        print("bench/sweep.py: no GPU: torch.cuda.is_available() is False. Run it where there is one", file=sys.stderr)
        return 2
    from tsplat.kernels.launch import LAUNCHES, current_target

    only = {name: int(value) for name, value in (o.split("=") for o in args.only)}
    family = current_target().family
    print(f"{torch.cuda.get_device_name()}, {args.splats} splats, {args.size}\n\n| kernel | constants | stage, ms | |\n| --- | --- | --- | --- |")
    for kernel in args.kernels:
        stage, channels, candidates = CANDIDATES[kernel]
        calls, _, _ = stage_calls(of_channels(args.splats, args.size, channels).to("cuda"))
        stands = LAUNCHES[kernel][family]
        tried = [*(c for c in candidates if only.items() <= c.items()), stands]
        times = sorted((time(calls[stage], LAUNCHES[kernel], family, c, args.times), list(c.items()), c == stands) for c in tried)
        for ms, constants, is_stand in times[:6]:
            print(f"| {kernel} | {', '.join(f'{k} {v}' for k, v in constants)} | {ms:.4f} | {'*' if is_stand else ''} |", flush=True)
        own = next(ms for ms, _, is_stand in times if is_stand)
        print(f"| {kernel} | in the table | {own:.4f} | {'!' if times[0][0] < 0.97 * own else ''} |", flush=True)
    return 0


def time(call: Any, table: dict[str, dict[str, int]], family: str, constants: dict[str, int], times: int) -> float:
    """Median ms of the stage with these constants; infinite where they do not compile or do not fit."""
    stands, table[family] = table[family], constants
    try:
        with torch.no_grad():
            return milliseconds(call, times)[0]
    except Exception:       # out of resources, or a shape that the compiler refuses: of whatever type
        return float("inf")
    finally:
        table[family] = stands


if __name__ == "__main__":
    sys.exit(main())
