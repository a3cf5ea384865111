"""What is fitted to each photo besides the scene: the pose of its camera, its exposure."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from tsplat.camera import Camera
from tsplat.fit.config import FitConfig
from tsplat.fit.pose import moved
from tsplat.fit.schedules import progress, rate_factor
from tsplat.fit.visible_adam import VisibleAdam


class PhotoParameters(nn.Module):
    """C photos, of which a step sees one, or one for each rank; the others, and their moments, rest in it (`VisibleAdam`).

    All ranks have a copy, and the gradients of all (`Ranks.add`). Rates do not depend on the number of ranks: nor does how often a photo is seen.

    Args:
        photos: C.
        config: `refine_poses` and `exposure` say which there are.

    Attributes:
        poses: `[C, 6]` increments (see `pose.moved`).
        exposures: `[C, 3, 4]`, what is added to the identity: colours become A c + b. The mean over all photos is taken off, so
            that the scene keeps the colours of the average photo, in which held-out ones are scored.
    """

    def __init__(self, photos: int, config: FitConfig) -> None:
        super().__init__()
        self.poses = nn.Parameter(torch.zeros(photos, 6)) if config.refine_poses else None
        self.exposures = nn.Parameter(torch.zeros(photos, 3, 4)) if config.exposure else None
        groups = [{"params": [parameter], "name": name} for name, parameter in self.named_parameters()]
        self.adam = VisibleAdam(groups) if groups else None

    def camera(self, camera: Camera, photo: int, extent: float) -> Camera:
        """The camera of a photo, moved."""
        return camera if self.poses is None else moved(camera, self.poses[photo], extent)

    def expose(self, image: Tensor, photo: int) -> Tensor:
        """A render `[H, W, 3]` as the photo's camera would have taken it."""
        if self.exposures is None:
            return image
        change = self.exposures[photo] - self.exposures.detach().mean(0)             # [3, 4]
        return image + image @ change[:, :3].T + change[:, 3]

    def step(self, photos: Sequence[int], config: FitConfig, step: int) -> None:
        """Move the parameters of the photos of a step by their gradients."""
        if self.adam is None:
            return
        rates = {"poses": config.lr_poses * config.lr_means_decay ** progress(config, step), "exposures": config.lr_exposure}
        seen = None
        for group in self.adam.param_groups:
            group["lr"] = rate_factor(config) * rates[group["name"]]
            parameter = group["params"][0]
            seen = torch.zeros(len(parameter), dtype=torch.bool, device=parameter.device) if seen is None else seen
        assert seen is not None
        seen[list(photos)] = True
        self.adam.step(seen)
