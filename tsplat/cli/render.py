"""`tsplat render`."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from tsplat.camera import Camera
from tsplat.cli.common import AXES, SCENE, add_device, device_of
from tsplat.pictures import CLIPS, FPS, MODES, capture_path, check_clip, depth_range, draw_layers, orbit, picture, write_clip
from tsplat.pictures.modes import Scene
from tsplat.scene import load_capture, load_scene, write_image

HELP = "render a scene to pictures or a clip"
USAGE = "tsplat render SCENE -o OUT [options]"
DESCRIPTION = """
Render a scene as PNG, or as an animated GIF or an MP4 if the name of OUT ends
in .gif or .mp4. An MP4 (which needs `pip install 'tsplat[video]'`) has even
sizes: an odd last column or row is left out.
"""
EXAMPLES = """
  tsplat render scene.ply -o view.png --camera capture --index 3
  tsplat render scene.ply -o view.png --orbit 12
  tsplat render scene.ply -o turn.gif --orbit 60 --mode normals
  tsplat render scene.ply -o fly.mp4 --path capture --frames 240
"""
SIZE = (800, 600)
MOST = 16384                         # pixels along a side: 3 GB of colours in float32. Beyond, systems kill a program rather than refuse it memory
FRAMES = 120
BACKGROUNDS = {"black": 0.0, "white": 1.0, "transparent": None}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("scene", metavar="SCENE", help=SCENE)
    parser.add_argument("-o", "--out", required=True, type=Path, metavar="OUT",
                        help="the picture, or several: OUT_000.png, OUT_001.png, ...; or a clip. Its folder is made")
    views = parser.add_argument_group("where from", "By default, a little above the scene, from -z if y is vertical.")
    view = views.add_mutually_exclusive_group()
    view.add_argument("--camera", metavar="DATA", help="take a camera of this capture (folder or transforms.json)")
    view.add_argument("--orbit", type=int, metavar="N", help="N pictures from around the scene")
    view.add_argument("--path", metavar="DATA", help="along a smooth path through the training cameras of this capture")
    views.add_argument("--index", type=int, metavar="I", help="with --camera: which photo's, in the order of their names (default: 0)")
    views.add_argument("--frames", type=int, metavar="N", help=f"with --path: how many pictures (default: {FRAMES})")
    views.add_argument("--closed", action="store_true", help="with --path: end where it began")
    views.add_argument("--size", type=_size, metavar="WxH", help=f"of the picture (default: the camera's, or {SIZE[0]}x{SIZE[1]})")
    views.add_argument("--fov", type=float, default=50.0, metavar="DEGREES", help="horizontal, without a capture (default: 50)")
    views.add_argument("--up", choices=AXES, default="-y", help="which way is up in the scene, without a capture (default: --up=-y)")
    what = parser.add_argument_group("what of")
    what.add_argument("--mode", choices=MODES, default="color",
                      help="depth: along the camera's axis, near is yellow and far dark violet (viridis). normals: of the surface that the depth "
                           "shows (not of single splats), in the camera's axes: red to the right, green up, blue towards the camera (default: color)")
    what.add_argument("--depth-range", type=float, nargs=2, metavar=("NEAR", "FAR"),
                      help="depths of the ends of the colour map (default: so that 98%% of all that is seen in all pictures is between them)")
    what.add_argument("--background", choices=BACKGROUNDS, default="black", help="transparent: PNG only (default: black)")
    what.add_argument("--antialiased", action="store_true", help="for scenes that were fitted with it")
    parser.add_argument("--fps", type=float, help=f"frames per second of a clip (default: {FPS:g})")
    add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    device, out, clip = device_of(options.device), options.out, options.out.suffix.lower() in CLIPS
    _check(options, clip)
    if clip:
        check_clip(out)
    elif out.suffix.lower() != ".png":
        raise ValueError(f"{out}: expected a file name that ends in .png, {' or '.join(CLIPS)}; got {out.suffix!r}")
    scene = load_scene(options.scene).to(device)
    cameras = [camera.to(device) for camera in _cameras(options, scene)]
    out.parent.mkdir(parents=True, exist_ok=True)
    pictures = _pictures(options, scene, cameras)
    if clip:
        from tqdm import tqdm

        write_clip(out, tqdm(pictures, total=len(cameras), unit="frame", leave=False, disable=None), options.fps or FPS)
        print(out)
        return
    digits = max(3, len(str(len(cameras) - 1)))
    for i, image in enumerate(pictures):
        path = out if options.orbit is None and options.path is None else out.with_name(f"{out.stem}_{i:0{digits}d}{out.suffix}")
        write_image(path, image)
        print(path)


def _check(options: argparse.Namespace, clip: bool) -> None:
    """Options that are out of range, or would be ignored, are errors."""
    ends = options.depth_range
    for name, value, good, expected in (
        ("--orbit", options.orbit, options.orbit is None or options.orbit >= 1, "at least 1"),
        ("--frames", options.frames, options.frames is None or options.frames >= 1, "at least 1"),
        ("--depth-range", ends, ends is None or 0 <= ends[0] < ends[1], "0 <= NEAR < FAR"),
        ("--fov", options.fov, 0 < options.fov < 180, "degrees above 0 and below 180"),
    ):
        if not good:
            raise ValueError(f"{name}: expected {expected}; got {value}")
    for name, given, useful, where in (
        ("--index", options.index is not None, options.camera is not None, "--camera"),
        ("--frames", options.frames is not None, options.path is not None, "--path"),
        ("--closed", options.closed, options.path is not None, "--path"),
        ("--fps", options.fps is not None, clip, "a clip"),
        ("--depth-range", ends is not None, options.mode == "depth", "--mode depth"),
        ("--background transparent", options.background == "transparent", not clip, "PNG"),
    ):
        if given and not useful:
            raise ValueError(f"{name}: expected only with {where}")


def _cameras(options: argparse.Namespace, scene: Scene) -> list[Camera]:
    size = options.size
    if options.camera is None and options.path is None:
        width, height = size or SIZE
        return orbit(scene, options.orbit or 1, width=width, height=height, fov=options.fov, up=AXES[options.up])
    if options.camera is not None:
        capture, index = load_capture(options.camera, test_every=0), options.index or 0
        if not 0 <= index < len(capture):
            raise ValueError(f"--index: expected 0 to {len(capture) - 1}, as {options.camera} has {len(capture)} photos; got {index}")
        cameras = [capture.camera(index)]
    else:
        cameras = capture_path(load_capture(options.path, test_every=0), options.frames or FRAMES, closed=options.closed)
    return cameras if size is None else [camera.resized(*size) for camera in cameras]


def _pictures(options: argparse.Namespace, scene: Scene, cameras: list[Camera]) -> Iterator[Tensor]:
    mode, antialiased = options.mode, options.antialiased
    shade = BACKGROUNDS[options.background]
    background = None if shade is None else torch.full((3,), shade, device=scene.device)
    ends = options.depth_range
    if mode == "depth" and ends is None:
        ends = depth_range(scene, cameras, antialiased=antialiased)
    for camera in cameras:
        layers = draw_layers(scene, camera, depth=mode in ("depth", "normals"), antialiased=antialiased)
        yield picture(layers, camera, mode, background=background, depth_range=ends)


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not all(side.isdecimal() and 1 <= int(side) <= MOST for side in (width, height)):
        raise argparse.ArgumentTypeError(f"expected WxH, such as 800x600, each from 1 to {MOST}; got {text!r}")
    return int(width), int(height)
