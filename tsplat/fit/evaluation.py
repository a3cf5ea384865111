"""Held-out quality: PSNR and SSIM per photo, and pictures to look at."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from tsplat.camera import Camera
from tsplat.fit.config import FitConfig
from tsplat.fit.drawing import fixed_background
from tsplat.fit.losses import Target, photo_loss, psnr, ssim, target_of
from tsplat.fit.pose import refined
from tsplat.fit.primitive import Scene, primitive_of
from tsplat.fit.ranks import ALONE, Ranks
from tsplat.fit.schedules import rate_factor
from tsplat.scene import Capture, write_image


class Quality(NamedTuple):
    """How close a render is to its photo: PSNR in dB, and SSIM (`losses.SSIM_NAME`)."""

    psnr: float
    ssim: float


@torch.no_grad()
def evaluate(gaussians: Scene, capture: Capture, views: Sequence[int], config: FitConfig, pictures: Path | None = None,
             cameras: Mapping[int, Camera] | None = None, device: torch.device | None = None, ranks: Ranks = ALONE) -> dict[str, Quality]:
    """Compare renders, clamped to 0..1, with photos `views` of a capture. Several ranks, with a part of the splats each, share the photos.

    Args:
        config: `primitive`, `background`, `antialiased` and `offload` of it are used.
        cameras: by view, instead of the capture's (see `refined_cameras`).
        pictures: an existing folder for one PNG per photo: the photo on the left, the render on the right.
        device: where to draw, default where the scene is; another with `offload` only.

    Returns:
        The quality by the photo's name, of all photos on all ranks.
    """
    device = device or gaussians.device
    background = fixed_background(config).to(device)
    primitive, qualities = primitive_of(config), {}
    for view, counts in _share(views, ranks):
        target = target_of(capture.images[view].to(device), background, masked=capture.masked)
        camera = (capture.camera(view) if cameras is None else cameras[view]).to(device)
        image = primitive.draw(gaussians, camera, background, config, ranks=ranks).image.clamp(0, 1)
        if not counts:
            continue
        qualities[capture.names[view]] = Quality(float(psnr(image, target)), float(ssim(image, target)))
        if pictures is not None:
            write_image(pictures / picture_name(capture.names[view]), torch.cat([target.image, image], dim=1))
    everyone = {name: quality for some in ranks.objects(qualities) for name, quality in some.items()}
    return {capture.names[view]: everyone[capture.names[view]] for view in views}


def scores(scene: Scene, capture: Capture, config: FitConfig, pictures: Path | None = None, device: torch.device | None = None,
           ranks: Ranks = ALONE) -> tuple[dict[str, Quality], dict[str, Quality]]:
    """What a fit reports of the held-out photos: `evaluate` with the capture's cameras, and, if the config refines poses, with `refined_cameras`."""
    device = device or scene.device
    plain = evaluate(scene, capture, capture.test, config, pictures, device=device, ranks=ranks)
    if not config.refine_poses:
        return plain, {}
    cameras = refined_cameras(scene, capture, capture.test, config, device, ranks)
    return plain, evaluate(scene, capture, capture.test, config, cameras=cameras, device=device, ranks=ranks)


def _share(views: Sequence[int], ranks: Ranks) -> Iterator[tuple[int, bool]]:
    """Of each so many views as there are ranks, that of this rank, and whether it counts: where none is left, it helps the others with the last."""
    for first in range(0, len(views), ranks.count):
        mine = first + ranks.rank
        yield views[min(mine, len(views) - 1)], mine < len(views)


def refined_cameras(gaussians: Scene, capture: Capture, views: Sequence[int], config: FitConfig, device: torch.device, ranks: Ranks = ALONE
                    ) -> dict[int, Camera]:
    """The cameras of photos `views`, with poses that suit the scene best as it is: their loss is minimised, the scene is frozen.

    For fits that refine poses, where those of held-out photos would be left behind. `device` is where to draw. Of several ranks, each gets the
    cameras that `evaluate` asks it for.
    """
    primitive = primitive_of(config)
    background = fixed_background(config).to(device)
    cameras = {}
    gaussians.requires_grad_(False)
    try:
        for view, _ in _share(views, ranks):
            target = target_of(capture.images[view].to(device), background, masked=capture.masked)

            def loss(camera: Camera, target: Target = target) -> Tensor:
                return photo_loss(primitive.draw(gaussians, camera, background, config, ranks=ranks).image, target, config.ssim_weight)

            cameras[view] = refined(capture.camera(view).to(device), loss, capture.extent, config.pose_steps, config.lr_poses * rate_factor(config))
    finally:
        gaussians.requires_grad_(True)
    return cameras


def picture_name(photo: str) -> str:
    """The file name of the picture of a photo: `left/0001.jpg` becomes `left_0001.png`."""
    return "_".join(Path(photo).with_suffix(".png").parts)


def mean_quality(qualities: dict[str, Quality]) -> Quality | None:
    """The mean over photos, or None if there are none."""
    if not qualities:
        return None
    psnrs, ssims = zip(*qualities.values(), strict=True)
    return Quality(sum(psnrs) / len(psnrs), sum(ssims) / len(ssims))
