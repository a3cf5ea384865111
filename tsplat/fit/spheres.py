"""How spheres are fitted to images (Pulsar, section 5.1): the course of gamma, which spheres to drop, and splitting them into smaller ones."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from tsplat.camera import Camera
from tsplat.checks import check_number, check_size, check_tensor
from tsplat.spheres import GAMMA, render_spheres

CHILDREN = 12
"""Nearest neighbours of a point of a face-centred cubic lattice."""


def gamma_at(step: int, steps: int, first: float = 0.1, last: float = 1e-2) -> float:
    """Gamma at `step`, counted from 0, of a fit of `steps`: it falls log-linearly from `first` to `last`, which the last step has.

    A large gamma makes spheres transparent, and so lets those that are hidden or in a wrong place have gradients; a small one makes
    the sharp images that are wanted in the end.

    Raises:
        ValueError: for a gamma outside of [1e-5, 1], no steps, or a step that is not one of them.
    """
    check_size("steps", steps)
    if not 0 <= step < steps:
        raise ValueError(f"step: expected 0 to {steps - 1}, as steps is {steps}; got {step}")
    for name, gamma in (("first", first), ("last", last)):
        check_number(name, gamma, "a gamma in [1e-5, 1]")
        if not GAMMA[0] <= gamma <= GAMMA[1]:
            raise ValueError(f"{name}: expected a gamma in [1e-5, 1]; got {gamma}")
    return min(max(float(first * (last / first) ** (step / max(1, steps - 1))), GAMMA[0]), GAMMA[1])


def visibility(positions: Tensor, radii: Tensor, opacities: Tensor, cameras: Iterable[Camera], *, gamma: float, near: float,
               far: float) -> Tensor:
    """The weight of each sphere in the images of all cameras, summed over their pixels, `[N]`.

    It is the gradient of a feature by images, and so 0 exactly where a sphere gets no gradient from any view: Pulsar's sign that it can be
    dropped (section 5.1).

    Args:
        positions, radii, opacities: `[N, 3]`, `[N]` and `[N]`, as in `render_spheres`. They need no gradient and get none.
        cameras: single ones or batches, of any sizes.
        gamma, near, far: as in `render_spheres`.
    """
    total = radii.new_zeros(radii.shape)
    with torch.enable_grad():
        for camera in cameras:
            probe = radii.new_zeros(len(radii), 1).requires_grad_()
            image = render_spheres(positions.detach(), probe, radii.detach(), camera, opacities=opacities.detach(), gamma=gamma, near=near,
                                   far=far).image
            total += torch.autograd.grad(image.sum(), probe)[0].squeeze(-1)
    return total


def worth_keeping(colors: Tensor, background: Tensor, weights: Tensor, *, color_distance: float = 0.1, least_weight: float = 0.0) -> Tensor:
    """Which spheres stay, bool `[N]`: those that are seen and differ from the background (Pulsar, section 5.1).

    Args:
        colors: `[N, D]`. A sphere that covers the background of the photos takes on its colour.
        background: `[D]`, the colour of the photos' background. It should be none of the object's.
        weights: `[N]`, from `visibility`.
        color_distance: spheres of which no channel is farther than this from the background are dropped.
        least_weight: spheres of no more than this weight, in pixels of all views together, are dropped.

    Raises:
        ValueError, TypeError: naming the argument, what came and what is expected.
    """
    check_tensor("colors", colors, ("N", "D"))
    check_tensor("background", background, (colors.shape[1],), like=colors)
    check_tensor("weights", weights, (colors.shape[0],), like=colors)
    for name, number in (("color_distance", color_distance), ("least_weight", least_weight)):
        check_number(name, number, "a number of at least 0")
        if not number >= 0:
            raise ValueError(f"{name}: expected a number of at least 0; got {number}")
    return ((colors - background).abs().amax(1) > color_distance) & (weights > least_weight)


class Refined(NamedTuple):
    """12 spheres for each of N. positions: `[12 N, 3]`. radii: `[12 N]`. parents: int64 `[12 N]`, for all else that a sphere has."""

    positions: Tensor
    radii: Tensor
    parents: Tensor


def refine(positions: Tensor, radii: Tensor, reach: float = 1.0) -> Refined:
    """Split each sphere into 12 smaller ones in face-centred cubic packing (Pulsar, section 5.1).

    They sit at the 12 lattice points that are nearest to the sphere's centre, in the directions (+-1, +-1, 0), (+-1, 0, +-1) and
    (0, +-1, +-1), and their radius is sqrt(2) times the rho at which spheres of the lattice touch: with sqrt(2) rho, the lattice's covering
    radius, they leave no gaps. The paper says "radius sqrt(2) r, where r is the previous radius". Taken by its letter, each part would be
    larger than the whole; here r is the radius of the packing, rho = reach R/(2 + sqrt(2)), with which the parts reach out to
    2 rho + sqrt(2) rho = reach R for a sphere of radius R: with reach = 1, they have radius 0.41 R and their centres a distance of 0.59 R.

    Args:
        positions, radii: `[N, 3]` and `[N]`.
        reach: of the 12, in radii of their sphere.

    Raises:
        ValueError, TypeError: naming the argument, what came and what is expected.
    """
    check_tensor("positions", positions, ("N", 3))
    check_tensor("radii", radii, (positions.shape[0],), like=positions)
    check_number("reach", reach, "a number above 0")
    if not 0 < reach < math.inf:
        raise ValueError(f"reach: expected a number above 0; got {reach}")
    rho = radii * (reach / (2 + math.sqrt(2)))
    signs = positions.new_tensor([(a, b) for a in (-1, 1) for b in (-1, 1)])
    zero = signs.new_zeros(4)
    a, b = signs.T
    directions = torch.cat([torch.stack(v, 1) for v in ((a, b, zero), (a, zero, b), (zero, a, b))])      # [12, 3], of length sqrt(2)
    offsets = directions * (math.sqrt(2) * rho[:, None, None])                                         # [N, 12, 3], of length 2 rho
    parents = torch.arange(len(radii), device=radii.device).repeat_interleave(CHILDREN)
    return Refined((positions[:, None] + offsets).flatten(0, 1), (math.sqrt(2) * rho)[parents], parents)
