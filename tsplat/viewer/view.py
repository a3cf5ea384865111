"""`draw_view`: what the viewer shows, as a pure function of the scene, the camera and what the visitor chose."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from tsplat.camera import Camera
from tsplat.checks import check_choice
from tsplat.pictures import MODES, Mode, draw_layers, picture
from tsplat.pictures.modes import Scene
from tsplat.scene import Gaussians, Spheres
from tsplat.scene.image_files import to_bytes

Pixels: TypeAlias = NDArray[np.uint8]


@dataclass(frozen=True)
class Settings:
    """What a visitor chooses.

    Args:
        mode: see `tsplat.pictures.picture`.
        splat_size: factor of the splats' scales, or of the spheres' radii; above 0.
        sh_degree: bands of spherical harmonics to use, at most; None for all.
        background: red, green and blue in 0..1.
        antialiased: see `tsplat.rasterize`; for Gaussians.
    """

    mode: Mode = "color"
    splat_size: float = 1.0
    sh_degree: int | None = None
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    antialiased: bool = False

    def __post_init__(self) -> None:
        check_choice("mode", self.mode, MODES)
        if not self.splat_size > 0:
            raise ValueError(f"splat_size: expected above 0; got {self.splat_size}")


@torch.no_grad()
def draw_view(scene: Scene, camera: Camera, settings: Settings) -> Pixels:
    """Render a scene for people.

    Args:
        scene: Gaussians, or spheres of 1 or 3 channels.
        camera: one, on any device.

    Returns:
        `[H, W, 3]`.
    """
    camera = camera.to(scene.device)
    layers = draw_layers(_as_chosen(scene, settings), camera, depth=settings.mode not in ("color", "alpha"), antialiased=settings.antialiased)
    image = picture(layers, camera, settings.mode, background=torch.tensor(settings.background, device=scene.device))
    pixels: Pixels = to_bytes(image).numpy()
    return pixels


def _as_chosen(scene: Scene, settings: Settings) -> Scene:
    """With the size and the bands that the settings ask for; the scene itself, if it has them."""
    larger = math.log(settings.splat_size)
    if isinstance(scene, Spheres):
        return scene if not larger else Spheres(scene.positions, scene.log_radii + larger, scene.opacity_logits, scene.features,
                                                gamma=scene.gamma, near=scene.near, far=scene.far)
    degree = scene.sh_degree if settings.sh_degree is None else min(settings.sh_degree, scene.sh_degree)
    if not larger and degree == scene.sh_degree:
        return scene
    return Gaussians(scene.means, scene.quats, scene.log_scales + larger, scene.opacity_logits, scene.sh0, scene.sh_rest[:, :(degree + 1)**2 - 1])
