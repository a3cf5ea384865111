"""gsplat's `rasterization` on tsplat's ops."""

from __future__ import annotations

import enum
import functools
import math
from collections import UserDict
from collections.abc import Callable
from typing import Any

import numpy
import torch
from torch import Tensor
from tsplat_reference import camera_centers

from tsplat import ops
from tsplat.checks import check_choice, check_size, check_tensor
from tsplat.compat.gsplat.stages import (
    MODELS,
    Packed,
    blend,
    check_scene,
    core_model,
    draw,
    fully_fused_projection,
    joined,
    per_image,
    scenes,
    sparse_rows,
)
from tsplat.compat.gsplat.tiles import isect_offset_encode, isect_tiles
from tsplat.rasterize import TILE

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
TRIANGLE = (0, 1, 2, 4, 5, 8)
"""The upper triangle of a flat 3x3 matrix."""


class RollingShutterType(enum.Enum):
    """gsplat's names; only GLOBAL is there."""

    ROLLING_TOP_TO_BOTTOM = 0
    ROLLING_LEFT_TO_RIGHT = 1
    ROLLING_BOTTOM_TO_TOP = 2
    ROLLING_RIGHT_TO_LEFT = 3
    GLOBAL = 4


class Deferred:
    """A value of `Meta` that is made when it is first read."""

    def __init__(self, make: Callable[[], Any]) -> None:
        self.make = make


class Meta(UserDict[str, Any]):
    """gsplat's `meta`. The lists of tiles are made when they are read: rendering has its own."""

    def __getitem__(self, key: str) -> Any:
        value = super().__getitem__(key)
        if isinstance(value, Deferred):
            value = self.data[key] = value.make()
        return value


