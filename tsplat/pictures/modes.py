"""From a scene and a camera to a picture: of its colours, depth, alpha or normals."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Literal, NamedTuple, TypeAlias, get_args

import torch
from torch import Tensor

from tsplat.camera import Camera
from tsplat.checks import check_choice, check_tensor
from tsplat.pictures.colormap import viridis
from tsplat.pictures.normals import camera_points, normals
from tsplat.scene import Gaussians, Spheres
from tsplat.scene.quantiles import quantiles

Scene: TypeAlias = Gaussians | Spheres
Mode = Literal["color", "depth", "alpha", "normals"]
MODES: tuple[Mode, ...] = get_args(Mode)
SOLID = 0.5                 # alpha from which a pixel has a normal, and a depth that counts
PROBE = 128                 # pixels of the longer side of the views that `depth_range` looks at
FLATTEST = 1.001            # far over near, at least: the rounding of a plane is not to have all the colours
QUANTILES = 0.01, 0.99      # of solid depths: what near and far are, so that a few stray splats do not take all the colours


class Layers(NamedTuple):
    """What pictures of a view are made of.

    color: `[H, W, 3]` over black. alpha: `[H, W]`. depth: `[H, W]`, expected camera z, which means something where alpha is not small;
    None if it was not asked for.
    """

    color: Tensor
    alpha: Tensor
    depth: Tensor | None


@torch.no_grad()
def draw_layers(scene: Scene, camera: Camera, *, depth: bool = True, antialiased: bool = False) -> Layers:
    """Render what a picture takes.

    Args:
        scene: Gaussians, or spheres of 1 (grey) or 3 channels.
        camera: one, not a batch, on the scene's device.
        depth: whether depth is needed: of all modes but `"color"` and `"alpha"`.
        antialiased: for Gaussians that were fitted with it; see `rasterize`.

    Raises:
        ValueError: for a batch of cameras, and for spheres of other channels.
    """
    if camera.batched:
        raise ValueError(f"camera: expected one camera; got a batch of {len(camera)}")
    background = scene.opacity_logits.new_zeros(3)
    if not isinstance(scene, Spheres):
        rendering = scene.render(camera, background=background, depth="expected" if depth else None, antialiased=antialiased)
        return Layers(rendering.image, rendering.alpha, rendering.depth)
    channels = scene.features.shape[1]
    if channels not in (1, 3):
        raise ValueError(f"scene: expected spheres of 1 or 3 channels to picture; got {channels}")
    spheres = scene.render(camera, background=background[:channels], depth="expected" if depth else None)
    z = spheres.depth
    if z is not None and camera.model == "pinhole":             # from the distance along the ray to camera z
        z = z / camera_points(torch.ones_like(z), camera).norm(dim=-1)
    return Layers(spheres.image.expand(-1, -1, 3), spheres.alpha, z)


def picture(layers: Layers, camera: Camera, mode: Mode = "color", *, background: Tensor | None = None,
            depth_range: tuple[float, float] | None = None) -> Tensor:
    """The picture of a mode, over a background where alpha is below 1.

    `"color"`: the scene's colours. `"depth"`: camera z from near, yellow, to far, dark violet (`viridis`). `"alpha"`: white where the
    scene hides the background, black where it does not. `"normals"`: (x, -y, -z) / 2 + 1/2 of the normals of the depth map (`normals`)
    as red, green and blue: red to the right, green up, blue towards the camera. Where alpha is below 0.5 there are none.

    Args:
        layers: of the view.
        camera: which they were drawn with.
        mode: one of the above.
        background: `[3]` in 0..1, or None for a picture with alpha.
        depth_range: camera z of near and far, or None for what the function `depth_range` would find in this view. A clip needs one for
            all, lest it flicker.

    Returns:
        `[H, W, 3]` in 0..1, or with alpha `[H, W, 4]`, whose colours are not multiplied by it. The picture of alpha has 3 channels.
    """
    check_choice("mode", mode, MODES)
    if background is not None:
        check_tensor("background", background, (3,), like=layers.color)
    if mode == "alpha":
        return layers.alpha[..., None].expand(-1, -1, 3).clamp(0, 1)
    alpha = layers.alpha[..., None]
    if mode == "color":
        colors = layers.color                                   # times alpha, as all three are below
    elif layers.depth is None:
        raise ValueError(f"layers: expected depth for the mode {mode!r}; got None")
    elif mode == "depth":
        near, far = _range_of([_solid_depths(layers)]) if depth_range is None else depth_range
        if not 0 <= near < far:
            raise ValueError(f"depth_range: expected 0 <= near < far; got {near} and {far}")
        colors = viridis((far - layers.depth) / (far - near)) * alpha
    else:
        normal = normals(layers.depth, layers.alpha >= SOLID, camera)
        alpha = alpha * normal.isfinite().all(-1, keepdim=True)
        colors = (0.5 + normal.nan_to_num(0.0) * normal.new_tensor([0.5, -0.5, -0.5])) * alpha
    if background is not None:
        return (colors + (1 - alpha) * background).clamp(0, 1)
    return torch.cat([colors / alpha.clamp(min=1e-6), alpha], -1).clamp(0, 1)


def depth_range(scene: Scene, cameras: Iterable[Camera], *, antialiased: bool = False) -> tuple[float, float]:
    """Near and far for pictures of all these views, which are rendered for it at no more than 128 pixels a side.

    The 1% and the 99% quantile of camera z over all pixels whose alpha is at least 0.5; 0 and 1 if there is none.
    """
    depths = []
    for camera in cameras:
        scale = min(1.0, PROBE / max(camera.width, camera.height))
        size = (max(1, round(scale * side)) for side in (camera.width, camera.height))
        depths.append(_solid_depths(draw_layers(scene, camera.resized(*size), antialiased=antialiased)))
    return _range_of(depths)


def _solid_depths(layers: Layers) -> Tensor:
    assert layers.depth is not None
    return layers.depth[layers.alpha >= SOLID]


def _range_of(depths: Sequence[Tensor]) -> tuple[float, float]:
    every = torch.cat([torch.empty(0), *(values.cpu() for values in depths)])
    if not len(every):
        return 0.0, 1.0
    near, far = quantiles(every, QUANTILES)
    return near, max(far, near * FLATTEST) or 1.0
