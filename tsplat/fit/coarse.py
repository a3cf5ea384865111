"""Coarse to fine: the first steps compare at half the size, with a quarter of the pixels.

A splat's place, size and colour are mostly settled by what a photo shows at half the size, where a step takes about half the time; the
details that are left take the rest of the steps.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from tsplat.camera import Camera
from tsplat.fit.config import FitConfig
from tsplat.fit.losses import WINDOW

SMALLEST = 4 * WINDOW
"""Pixels along the shorter side under which photos are not halved: SSIM's window would see all of such a picture at once."""


def at_step(config: FitConfig, step: int, photo: Tensor, camera: Camera) -> tuple[Tensor, Camera]:
    """Photo `[H, W, 3 or 4]` and its camera at the size that `step`, counted from 0, compares."""
    if step >= config.coarse * config.steps or min(camera.width, camera.height) < 2 * SMALLEST:
        return photo, camera
    return halved(photo, camera)


def halved(photo: Tensor, camera: Camera) -> tuple[Tensor, Camera]:
    """Both at half the size, rounded up: a pixel is the mean of those it covers, and its colour that of those that count."""
    height, width = -(-camera.height // 2), -(-camera.width // 2)
    colour, fourth = photo[..., :3], photo[..., 3:]                                    # alpha or mask, if any
    small = _shrink(torch.cat([colour * fourth, fourth], -1) if fourth.numel() else colour, height, width)
    if fourth.numel():
        small = torch.cat([small[..., :3] / small[..., 3:].clamp(min=1e-6), small[..., 3:]], -1)
    scale = camera.Ks.new_tensor([width / camera.width, height / camera.height, 1.0])
    return small, dataclasses.replace(camera, Ks=camera.Ks * scale[:, None], width=width, height=height)


def _shrink(image: Tensor, height: int, width: int) -> Tensor:
    """`[H, W, D]` to `[height, width, D]`."""
    return interpolate(image.permute(2, 0, 1)[None], size=(height, width), mode="area")[0].permute(1, 2, 0)
