"""What Pulsar's applications share: spheres to optimise, views to compare with, the loop, pictures, and the report."""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import tsplat
from tsplat.fit.spheres import gamma_at, refine
from tsplat.scene import load_capture, write_image

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "bench"))

from output import add_json, environment, print_json, printing  # noqa: E402

PICTURES = ROOT / "bench" / "pictures"
SLOWEST = 0.1
"""Part of the learning rates that the last step of a stage has."""
LAST_ROUND = 0.1
PSNR = "held-out PSNR, dB"


def arguments(doc: str | None, application: str, **options: float) -> argparse.ArgumentParser:
    """The options of all applications, and those of one: numbers with defaults. The application's name is that of its script and its picture."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("TSPLAT_DATA", ROOT.parent / "shared")) / "data",
                        help="folder of the data sets (default: data in the folder TSPLAT_DATA)")
    parser.add_argument("--picture", type=Path, default=PICTURES / f"{application}.png", help="the picture to write")
    parser.add_argument("--targets", action="store_true", help="show the views, too: above, in the picture (for data that may be copied only)")
    parser.add_argument("--seed", type=int, default=0)
    parser.set_defaults(application=application)
    add_json(parser)
    for name, default in options.items():
        parser.add_argument("--" + name.replace("_", "-"), type=type(default), default=default, help=f"default {default}")
    return parser


class Spheres(tsplat.Spheres):
    """`tsplat.Spheres`, with the steps between which they are optimised."""

    @staticmethod
    def of(positions: Tensor, radii: Tensor, features: Tensor, opacities: Tensor) -> Spheres:
        """From radii and opacities, `[N]` each."""
        return Spheres(positions, radii.log(), opacities.logit(), features)

    @torch.no_grad()
    def select(self, keep: Tensor) -> Spheres:
        """Only those of a mask or with these indices."""
        return Spheres.of(self.positions[keep], self.radii[keep], self.features[keep], self.opacities[keep])

    @torch.no_grad()
    def refined(self, reach: float) -> Spheres:
        """Each split into 12 that inherit its features and opacity."""
        positions, radii, parents = refine(self.positions, self.radii, reach)
        return Spheres.of(positions, radii, self.features[parents], self.opacities[parents])

    @torch.no_grad()
    def relocated(self, alive: Tensor, generator: torch.Generator) -> Spheres:
        """As many spheres, but those that are not alive are copies of random ones that are, moved by about 0.7 of their radius per axis."""
        live = alive.nonzero().squeeze(1)
        if not len(live):
            raise ValueError("alive: expected a sphere that is; got none (too high learning rates?)")
        copied = live[torch.randint(len(live), (len(self) - len(live),), generator=generator)]
        spheres = self.select(torch.cat([live, copied]))
        spheres.positions[len(live):] += 0.7 * spheres.radii[len(live):, None] * torch.randn(len(copied), 3, generator=generator)
        return spheres

    @torch.no_grad()
    def with_features(self, features: Tensor) -> Spheres:
        """The same with other features."""
        spheres = Spheres.of(self.positions, self.radii, features, self.opacities)
        for name, parameter in spheres.named_parameters():
            parameter.requires_grad_(self.get_parameter(name).requires_grad)
        return spheres

    def groups(self, size: float, speed: float = 1.0) -> list[dict[str, object]]:
        """Adam's parameter groups: positions move in proportion to the scene's size."""
        rates = (self.positions, 2e-3 * size), (self.log_radii, 1e-2), (self.features, 2e-2), (self.opacity_logits, 5e-2)
        return [{"params": [parameter], "lr": speed * rate} for parameter, rate in rates]


@dataclass(frozen=True)
class Stage:
    """Where the object is: how an image of spheres comes about.

    centre: `[3]`, and radius of a ball that holds it. background: `[D]`. Near and far are where the ball begins and ends for a camera at
    `distance` from its centre.
    """

    centre: Tensor
    radius: float
    distance: float
    background: Tensor
    fade_below: float = 0.0

    @property
    def planes(self) -> dict[str, float]:
        """Near and far of `render_spheres`."""
        return {"near": max(0.0, self.distance - self.radius), "far": self.distance + self.radius}

    def render(self, spheres: Spheres, camera: tsplat.Camera, gamma: float, features: Tensor | None = None) -> Tensor:
        """Images `[(C,) H, W, D]`."""
        return tsplat.render_spheres(spheres.positions, spheres.features if features is None else features, spheres.radii, camera,
                                     opacities=spheres.opacities, background=self.background, gamma=gamma, fade_below=self.fade_below,
                                     **self.planes).image


@dataclass(frozen=True)
class Views:
    """C images `[C, H, W, D]` with their cameras."""

    cameras: tsplat.Camera
    images: Tensor

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: Tensor) -> Views:
        return Views(self.cameras[index], self.images[index])

    def each(self) -> Iterator[tuple[tsplat.Camera, Tensor]]:
        """One after the other."""
        return ((self.cameras[i], image) for i, image in enumerate(self.images))


def load_views(folder: Path, downscale: float, background: Tensor) -> tuple[Views, Views]:
    """Training and held-out views of a capture of RGBA images, over a background."""
    capture = load_capture(folder, downscale=downscale)
    images = torch.stack([capture.images[i] for i in range(len(capture))])
    images = images[..., :3] * images[..., 3:] + background * (1 - images[..., 3:])
    cameras = tsplat.Camera(capture.viewmats, capture.Ks, capture.width[0], capture.height[0])
    views = Views(cameras, images)
    return views[torch.tensor(capture.train)], views[torch.tensor(capture.test)]


def orbit(eyes: Tensor, size: int, fov: float, up: tuple[float, float, float] = (0.0, 1.0, 0.0)) -> tsplat.Camera:
    """A batch of cameras at `[C, 3]` that look at the origin."""
    cameras = [tsplat.Camera.look_at(eye, (0, 0, 0), up, width=size, height=size, fov=fov) for eye in eyes]
    return tsplat.Camera(torch.stack([c.viewmats for c in cameras]), torch.stack([c.Ks for c in cameras]), size, size)


def optimise(groups: list[dict[str, object]], views: Views, loss: Callable[[Views, float], Tensor], *, steps: int, batch: int,
             gamma: tuple[float, float], generator: torch.Generator, name: str) -> None:
    """Adam on the loss of random batches of views, with gamma falling, and learning rates as half a cosine."""
    from tqdm import trange

    adam = torch.optim.Adam(groups, eps=1e-15)              # type: ignore[arg-type]
    decay = torch.optim.lr_scheduler.LambdaLR(adam, lambda step: SLOWEST + (1 - SLOWEST) * (1 + math.cos(math.pi * step / steps)) / 2)
    order: list[int] = []
    with trange(steps, desc=name, mininterval=1, disable=None) as bar:
        for step in bar:
            if len(order) < batch:
                order += torch.randperm(len(views), generator=generator).tolist()
            some, order = torch.tensor(order[:batch]), order[batch:]
            value = loss(views[some], gamma_at(step, steps, *gamma))
            adam.zero_grad()
            value.backward()
            adam.step()
            decay.step()
            if step % 10 == 0:
                bar.set_postfix(loss=f"{value.item():.4f}")


def optimise_and_relocate(spheres: Spheres, views: Views, loss: Callable[[Spheres, Views, float], Tensor],
                          alive: Callable[[Spheres], Tensor], *, rounds: int, steps: int, size: float, speed: float, batch: int,
                          gamma: tuple[float, float], generator: torch.Generator, name: str) -> tuple[Spheres, int]:
    """`optimise` in rounds, of `steps` in all; between these, spheres that are not alive go where others are. From the first round to the last,
    learning rates fall to `LAST_ROUND`: the shape comes first, its outline last. Returns the spheres, and how many went elsewhere, in all rounds."""
    moved = 0
    fall = (gamma[1] / gamma[0]) ** (1 / rounds)
    for i in range(rounds):
        if i:
            live = alive(spheres)
            moved += int((~live).sum())
            spheres = spheres.relocated(live, generator)
        ends = gamma[0] * fall**i, gamma[0] * fall ** (i + 1)
        groups = spheres.groups(size, speed * LAST_ROUND ** (i / max(1, rounds - 1)))
        optimise(groups, views, partial(loss, spheres), steps=max(1, steps // rounds), batch=batch, gamma=ends, generator=generator,
                 name=f"{name} {i + 1}/{rounds}")
    return spheres, moved


def psnr(image: Tensor, target: Tensor) -> float:
    """In dB, for a peak of 1."""
    return float(-10 * (image.clamp(0, 1) - target).square().mean().log10())


@torch.no_grad()
def mean_psnr(draw: Callable[[tsplat.Camera], Tensor], views: Views) -> float:
    """Mean over views of the PSNR of what `draw` makes of a camera."""
    return sum(psnr(draw(camera), image) for camera, image in views.each()) / len(views)


def write_rows(path: Path, rows: Iterable[Iterable[Tensor]], targets: Iterable[Tensor] | None = None) -> None:
    """Images `[H, W, 1 or 3]` of one size, row by row, as a PNG; above them, the targets, if they are to be shown."""
    rows = rows if targets is None else [targets, *rows]
    write_image(path, torch.cat([torch.cat([image.expand(-1, -1, 3) for image in row], 1) for row in rows]).clamp(0, 1))


@contextlib.contextmanager
def report(args: argparse.Namespace, measure: str, goal: float | None = None) -> Iterator[dict[str, Any]]:
    """Around all that an application does: its time, and with `--json` its document, unless it fails.

    Args:
        args: its options.
        measure: what its figures are.
        goal: what the last of them is to reach.

    Yields:
        The document, into which the application puts `figures`, by stage; `spheres`, how many there are in the end; and `steps`, of Adam, in
        all. Where they tell something: `counts`, of the spheres that each figure is of; `relocated`, how many were; `note`, what a reader of
        the figures has to know.
    """
    wall, cpu = time.perf_counter(), time.process_time()
    document: dict[str, Any] = {"application": args.application, "measure": measure}
    with printing(args.json):
        yield document
        document |= {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}
        if goal is not None:
            *_, last = document["figures"].values()
            document |= {"goal": goal, "met": last >= goal}
            print(f"{args.application}: goal {goal:g} {'met' if document['met'] else 'missed'}")
        print(f"{document['cpu_s']:.0f} s of CPU time, {document['wall_s']:.0f} s in all; {args.picture.name} written", flush=True)
    if args.json:
        print_json(environment("cpu") | document)
