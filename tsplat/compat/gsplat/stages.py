"""gsplat's stage functions on tsplat's ops."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from tsplat_reference import Projection, covariances
from tsplat_reference.constants import ALPHA_MIN

from tsplat import ops
from tsplat.camera import CameraModel
from tsplat.checks import check_choice, check_number, check_size, check_tensor
from tsplat.compat.gsplat.tiles import core_lists

ALPHA_MAX = 0.999
"""gsplat up to 1.5.3; 0.99 on its main branch."""
OPAQUE = ALPHA_MIN * math.exp(0.5 * 3.33**2)
"""The opacity at which a splat reaches 3.33 standard deviations: gsplat's extent where it is not given opacities."""
UPPER = ((0, 1, 2), (1, 3, 4), (2, 4, 5))
"""A symmetric matrix by its upper triangle."""
MODELS: dict[str, CameraModel] = {"pinhole": "pinhole", "ortho": "orthographic", "fisheye": "fisheye"}


class Packed(NamedTuple):
    """Where the visible splats are in the padded rows of their images: slots `[nnz]` of `[I M]`. images, rows: I and M."""

    slots: Tensor
    images: int
    rows: int

    @staticmethod
    def of(image_ids: Tensor, images: int) -> Packed:
        """For the image `[nnz]` of each splat."""
        per_image = torch.bincount(image_ids, minlength=images)
        rows = int(per_image.max()) if images else 0
        order = image_ids.argsort(stable=True)
        row = torch.empty_like(order)
        row[order] = torch.arange(len(order), device=order.device) - (per_image.cumsum(0) - per_image)[image_ids[order]]
        return Packed(image_ids * rows + row, images, rows)

    def spread(self, values: Tensor) -> Tensor:
        """`[I, M, ...]` of `[nnz, ...]`, zeros where there is none."""
        flat = values.new_zeros(self.images * self.rows, *values.shape[1:])
        return flat.index_copy(0, self.slots, values).view(self.images, self.rows, *values.shape[1:])

    def gather(self, values: Tensor) -> Tensor:
        """`[nnz, ...]` of `[I, M, ...]`."""
        return values.flatten(0, 1)[self.slots]


def fully_fused_projection(means: Tensor, covars: Tensor | None, quats: Tensor | None, scales: Tensor | None, viewmats: Tensor, Ks: Tensor,
                           width: int, height: int, eps2d: float = 0.3, near_plane: float = 0.01, far_plane: float = 1e10,
                           radius_clip: float = 0.0, packed: bool = False, sparse_grad: bool = False, calc_compensations: bool = False,
                           camera_model: str = "pinhole", opacities: Tensor | None = None) -> tuple[Any, ...]:
    """Project Gaussians to 2D splats.

    Args:
        means: `[..., N, 3]`. covars: `[..., N, 6]`, upper triangles, or None for quats and scales: `[..., N, 4]` (wxyz) and `[..., N, 3]`.
        viewmats, Ks: `[..., C, 4, 4]` world to camera and `[..., C, 3, 3]`.
        width, height: in pixels.
        eps2d: added to the diagonal of the 2D covariance. near_plane, far_plane: culled outside. radius_clip: culled up to this radius.
        packed: return the visible splats only.
        sparse_grad: gradients of means, covars, quats and scales as sparse tensors of the visible rows; with `packed`, without batches.
        calc_compensations: also the factors of opacities for antialiasing.
        camera_model: "pinhole", "ortho" or "fisheye".
        opacities: `[..., N]`, for tighter extents.

    Returns:
        radii int32 `[..., C, N, 2]` (0 if culled), means2d, depths, conics `[..., C, N, 3]` and compensations (or None). With `packed`:
        int64 `[nnz]` ids of batches, cameras and Gaussians, and these, `[nnz, ...]`.
    """
    batch, N, C = check_scene(means, covars, quats, scales, viewmats, Ks)
    if opacities is not None:
        check_tensor("opacities", opacities, (*batch, N), like=means)
    check_size("width", width)
    check_size("height", height)
    check_number("radius_clip", radius_clip, "a radius in pixels")
    if sparse_grad and (not packed or batch):
        raise ValueError("sparse_grad: expected packed=True and no batch dimensions with it")
    model = core_model(camera_model)
    quats, scales = (quats, scales) if covars is None else (None, None)
    seen: list[Tensor] = []
    if sparse_grad:
        means, covars, quats, scales = (sparse_rows(v, seen) for v in (means, covars, quats, scales))
    matrices = None if covars is None else covars[..., torch.tensor(UPPER, device=covars.device)]
    extents = means.new_full(means.shape[:-1], OPAQUE) if opacities is None else opacities

    def project(antialiased: bool) -> list[Projection]:
        return [ops.project(m, q, s, c, o, v, K, width, height, model, near_plane, far_plane, eps2d, antialiased)
                for m, q, s, c, o, v, K in scenes(batch, means, quats, scales, matrices, extents, viewmats, Ks)]

    parts = project(calc_compensations)
    if calc_compensations and opacities is None:        # the core's extents are those of compensated opacities, gsplat's here are not
        parts = [p._replace(compensations=q.compensations) for p, q in zip(project(False), parts, strict=True)]
    radii, means2d, depths, conics, compensations = (joined(values, batch) for values in zip(*parts, strict=True))
    if radius_clip > 0:
        radii = radii * (radii > radius_clip).any(-1, keepdim=True)
    visible = (radii > 0).all(-1)
    results = radii, means2d, depths, conics, compensations if calc_compensations else None
    if not packed:
        return results
    batch_ids, camera_ids, gaussian_ids = visible.view(math.prod(batch), C, N).nonzero().unbind(-1)
    seen.append(gaussian_ids)
    return batch_ids, camera_ids, gaussian_ids, *(None if v is None else v[visible] for v in results)


