"""`tsplat info`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch

from tsplat.cli.common import SCENE, add_json, print_json
from tsplat.scene import Spheres, load_capture, load_scene
from tsplat.scene.formats import find_format, is_sog
from tsplat.scene.quantiles import quantiles

HELP = "say what is in a scene file or a folder of photos"
USAGE = "tsplat info PATH [options]"
DESCRIPTION = "Say what is in a scene file, or in a capture: photos and their cameras."
EXAMPLES = """
  tsplat info scene.ply
  tsplat info capture --json
"""
QUANTILES = (0.0, 0.05, 0.5, 0.95, 1.0)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("path", type=Path, metavar="PATH", help=f"{SCENE}, a capture folder or a transforms.json")
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    path: Path = options.path
    is_capture = (path.is_dir() or path.suffix.lower() == ".json") and not is_sog(path)
    facts = _of_capture(path) if is_capture else _of_scene(path)
    if options.json:
        print_json(facts)
    elif is_capture:
        _print_capture(facts)
    else:
        _print_scene(facts)


def _of_scene(path: Path) -> dict[str, Any]:
    scene = load_scene(path)
    facts: dict[str, Any]
    if isinstance(scene, Spheres):
        facts = {"kind": "spheres", "count": len(scene), "channels": scene.features.shape[1], "gamma": scene.gamma, "near": scene.near,
                 "far": scene.far}
        rows = {**dict(zip("xyz", scene.positions.unbind(1), strict=True)), "opacity": scene.opacities, "radius": scene.radii}
    else:
        facts = {"kind": "gaussians", "count": len(scene), "format": find_format(path).name, "sh_degree": scene.sh_degree}
        rows = {**dict(zip("xyz", scene.means.unbind(1), strict=True)), "opacity": scene.opacities, "scale": scene.scales.amax(1)}
    good = torch.stack([p.detach().flatten(1).isfinite().all(1) if p.ndim > 1 else p.isfinite() for p in scene.parameters()]).all(0)
    facts["not_finite"] = int((~good).sum())
    facts["quantiles"] = None
    if bool(good.any()):
        facts["quantiles"] = {"at": QUANTILES, **{name: quantiles(values[good], QUANTILES) for name, values in rows.items()}}
    return facts


def _print_scene(facts: dict[str, Any]) -> None:
    if facts["kind"] == "spheres":
        print(f"spheres  {facts['count']}, {facts['channels']} channels, gamma {facts['gamma']:g}, near {facts['near']:g}, far {facts['far']:g}")
    else:
        print(f"format   {facts['format']}")
        print(f"splats   {facts['count']}, spherical harmonics of degree {facts['sh_degree']}")
    if facts["not_finite"]:
        print(f"         {facts['not_finite']} of them with NaN or infinity, left out below")
    for name, values in (facts["quantiles"] or {}).items():
        if name == "at":
            print(f"{'':9}" + "".join(f"{f'{q:.0%}':>11}" for q in values))
        else:
            print(f"{name:9}" + "".join(f"{value:11.4g}" for value in values))


def _of_capture(path: Path) -> dict[str, Any]:
    capture = load_capture(path)
    return {"kind": "capture", "count": len(capture), "train": len(capture.train), "test": len(capture.test),
            "sizes": sorted(set(zip(capture.width, capture.height, strict=True))),
            "points": 0 if capture.points is None else len(capture.points), "extent": capture.extent, "masked": capture.masked}


def _print_capture(facts: dict[str, Any]) -> None:
    sizes = facts["sizes"]
    print(f"photos   {facts['count']}: {facts['train']} to train on, {facts['test']} held out")
    print(f"size     {', '.join(f'{w}x{h}' for w, h in sizes[:8])}{', ...' if len(sizes) > 8 else ''}")
    print(f"points   {facts['points']}")
    print(f"extent   {facts['extent']:.4g} (1.1 times the largest distance of a camera from their mean)")
    print(f"masks    {'yes' if facts['masked'] else 'no'}")
