"""Held-out quality: PSNR and SSIM per photo, and pictures to look at."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch

from tsplat.fit.config import FitConfig
from tsplat.fit.drawing import fixed_background
from tsplat.fit.losses import psnr, ssim, target_of
from tsplat.fit.primitive import Scene, primitive_of
from tsplat.scene import Capture, write_image


class Quality(NamedTuple):
    """How close a render is to its photo: PSNR in dB, and SSIM (`losses.SSIM_NAME`)."""

    psnr: float
    ssim: float


@torch.no_grad()
def evaluate(gaussians: Scene, capture: Capture, views: Sequence[int], config: FitConfig, pictures: Path | None = None
             ) -> dict[str, Quality]:
    """Compare renders, clamped to 0..1, with photos `views` of a capture.

    Args:
        config: `primitive`, `background` and `antialiased` of it are used.
        pictures: an existing folder for one PNG per photo: the photo on the left, the render on the right.

    Returns:
        The quality by the photo's name.
    """
    device = gaussians.means.device
    background = fixed_background(config).to(device)
    primitive, qualities = primitive_of(config), {}
    for view in views:
        target = target_of(capture.images[view].to(device), background, masked=capture.masked)
        image = primitive.draw(gaussians, capture.camera(view).to(device), background, config).image.clamp(0, 1)
        qualities[capture.names[view]] = Quality(float(psnr(image, target)), float(ssim(image, target)))
        if pictures is not None:
            write_image(pictures / picture_name(capture.names[view]), torch.cat([target.image, image], dim=1))
    return qualities


def picture_name(photo: str) -> str:
    """The file name of the picture of a photo: `left/0001.jpg` becomes `left_0001.png`."""
    return "_".join(Path(photo).with_suffix(".png").parts)


def mean_quality(qualities: dict[str, Quality]) -> Quality | None:
    """The mean over photos, or None if there are none."""
    if not qualities:
        return None
    psnrs, ssims = zip(*qualities.values(), strict=True)
    return Quality(sum(psnrs) / len(psnrs), sum(ssims) / len(ssims))
