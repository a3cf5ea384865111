"""Held-out quality of a short fit of real photos on a CPU: fox at 133x237, 43 photos to train on, 7 held out, 27,000 splats.

    python bench/quality/fox.py [--data FOLDER] [--seeds 0 1 2] [--steps 1000]

One line per seed: PSNR and SSIM over the held-out photos, wall and CPU seconds of the whole fit, from reading the photos to
scoring. The photos are those of `data/fox` in the folder that the environment variable TSPLAT_DATA names (default ../shared).
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

import torch

from tsplat.fit import FitConfig, fit

REPOSITORY = Path(__file__).resolve().parents[2]


def main() -> None:
    """Fit once per seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    data = Path(os.environ.get("TSPLAT_DATA", REPOSITORY.parent / "shared")) / "data" / "fox"
    parser.add_argument("--data", type=Path, default=data, help="the capture (default: data/fox under TSPLAT_DATA)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=1000)
    options = parser.parse_args()
    for seed in options.seeds:
        config = FitConfig(steps=options.steps, splats=27_000, downscale=4, seed=seed)
        wall, cpu = time.perf_counter(), time.process_time()
        result = fit(options.data, config, progress=False)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        assert result.mean is not None
        print(f"fox seed {seed}: PSNR {result.mean.psnr:.2f} dB, SSIM {result.mean.ssim:.4f}, {len(result.gaussians)} splats, "
              f"{config.steps} steps, {wall:.1f} s wall, {cpu:.1f} s CPU, {torch.get_num_threads()} threads", flush=True)


if __name__ == "__main__":
    main()
