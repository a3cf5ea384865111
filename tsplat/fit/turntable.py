"""A turn around a scene, as its photos were taken: at their distance, height and upright."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from tsplat.camera import Camera
from tsplat.fit.config import FitConfig
from tsplat.fit.drawing import fixed_background
from tsplat.fit.initial import view_cube
from tsplat.fit.primitive import Scene, primitive_of
from tsplat.pictures.clip import write_clip
from tsplat.scene import Capture

MAX_SIDE = 480         # pixels of a frame
FPS = 20.0


def turntable(capture: Capture, frames: int) -> list[Camera]:
    """Cameras on a circle around the middle of what the photos show, with the lens of the first photo, at most 480 pixels wide or high."""
    low, high = (torch.tensor(corner, dtype=torch.float64) for corner in view_cube(capture))
    centre = (low + high) / 2
    poses = capture.viewmats.double()
    eyes = -(poses[:, :3, :3].mT @ poses[:, :3, 3:])[..., 0] - centre                  # [C, 3] from the centre
    up = _unit(-poses[:, 1, :3].mean(0), torch.tensor([0.0, -1.0, 0.0]))
    heights = eyes @ up
    away = eyes - heights[:, None] * up                                               # [C, 3] in the plane of the circle
    radius = float(away.norm(dim=1).median()) or capture.extent
    least = int(up.abs().argmin())
    front = _unit(away[0], torch.linalg.cross(up, torch.eye(3, dtype=torch.float64)[least]))
    side = torch.linalg.cross(up, front)
    first = capture.camera(0)
    scale = min(1.0, MAX_SIDE / max(first.width, first.height))
    width, height = (max(1, round(scale * side_)) for side_ in (first.width, first.height))
    fov = 2 * math.degrees(math.atan(first.width / 2 / float(first.Ks[0, 0])))
    cameras = []
    for i in range(frames):
        angle = 2 * math.pi * i / frames
        eye = centre + radius * (math.cos(angle) * front + math.sin(angle) * side) + float(heights.median()) * up
        cameras.append(Camera.look_at(eye, centre, up, width=width, height=height, fov=fov))
    return cameras


@torch.no_grad()
def write_turntable(path: Path, scene: Scene, capture: Capture, config: FitConfig, frames: int, device: torch.device) -> None:
    """Write the turn, drawn on `device`, as a clip (`tsplat.pictures.write_clip`)."""
    primitive = primitive_of(config)
    background = fixed_background(config).to(device)
    write_clip(path, (primitive.draw(scene, camera.to(device), background, config).image for camera in turntable(capture, frames)), FPS)


def _unit(vector: Tensor, otherwise: Tensor) -> Tensor:
    length = float(vector.norm())
    return vector / length if length > 1e-6 else (otherwise / otherwise.norm()).to(vector)
