"""`tsplat eval`."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

from tsplat.cli.common import REFINED, SCENE, add_device, add_fields, add_json, config_of, device_of, print_json, print_qualities
from tsplat.fit import FitConfig
from tsplat.fit.evaluation import scores
from tsplat.fit.output import metrics_of, read_config, write_json
from tsplat.scene import Spheres, load_capture, load_scene

HELP = "measure a scene file against held-out photos"
USAGE = "tsplat eval SCENE DATA [options]"
DESCRIPTION = """
Measure a scene against the held-out photos of a capture. What is not given here
is taken from the config.json beside the scene, if there is one: then the result
is what metrics.json says. Of a fit that refined poses, those of the photos are
refined here as they were there, for the second score.
"""
EXAMPLES = """
  tsplat eval out/scene.ply capture
  tsplat eval out/scene.ply capture --test-every 4 --json
  tsplat eval out/scene.ply capture --no-refine-poses    the plain score alone
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("scene", type=Path, metavar="SCENE", help=SCENE)
    parser.add_argument("data", metavar="DATA", help="the capture: folder or transforms.json")
    parser.add_argument("-o", "--out", type=Path, metavar="OUT.json", help="also write the metrics of each photo to this file")
    add_json(parser)
    add_device(parser)
    add_fields(parser, ("downscale", "test_every", "background", "antialiased", "offload", "refine_poses", "pose_steps"))


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    beside = options.scene.with_name("config.json")
    config = config_of(options, read_config(beside) if beside.is_file() else FitConfig())
    scene, device = load_scene(options.scene), device_of(options.device)
    config = dataclasses.replace(config, primitive="spheres" if isinstance(scene, Spheres) else "gaussians")
    capture = load_capture(options.data, downscale=config.downscale, test_every=config.test_every)
    if not capture.test:
        raise ValueError(f"{options.data}: expected held-out photos; there are none with test_every = {config.test_every}")
    qualities, refined = scores(scene.to(config.home(device)), capture, config, device=device)
    metrics = metrics_of(qualities, refined)
    if options.json:
        print_json(metrics)
    else:
        print_qualities(qualities)
        print_qualities(refined, REFINED)
    if options.out is not None:
        write_json(options.out, metrics)
