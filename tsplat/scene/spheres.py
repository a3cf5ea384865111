"""`Spheres`: the trainable spheres of a scene (Pulsar), in the raw parameters that files and optimisers hold."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from tsplat.camera import Camera
from tsplat.checks import check_tensor
from tsplat.scene.module import Splats
from tsplat.scene.neighbours import nearest_squared_distances
from tsplat.scene.ply_table import binary_rows, columns, read_header, write_columns
from tsplat.spheres import SphereRendering, render_spheres

MIN_RADIUS = 1e-7
COLUMNS = ("x", "y", "z", "radius", "opacity")
COMMENT = "tsplat spheres"


def is_spheres(path: str | os.PathLike[str]) -> bool:
    """Whether a file is a .ply of spheres."""
    path = Path(path)
    return path.suffix.lower() == ".ply" and any(c.startswith(COMMENT) for c in read_header(path).comments)


class Spheres(Splats):
    """N spheres with features (colours, most often), and what gives their depths a meaning.

    The parameters are raw (unbounded); the properties `radii` and `opacities` are what `tsplat.render_spheres` takes.

    Args:
        positions: `[N, 3]` centres, world units.
        log_radii: `[N]` natural logarithms of the radii.
        opacity_logits: `[N]`.
        features: `[N, D]`, D from 1.
        gamma, near, far: with which the spheres were made to look right; see `tsplat.render_spheres`.

    Raises:
        TypeError, ValueError: naming the argument, what came and what is expected. All tensors share N, dtype and device.
    """

    positions: nn.Parameter
    log_radii: nn.Parameter
    opacity_logits: nn.Parameter
    features: nn.Parameter

    NAMES = ("positions", "log_radii", "opacity_logits", "features")

    def __init__(self, positions: Tensor, log_radii: Tensor, opacity_logits: Tensor, features: Tensor, *, gamma: float = 0.01,
                 near: float = 0.1, far: float = 100.0) -> None:
        super().__init__(positions=positions, log_radii=log_radii, opacity_logits=opacity_logits, features=features)
        self.gamma, self.near, self.far = float(gamma), float(near), float(far)

    @property
    def radii(self) -> Tensor:
        """`[N]`, world units."""
        return self.log_radii.exp()

    def render(self, camera: Camera, *, gamma: float | Tensor | None = None, **options: Any) -> SphereRendering:
        """`tsplat.render_spheres` of these spheres, with their own gamma, near and far.

        Args:
            camera: one or a batch.
            gamma: instead of their own.
            options: further arguments of `tsplat.render_spheres`.
        """
        return render_spheres(self.positions, self.features, self.radii, camera, opacities=self.opacities,
                              gamma=self.gamma if gamma is None else gamma, near=self.near, far=self.far, **options)

    def get_extra_state(self) -> dict[str, float]:
        """Part of `state_dict`."""
        return {"gamma": self.gamma, "near": self.near, "far": self.far}

    def set_extra_state(self, state: Mapping[str, float]) -> None:
        """Take on what `get_extra_state` gave."""
        self.gamma, self.near, self.far = state["gamma"], state["near"], state["far"]

    def extra_repr(self) -> str:
        """What `repr` shows."""
        return f"{len(self)} spheres, {self.features.shape[1]} channels, gamma={self.gamma:g}, near={self.near:g}, far={self.far:g}"

    @classmethod
    def from_points(cls, points: Tensor, colors: Tensor | None = None, opacity: float = 0.5, *, gamma: float = 0.01, near: float = 0.1,
                    far: float = 100.0) -> Spheres:
        """One sphere per point, whose radius is the root mean squared distance to the 3 nearest other points.

        Args:
            points: `[N, 3]`, finite. A point without any other gets the radius 1, coincident points `MIN_RADIUS`.
            colors: `[N, D]`, or None for mid grey of 3 channels.
            opacity: above 0 and below 1.
            gamma, near, far: as those of the class.
        """
        check_tensor("points", points, ("N", 3))
        n = len(points)
        if colors is not None:
            check_tensor("colors", colors, (n, "D"), like=points)
        if not 0 < opacity < 1:
            raise ValueError(f"opacity: expected above 0 and below 1; got {opacity}")
        bad = int((~points.isfinite()).any(1).sum())
        if bad:
            raise ValueError(f"points: expected finite coordinates; got {bad} of {n} points with NaN or infinity")
        with torch.no_grad():
            squared = nearest_squared_distances(points, 3)                            # [N, up to 3]
            radius = squared.mean(1).sqrt().clamp(min=MIN_RADIUS) if n > 1 else points.new_ones(n)
            return cls(points, radius.log(), points.new_full((n,), math.log(opacity / (1 - opacity))),
                       points.new_full((n, 3), 0.5) if colors is None else colors, gamma=gamma, near=near, far=far)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Spheres:
        """Read a .ply that `save` wrote (float32).

        Raises:
            ValueError: naming the file and what is wrong: not a .ply, of something else than spheres, truncated.
            OSError: the file cannot be read.
        """
        path = Path(path)
        header = read_header(path)
        names = [name for name, _ in header.elements["vertex"][1]]
        numbers = next((c.removeprefix(COMMENT).split() for c in header.comments if c.startswith(COMMENT)), None)
        missing = [name for name in (*COLUMNS, "feature_0") if name not in names]
        if header.format != "binary_little_endian" or numbers is None or missing:
            raise ValueError(f"{path}: expected spheres, a binary_little_endian .ply with a comment '{COMMENT} gamma near far' and the columns "
                             f"{', '.join(COLUMNS)} and feature_0; got {header.format or 'no format'} with {', '.join(names)}")
        try:
            gamma, near, far = map(float, numbers)
        except ValueError:
            raise ValueError(f"{path}: expected the comment '{COMMENT} gamma near far'; got {' '.join(numbers)!r}") from None
        rows = binary_rows(path, header)
        features = tuple(f"feature_{i}" for i in range(sum(name.startswith("feature_") for name in names)))
        if not set(features) <= set(names):
            raise ValueError(f"{path}: expected columns {', '.join(features)}; got {', '.join(names)}")
        return cls(columns(rows, COLUMNS[:3]), columns(rows, ("radius",))[:, 0].log(), columns(rows, ("opacity",))[:, 0], columns(rows, features),
                   gamma=gamma, near=near, far=far)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a .ply: centre, radius, opacity (its logit, as in files of Gaussians) and features. An older file stays until the new one is
        whole."""
        names = (*COLUMNS, *(f"feature_{i}" for i in range(self.features.shape[1])))
        rows = torch.cat([self.positions, self.radii[:, None], self.opacity_logits[:, None], self.features], 1)
        write_columns(path, names, rows, f"{COMMENT} {self.gamma!r} {self.near!r} {self.far!r}")

    @classmethod
    def check(cls, tensors: Mapping[str, Tensor]) -> None:
        """See `Splats.check`."""
        positions = tensors["positions"]
        check_tensor("positions", positions, ("N", 3))
        n = len(positions)
        for name, shape in {"log_radii": (n,), "opacity_logits": (n,), "features": (n, "D")}.items():
            check_tensor(name, tensors[name], shape, like=positions)
        if not tensors["features"].shape[1]:
            raise ValueError(f"features: expected at least 1 channel; got shape {list(tensors['features'].shape)}")
