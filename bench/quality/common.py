"""What the quality scripts share: fits of one capture with some seeds, and a line for each."""

from __future__ import annotations

import argparse
import dataclasses
import os
import re
import sys
import time
from pathlib import Path

import torch
from torch.profiler import ProfilerActivity, profile

from tsplat.cli.common import add_fields, config_of
from tsplat.fit import FitConfig, Step, fit
from tsplat.fit.drawing import fixed_background
from tsplat.fit.evaluation import evaluate, mean_quality
from tsplat.fit.primitive import Scene, primitive_of
from tsplat.scene import Capture, load_capture, write_image

REPOSITORY = Path(__file__).resolve().parents[2]
sys.path.append(str(REPOSITORY / "bench"))

from output import add_json, environment, print_json, printing  # noqa: E402

SHOWN = 4            # held-out views in a picture
PROFILED = 20        # steps
STAGES = {"projection": "project", "harmonics": "harmonics", "outlines": "outlines", "blending": "blend(_spheres)?", "SSIM": "aten::convolution",
          "Adam": r"Optimizer\.step.*"}
"""By the names of their events, which are those of the ops. (Binning, which has no gradient, has none.)"""


def measure(name: str, description: str | None, config: FitConfig, parts: tuple[float, ...] = ()) -> None:
    """Fit `data/<name>` in the folder that TSPLAT_DATA names (default ../shared) once per seed, and print what came of it.

    A line has PSNR and SSIM over the held-out photos, splats, wall and CPU seconds of the whole fit, from reading the photos to
    scoring.

    Args:
        name, description: of the script.
        config: with which; the options of `tsplat fit` change it.
        parts: of the steps, after which the held-out photos are scored, too: a curve. That time does not count.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    data = Path(os.environ.get("TSPLAT_DATA", REPOSITORY.parent / "shared")) / "data" / name
    parser.add_argument("--data", type=Path, default=data, help=f"the capture (default: data/{name} under TSPLAT_DATA)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--picture", type=Path, help=f"write renders of {SHOWN} held-out views of the last seed to this file")
    parser.add_argument("--profile", action="store_true", help="also say what part of a step each stage takes, near the end of the last fit")
    parser.add_argument("--device", default="cpu")
    add_json(parser)
    add_fields(parser, [item.name for item in dataclasses.fields(FitConfig) if item.name != "seed"])
    options = parser.parse_args()
    config = config_of(options, config)
    fits, shares = [], None
    with printing(options.json):
        for seed in options.seeds:
            chosen = dataclasses.replace(config, seed=seed)
            wall, cpu = time.perf_counter(), time.process_time()
            capture = load_capture(options.data, downscale=chosen.downscale, test_every=chosen.test_every)
            curve, shares = _Curve(capture, chosen, parts), _Shares(chosen) if options.profile and seed == options.seeds[-1] else None
            result = fit(capture, chosen, progress=False, callbacks=[curve, *([shares] if shares else [])], device=options.device)
            wall, cpu = time.perf_counter() - wall - curve.wall, time.process_time() - cpu - curve.cpu
            assert result.mean is not None
            fits.append({"seed": seed, **result.mean._asdict(), "splats": len(result.gaussians), "steps": chosen.steps, "wall_s": wall, "cpu_s": cpu,
                         "curve": curve.points})
            print(f"{name} seed {seed}: PSNR {result.mean.psnr:.2f} dB, SSIM {result.mean.ssim:.4f}, {len(result.gaussians)} splats, "
                  f"{chosen.steps} steps, {wall:.1f} s wall, {cpu:.1f} s CPU, {torch.get_num_threads()} threads"
                  + "".join(f"; {psnr:.2f} dB after {seconds:.0f} s" for seconds, psnr in curve.points), flush=True)
            if shares:
                print(f"  {shares.text}")
    if options.picture:
        _write_picture(options.picture, result.gaussians, capture, chosen)
    if options.json:
        changed = {item.name: value for item in dataclasses.fields(FitConfig) if (value := getattr(config, item.name)) != item.default}
        print_json({**environment(options.device), "capture": name, "config": changed, "fits": fits, "profile": shares.text if shares else ""})


def _write_picture(path: Path, scene: Scene, capture: Capture, config: FitConfig) -> None:
    """Renders of the first held-out views, side by side."""
    with torch.no_grad():
        views = [primitive_of(config).draw(scene, capture.camera(i).to(scene.device), fixed_background(config).to(scene.device), config).image
                 for i in capture.test[:SHOWN]]
    write_image(path, torch.cat(views, 1).clamp(0, 1))


class _Shares:
    """A callback that profiles some of the last steps: what part of their CPU time the stages take, which are custom ops."""

    def __init__(self, config: FitConfig) -> None:
        self.begin, self.end = config.steps - PROFILED - 1, config.steps - 1
        self.profiler = profile(activities=[ProfilerActivity.CPU])
        self.text = ""

    def __call__(self, step: Step) -> None:
        if step.number == self.begin:
            self.profiler.start()
        elif step.number == self.end:
            self.profiler.stop()
            events = {event.key: event for event in self.profiler.key_averages()}
            total = sum(event.self_cpu_time_total for event in events.values())
            shares = {f"{stage}{way}": sum(event.cpu_time_total for key, event in events.items() if re.fullmatch(name + suffix, key))
                      for stage, name in STAGES.items() for way, suffix in (("", ""), (", backward", "_?[Bb]ackward"))}
            self.text = f"of {1e-3 * total / PROFILED:.0f} ms a step: " + ", ".join(
                f"{name} {100 * us / total:.0f} %" for name, us in sorted(shares.items(), key=lambda item: -item[1]) if us > total / 100)


class _Curve:
    """A callback that scores the scene after some parts of the steps."""

    def __init__(self, capture: Capture, config: FitConfig, parts: tuple[float, ...]) -> None:
        self.capture, self.config = capture, config
        self.due = {round(part * config.steps) for part in parts}
        self.wall, self.cpu, self.start = 0.0, 0.0, time.perf_counter()
        self.points: list[tuple[float, float]] = []           # seconds and PSNR

    def __call__(self, step: Step) -> None:
        if step.number not in self.due:
            return
        wall, cpu = time.perf_counter(), time.process_time()
        mean = mean_quality(evaluate(step.gaussians, self.capture, self.capture.test, self.config))
        assert mean is not None
        self.points.append((wall - self.start - self.wall, mean.psnr))
        self.wall += time.perf_counter() - wall
        self.cpu += time.process_time() - cpu


