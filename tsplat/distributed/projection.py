"""Projection of the own splats into the cameras of all ranks: as pairs of a camera and a splat, of which most do not meet.

This bounds memory. Of each pair there is one byte, for a moment (`ops.may_see`); projected, and recorded for backward, are pairs that may meet,
and coloured and sent those that do. `ops.project` takes all splats in all cameras, so that it is called camera by camera; but rows are picked
once for all, as the gradient of that has a row for every splat.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from tsplat_reference import camera_centers

from tsplat import ops
from tsplat.drawn import Drawn, is_finite, shade
from tsplat.ops.common import Maybe, at


def project(means: Tensor, quats: Tensor | None, scales: Tensor | None, covars: Tensor | None, opacities: Tensor, colors: Tensor, viewmats: Tensor,
            Ks: Tensor, settings: tuple[int, int, str, float, float, float, bool], sh_degree: int | None, screen_offset: Tensor | None,
            absgrad: Tensor | None) -> tuple[Drawn, Tensor, Tensor]:
    """The pairs that are drawn, camera by camera.

    Args:
        means, quats, scales, covars, opacities, colors, sh_degree, screen_offset, absgrad: as in `rasterize`; N splats.
        viewmats, Ks: `[C, 4, 4]` and `[C, 3, 3]`.
        settings: width, height, model, near, far, eps2d and antialiased, as in `ops.project`.

    Returns:
        Their rows `[V, ...]`; int64 `[V, 2]`, the camera and the splat of each; and int64 `[C]`, how many each camera has.
    """
    antialiased = settings[-1]
    camera, splat = ops.may_see(means, _sizes(scales, covars), opacities, viewmats, Ks, *settings[:-1]).nonzero().unbind(1)
    counts = _counts(camera, len(viewmats)).tolist()
    splats = [_split(at(x, splat), counts) for x in (means, quats, scales, covars, opacities)]
    parts = [ops.project(mean, quat, scale, covar, opacity, viewmat, K, *settings) for mean, quat, scale, covar, opacity, viewmat, K in zip(
        *splats, torch.split(viewmats, 1), torch.split(Ks, 1), strict=True)]
    radii, means2d, depths, conics, compensations = (torch.cat([x.squeeze(0) for x in field]) for field in zip(*parts, strict=True))

    visible = (radii > 0).all(-1).nonzero().squeeze(1)
    camera, splat = camera.index_select(0, visible), splat.index_select(0, visible)
    pair = camera * len(means) + splat                                                      # row of what is [C, N, ...]
    if sh_degree is None:
        view_colors = at(colors, splat) if colors.ndim == 2 else at(colors.flatten(0, 1), pair)
    else:
        origin = means.new_zeros(1, 3)                      # relative to the cameras, one call serves the pairs of all of them: to the same bits
        relative = at(means, splat) - camera_centers(viewmats).index_select(0, camera)
        everything = torch.ones_like(splat, dtype=torch.bool)[None]
        view_colors = shade(relative, origin, at(colors, splat), sh_degree, everything).squeeze(0)
    finite = is_finite(view_colors).nonzero().squeeze(1)
    visible, camera, splat, pair, view_colors = (x.index_select(0, finite) for x in (visible, camera, splat, pair, view_colors))
    radii, means2d, depths, conics, compensations = (x.index_select(0, visible) for x in (radii, means2d, depths, conics, compensations))
    offset, probe = (None if x is None else at(x.flatten(0, 1), pair) for x in (screen_offset, absgrad))
    means2d = means2d if offset is None else means2d + offset
    view_opacities = at(opacities, splat) * compensations if antialiased else at(opacities, splat)
    return (Drawn(radii, means2d, conics, view_opacities, view_colors, depths, probe), torch.stack([camera, splat], 1),
            _counts(camera, len(viewmats)))


def _sizes(scales: Tensor | None, covars: Tensor | None) -> Tensor:
    """`[N]`, at least the largest standard deviation of each splat."""
    if covars is not None:
        return covars.detach().abs().sum(2).amax(1).sqrt()                                  # a norm, which no eigenvalue exceeds
    assert scales is not None
    return scales.detach().abs().amax(1)


def _counts(camera: Tensor, cameras: int) -> Tensor:
    """Int64 `[C]`: how many of the pairs are of each camera."""
    return camera.new_zeros(cameras).index_add(0, camera, torch.ones_like(camera))          # bincount has a shape that depends on data


def _split(rows: Maybe, counts: list[int]) -> Sequence[Maybe]:
    """The rows of each camera. (The gradient of a split is one concatenation, that of slices a sum of as many arrays.)"""
    return [rows] * len(counts) if rows is None else torch.split(rows, counts)
