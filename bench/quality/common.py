"""What the quality scripts share: fits of one capture with some seeds, and a line for each."""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
import time
from pathlib import Path

import torch
from callbacks import Curve, Shares
from peer import RASTERIZERS, check_rasterizer, drawn_by

from tsplat.cli.common import add_device, add_fields, config_of, device_of
from tsplat.fit import FitConfig, fit
from tsplat.fit.drawing import fixed_background
from tsplat.fit.primitive import Scene, primitive_of
from tsplat.scene import Capture, load_capture, write_image

REPOSITORY = Path(__file__).resolve().parents[2]
sys.path.append(str(REPOSITORY / "bench"))

from output import add_json, environment, print_json, printing  # noqa: E402

SHOWN = 4            # held-out views in a picture


def measure(name: str, description: str | None, config: FitConfig, parts: tuple[float, ...] = ()) -> None:
    """Fit `data/<name>` in the folder that TSPLAT_DATA names (default ../shared) once per seed, and print what came of it.

    A line has PSNR and SSIM over the held-out photos, splats, wall and CPU seconds of the whole fit, from reading the photos to
    scoring, and how many splats the steps draw, optimise and compare per second of theirs.

    Args:
        name, description: of the script.
        config: with which; the options of `tsplat fit` change it.
        parts: of the steps, after which the held-out photos are scored, too: a curve. That time does not count. (Default of `--curve`.)
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    data = Path(os.environ.get("TSPLAT_DATA", REPOSITORY.parent / "shared")) / "data" / name
    parser.add_argument("--data", type=Path, default=data, help=f"the capture (default: data/{name} under TSPLAT_DATA)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--picture", type=Path, help=f"write renders of {SHOWN} held-out views of the last seed to this file")
    parser.add_argument("--profile", action="store_true", help="also say what part of a step each stage takes, near the end of the last fit")
    parser.add_argument("--curve", type=float, nargs="*", default=parts, metavar="PART", help="score after these parts of the steps, too")
    parser.add_argument("--rasterizer", choices=RASTERIZERS, default="tsplat", help="what draws, in the same trainer (gsplat: 1.5.3, for CUDA)")
    add_device(parser)
    add_json(parser)
    add_fields(parser, [item.name for item in dataclasses.fields(FitConfig) if item.name != "seed"])
    options = parser.parse_args()
    config = config_of(options, config)
    try:
        device = device_of(options.device)
        check_rasterizer(options.rasterizer, config)
    except ValueError as error:
        parser.error(str(error))
    fits, shares = [], None
    with printing(options.json), drawn_by(options.rasterizer):
        for seed in options.seeds:
            chosen = dataclasses.replace(config, seed=seed)
            wall, cpu = time.perf_counter(), time.process_time()
            capture = load_capture(options.data, downscale=chosen.downscale, test_every=chosen.test_every)
            curve = Curve(capture, chosen, options.curve, device)
            shares = Shares(chosen, device) if options.profile and seed == options.seeds[-1] else None
            result = fit(capture, chosen, progress=False, callbacks=[curve, *([shares] if shares else [])], device=device)
            wall, cpu = time.perf_counter() - wall - curve.wall, time.process_time() - cpu - curve.cpu
            assert result.mean is not None
            fits.append({"seed": seed, **result.mean._asdict(), "splats": len(result.gaussians), "steps": chosen.steps, "wall_s": wall, "cpu_s": cpu,
                         "steps_s": (taken := result.seconds - curve.wall), "splats_per_s": curve.drawn / taken, "curve": curve.points})
            print(f"{name} seed {seed}: PSNR {result.mean.psnr:.2f} dB, SSIM {result.mean.ssim:.4f}, {len(result.gaussians)} splats, "
                  f"{chosen.steps} steps, {wall:.1f} s wall, {cpu:.1f} s CPU, {torch.get_num_threads()} threads, "
                  f"{fits[-1]['splats_per_s']:,.0f} splats/s"
                  + "".join(f"; {psnr:.2f} dB after {seconds:.0f} s" for seconds, psnr in curve.points), flush=True)
            if shares:
                print(f"  {shares.text}")
        if options.picture:
            _write_picture(options.picture, result.gaussians, capture, chosen)
    if options.json:
        changed = {item.name: value for item in dataclasses.fields(FitConfig) if (value := getattr(config, item.name)) != item.default}
        print_json({**environment(device.type), "rasterizer": options.rasterizer, "capture": name, "config": changed, "fits": fits,
                    "profile": shares.text if shares else ""})


def _write_picture(path: Path, scene: Scene, capture: Capture, config: FitConfig) -> None:
    """Renders of the first held-out views, side by side."""
    with torch.no_grad():
        views = [primitive_of(config).draw(scene, capture.camera(i).to(scene.device), fixed_background(config).to(scene.device), config).image
                 for i in capture.test[:SHOWN]]
    write_image(path, torch.cat(views, 1).clamp(0, 1))
