"""Small random scenes that the tests share."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from tsplat import Camera


class Splats3D(NamedTuple):
    """The arguments of `tsplat.rasterize` up to `colors`."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor


class Splats2D(NamedTuple):
    """What blending takes, and what binning needs to make its lists."""

    means2d: Tensor
    conics: Tensor
    opacities: Tensor
    colors: Tensor
    backgrounds: Tensor | None
    depths: Tensor
    radii: Tensor


def generator(seed: int) -> torch.Generator:
    """Random numbers that do not depend on what ran before."""
    return torch.Generator().manual_seed(seed)


def uniform(low: float, high: float, *shape: int, seed: torch.Generator) -> Tensor:
    """Uniform float64."""
    return low + (high - low) * torch.rand(*shape, generator=seed, dtype=torch.float64)


def normal(*shape: int, seed: torch.Generator) -> Tensor:
    """Standard normal float64."""
    return torch.randn(*shape, generator=seed, dtype=torch.float64)


def splats(n: int, *, seed: int = 0, channels: int = 3, spread: float = 1.5, depth: tuple[float, float] = (2.0, 6.0),
           size: tuple[float, float] = (0.03, 0.5), opacity: tuple[float, float] = (0.05, 0.95)) -> Splats3D:
    """n anisotropic splats in front of a camera at the origin that looks along z, about half of them partly or wholly out of
    its view.
    """
    g = generator(seed)
    z = uniform(*depth, n, seed=g)
    xy = uniform(-spread, spread, n, 2, seed=g) * z[:, None] / 2
    quats = normal(n, 4, seed=g) * uniform(0.5, 2.0, n, 1, seed=g)                  # of any length
    scales = uniform(math.log(size[0]), math.log(size[1]), n, 3, seed=g).exp()
    return Splats3D(torch.cat([xy, z[:, None]], 1), quats, scales, uniform(*opacity, n, seed=g),
                    uniform(0.0, 1.0, n, channels, seed=g))


def sh_coefficients(n: int, degree: int, channels: int = 3, *, seed: int = 0) -> Tensor:
    """`[n, (degree + 1)^2, channels]`; colours on both sides of the clamp at 0."""
    return normal(n, (degree + 1) ** 2, channels, seed=generator(seed)) * 0.5


def camera(count: int | None = None, width: int = 24, height: int = 17, *, model: str = "pinhole", seed: int = 0,
           near: float = 0.01, far: float = 1e10, turn: float = 0.15) -> Camera:
    """One camera (count None) or a batch about the origin, slightly turned, with fx != fy and the principal point off the
    centre.
    """
    g = generator(1000 + seed)
    c = 1 if count is None else count
    axis = normal(c, 3, seed=g) * turn
    skew = torch.zeros(c, 3, 3, dtype=torch.float64)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        skew[:, i, j], skew[:, j, i] = -axis[:, k], axis[:, k]
    viewmats = torch.eye(4, dtype=torch.float64).repeat(c, 1, 1)
    viewmats[:, :3, :3], viewmats[:, :3, 3] = torch.linalg.matrix_exp(skew), normal(c, 3, seed=g) * turn
    f = {"pinhole": 0.9, "fisheye": 0.8, "orthographic": 0.2}[model] * width
    Ks = torch.eye(3, dtype=torch.float64).repeat(c, 1, 1)
    Ks[:, 0, 0], Ks[:, 1, 1] = f * uniform(0.9, 1.1, c, seed=g), f * uniform(0.9, 1.1, c, seed=g)
    Ks[:, 0, 2], Ks[:, 1, 2] = width * uniform(0.4, 0.6, c, seed=g), height * uniform(0.4, 0.6, c, seed=g)
    if count is None:
        viewmats, Ks = viewmats[0], Ks[0]
    return Camera(viewmats, Ks, width, height, model=model, near=near, far=far)


def splats2d(cameras: int, n: int, width: int, height: int, *, seed: int = 0, channels: int = 3,
             size: tuple[float, float] = (0.4, 4.0), opacity: tuple[float, float] = (0.05, 0.999), shared_colors: bool = False,
             background: bool = True) -> Splats2D:
    """Projected splats straight away: log-uniform standard deviations in pixels, any orientation, centres up to a few sizes
    outside.
    """
    g = generator(seed)
    centre = uniform(-0.15, 1.15, cameras, n, 2, seed=g) * torch.tensor([width, height], dtype=torch.float64)
    sd = uniform(math.log(size[0]), math.log(size[1]), cameras, n, 2, seed=g).exp()
    angle = uniform(0.0, math.pi, cameras, n, seed=g)
    turn = torch.stack([torch.stack([angle.cos(), -angle.sin()], -1), torch.stack([angle.sin(), angle.cos()], -1)], -2)
    cov = turn @ torch.diag_embed(sd**2) @ turn.mT
    conic = torch.linalg.inv(cov)
    opacities = uniform(*opacity, cameras, n, seed=g)
    radii = (3.33 * torch.diagonal(cov, dim1=-2, dim2=-1).sqrt()).ceil().int()
    return Splats2D(centre, torch.stack([conic[..., 0, 0], conic[..., 0, 1], conic[..., 1, 1]], -1), opacities,
                    uniform(0.0, 1.0, 1 if shared_colors else cameras, n, channels, seed=g),
                    uniform(0.0, 1.0, cameras, channels, seed=g) if background else None, uniform(1.0, 9.0, cameras, n, seed=g),
                    radii)


class Spheres(NamedTuple):
    """The arguments of `tsplat.render_spheres` but the camera."""

    positions: Tensor
    features: Tensor
    radii: Tensor
    opacities: Tensor


def spheres(n: int, *, cameras: int | None = None, seed: int = 0, channels: int = 3, depth: tuple[float, float] = (2.0, 6.0), spread: float = 0.8,
            size: tuple[float, float] = (0.05, 0.6), opacity: tuple[float, float] = (0.05, 1.0)) -> Spheres:
    """n spheres in front of a camera at the origin that looks along z, some of them partly or wholly out of its view; with
    `cameras`, others for each."""
    g = generator(seed)
    shape = (n,) if cameras is None else (cameras, n)
    z = uniform(*depth, *shape, seed=g)
    xy = uniform(-spread, spread, *shape, 2, seed=g) * z[..., None]
    radii = uniform(math.log(size[0]), math.log(size[1]), *shape, seed=g).exp()
    return Spheres(torch.cat([xy, z[..., None]], -1), uniform(0.0, 1.0, *shape, channels, seed=g), radii, uniform(*opacity, *shape, seed=g))
