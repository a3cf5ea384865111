"""The sphere renderer a second time, to judge the first: every sphere at every pixel, in world space, with gradients by autograd.

Written from Pulsar's equation 1 and the conventions alone. No tiles, lists, camera space, blocks or closed-form derivatives. Expects sane
spheres, positive opacities, and no ray that touches an outline or a centre; small sizes only, in float64.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Images(NamedTuple):
    """`[C, H, W, ...]`; weights and depths of all spheres `[C, H, W, N]`, 0 and infinite where missed."""

    image: Tensor
    alpha: Tensor
    depth: Tensor
    weights: Tensor
    depths: Tensor


def rays(viewmat: Tensor, K: Tensor, width: int, height: int, model: str) -> tuple[Tensor, Tensor]:
    """Origins and unit directions of the rays through the pixel centres, in world space, `[H, W, 3]`."""
    v, u = torch.meshgrid(torch.arange(height, dtype=K.dtype) + 0.5, torch.arange(width, dtype=K.dtype) + 0.5, indexing="ij")
    pixels = torch.stack([u, v, torch.ones_like(u)], -1)
    plane = torch.einsum("ij,hwj->hwi", torch.linalg.inv(K), pixels)                        # z = 1
    to_world = torch.linalg.inv(viewmat)
    if model == "pinhole":
        origins, directions = torch.zeros_like(plane), plane / torch.linalg.vector_norm(plane, dim=-1, keepdim=True)
    else:
        origins, directions = plane * plane.new_tensor([1, 1, 0]), torch.zeros_like(plane) + plane.new_tensor([0, 0, 1])
    rotate = to_world[:3, :3]
    return torch.einsum("ij,hwj->hwi", rotate, origins) + to_world[:3, 3], torch.einsum("ij,hwj->hwi", rotate, directions)


def render(positions: Tensor, features: Tensor, radii: Tensor, opacities: Tensor, background: Tensor, gamma: Tensor, viewmats: Tensor,
           Ks: Tensor, width: int, height: int, *, model: str = "pinhole", near: float, far: float, background_depth: float = 1e-6,
           chord: bool = False, nearest: int | None = None) -> Images:
    """`[C, N, ...]` geometry or `[N, ...]` for all cameras; with `nearest`, gradients by way of so many hits of each pixel only."""
    views = []
    for c in range(len(viewmats)):
        p, f, R, o = (x[c] if x.ndim == rank else x for x, rank in ((positions, 3), (features, 3), (radii, 2), (opacities, 2)))
        origin, direction = rays(viewmats[c], Ks[c], width, height, model)
        to = p - origin[..., None, :]                                                       # [H, W, N, 3]
        along = (to * direction[..., None, :]).sum(-1)
        across = torch.linalg.cross(to, direction[..., None, :].expand_as(to))
        q = torch.linalg.vector_norm(across, dim=-1)
        delta = q
        if chord and model == "pinhole":
            length = torch.linalg.vector_norm(to, dim=-1, keepdim=True)
            delta = torch.linalg.vector_norm(to - length * direction[..., None, :], dim=-1)
        inside = (delta < R) & ((along > 0) | (model != "pinhole"))
        D = along - torch.where(inside, R**2 - q**2, 1.0).sqrt()
        hit = inside & (near <= D) & (far >= D)
        z = (far - D) / (far - near)
        score = torch.where(hit, o * z / gamma + torch.log(o) + torch.log(torch.where(hit, 1 - delta / R, 1.0)), -torch.inf)
        if nearest is not None:
            order = torch.where(hit, D, torch.inf).argsort(-1)
            kept = torch.zeros_like(hit).scatter(-1, order[..., :nearest], True)
            score, D = (torch.where(kept, x, x.detach()) for x in (score, D))
        else:
            kept = torch.ones_like(hit)
        behind = (background_depth / gamma).expand(height, width, 1)
        weights = torch.softmax(torch.cat([score, behind], -1), -1)
        w, rest = weights[..., :-1], weights[..., -1:]
        b = background[c] if background.ndim == 2 else background
        image = torch.where(kept, w, 0.0) @ f + torch.where(kept, 0.0, w) @ f.detach() + rest * b
        views.append(Images(image, w.sum(-1), (w * torch.where(hit, D, 0.0)).sum(-1), w, torch.where(hit, D, torch.inf)))
    return Images(*map(torch.stack, zip(*views, strict=True)))
