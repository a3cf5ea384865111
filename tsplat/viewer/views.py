"""`Views`: the places from which a scene is looked at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from tsplat.camera import Camera
from tsplat.fit.initial import view_cube
from tsplat.scene import Capture, Spheres
from tsplat.viewer.view import Scene


@dataclass(frozen=True)
class Views:
    """Where visitors begin, and where they can go.

    Args:
        start: the camera of the first picture.
        middle: `[3]`, of what there is to see.
        up: `[3]`, which way is up.
        photos: cameras of photos, by name.
    """

    start: Camera
    middle: Tensor
    up: Tensor
    photos: Mapping[str, Camera] = field(default_factory=dict)

    @classmethod
    def of_capture(cls, capture: Capture, up: Tensor | None = None) -> Views:
        """Those of its photos, beginning with the first; up is as in the photos, on average, unless it is given."""
        low, high = (torch.tensor(corner) for corner in view_cube(capture))
        if up is None:
            up = -capture.viewmats[:, 1, :3].mean(0)
        return cls(capture.camera(0), (low + high) / 2, up, {name: capture.camera(i) for i, name in enumerate(capture.names)})


def middle_of(scene: Scene) -> Tensor:
    """`[3]`: the median of the splats, zeros if there are none."""
    centres = (scene.positions if isinstance(scene, Spheres) else scene.means).detach().cpu()
    centres = centres[centres.isfinite().all(1)]
    return centres.median(0).values if len(centres) else torch.zeros(3)
