"""Where a visitor stands and looks: as web pages say it (viser's conventions), and as tsplat's cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from tsplat_reference import camera_centers
from tsplat_reference.projection import rotation_matrix

from tsplat.camera import Camera

UPRIGHT = 0.05
"""Least cosine of the scene's up and the picture's for which the camera goes on turning about an axis in the plane of the former."""
NEAREST = 0.1
"""Least distance of the point that a camera turns around, as a part of the camera's distance to the middle of the scene."""


class Viewpoint(NamedTuple):
    """A pinhole camera with square pixels and its principal point in the middle.

    Args:
        wxyz: unit quaternion of the rotation from the camera's axes (OpenCV's: x right, y down, z forward) to the world's.
        position: of the camera in the world.
        fov: vertical field of view in radians.
        width, height: of the picture in pixels.
    """

    wxyz: tuple[float, ...]
    position: tuple[float, ...]
    fov: float
    width: int
    height: int

    def camera(self, divisor: int = 1) -> Camera:
        """In float32, at `1 / divisor` of the resolution."""
        rotation = torch.tensor(rotation_matrix(list(self.wxyz)), dtype=torch.float64)
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, :3], viewmat[:3, 3] = rotation.T, -rotation.T @ torch.tensor(self.position, dtype=torch.float64)
        f = 0.5 * self.height / math.tan(self.fov / 2)
        K = torch.tensor([[f, 0, self.width / 2], [0, f, self.height / 2], [0, 0, 1]])
        camera = Camera(viewmat.float(), K, self.width, self.height)
        return camera.resized(*(max(1, round(side / divisor)) for side in (self.width, self.height)))


class Stance(NamedTuple):
    """How a page is told where to stand: `position` and `look_at` are points, `up` is a direction that is not along the view, and `fov` is
    vertical, in radians. The mouse turns the camera around `look_at`, and about `up`.
    """

    position: tuple[float, ...]
    look_at: tuple[float, ...]
    up: tuple[float, ...]
    fov: float


def stance(camera: Camera, middle: Tensor, up: Sequence[float] | Tensor, aspect: float | None = None) -> Stance:
    """Where to stand to see what a camera sees, all of it.

    Args:
        camera: one pinhole camera.
        middle: `[3]`, of the scene: the camera turns around the point on its axis that is nearest to it.
        up: `[3]`, of the scene. It stays up, unless the camera is turned about its axis: then the picture's up is.
        aspect: width over height of the page, default that of the camera. The principal point goes to the middle.
    """
    viewmat, K = camera.viewmats.double().cpu(), camera.Ks.double().cpu()
    right, down, forward = viewmat[:3, :3]
    eye, middle, up = camera_centers(viewmat), middle.double().cpu(), torch.as_tensor(up, dtype=torch.float64)
    distance = max(float((middle - eye) @ forward), NEAREST * float((middle - eye).norm())) or 1.0
    level = up - (up @ right) * right
    if float(level @ -down) < UPRIGHT:
        level = -down
    half_width, half_height = camera.width / 2 / float(K[0, 0]), camera.height / 2 / float(K[1, 1])
    fov = 2 * math.atan(max(half_height, 0.0 if aspect is None else half_width / aspect))
    return Stance(tuple(eye.tolist()), tuple((eye + distance * forward).tolist()), tuple(level.tolist()), fov)