def rasterize_to_pixels(means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, image_width: int, image_height: int, tile_size: int,
                        isect_offsets: Tensor, flatten_ids: Tensor, backgrounds: Tensor | None = None, masks: Tensor | None = None,
                        packed: bool = False, absgrad: bool = False) -> tuple[Tensor, Tensor]:
    """Blend splats over the pixels of the tiles that list them.

    Args:
        means2d, conics, colors, opacities: `[..., N, 2]`, `[..., N, 3]`, `[..., N, D]` and `[..., N]`, or with `packed` `[nnz, ...]`.
        image_width, image_height, tile_size: in pixels. On a GPU tile_size is a multiple of 8.
        isect_offsets, flatten_ids: of `isect_offset_encode`, reshaped to `[..., tile_height, tile_width]`, and of `isect_tiles`.
        backgrounds: `[..., D]`.
        masks: bool `[..., tile_height, tile_width]`: False for tiles to leave empty.
        absgrad: backward sets `means2d.absgrad` to the sum over pixels of |gradient|.

    Returns:
        `[..., image_height, image_width, D]` and alpha `[..., image_height, image_width, 1]`.
    """
    images = isect_offsets.shape[:-2]
    check_tensor("means2d", means2d, ("nnz", 2) if packed else (*images, "N", 2))
    rest = means2d.shape[:-1]
    for name, value, shape in (("conics", conics, (*rest, 3)), ("colors", colors, (*rest, "D")), ("opacities", opacities, rest)):
        check_tensor(name, value, shape, like=means2d)
    if backgrounds is not None:
        check_tensor("backgrounds", backgrounds, (*images, colors.shape[-1]), like=means2d)
    if masks is not None and masks.shape != isect_offsets.shape:
        raise ValueError(f"masks: expected shape {list(isect_offsets.shape)}; got {list(masks.shape)}")
    check_size("tile_size", tile_size)
    tile_height, tile_width = isect_offsets.shape[-2:]
    if tile_width * tile_size < image_width or tile_height * tile_size < image_height:
        raise ValueError(f"isect_offsets: expected tiles of {tile_size} that cover {image_width} x {image_height} pixels; "
                         f"got {tile_width} x {tile_height}")
    ids, offsets, tile = core_lists(isect_offsets, flatten_ids, masks, image_width, image_height, tile_size)
    I, tiles = math.prod(images), tile_height * tile_width
    layout = None
    if packed:                                          # the image of a splat is that of the tiles that list it
        tile_of = torch.searchsorted(isect_offsets.reshape(-1).long(), torch.arange(len(flatten_ids), device=ids.device), right=True) - 1
        image_ids = torch.zeros(len(means2d), dtype=torch.int64, device=ids.device)
        image_ids[flatten_ids.long()] = tile_of // tiles
        layout = Packed.of(image_ids, I)
        ids = layout.slots[ids.long()].to(torch.int32)
    color, alpha = draw(means2d, conics, colors, opacities, None if backgrounds is None else backgrounds.reshape(I, -1), ids, offsets, I,
                        image_width, image_height, tile, layout, absgrad)
    return color.view(*images, *color.shape[1:]), alpha.view(*images, *alpha.shape[1:])


def draw(means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, backgrounds: Tensor | None, ids: Tensor, offsets: Tensor,
         images: int, width: int, height: int, tile: int, layout: Packed | None, absgrad: bool) -> tuple[Tensor, Tensor]:
    """Blend by lists of the core: images `[I, H, W, D]` and alphas `[I, H, W, 1]`. With `absgrad`, backward sets `means2d.absgrad`.

    The image is a copy of what backward reads, as training loops write into it (`colors[~masks] = 0`).
    """
    m, c, o, f = per_image(images, layout, means2d, conics, opacities, colors)
    probe = None
    if absgrad:
        probe = torch.zeros_like(m, requires_grad=True)
        probe.register_hook(  # type: ignore[no-untyped-call]
            lambda v: setattr(means2d, "absgrad", v.view_as(means2d) if layout is None else layout.gather(v)))
    return blend(m, c, o, f, backgrounds, probe, ids, offsets, width, height, tile)


def blend(means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, backgrounds: Tensor | None, absgrad: Tensor | None, ids: Tensor,
          offsets: Tensor, width: int, height: int, tile: int) -> tuple[Tensor, Tensor]:
    """The core's op by gsplat's rules."""
    color, alpha = ops.blend(means2d, conics, opacities, colors, backgrounds, absgrad, ids, offsets, width, height, tile, ALPHA_MAX, True)
    return color.clone() if color.requires_grad else color, alpha[..., None]


