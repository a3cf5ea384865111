"""`picture`: what the viewer shows, as a pure function of the scene, the camera and what the visitor chose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tsplat.camera import Camera
from tsplat.checks import check_choice
from tsplat.rasterize import rasterize
from tsplat.scene import Gaussians, Spheres
from tsplat.spheres import render_spheres

Scene: TypeAlias = Gaussians | Spheres
Pixels: TypeAlias = NDArray[np.uint8]
Mode = Literal["colour", "depth", "alpha"]
MODES: tuple[Mode, ...] = get_args(Mode)

DEPTH_COLORS = torch.tensor([[1.0, 0.95, 0.6], [0.99, 0.6, 0.25], [0.8, 0.25, 0.4], [0.42, 0.1, 0.5], [0.1, 0.05, 0.3]])
"""From the nearest to the farthest."""
DEPTH_RANGE = 0.02, 0.98      # quantiles: a few splats far off would leave one colour for all others
SOLID = 0.5                   # alpha from which a pixel's depth counts for the range
SAMPLE = 10_000               # pixels, whose quantiles are good enough, and take 1 ms instead of 100


@dataclass(frozen=True)
class Settings:
    """What a visitor chooses.

    Args:
        mode: `"colour"`, `"depth"` (near is light, far is dark; over the range of this picture) or `"alpha"`.
        splat_size: factor of the splats' scales, or of the spheres' radii; above 0.
        sh_degree: bands of spherical harmonics to use, at most; None for all.
        background: red, green and blue in 0..1.
        antialiased: see `tsplat.rasterize`; for Gaussians.
    """

    mode: Mode = "colour"
    splat_size: float = 1.0
    sh_degree: int | None = None
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    antialiased: bool = False

    def __post_init__(self) -> None:
        check_choice("mode", self.mode, MODES)
        if not self.splat_size > 0:
            raise ValueError(f"splat_size: expected above 0; got {self.splat_size}")


class _Drawing(NamedTuple):
    """image `[H, W, 3]`, alpha and depth `[H, W]`."""

    image: Tensor
    alpha: Tensor
    depth: Tensor | None


@torch.no_grad()
def picture(scene: Scene, camera: Camera, settings: Settings) -> Pixels:
    """Render a scene for people.

    Args:
        scene: of features of spheres, the first three are the colours, or the first one is grey.
        camera: one, on any device.

    Returns:
        `[H, W, 3]`.
    """
    camera = camera.to(scene.device)
    background = torch.tensor(settings.background, device=scene.device)
    if isinstance(scene, Spheres):
        drawing = _draw_spheres(scene, camera, background, settings)
    else:
        drawing = _draw_gaussians(scene, camera, background, settings)
    image = drawing.image
    if settings.mode == "alpha":
        image = drawing.alpha[..., None].expand(-1, -1, 3)
    elif drawing.depth is not None:
        image = torch.lerp(background, _depth_colors(drawing.depth, drawing.alpha), drawing.alpha[..., None])
    pixels: Pixels = image.clamp(0, 1).mul(255).round().to(torch.uint8).cpu().numpy()
    return pixels


def _draw_gaussians(scene: Gaussians, camera: Camera, background: Tensor, settings: Settings) -> _Drawing:
    degree = scene.sh_degree if settings.sh_degree is None else min(settings.sh_degree, scene.sh_degree)
    r = rasterize(scene.means, scene.quats, scene.scales * settings.splat_size, scene.opacities, scene.sh, camera, sh_degree=degree,
                  background=background, antialiased=settings.antialiased, depth="expected" if settings.mode == "depth" else None)
    return _Drawing(r.image, r.alpha, r.depth)


def _draw_spheres(scene: Spheres, camera: Camera, background: Tensor, settings: Settings) -> _Drawing:
    features = scene.features[:, :3] if scene.features.shape[1] >= 3 else scene.features[:, :1].expand(-1, 3)
    r = render_spheres(scene.positions, features, scene.radii * settings.splat_size, camera, opacities=scene.opacities, background=background,
                       gamma=scene.gamma, near=scene.near, far=scene.far, depth="expected" if settings.mode == "depth" else None)
    return _Drawing(r.image, r.alpha, r.depth)


def _depth_colors(depth: Tensor, alpha: Tensor) -> Tensor:
    """`[H, W, 3]`."""
    solid = depth[alpha > SOLID]
    if not len(solid):
        return depth.new_zeros(*depth.shape, 3)
    few = solid[::max(1, len(solid) // SAMPLE)]
    near, far = few.quantile(depth.new_tensor(DEPTH_RANGE))
    colors = DEPTH_COLORS.to(depth)
    place = ((depth - near) / (far - near).clamp_min(1e-10)).clamp(0, 1) * (len(colors) - 1)
    first = place.long().clamp_max(len(colors) - 2)
    return torch.lerp(colors[first], colors[first + 1], (place - first)[..., None])
