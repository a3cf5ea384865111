"""`Views`: the places from which a scene is looked at."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from tsplat.camera import Camera
from tsplat.fit.initial import view_cube
from tsplat.pictures import orbit
from tsplat.pictures.modes import Scene
from tsplat.scene import Capture, Spheres

SIZE = (800, 600)            # of the start's picture where no page says another


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
    def of_scene(cls, scene: Scene, up: Sequence[float]) -> Views:
        """From in front of a scene, with all of it in the picture. `up` is an axis, or minus one (see `tsplat.pictures.orbit`)."""
        width, height = SIZE
        centres = (scene.positions if isinstance(scene, Spheres) else scene.means).detach().cpu()
        centres = centres[centres.isfinite().all(1)]
        middle = centres.median(0).values if len(centres) else torch.zeros(3)
        return cls(orbit(scene, 1, width=width, height=height, up=up)[0], middle, torch.tensor(up))

    @classmethod
    def of_capture(cls, capture: Capture, up: Sequence[float] | None = None) -> Views:
        """Those of its photos, beginning with the first; up is as in the photos, on average, unless it is given."""
        low, high = (torch.tensor(corner) for corner in view_cube(capture))
        level = -capture.viewmats[:, 1, :3].mean(0) if up is None else torch.tensor(up)
        return cls(capture.camera(0), (low + high) / 2, level, {name: capture.camera(i) for i, name in enumerate(capture.names)})
