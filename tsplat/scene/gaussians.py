"""`Gaussians`: the trainable splats of a scene, in the raw parameters that files and optimisers hold."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from tsplat.camera import Camera
from tsplat.checks import check_tensor
from tsplat.rasterize import Rendering, rasterize
from tsplat.scene.module import Splats
from tsplat.scene.neighbours import nearest_squared_distances

SH_C0 = 0.28209479177387814      # the constant band of the real spherical harmonics
MAX_SH_DEGREE = 4
MIN_SCALE = 1e-7


class Gaussians(Splats):
    """N anisotropic 3D Gaussians with view-dependent colour.

    The parameters are raw (unbounded); the properties `scales`, `opacities` and `sh` are what the renderer takes.

    Args:
        means: `[N, 3]` centres, world units.
        quats: `[N, 4]` rotations, wxyz, of any non-zero length.
        log_scales: `[N, 3]` natural logarithms of the standard deviations along the own axes.
        opacity_logits: `[N]`.
        sh0: `[N, 1, 3]` constant spherical-harmonic coefficient; colour = max(0, SH + 0.5).
        sh_rest: `[N, K - 1, 3]` the other coefficients, K = (degree + 1)^2, degree 0 to 4.

    Raises:
        TypeError, ValueError: naming the argument, what came and what is expected. All share N, dtype and device.
    """

    means: nn.Parameter
    quats: nn.Parameter
    log_scales: nn.Parameter
    opacity_logits: nn.Parameter
    sh0: nn.Parameter
    sh_rest: nn.Parameter

    NAMES = ("means", "quats", "log_scales", "opacity_logits", "sh0", "sh_rest")

    def __init__(self, means: Tensor, quats: Tensor, log_scales: Tensor, opacity_logits: Tensor, sh0: Tensor,
                 sh_rest: Tensor) -> None:
        super().__init__(means=means, quats=quats, log_scales=log_scales, opacity_logits=opacity_logits, sh0=sh0, sh_rest=sh_rest)

    @property
    def scales(self) -> Tensor:
        """`[N, 3]` standard deviations along the own axes, world units."""
        return self.log_scales.exp()

    @property
    def sh(self) -> Tensor:
        """`[N, K, 3]` spherical-harmonic coefficients."""
        return torch.cat([self.sh0, self.sh_rest], dim=1)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 4."""
        return math.isqrt(self.sh_rest.shape[1] + 1) - 1

    def render(self, camera: Camera, **options: Any) -> Rendering:
        """`tsplat.rasterize` of these Gaussians, with all bands of their colours.

        Args:
            camera: one or a batch.
            options: further arguments of `tsplat.rasterize`.
        """
        return rasterize(self.means, self.quats, self.scales, self.opacities, self.sh, camera, sh_degree=self.sh_degree, **options)

    def extra_repr(self) -> str:
        """What `repr` shows."""
        return f"{len(self)} Gaussians, sh_degree={self.sh_degree}"

    @classmethod
    def from_points(cls, points: Tensor, colors: Tensor | None = None, sh_degree: int = 3, opacity: float = 0.1) -> Gaussians:
        """One round Gaussian per point, as large as the root mean squared distance to the 3 nearest other points.

        Args:
            points: `[N, 3]`, finite. A point without any other gets the scale 1, coincident points `MIN_SCALE`.
            colors: `[N, 3]` in 0..1, or None for mid grey.
            sh_degree: 0 to 4.
            opacity: above 0 and below 1.
        """
        check_tensor("points", points, ("N", 3))
        n = len(points)
        if colors is not None:
            check_tensor("colors", colors, (n, 3), like=points)
        if not isinstance(sh_degree, int) or not 0 <= sh_degree <= MAX_SH_DEGREE:
            raise ValueError(f"sh_degree: expected an int of 0 to {MAX_SH_DEGREE}; got {sh_degree!r}")
        if not 0 < opacity < 1:
            raise ValueError(f"opacity: expected above 0 and below 1; got {opacity}")
        bad = int((~points.isfinite()).any(1).sum())
        if bad:
            raise ValueError(f"points: expected finite coordinates; got {bad} of {n} points with NaN or infinity")
        with torch.no_grad():
            squared = nearest_squared_distances(points, 3)                            # [N, up to 3]
            scale = squared.mean(1).sqrt().clamp(min=MIN_SCALE) if n > 1 else points.new_ones(n)
            sh0 = points.new_zeros(n, 1, 3) if colors is None else ((colors - 0.5) / SH_C0)[:, None]
            return cls(
                means=points,
                quats=points.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
                log_scales=scale.log()[:, None].repeat(1, 3),
                opacity_logits=points.new_full((n,), math.log(opacity / (1 - opacity))),
                sh0=sh0,
                sh_rest=points.new_zeros(n, (sh_degree + 1) ** 2 - 1, 3),
            )

    @classmethod
    def random(cls, n: int, low: float | Sequence[float] = -1.0, high: float | Sequence[float] = 1.0, sh_degree: int = 3,
               generator: torch.Generator | None = None) -> Gaussians:
        """`n` Gaussians of random colour, uniform in the box from `low` to `high` (numbers, or one per axis).

        The start of a scene without points; see `from_points` for the other parameters.
        """
        low_corner, high_corner = torch.as_tensor(low, dtype=torch.float32), torch.as_tensor(high, dtype=torch.float32)
        if n < 0 or not bool(torch.all(low_corner < high_corner)):
            raise ValueError(f"n, low, high: expected n >= 0 and low < high; got {n}, {low} and {high}")
        points = low_corner + (high_corner - low_corner) * torch.rand(n, 3, generator=generator)
        return cls.from_points(points, torch.rand(n, 3, generator=generator), sh_degree)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Gaussians:
        """Read a file in the format of its name: `.ply` (3DGS, or PlayCanvas's compressed kind), `.splat`, `.spz`, `.glb`
        (KHR_gaussian_splatting), `.sog` (or the meta.json or folder of an unpacked one), `.ksplat`. All have the axes of a .ply then.

        Raises:
            ValueError: an unknown name, or a file that is not what its name says: one line with the file and what is wrong where.
            ImportError: an .spz of version 4 without the package zstandard.
            OSError: the file cannot be read.
        """
        from tsplat.scene import formats
        return formats.load(path)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a file in the format of its name: `.ply` (3DGS; all others round), `.compressed.ply` (PlayCanvas), `.splat`, `.spz`, `.glb`.

        An older file stays until the new one is whole. What the format cannot hold is left out with a warning.

        Raises:
            ValueError: an unknown name, or Gaussians that the format cannot hold at all.
            OSError: the file cannot be written; an old one stays as it was.
        """
        from tsplat.scene import formats
        formats.save(path, self)

    @classmethod
    def check(cls, tensors: Mapping[str, Tensor]) -> None:
        """See `Splats.check`."""
        means, sh_rest = tensors["means"], tensors["sh_rest"]
        check_tensor("means", means, ("N", 3))
        n = len(means)
        shapes = {"quats": (n, 4), "log_scales": (n, 3), "opacity_logits": (n,), "sh0": (n, 1, 3), "sh_rest": (n, "K - 1", 3)}
        for name, shape in shapes.items():
            check_tensor(name, tensors[name], shape, like=means)
        sizes = [(degree + 1) ** 2 - 1 for degree in range(MAX_SH_DEGREE + 1)]
        if sh_rest.shape[1] not in sizes:
            raise ValueError(f"sh_rest: expected {', '.join(map(str, sizes))} coefficients (degree 0 to {MAX_SH_DEGREE}); "
                             f"got {sh_rest.shape[1]}")
