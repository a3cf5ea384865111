"""Poses as parameters: increments of them, for the cameras of a fit and for held-out ones with the scene as it is."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch
from torch import Tensor

from tsplat.camera import Camera

LAST_RATE = 0.01       # of the first


def moved(camera: Camera, increment: Tensor, extent: float) -> Camera:
    """The camera after an increment `[6]`, in its own axes: a shift in units of `extent` behind a rotation.

    That is about its axis by 2 atan(length / 2), nearly the length in radians (Rodrigues' parameters, doubled): differentiable at 0, where kornia 0.8
    has NaN for angles. Small numbers of like size for both, so that one learning rate suits them.
    """
    from kornia.geometry.conversions import quaternion_to_rotation_matrix

    shift, turn = increment[:3] * extent, increment[3:]
    rotated = quaternion_to_rotation_matrix(torch.cat([torch.ones_like(turn[:1]), turn / 2])) @ camera.viewmats[..., :3, :]
    viewmats = torch.cat([rotated, camera.viewmats[..., 3:, :]], -2)
    return dataclasses.replace(camera, viewmats=viewmats + torch.nn.functional.pad(shift[:, None], (3, 0, 0, 1)))


def refined(camera: Camera, loss: Callable[[Camera], Tensor], extent: float, steps: int, rate: float) -> Camera:
    """The camera after `steps` of Adam on its pose alone.

    Args:
        camera: to begin with.
        loss: of a camera, differentiable in its pose.
        extent: see `moved`.
        rate: the first learning rate; it falls to 1 % of that, log-linearly.
    """
    increment = camera.viewmats.new_zeros(6, requires_grad=True)
    adam = torch.optim.Adam([increment], lr=rate)
    best, least = camera, float("inf")
    for step in range(steps + 1):
        here = moved(camera, increment, extent)
        value = loss(here)
        if float(value.detach()) < least:                          # the last step need not be the best
            best, least = dataclasses.replace(here, viewmats=here.viewmats.detach()), float(value.detach())
        if step < steps:
            (increment.grad,) = torch.autograd.grad(value, increment)
            adam.param_groups[0]["lr"] = rate * LAST_RATE ** (step / max(1, steps - 1))
            adam.step()
    return best
