"""`tsplat render`."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import torch
from torch import Tensor

from tsplat.camera import Camera
from tsplat.cli.common import SCENE, add_device, device_of, quantiles
from tsplat.fit import draw
from tsplat.scene import Spheres, load_capture, load_scene, write_image

HELP = "render a scene to PNG"
AXES = {sign + axis: tuple(float(f"{sign}1") * (axis == a) for a in "xyz") for sign in ("", "-") for axis in "xyz"}
SIZE = (800, 600)
ELEVATION = 20.0                     # degrees above the horizon, for cameras that frame the scene
FRAMED = 0.95                        # part of the splats to be in the picture; the others may be far away


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("scene", metavar="SCENE", help=SCENE)
    parser.add_argument("-o", "--out", required=True, type=Path, metavar="OUT.png", help="picture to write; its folder is made")
    view = parser.add_mutually_exclusive_group()
    view.add_argument("--camera", metavar="DATA", help="take a camera of this capture (folder or transforms.json)")
    view.add_argument("--orbit", type=int, metavar="N", help="N pictures from around the scene: OUT_000.png, OUT_001.png, ...")
    parser.add_argument("--index", type=int, default=0, metavar="I", help="which photo's camera, in the order of their names (default: 0)")
    parser.add_argument("--size", type=_size, metavar="WxH", help=f"of the picture (default: the camera's, or {SIZE[0]}x{SIZE[1]})")
    parser.add_argument("--fov", type=float, default=50.0, metavar="DEGREES", help="horizontal, without --camera (default: 50)")
    parser.add_argument("--up", choices=AXES, default="-y", help="which way is up in the scene, without --camera (default: --up=-y)")
    parser.add_argument("--background", choices=("black", "white"), default="black", help="(default: black)")
    parser.add_argument("--antialiased", action="store_true", help="for scenes that were fitted with it")
    add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    device = device_of(options.device)
    scene = load_scene(options.scene)
    if options.camera is not None:
        cameras = [_capture_camera(options.camera, options.index, options.size)]
    else:
        centres = scene.positions if isinstance(scene, Spheres) else scene.means
        cameras = _framing_cameras(centres, 1 if options.orbit is None else options.orbit, AXES[options.up],
                                   options.size or SIZE, options.fov)
    out: Path = options.out
    out.parent.mkdir(parents=True, exist_ok=True)
    background = torch.full((3,), float(options.background == "white"), device=device)
    scene.to(device)
    for i, camera in enumerate(cameras):
        with torch.no_grad():
            if isinstance(scene, Spheres):
                image = scene.render(camera.to(device), background=background).image
            else:
                image = draw(scene, camera.to(device), background, antialiased=options.antialiased).image
        path = out if options.orbit is None else out.with_name(f"{out.stem}_{i:03d}{out.suffix}")
        write_image(path, image)
        print(path)


def _capture_camera(data: str, index: int, size: tuple[int, int] | None) -> Camera:
    capture = load_capture(data, test_every=0)
    if not 0 <= index < len(capture):
        raise ValueError(f"--index: expected 0 to {len(capture) - 1}, as {data} has {len(capture)} photos; got {index}")
    camera = capture.camera(index)
    return camera if size is None else camera.resized(*size)


def _framing_cameras(means: Tensor, count: int, up: tuple[float, ...], size: tuple[int, int], fov: float) -> list[Camera]:
    """Cameras on a circle around the middle of the splats, so far off that most of them are in the picture."""
    if count < 1:
        raise ValueError(f"--orbit: expected at least 1; got {count}")
    if not 0 < fov < 180:
        raise ValueError(f"--fov: expected degrees above 0 and below 180; got {fov}")
    means = means.detach()[means.isfinite().all(1)]
    centre, radius = torch.zeros(3), 1.0
    if len(means):
        centre = torch.tensor([sum(quantiles(axis, [1 - FRAMED, FRAMED])) / 2 for axis in means.unbind(1)])
        radius = quantiles((means - centre).norm(dim=1), [FRAMED])[0] or 1.0
    slope = math.tan(math.radians(fov) / 2) * min(1.0, size[1] / size[0])
    distance = radius / math.sin(math.atan(slope))
    axis = torch.tensor(up)
    back = -axis.abs().roll(1)                                     # from where the first camera looks: -z if y is vertical
    side = torch.linalg.cross(axis, back)
    elevation = math.radians(ELEVATION)
    cameras = []
    for i in range(count):
        angle = 2 * math.pi * i / count
        level = math.cos(angle) * back + math.sin(angle) * side
        eye = centre + distance * (math.cos(elevation) * level + math.sin(elevation) * axis)
        cameras.append(Camera.look_at(eye, centre, up, width=size[0], height=size[1], fov=fov))
    return cameras


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit() and int(width) and int(height)):
        raise argparse.ArgumentTypeError(f"expected WxH, such as 800x600; got {text!r}")
    return int(width), int(height)
