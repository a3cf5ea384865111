"""Views to take pictures from: a circle around a scene, and a path through the cameras of a capture."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from tsplat.camera import Camera
from tsplat.pictures.modes import Scene
from tsplat.pictures.spline import Poses, round_trip, spline
from tsplat.scene import Capture, Spheres
from tsplat.scene.quantiles import quantiles

ELEVATION = 20.0                     # degrees above the horizon
FRAMED = 0.95                        # part of the splats to be in the picture; the others may be far away
FRAMES_PER_KEY = 15                  # of a path, at least: one through every photo of a hand-held camera would shake as the hand did


def orbit(scene: Scene, frames: int, *, width: int, height: int, fov: float = 50.0, up: Sequence[float] = (0.0, -1.0, 0.0)) -> list[Camera]:
    """Cameras on a circle around the middle of the splats, so far off that most of them are in the picture.

    Args:
        scene: to go around.
        frames: cameras, evenly spread.
        width, height: of the pictures, in pixels.
        fov: horizontal field of view in degrees.
        up: which way is up in the scene: an axis, or minus one.

    Raises:
        ValueError: naming the argument.
    """
    if frames < 1:
        raise ValueError(f"frames: expected at least 1; got {frames}")
    if not 0 < fov < 180:
        raise ValueError(f"fov: expected degrees above 0 and below 180; got {fov}")
    centre, radius = _middle((scene.positions if isinstance(scene, Spheres) else scene.means).detach().cpu())
    slope = math.tan(math.radians(fov) / 2) * min(1.0, height / width)
    distance = radius / math.sin(math.atan(slope))
    axis = torch.tensor(up)
    back = -axis.abs().roll(1)                                     # from where the first camera looks: -z if y is vertical
    side = torch.linalg.cross(axis, back)
    elevation = math.radians(ELEVATION)
    cameras = []
    for i in range(frames):
        angle = 2 * math.pi * i / frames
        level = math.cos(angle) * back + math.sin(angle) * side
        eye = centre + distance * (math.cos(elevation) * level + math.sin(elevation) * axis)
        cameras.append(Camera.look_at(eye, centre, up, width=width, height=height, fov=fov))
    return cameras


def capture_path(capture: Capture, frames: int, *, closed: bool = False) -> list[Camera]:
    """A smooth path, at an even speed, through cameras of a capture, with the lens and the picture size of the first of them.

    It goes by the photos to train on (of more than one for 15 frames, only so many, evenly chosen), on a short way through them rather
    than in the order of their names, which need not be that of a walk.

    Args:
        capture: with at least one photo.
        frames: cameras along the path.
        closed: end where the path began, so that a clip can be repeated.

    Raises:
        ValueError: naming the argument.
    """
    if frames < 1:
        raise ValueError(f"frames: expected at least 1; got {frames}")
    chosen = capture.train or list(range(len(capture)))
    count = max(4, frames // FRAMES_PER_KEY)
    if count < len(chosen):
        chosen = [chosen[i * len(chosen) // count] for i in range(count)]
    keys = Poses.of(capture.viewmats[chosen])
    table = Poses(keys.eyes[:, None], keys.quats[:, None]).distance(keys, capture.extent)
    order = round_trip(table, closed=closed)
    path = spline(keys.at(order), frames, capture.extent, closed=closed)
    first = capture.camera(chosen[0])
    return [Camera(viewmat, first.Ks, first.width, first.height) for viewmat in path.viewmats().to(first.viewmats)]


def _middle(centres: Tensor) -> tuple[Tensor, float]:
    """Centre `[3]` and radius of what most of the splats are in; the unit sphere if there are none."""
    centres = centres[centres.isfinite().all(1)]
    if not len(centres):
        return torch.zeros(3), 1.0
    centre = torch.tensor([sum(quantiles(axis, [1 - FRAMED, FRAMED])) / 2 for axis in centres.unbind(1)])
    return centre, quantiles((centres - centre).norm(dim=1), [FRAMED])[0] or 1.0