def rasterization(means: Tensor, quats: Tensor | None, scales: Tensor | None, opacities: Tensor, colors: Tensor, viewmats: Tensor, Ks: Tensor,
                  width: int, height: int, near_plane: float = 0.01, far_plane: float = 1e10, radius_clip: float = 0.0, eps2d: float = 0.3,
                  sh_degree: int | None = None, packed: bool = True, tile_size: int = 16, backgrounds: Tensor | None = None,
                  render_mode: str = "RGB", sparse_grad: bool = False, absgrad: bool = False, rasterize_mode: str = "classic",
                  channel_chunk: int = 32, distributed: bool = False, camera_model: str = "pinhole", segmented: bool = False,
                  covars: Tensor | None = None, with_ut: bool = False, with_eval3d: bool = False, radial_coeffs: Tensor | None = None,
                  tangential_coeffs: Tensor | None = None, thin_prism_coeffs: Tensor | None = None, ftheta_coeffs: Any = None,
                  rolling_shutter: Any = RollingShutterType.GLOBAL, viewmats_rs: Tensor | None = None) -> tuple[Tensor, Tensor, Meta]:
    """Render N Gaussians in C cameras, with any batch dimensions in front.

    Args:
        means: `[..., N, 3]`.
        quats, scales: `[..., N, 4]` (wxyz, of any length) and `[..., N, 3]`; not read if covars is given.
        opacities: `[..., N]`.
        colors: `[..., N, D]` or, for each camera, `[..., C, N, D]`; with `sh_degree` coefficients `[..., (C,) N, K, D]`.
        viewmats, Ks: `[..., C, 4, 4]` world to camera and `[..., C, 3, 3]` intrinsics in pixels.
        width, height: of the images in pixels.
        near_plane, far_plane: Gaussians outside are culled. radius_clip: and those whose radius is at most this many pixels.
        eps2d: added to the diagonal of the projected covariance.
        sh_degree: bands to use of SH coefficients in `colors`, 0 to 4.
        packed: whether `meta` has the visible splats only, `[nnz, ...]`, rather than `[..., C, N, ...]`.
        tile_size: of the tiles in `meta`.
        backgrounds: `[..., C, D]`.
        render_mode: "RGB", "D" (accumulated depth), "ED" (expected depth), "RGB+D" or "RGB+ED" (depth as the last channel).
        sparse_grad: gradients of means, quats and scales as sparse tensors of the visible rows; with `packed`, without batch dimensions.
        absgrad: backward sets `meta["means2d"].absgrad` to the sum over pixels of |gradient| (AbsGS).
        rasterize_mode: "classic" or "antialiased".
        camera_model: "pinhole", "ortho" or "fisheye".
        covars: `[..., N, 3, 3]`, of which the upper triangles are read, instead of quats and scales.
        channel_chunk, segmented: no difference.
        distributed: each rank of the default process group gives Gaussians and C cameras of its own and gets the images of its cameras, with
            the Gaussians of all ranks: see `tsplat.distributed`. Without batch dimensions and colours for each camera, as in gsplat.
        with_ut, with_eval3d, radial_coeffs, tangential_coeffs, thin_prism_coeffs, ftheta_coeffs, rolling_shutter, viewmats_rs: not there.

    Returns:
        Images `[..., C, height, width, X]`, alphas `[..., C, height, width, 1]`, and `meta`: batch_ids, camera_ids, gaussian_ids (None unless
        packed), radii, means2d (in the graph: `retain_grad()`), depths, conics, opacities, tile_width, tile_height, tiles_per_gauss, isect_ids,
        flatten_ids, isect_offsets, width, height, tile_size, n_batches, n_cameras. With `distributed`, camera_ids count the cameras of all ranks,
        and the Gaussians are those of this rank, where their gradients arrive.

    Raises:
        ValueError, TypeError: naming the argument, what came and what is expected.
        NotImplementedError: naming the option; and for the lists of tiles in `meta` (tiles_per_gauss, isect_ids, flatten_ids, isect_offsets)
            with `distributed`.
    """
    _reject({"with_ut": with_ut, "with_eval3d": with_eval3d, "radial_coeffs": radial_coeffs,
             "tangential_coeffs": tangential_coeffs, "thin_prism_coeffs": thin_prism_coeffs, "ftheta_coeffs": ftheta_coeffs,
             "rolling_shutter": getattr(rolling_shutter, "name", rolling_shutter) != "GLOBAL", "viewmats_rs": viewmats_rs})
    check_choice("render_mode", render_mode, RENDER_MODES)
    check_choice("rasterize_mode", rasterize_mode, ("classic", "antialiased"))
    check_size("tile_size", tile_size)
    # numpy's, as gsplat's own parser of fisheye captures has them
    width, height = (int(v) if isinstance(v, numpy.integer) else v for v in (width, height))
    if covars is not None:
        check_tensor("covars", covars, (..., 3, 3))
        covars = covars.flatten(-2)[..., TRIANGLE]
    batch, N, C = check_scene(means, covars, quats, scales, viewmats, Ks)
    check_tensor("opacities", opacities, (*batch, N), like=means)
    _check_colors(colors, means, batch, N, C, sh_degree)
    backgrounds = backgrounds if "RGB" in render_mode else None         # that of depth is 0, whatever the shape
    if backgrounds is not None:
        check_tensor("backgrounds", backgrounds, (*batch, C, colors.shape[-1]), like=means)
    if sparse_grad and (not packed or batch):
        raise ValueError("sparse_grad: expected packed=True and no batch dimensions with it")
    seen: list[Tensor] = []
    if sparse_grad:
        means, covars, quats, scales = (sparse_rows(v, seen) for v in (means, covars, quats, scales))
    antialiased = rasterize_mode == "antialiased"
    images, own, group = math.prod(batch) * C, C, None
    if distributed:
        from tsplat.compat.gsplat import distributed as ranks  # only where it is used: some builds of torch have no torch.distributed
        if batch or colors.ndim > (2 if sh_degree is None else 3):
            raise ValueError("distributed: expected no batch dimensions and no colors per camera; "
                             f"got means of shape {list(means.shape)} and colors of shape {list(colors.shape)}")
        group, viewmats, Ks = ranks.gather(viewmats, Ks, (means, covars, quats, scales, opacities, colors), {
            "width": width, "height": height, f"camera_model (of {', '.join(MODELS)})": list(MODELS.values()).index(core_model(camera_model)),
            "near_plane": near_plane, "far_plane": far_plane, "radius_clip": radius_clip, "eps2d": eps2d,
            f"render_mode (of {', '.join(RENDER_MODES)})": RENDER_MODES.index(render_mode), "antialiased": antialiased, "absgrad": absgrad,
            "channels of colors": colors.shape[-1], "sh_degree (-1: None)": -1 if sh_degree is None else sh_degree})
        C = len(viewmats)                               # of all ranks; Gaussians are those of this one

    radii, means2d, depths, conics, compensations = fully_fused_projection(
        means, covars, quats, scales, viewmats, Ks, width, height, eps2d, near_plane, far_plane, radius_clip, calc_compensations=antialiased,
        camera_model=camera_model, opacities=opacities)
    visible = (radii > 0).all(-1)
    view_opacities = opacities[..., None, :].expand(*batch, C, N)
    view_opacities = view_opacities * compensations if antialiased else view_opacities
    view_colors = _view_colors(means, viewmats, colors, sh_degree, visible, batch) if "RGB" in render_mode else None
    batch_ids = camera_ids = gaussian_ids = layout = None
    if packed:
        batch_ids, camera_ids, gaussian_ids = visible.view(math.prod(batch), C, N).nonzero().unbind(-1)
        seen.append(gaussian_ids)
        radii, means2d, depths, conics, view_opacities = (v[visible] for v in (radii, means2d, depths, conics, view_opacities))
        view_colors = None if view_colors is None else view_colors[visible]
        layout = Packed.of(batch_ids * C + camera_ids, images) if group is None else None
    channels = [] if view_colors is None else [view_colors]
    if render_mode != "RGB":
        channels.append(depths[..., None])
    if backgrounds is not None:
        backgrounds = torch.nn.functional.pad(backgrounds.reshape(images, -1), (0, int(render_mode != "RGB")))
    color = torch.cat(channels, -1)

    if group is None:
        ids, offsets = _bins(means2d, radii, conics, view_opacities, depths, color, images, width, height, layout)
        image, alpha = draw(means2d, conics, color, view_opacities, backgrounds, ids, offsets, images, width, height, TILE, layout, absgrad)
    else:
        near = ranks.send_visible(camera_ids, radii, means2d, conics, view_opacities, color, depths, C, absgrad, group)
        ids, offsets = ops.bin_splats(near.means2d, near.radii, near.conics, near.opacities, near.depths, width, height, TILE)
        image, alpha = blend(near.means2d, near.conics, near.opacities, near.colors, backgrounds, near.absgrad, ids, offsets, width, height, TILE)
    if "ED" in render_mode:
        image = torch.cat([image[..., :-1], image[..., -1:] / alpha.clamp_min(1e-10)], -1)

    tile_width, tile_height = -(-width // tile_size), -(-height // tile_size)

    @functools.cache
    def lists() -> tuple[Tensor, ...]:
        if group is not None:
            raise NotImplementedError("meta: tsplat has no lists of tiles with distributed=True; their splats are on other ranks")
        image_ids = None if batch_ids is None or camera_ids is None else batch_ids * C + camera_ids
        return isect_tiles(means2d.detach(), radii, depths.detach(), tile_size, tile_width, tile_height, packed=packed, n_images=images,
                           image_ids=image_ids, gaussian_ids=gaussian_ids)

    def list_offsets() -> Tensor:
        return isect_offset_encode(lists()[1], images, tile_width, tile_height).view(*batch, C, tile_height, tile_width)

    meta = Meta({
        "batch_ids": batch_ids, "camera_ids": camera_ids, "gaussian_ids": gaussian_ids, "radii": radii, "means2d": means2d, "depths": depths,
        "conics": conics, "opacities": view_opacities, "tile_width": tile_width, "tile_height": tile_height,
        "tiles_per_gauss": Deferred(lambda: lists()[0]), "isect_ids": Deferred(lambda: lists()[1]), "flatten_ids": Deferred(lambda: lists()[2]),
        "isect_offsets": Deferred(list_offsets), "width": width, "height": height, "tile_size": tile_size, "n_batches": math.prod(batch),
        "n_cameras": own})
    return image.view(*batch, own, *image.shape[1:]), alpha.view(*batch, own, *alpha.shape[1:]), meta


def _view_colors(means: Tensor, viewmats: Tensor, colors: Tensor, sh_degree: int | None, visible: Tensor, batch: torch.Size) -> Tensor:
    """`[..., C, N, D]`."""
    C, N = visible.shape[-2:]
    per_camera = colors.ndim == len(batch) + (3 if sh_degree is None else 4)
    if sh_degree is None:
        return colors if per_camera else colors.unsqueeze(len(batch)).expand(*batch, C, N, -1)
    parts = []
    for m, v, coeffs, mask in scenes(batch, means, viewmats, colors, visible):
        centers = camera_centers(v)
        if per_camera:
            parts.append(torch.cat([ops.harmonics(m, centers[c:c + 1], coeffs[c], sh_degree, mask[c:c + 1]) for c in range(C)]))
        else:
            parts.append(ops.harmonics(m, centers, coeffs, sh_degree, mask))
    return (joined(parts, batch) + 0.5).clamp_min(0.0)


@torch.no_grad()
def _bins(means2d: Tensor, radii: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, colors: Tensor, images: int, width: int, height: int,
          layout: Packed | None) -> tuple[Tensor, Tensor]:
    """The core's lists. Splats whose colour is not finite are left out, as in `tsplat.rasterize`."""
    radii = radii * colors.isfinite().all(-1, keepdim=True)
    m, r, c, o, d = per_image(images, layout, means2d, radii, conics, opacities, depths)
    ids, offsets = ops.bin_splats(m, r, c, o, d, width, height, TILE)
    return ids, offsets


def _check_colors(colors: Tensor, means: Tensor, batch: torch.Size, N: int, C: int, sh_degree: int | None) -> None:
    tail = ("D",) if sh_degree is None else ("K", "D")
    per_camera = getattr(colors, "ndim", 0) == len(batch) + 2 + len(tail)
    check_tensor("colors", colors, (*batch, C, N, *tail) if per_camera else (*batch, N, *tail), like=means)
    if colors.shape[-1] < 1:
        raise ValueError(f"colors: expected at least 1 channel; got shape {list(colors.shape)}")
    if sh_degree is not None:
        check_choice("sh_degree", sh_degree, range(5))
        if colors.shape[-2] < (sh_degree + 1) ** 2:
            raise ValueError(f"colors: expected at least {(sh_degree + 1) ** 2} SH coefficients for sh_degree {sh_degree}; got {list(colors.shape)}")


def _reject(options: dict[str, Any]) -> None:
    for name, value in options.items():
        if value is not None and value is not False:
            raise NotImplementedError(f"{name}: tsplat does not have this option of gsplat yet")
