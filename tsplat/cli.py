"""The command line: `tsplat fit`, `tsplat eval`, `tsplat render`, `tsplat convert`, `tsplat info`."""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
import sys
import typing
import warnings
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

import tsplat
from tsplat.camera import Camera
from tsplat.fit import FitConfig, Quality, draw, evaluate, fit
from tsplat.fit.evaluation import mean_quality
from tsplat.fit.output import metrics_of, read_config, write_json
from tsplat.scene import Gaussians, Spheres, load_capture, load_scene, write_image, write_synthetic_capture
from tsplat.scene.formats import FORMATS, find_format, is_sog

INTERRUPTED = 130                    # the exit status of a shell's command that was stopped by Ctrl-C
AXES = {sign + axis: tuple(float(f"{sign}1") * (axis == a) for a in "xyz") for sign in ("", "-") for axis in "xyz"}
SIZE = (800, 600)
ELEVATION = 20.0                     # degrees above the horizon, for cameras that frame the scene
FRAMED = 0.95                        # part of the splats to be in the picture; the others may be far away
SCENE = f"a scene file ({', '.join(item.suffix for item in FORMATS)})"
QUANTILES = (0.0, 0.05, 0.5, 0.95, 1.0)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status: 0, 2 for an error (one line on stderr), 130 after Ctrl-C.

    Args:
        argv: the arguments, default `sys.argv[1:]`.
    """
    options = _parser().parse_args(argv)
    debug = options.debug or bool(os.environ.get("TSPLAT_DEBUG"))
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_: print(f"tsplat: warning: {message}", file=sys.stderr)
            options.run(options)
    except KeyboardInterrupt as interrupt:
        print(f"tsplat: {interrupt or 'interrupted'}", file=sys.stderr)
        return INTERRUPTED
    except (ValueError, OSError, ArithmeticError, NotImplementedError, MemoryError, ImportError) as error:
        if debug:
            raise
        print(f"tsplat: error: {_text(error)}", file=sys.stderr)
        return 2
    return 0


def _text(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None and error.strerror is not None:
        return f"{error.filename}: {error.strerror}"
    return str(error) or type(error).__name__


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="tsplat", description="Fit, render, convert and inspect scenes of Gaussian splats.")
    parser.add_argument("--version", action="version", version=f"tsplat {tsplat.__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument("--debug", action="store_true", help="show where an error came from (also: TSPLAT_DEBUG=1)")
    _add_fit(commands.add_parser("fit", parents=[shared], help="fit a scene to photos"))
    _add_eval(commands.add_parser("eval", parents=[shared], help="measure a scene file against held-out photos"))
    _add_render(commands.add_parser("render", parents=[shared], help="render a scene to PNG"))
    _add_convert(commands.add_parser("convert", parents=[shared], help="write a scene in another file format"))
    _add_info(commands.add_parser("info", parents=[shared], help="say what is in a scene file or a folder of photos"))
    return parser


def _add_fit(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(run=_fit)
    parser.description = ("Fit Gaussians, or spheres, to posed photos. Writes scene.ply, metrics.json, config.json, curves.png, test/*.png (held-out "
                          "photo beside render), contact.png and checkpoint.pt, from which the same command goes on after an interruption.")
    data = parser.add_mutually_exclusive_group(required=True)
    data.add_argument("data", nargs="?", metavar="DATA", help="folder of a COLMAP model with photos, or of a transforms.json")
    data.add_argument("--synthetic", action="store_true",
                      help="no photos at hand: render a small capture of a made-up scene to OUT/capture, and fit that")
    parser.add_argument("-o", "--out", required=True, type=Path, metavar="OUT", help="folder to write to, made if need be")
    parser.add_argument("--config", type=Path, metavar="FILE", help="a config.json, for what is not given here: makes the same scene again")
    parser.add_argument("--fresh", action="store_true", help="start anew instead of going on from OUT/checkpoint.pt")
    parser.add_argument("--quiet", action="store_true", help="no progress line")
    _add_device(parser)
    _add_fields(parser, [item.name for item in dataclasses.fields(FitConfig)])


def _add_fields(parser: argparse.ArgumentParser, names: Sequence[str]) -> None:
    """An option for each of these fields of `FitConfig`, which is not in the result if it was not given."""
    kinds = typing.get_type_hints(FitConfig)
    for item in dataclasses.fields(FitConfig):
        if item.name not in names:
            continue
        kind, text = kinds[item.name], item.metadata["help"]
        if item.default is None:                                                     # `kind | None`, of which the help says what None means
            kind = next(k for k in typing.get_args(kind) if k is not type(None))
        else:
            text = f"{text} (default: {item.default:g})" if kind is float else f"{text} (default: {item.default})"
        flag = "--" + item.name.replace("_", "-")
        if kind is bool:
            parser.add_argument(flag, action=argparse.BooleanOptionalAction, default=argparse.SUPPRESS, help=text)
        elif choices := typing.get_args(kind):
            parser.add_argument(flag, choices=choices, default=argparse.SUPPRESS, help=text)
        else:
            parser.add_argument(flag, type=kind, default=argparse.SUPPRESS, metavar=kind.__name__.upper(), help=text)


def _add_eval(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(run=_eval)
    parser.description = ("Measure a scene against the held-out photos of a capture. What is not given here is taken from the config.json "
                          "beside the scene, if there is one: then the result is what metrics.json says.")
    parser.add_argument("scene", type=Path, metavar="SCENE", help=SCENE)
    parser.add_argument("data", metavar="DATA", help="the capture: folder or transforms.json")
    parser.add_argument("-o", "--out", type=Path, metavar="OUT.json", help="also write the metrics of each photo to this file")
    _add_device(parser)
    _add_fields(parser, ("downscale", "test_every", "background", "antialiased"))


def _add_render(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(run=_render)
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
    _add_device(parser)


def _add_convert(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(run=_convert)
    parser.description = "Write a scene in the format that the name of OUT says; its folder is made."
    parser.add_argument("scene", metavar="IN", help=SCENE)
    parser.add_argument("out", type=Path, metavar="OUT", help=f"a scene file ({', '.join(item.suffix for item in FORMATS if item.write)})")


def _add_info(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(run=_info)
    parser.add_argument("path", type=Path, metavar="PATH", help=f"{SCENE}, a capture folder or a transforms.json")


def _add_device(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--device", default="cpu", help="where to compute, as torch names it (default: cpu)")


def _fit(options: argparse.Namespace) -> None:
    config = _config(options, options.config)
    data = options.data
    if options.synthetic:
        data = options.out / "capture"
        if not (data / "sparse" / "0" / "points3D.txt").exists():              # the file that is written last
            print(f"rendering a small capture of a made-up scene to {data}")
            write_synthetic_capture(data)
    result = fit(data, config, options.out, resume=not options.fresh, progress=not options.quiet, device=_device(options.device))
    _print_mean(result.qualities)
    if result.refined_mean is not None:
        print(f"with their poses refined, too: PSNR {result.refined_mean.psnr:.2f} dB, SSIM {result.refined_mean.ssim:.4f}")
    print(f"{len(result.gaussians)} splats after {config.steps} steps in {result.seconds:.0f} s: {options.out / 'scene.ply'}")


def _config(options: argparse.Namespace, path: Path | None) -> FitConfig:
    """What the options say, on top of what the file says."""
    given = {item.name: getattr(options, item.name) for item in dataclasses.fields(FitConfig) if hasattr(options, item.name)}
    return FitConfig(**given) if path is None else dataclasses.replace(read_config(path), **given)


def _eval(options: argparse.Namespace) -> None:
    beside = options.scene.with_name("config.json")
    config = _config(options, beside if beside.is_file() else None)
    scene = load_scene(options.scene).to(_device(options.device))
    config = dataclasses.replace(config, primitive="spheres" if isinstance(scene, Spheres) else "gaussians")
    capture = load_capture(options.data, downscale=config.downscale, test_every=config.test_every)
    if not capture.test:
        raise ValueError(f"{options.data}: expected held-out photos; there are none with test_every = {config.test_every}")
    qualities = evaluate(scene, capture, capture.test, config)
    for name, quality in qualities.items():
        print(f"{name}: PSNR {quality.psnr:.2f} dB, SSIM {quality.ssim:.4f}")
    _print_mean(qualities)
    if options.out is not None:
        write_json(options.out, metrics_of(qualities))


def _print_mean(qualities: dict[str, Quality]) -> None:
    mean = mean_quality(qualities)
    if mean is not None:
        print(f"{len(qualities)} held-out photos: PSNR {mean.psnr:.2f} dB, SSIM {mean.ssim:.4f}")


def _render(options: argparse.Namespace) -> None:
    device = _device(options.device)
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
    if size is None:
        return camera
    Ks = camera.Ks * torch.tensor([[size[0] / camera.width], [size[1] / camera.height], [1.0]])
    return dataclasses.replace(camera, Ks=Ks, width=size[0], height=size[1])


def _framing_cameras(means: Tensor, count: int, up: tuple[float, ...], size: tuple[int, int], fov: float) -> list[Camera]:
    """Cameras on a circle around the middle of the splats, so far off that most of them are in the picture."""
    if count < 1:
        raise ValueError(f"--orbit: expected at least 1; got {count}")
    if not 0 < fov < 180:
        raise ValueError(f"--fov: expected degrees above 0 and below 180; got {fov}")
    means = means.detach()[means.isfinite().all(1)]
    centre, radius = torch.zeros(3), 1.0
    if len(means):
        centre = torch.tensor([sum(_quantiles(axis, [1 - FRAMED, FRAMED])) / 2 for axis in means.unbind(1)])
        radius = _quantiles((means - centre).norm(dim=1), [FRAMED])[0] or 1.0
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


def _convert(options: argparse.Namespace) -> None:
    out: Path = options.out
    gaussians = Gaussians.load(options.scene)
    out.parent.mkdir(parents=True, exist_ok=True)
    gaussians.save(out)
    print(f"{len(gaussians)} splats: {out} ({out.stat().st_size} bytes)")


def _info(options: argparse.Namespace) -> None:
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
        print(f"{name:9}" + "".join(f"{value:11.4g}" for value in _quantiles(values.detach()[good], QUANTILES)))


def _print_capture(path: Path) -> None:
    capture = load_capture(path)
    sizes = sorted(set(zip(capture.width, capture.height, strict=True)))
    print(f"photos   {len(capture)}: {len(capture.train)} to train on, {len(capture.test)} held out")
    print(f"size     {', '.join(f'{w}x{h}' for w, h in sizes[:8])}{', ...' if len(sizes) > 8 else ''}")
    print(f"points   {0 if capture.points is None else len(capture.points)}")
    print(f"extent   {capture.extent:.4g} (1.1 times the largest distance of a camera from their mean)")
    print(f"masks    {'yes' if capture.masked else 'no'}")


def _quantiles(values: Tensor, at: Sequence[float]) -> list[float]:
    """Of non-empty `[n]`, to the nearest value."""
    ordered = values.sort().values
    return [float(ordered[round(q * (len(ordered) - 1))]) for q in at]


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit() and int(width) and int(height)):
        raise argparse.ArgumentTypeError(f"expected WxH, such as 800x600; got {text!r}")
    return int(width), int(height)


def _device(name: str) -> torch.device:
    try:
        return torch.device(name)
    except RuntimeError:
        raise ValueError(f"--device: expected a device as torch names it, such as cpu or cuda; got {name!r}") from None
