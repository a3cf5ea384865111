"""Spheres twice, by `tsplat.render_spheres` and by `plain_spheres`, for the tests of what they are and of what can be asked of them."""

from __future__ import annotations

import dataclasses
from typing import Any

import plain_spheres
import scenes
import torch
import tsplat_reference as reference
from backends import Backend
from compare import assert_close, gradients, leaves
from torch import Tensor

import tsplat
from tsplat import Camera, ops

NEAR, FAR = 0.5, 8.0
K_FORM = torch.tensor([[1.0, 0, 1], [0, 1, 1], [0, 0, 0]], dtype=torch.float64)
"""The entries of Ks that are used, and so have a gradient."""


def options(**others: Any) -> dict[str, Any]:
    return {"near": NEAR, "far": FAR, "percent_allowed_difference": 0.0, **others}


def moved(viewmats: Tensor, twist: Tensor) -> Tensor:
    """Poses after a rigid motion `[..., 6]`: only along those do the renderers, one in camera space and one in world space, agree."""
    a, b, c, x, y, z = twist.unbind(-1)
    zero = torch.zeros_like(a)
    rows = [[zero, -c, b, x], [c, zero, -a, y], [-b, a, zero, z], [zero] * 4]
    return torch.linalg.matrix_exp(torch.stack([torch.stack(r, -1) for r in rows], -2)) @ viewmats


def both(s: scenes.Spheres, camera: Camera, backend: Backend | None = None, *, background: Tensor | None = None, gamma: float = 0.1,
         background_depth: float = 0.1, distance: str = "orthogonal", **others: Any) -> tuple[tuple[Any, list[Tensor]], ...]:
    """Results (image, alpha, depth) and gradients of all inputs: wanted, and got."""
    C, D = len(camera), s.features.shape[-1]
    background = scenes.uniform(0.0, 1.0, C, D, seed=scenes.generator(9)) if background is None else background
    twist = torch.zeros(*camera.viewmats.shape[:-2], 6, dtype=torch.float64)
    inputs = (*s, background, torch.tensor(gamma, dtype=torch.float64), twist, camera.Ks)
    p, f, R, o, b, g, t, Ks = mine = leaves(*inputs)
    plain = plain_spheres.render(p, f, R, o, b, g, moved(camera.viewmats, t).view(-1, 4, 4), Ks.view(-1, 3, 3), camera.width, camera.height,
                                 model=camera.model, near=NEAR, far=FAR, background_depth=background_depth, chord=distance == "chord")
    want = [x if camera.batched else x.squeeze(0) for x in plain[:3]]
    v_want = gradients(want, mine)
    mine = leaves(*(backend.put(x) if backend else x for x in inputs))
    p, f, R, o, b, g, t, Ks = mine
    viewmats = camera.viewmats if backend is None else backend.put(camera.viewmats)
    r = tsplat.render_spheres(p, f, R, dataclasses.replace(camera, viewmats=moved(viewmats, t), Ks=Ks), opacities=o, background=b, gamma=g,
                              background_depth=background_depth, distance=distance, depth="accumulated", **options(**others))
    got = [r.image, r.alpha, r.depth]
    v_got = gradients(got, mine)
    v_want[7], v_got[7] = v_want[7] * K_FORM, v_got[7] * K_FORM.to(v_got[7])
    return (want, v_want), (got, v_got)


def assert_agree(*args: Any, **others: Any) -> None:
    """Values to 1e-12 in these scenes, gradients to 1e-8 of the largest.

    Positions are rounded to some eps |c|, which is 100 eps in units of R, and so is d. A weight's error is that times exp(o z/gamma) over the
    sum, 2e4 at the most where a ray just hits an outline with nothing else but the background there: 1e-9. In a gradient by position 1/h,
    with h^2 = 2 d R^2, multiplies it by another few.
    """
    (want, v_want), (got, v_got) = both(*args, **others)
    assert_close(got, want, 1e-12)
    assert_close(v_got, v_want, 1e-8)


def early_end(s: scenes.Spheres, camera: Camera, tolerance: float) -> tuple[reference.SphereImages, tuple[Any, ...]]:
    """Images of `ops.blend_spheres`, and the arguments that it shares with the formula."""
    C, K = camera.viewmats.shape[0], camera.Ks
    centers = torch.einsum("cij,nj->cni", camera.viewmats[:, :3, :3], s.positions) + camera.viewmats[:, None, :3, 3]
    mine = leaves(centers, s.radii[None], s.opacities[None], s.features[None], torch.ones(C, 3, dtype=torch.float64),
                  torch.tensor(0.02, dtype=torch.float64), K)
    size = camera.width, camera.height
    outline = ops.outlines(centers, s.radii[None], K, *size, "pinhole", NEAR, FAR)
    bins = ops.bin_splats(outline.means2d, outline.radii, outline.conics, outline.opacities, outline.depths, *size, 8)
    rest = (*mine, *bins, None, *size, 8, "pinhole", NEAR, FAR, 1e-6, False, True)
    return ops.blend_spheres(*rest, tolerance), (mine, rest)
