"""Scenes of any kind, from their files."""

from __future__ import annotations

import os

from tsplat.scene.gaussians import Gaussians
from tsplat.scene.spheres import Spheres, is_spheres


def load_scene(path: str | os.PathLike[str]) -> Gaussians | Spheres:
    """What the file holds; see `Gaussians.load` and `Spheres.load`."""
    return Spheres.load(path) if is_spheres(path) else Gaussians.load(path)
