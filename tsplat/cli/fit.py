"""`tsplat fit`."""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from tsplat.cli import torchrun
from tsplat.cli.common import REFINED, add_device, add_fields, config_of, device_of, print_mean
from tsplat.fit import FitConfig, Step, fit
from tsplat.fit.checkpoint import read_checkpoint
from tsplat.fit.output import read_config
from tsplat.scene import Capture, load_capture, write_synthetic_capture

if TYPE_CHECKING:
    from torch.distributed import ProcessGroup  # some builds of torch have none

HELP = "fit a scene to photos"
USAGE = "tsplat fit DATA -o OUT [options]"
DESCRIPTION = """
Fit Gaussians, or spheres, to posed photos. Writes scene.ply, metrics.json,
config.json, curves.png, test/*.png (held-out photo beside render), contact.png
and checkpoint.pt, from which the same command goes on after an interruption.
With several processes (torchrun) the splats are sharded over them, and each
renders a photo of its own at a time, on a GPU of its own with --device cuda.
"""
EXAMPLES = """
  tsplat fit --synthetic -o out
  tsplat fit capture -o out --downscale 4 --steps 7000 --max-splats 200000
  tsplat fit capture -o again --config out/config.json
  tsplat fit capture -o out --view                     watch it in a web page
  torchrun --nproc-per-node=8 -m tsplat fit capture -o out --device cuda
"""
VIEW_PORT = 8080
POLL_SECONDS = 0.2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    data = parser.add_mutually_exclusive_group(required=True)
    data.add_argument("data", nargs="?", metavar="DATA", help="folder of a COLMAP model with photos, or of a transforms.json")
    data.add_argument("--synthetic", action="store_true",
                      help="no photos at hand: render a small capture of a made-up scene to OUT/capture, and fit that")
    parser.add_argument("-o", "--out", required=True, type=Path, metavar="OUT", help="folder to write to, made if need be")
    parser.add_argument("--config", type=Path, metavar="FILE", help="a config.json, for what is not given here: makes the same scene again")
    parser.add_argument("--fresh", action="store_true", help="start anew instead of going on from OUT/checkpoint.pt")
    parser.add_argument("--quiet", action="store_true", help="no progress line, which is on terminals only anyway")
    parser.add_argument("--view", action="store_true",
                        help="show a web page of the scene as it is fitted, which this machine alone can open (needs pip install 'tsplat[viewer]'). "
                             "The command ends when the fit is done and no page is open; a paused fit goes on when none has been open for 5 seconds")
    parser.add_argument("--view-port", type=int, metavar="PORT", help=f"with --view: of the page; 0 for any (default: {VIEW_PORT})")
    add_device(parser)
    add_fields(parser)


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    config = config_of(options, FitConfig() if options.config is None else read_config(options.config))
    if options.view_port is not None and not options.view:
        raise ValueError("--view-port: expected only with --view")
    if options.view and torchrun.ranks() > 1:
        raise ValueError(f"--view: expected only with one process, in which the page's scene is whole; got {torchrun.ranks()} of torchrun")
    with torchrun.joined(device_of(options.device, used=torchrun.ranks() == 1)) as (group, device):
        data = _synthetic(options.out / "capture", group) if options.synthetic else options.data
        if options.view:
            _view(options, data, config, device)
        else:
            _fit(options, data, config, device, group)


def _synthetic(folder: Path, group: ProcessGroup | None) -> Path:
    """The capture of a made-up scene, which the first process renders, if need be."""
    if torchrun.rank() == 0 and not (folder / "sparse" / "0" / "points3D.txt").exists():              # the file that is written last
        print(f"rendering photos of a made-up scene to {folder / 'images'}", flush=True)
        write_synthetic_capture(folder)
    if group is not None:
        torch.distributed.barrier(group)
    return folder


def _view(options: argparse.Namespace, data: str | Path, config: FitConfig, device: torch.device) -> None:
    """The fit, with its page."""
    from tsplat.viewer.page import training_page

    capture = load_capture(data, downscale=config.downscale, test_every=config.test_every)
    with training_page(capture, config, port=VIEW_PORT if options.view_port is None else options.view_port) as (page, training):
        print(f"the fit can be watched at {page.url}", flush=True)
        _fit(options, capture, config, device, None, training)
        if page.visited:
            print("the page stays until it is closed (or Ctrl-C)", flush=True)
        with contextlib.suppress(KeyboardInterrupt):                              # the fit is done: this is no failure
            while page.visited:
                time.sleep(POLL_SECONDS)


def _fit(options: argparse.Namespace, data: Capture | str | Path, config: FitConfig, device: torch.device, group: ProcessGroup | None,
         *callbacks: Callable[[Step], None]) -> None:
    checkpoint = options.out / "checkpoint.pt"
    try:
        result = fit(data, config, options.out, resume=not options.fresh or torchrun.restarted(), progress=sys.stderr.isatty() and not options.quiet,
                     callbacks=callbacks, device=device, group=group)
    except (RuntimeError, torchrun.Ended) as error:
        if isinstance(error, torchrun.Ended) or (group is not None and torchrun.is_loss(error)):
            ended = "ended by torchrun, as where " if isinstance(error, torchrun.Ended) else ""
            raise ConnectionError(f"process {torchrun.rank()}: {ended}another process of this fit has ended; " + (
                f"the same command goes on from {checkpoint}, after step {read_checkpoint(checkpoint)['state']['step']}" if checkpoint.exists()
                else "there is no checkpoint yet")) from error
        raise
    except KeyboardInterrupt as interrupt:
        if not interrupt.args and checkpoint.exists():                         # while reading photos, or in the evaluation
            raise KeyboardInterrupt(f"interrupted; the same command goes on from {checkpoint}") from None
        raise
    if torchrun.rank() > 0:
        return
    print_mean(result.qualities)
    print_mean(result.refined, REFINED)
    print(f"{len(result.gaussians)} splats after {config.steps} steps in {result.seconds:.0f} s: {options.out / 'scene.ply'}")
