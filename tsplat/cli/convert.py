"""`tsplat convert`."""

from __future__ import annotations

import argparse
from pathlib import Path

from tsplat.cli.common import SCENE
from tsplat.scene import Spheres, load_scene
from tsplat.scene.formats import FORMATS

HELP = "write a scene in another file format"
USAGE = "tsplat convert IN OUT [options]"
DESCRIPTION = "Write a scene in the format that the name of OUT says; its folder is made."
EXAMPLES = """
  tsplat convert scene.ply scene.spz
  tsplat convert scene.sog scene.ply
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("scene", metavar="IN", help=SCENE)
    parser.add_argument("out", type=Path, metavar="OUT", help=f"a scene file ({', '.join(item.suffix for item in FORMATS if item.write)})")


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    out: Path = options.out
    gaussians = load_scene(options.scene)
    if isinstance(gaussians, Spheres):
        raise ValueError(f"{options.scene}: expected Gaussians, for which these formats are; got spheres, which only their own .ply holds")
    out.parent.mkdir(parents=True, exist_ok=True)
    gaussians.save(out)
    print(f"{len(gaussians)} splats: {out} ({out.stat().st_size} bytes)")
