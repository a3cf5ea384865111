"""What the quality scripts share: fits of one capture with some seeds, and a line for each."""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
import time
from pathlib import Path

import torch

from tsplat.fit import FitConfig, Step, fit
from tsplat.fit.evaluation import evaluate, mean_quality
from tsplat.scene import Capture, load_capture

REPOSITORY = Path(__file__).resolve().parents[2]
sys.path.append(str(REPOSITORY / "bench"))

from output import add_json, print_json, printing  # noqa: E402


def measure(name: str, description: str | None, config: FitConfig, parts: tuple[float, ...] = ()) -> None:
    """Fit `data/<name>` in the folder that TSPLAT_DATA names (default ../shared) once per seed, and print what came of it.

    A line has PSNR and SSIM over the held-out photos, splats, wall and CPU seconds of the whole fit, from reading the photos to
    scoring.

    Args:
        name, description: of the script.
        config: with which; `--steps`, `--splats`, `--max-splats`, `--density`, `--resolution-warmup` and `--seeds` change it.
        parts: of the steps, after which the held-out photos are scored, too: a curve. That time does not count.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    data = Path(os.environ.get("TSPLAT_DATA", REPOSITORY.parent / "shared")) / "data" / name
    parser.add_argument("--data", type=Path, default=data, help=f"the capture (default: data/{name} under TSPLAT_DATA)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=config.steps)
    parser.add_argument("--splats", type=int, default=config.splats)
    parser.add_argument("--max-splats", type=int, default=config.max_splats)
    parser.add_argument("--density", default=config.density)
    parser.add_argument("--resolution-warmup", type=float, default=config.resolution_warmup)
    parser.add_argument("--device", default="cpu")
    add_json(parser)
    options = parser.parse_args()
    fits = []
    for seed in options.seeds:
        chosen = dataclasses.replace(config, steps=options.steps, splats=options.splats, max_splats=options.max_splats, density=options.density,
                                     resolution_warmup=options.resolution_warmup, seed=seed)
        wall, cpu = time.perf_counter(), time.process_time()
        capture = load_capture(options.data, downscale=chosen.downscale, test_every=chosen.test_every)
        curve = _Curve(capture, chosen, parts)
        result = fit(capture, chosen, progress=False, callbacks=[curve], device=options.device)
        wall, cpu = time.perf_counter() - wall - curve.wall, time.process_time() - cpu - curve.cpu
        assert result.mean is not None
        fits.append({"seed": seed, **result.mean._asdict(), "splats": len(result.gaussians), "steps": chosen.steps, "wall_s": wall, "cpu_s": cpu})
        with printing(options.json):
            print(f"{name} seed {seed}: PSNR {result.mean.psnr:.2f} dB, SSIM {result.mean.ssim:.4f}, {len(result.gaussians)} splats, "
                  f"{chosen.steps} steps, {wall:.1f} s wall, {cpu:.1f} s CPU, {torch.get_num_threads()} threads{curve.text}", flush=True)
    if options.json:
        print_json({"capture": name, "threads": torch.get_num_threads(), "fits": fits})


class _Curve:
    """A callback that scores the scene after some parts of the steps."""

    def __init__(self, capture: Capture, config: FitConfig, parts: tuple[float, ...]) -> None:
        self.capture, self.config = capture, config
        self.due = {round(part * config.steps) for part in parts}
        self.text, self.wall, self.cpu, self.start = "", 0.0, 0.0, time.perf_counter()

    def __call__(self, step: Step) -> None:
        if step.number not in self.due:
            return
        wall, cpu = time.perf_counter(), time.process_time()
        mean = mean_quality(evaluate(step.gaussians, self.capture, self.capture.test, self.config))
        assert mean is not None
        self.text += f"; {mean.psnr:.2f} dB after {wall - self.start - self.wall:.0f} s"
        self.wall += time.perf_counter() - wall
        self.cpu += time.process_time() - cpu