def per_image(images: int, layout: Packed | None, means2d: Tensor, *values: Tensor) -> list[Tensor]:
    """means2d and the other values as `[I, N, ...]`, of `[..., N, ...]` or `[nnz, ...]`."""
    dims = means2d.ndim - 2
    return [v.reshape(images, *v.shape[dims:]) if layout is None else layout.spread(v) for v in (means2d, *values)]


def spherical_harmonics(degrees_to_use: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None = None) -> Tensor:
    """Spherical harmonics `[..., D]` of directions `[..., 3]` of any length by coefficients `[..., K, D]`, K >= (degrees_to_use + 1)^2.

    masks: bool `[...]`: zeros where False.
    """
    check_choice("degrees_to_use", degrees_to_use, range(5))
    check_tensor("dirs", dirs, (..., 3))
    check_tensor("coeffs", coeffs, (*dirs.shape[:-1], "K", "D"), like=dirs)
    if coeffs.shape[-2] < (degrees_to_use + 1) ** 2:
        raise ValueError(f"coeffs: expected at least {(degrees_to_use + 1) ** 2} coefficients for degree {degrees_to_use}; "
                         f"got {list(coeffs.shape)}")
    flat = dirs.reshape(-1, 3)
    mask = torch.ones(len(flat), dtype=torch.bool, device=dirs.device) if masks is None else masks.reshape(-1)
    out = ops.harmonics(flat, flat.new_zeros(1, 3), coeffs.reshape(-1, *coeffs.shape[-2:]), degrees_to_use, mask[None])
    return out.view(*dirs.shape[:-1], coeffs.shape[-1])


def quat_scale_to_covar_preci(quats: Tensor, scales: Tensor, compute_covar: bool = True, compute_preci: bool = True, triu: bool = False
                              ) -> tuple[Tensor | None, Tensor | None]:
    """Covariances R S^2 R^T and their inverses, each `[..., 3, 3]`, or `[..., 6]` (upper triangles) with `triu`, or None if not asked for."""
    check_tensor("quats", quats, (..., 4))
    check_tensor("scales", scales, (*quats.shape[:-1], 3), like=quats)

    def matrices(extents: Tensor) -> Tensor:
        found = covariances(quats.reshape(-1, 4), extents.reshape(-1, 3)).view(*quats.shape[:-1], 3, 3)
        return found.flatten(-2)[..., [0, 1, 2, 4, 5, 8]] if triu else found

    return matrices(scales) if compute_covar else None, matrices(1 / scales) if compute_preci else None


def check_scene(means: Tensor, covars: Tensor | None, quats: Tensor | None, scales: Tensor | None, viewmats: Tensor, Ks: Tensor
                ) -> tuple[torch.Size, int, int]:
    """Check the shapes of a scene (covars as upper triangles); batch dimensions, N and C."""
    check_tensor("means", means, (..., "N", 3))
    if means.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"means: expected dtype torch.float32 or torch.float64, as half precision cannot hold a position; got {means.dtype}")
    batch, N = means.shape[:-2], means.shape[-2]
    if covars is not None:
        check_tensor("covars", covars, (*batch, N, 6), like=means)
    else:
        check_tensor("quats", quats, (*batch, N, 4), like=means)
        check_tensor("scales", scales, (*batch, N, 3), like=means)
    check_tensor("viewmats", viewmats, (*batch, "C", 4, 4), like=means)
    C = viewmats.shape[-3]
    check_tensor("Ks", Ks, (*batch, C, 3, 3), like=means)
    return batch, N, C


def core_model(camera_model: str) -> CameraModel:
    """The core's name of a camera model."""
    if camera_model in ("ftheta", "lidar"):
        raise NotImplementedError(f"camera_model: tsplat has no {camera_model!r} cameras yet")
    check_choice("camera_model", camera_model, tuple(MODELS))
    return MODELS[camera_model]


def scenes(batch: torch.Size, *values: Tensor | None) -> Iterator[list[Any]]:
    """The values of each scene of a batch, whose dimensions lead."""
    if not batch:
        yield list(values)
        return
    for i in range(math.prod(batch)):
        yield [None if v is None else v.flatten(0, len(batch) - 1)[i] for v in values]


def joined(parts: Sequence[Tensor], batch: torch.Size) -> Tensor:
    """The opposite of `scenes`."""
    return torch.stack(list(parts)).view(*batch, *parts[0].shape) if batch else parts[0]


def sparse_rows(values: Any, seen: list[Tensor]) -> Any:
    """The same tensor; its gradient is sparse, of the rows that `seen` names by the time of backward."""
    return None if values is None else _SparseRows.apply(values, seen)  # type: ignore[no-untyped-call]


class _SparseRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, seen: list[Tensor]) -> Tensor:
        ctx.seen = seen
        return values.view_as(values)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        rows = torch.unique(torch.cat(ctx.seen))
        return torch.sparse_coo_tensor(rows[None], gradient[rows], gradient.shape, is_coalesced=True, check_invariants=False), None
