"""`tsplat info`."""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from tsplat.cli.common import SCENE, quantiles
from tsplat.scene import Spheres, load_capture, load_scene
from tsplat.scene.formats import find_format, is_sog

HELP = "say what is in a scene file or a folder of photos"
QUANTILES = (0.0, 0.05, 0.5, 0.95, 1.0)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("path", type=Path, metavar="PATH", help=f"{SCENE}, a capture folder or a transforms.json")


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    path: Path = options.path
    if (path.is_dir() or path.suffix.lower() == ".json") and not is_sog(path):
        _print_capture(path)
    else:
        _print_scene(path)


def _print_scene(path: Path) -> None:
    scene = load_scene(path)
    if isinstance(scene, Spheres):
        print(f"spheres  {len(scene)}, {scene.features.shape[1]} channels, gamma {scene.gamma:g}, near {scene.near:g}, far {scene.far:g}")
        rows = {**dict(zip("xyz", scene.positions.unbind(1), strict=True)), "opacity": scene.opacities, "radius": scene.radii}
    else:
        print(f"format   {find_format(path).name}")
        print(f"splats   {len(scene)}, spherical harmonics of degree {scene.sh_degree}")
        rows = {**dict(zip("xyz", scene.means.unbind(1), strict=True)), "opacity": scene.opacities, "scale": scene.scales.amax(1)}
    finite = torch.stack([p.detach().flatten(1).isfinite().all(1) if p.ndim > 1 else p.isfinite() for p in scene.parameters()])
    good = finite.all(0)
    if not bool(good.all()):
        print(f"         {int((~good).sum())} of them with NaN or infinity, left out below")
    if not bool(good.any()):
        return
    print(f"{'':9}" + "".join(f"{f'{q:.0%}':>11}" for q in QUANTILES))
    for name, values in rows.items():
        print(f"{name:9}" + "".join(f"{value:11.4g}" for value in quantiles(values.detach()[good], QUANTILES)))


def _print_capture(path: Path) -> None:
    capture = load_capture(path)
    sizes = sorted(set(zip(capture.width, capture.height, strict=True)))
    print(f"photos   {len(capture)}: {len(capture.train)} to train on, {len(capture.test)} held out")
    print(f"size     {', '.join(f'{w}x{h}' for w, h in sizes[:8])}{', ...' if len(sizes) > 8 else ''}")
    print(f"points   {0 if capture.points is None else len(capture.points)}")
    print(f"extent   {capture.extent:.4g} (1.1 times the largest distance of a camera from their mean)")
    print(f"masks    {'yes' if capture.masked else 'no'}")
