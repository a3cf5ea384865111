"""The interface of `diff_gaussian_rasterization` (Inria, 3D Gaussian Splatting), on tsplat's ops.

Change `from diff_gaussian_rasterization import ...` to `from tsplat.compat.inria import ...`. Kept: row-vector (transposed) matrices, the near
plane at 0.2, radii of 3 standard deviations along the longer axis, alpha at most 0.99, pixels that end without the splat that takes their
transmittance below 1e-4, and `means2D.grad` per half image (NDC). Different:

| | Inria | here |
| --- | --- | --- |
| where a splat ends | with the 16 x 16 tiles that its radius touches, which cuts off up to 0.011 of its opacity | where its alpha falls below 1/255 |
| `rotations` | taken as they are, of unit length | normalised; the gradient is that of the normalised |
| `viewmatrix`, `campos` | no gradient | the gradient (of campos by way of the harmonics) |
| principal point in `projmatrix` | moves splats, not the limits of their shape's Jacobian | moves both |
| where alpha is clamped | the gradient as if it were not | 0, the gradient |
| beyond 1.3 times the field of view, where the shape's Jacobian is limited | its off-diagonal twice in the gradient by depth | the gradient |
| colours | 3 channels | any number |
| results | without inverse depths in the version of 2023 | always with |
| `dc` (one of its branches) | the first coefficients, apart from `shs` | not there: give all as `shs` |
| splats that are not finite | NaN in the image | left out, gradient 0 |
| `debug`, `prefiltered` | write a dump; trap | nothing |
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from tsplat import ops
from tsplat.checks import check_size, check_tensor
from tsplat.rasterize import TILE

NEAR = 0.2
FAR = 1e10
EPS2D = 0.3
ALPHA_MAX = 0.99
BLOCK = 16
"""Pixels along the side of the tiles by which a splat counts as visible."""
SPREAD_MIN = 0.1
"""Least value under the root that parts the two eigenvalues."""
EXTENT_OPACITY = 1e30
"""Makes the core keep everything within 12 standard deviations of the image: which of it is visible, Inria's radius decides."""
UPPER = ((0, 1, 2), (1, 3, 4), (2, 4, 5))
"""A symmetric matrix by the 6 numbers of its upper triangle."""


class GaussianRasterizationSettings(NamedTuple):
    """A camera and what goes with it.

    image_height, image_width: in pixels. tanfovx, tanfovy: tangents of half the fields of view. bg: `[D]`. scale_modifier: factor of scales.
    viewmatrix, projmatrix: `[4, 4]` world to camera and to clip space, transposed. sh_degree: bands to use. campos: `[3]`, for the harmonics.
    prefiltered, debug: no difference. antialiasing: scale opacities by what the blur added to each splat's area.
    """

    image_height: int
    image_width: int
    tanfovx: float
    tanfovy: float
    bg: Tensor
    scale_modifier: float
    viewmatrix: Tensor
    projmatrix: Tensor
    sh_degree: int
    campos: Tensor
    prefiltered: bool = False
    debug: bool = False
    antialiasing: bool = False


class GaussianRasterizer(torch.nn.Module):
    """Renders Gaussians by its settings."""

    def __init__(self, raster_settings: GaussianRasterizationSettings) -> None:
        super().__init__()
        self.raster_settings = raster_settings

    @torch.no_grad()
    def markVisible(self, positions: Tensor) -> Tensor:
        """Bool `[N]`: which positions `[N, 3]` are beyond the near plane."""
        check_tensor("positions", positions, ("N", 3))
        V = self.raster_settings.viewmatrix
        return (positions * V[:3, 2]).sum(-1) + V[3, 2] > NEAR

    def forward(self, means3D: Tensor, means2D: Tensor, opacities: Tensor, shs: Tensor | None = None, colors_precomp: Tensor | None = None,
                scales: Tensor | None = None, rotations: Tensor | None = None, cov3D_precomp: Tensor | None = None
                ) -> tuple[Tensor, Tensor, Tensor]:
        """See `rasterize_gaussians`."""
        return rasterize_gaussians(means3D, means2D, shs, colors_precomp, opacities, scales, rotations, cov3D_precomp, self.raster_settings)


def rasterize_gaussians(means3D: Tensor, means2D: Tensor, sh: Tensor | None, colors_precomp: Tensor | None, opacities: Tensor,
                        scales: Tensor | None, rotations: Tensor | None, cov3Ds_precomp: Tensor | None,
                        raster_settings: GaussianRasterizationSettings) -> tuple[Tensor, Tensor, Tensor]:
    """Render N Gaussians.

    Args:
        means3D: `[N, 3]`.
        means2D: `[N, 3]` that requires grad; its values do not matter. Its gradient is that by the projected means, in units of half the image.
        sh, colors_precomp: one of `[N, K, D]` and `[N, D]`.
        opacities: `[N, 1]` or `[N]`.
        scales, rotations, cov3Ds_precomp: `[N, 3]` and `[N, 4]` (wxyz), or `[N, 6]`, upper triangles.

    Returns:
        Image `[D, H, W]`; radii int32 `[N]` in pixels, 0 for what is not seen; inverse depths `[1, H, W]`, the sum of weight / depth.

    Raises:
        ValueError, TypeError: naming the argument, what came and what is expected.
    """
    s = raster_settings
    sh, colors_precomp, scales, rotations, cov3Ds_precomp = (None if v is not None and v.shape == (0,) else v
                                                             for v in (sh, colors_precomp, scales, rotations, cov3Ds_precomp))
    _check(means3D, means2D, sh, colors_precomp, opacities, scales, rotations, cov3Ds_precomp, s)
    N, W, H = len(means3D), s.image_width, s.image_height
    viewmats = s.viewmatrix.mT[None]
    opacities = opacities.reshape(1, N)
    quats, scales = (rotations, scales * s.scale_modifier) if scales is not None else (None, None)
    covars = None if cov3Ds_precomp is None else cov3Ds_precomp[:, torch.tensor(UPPER, device=means3D.device)]
    p = ops.project(means3D, quats, scales, covars, torch.full_like(opacities[0], EXTENT_OPACITY), viewmats, _intrinsics(s, viewmats), W, H,
                    "pinhole", NEAR, FAR, EPS2D, s.antialiasing)
    means2d = p.means2d + (means2D - means2D.detach())[:, :2] * means2D.new_tensor([W / 2, H / 2])
    radii = _radii(p.means2d.detach(), p.conics.detach(), W, H) * (p.radii[..., 0] > 0)
    visible = radii > 0

    if sh is None:
        assert colors_precomp is not None
        colors = colors_precomp[None]
    else:
        colors = (ops.harmonics(means3D, s.campos[None], sh, s.sh_degree, visible) + 0.5).clamp_min(0.0)
    inverse = torch.where(visible, 1 / torch.where(visible, p.depths, 1.0), 0.0)
    colors = torch.cat([colors, inverse[..., None]], -1)
    opacities = opacities * p.compensations if s.antialiasing else opacities
    boxes = (radii * colors.detach().isfinite().all(-1))[..., None].expand(-1, -1, 2)
    bins = ops.bin_splats(means2d, boxes.contiguous(), p.conics, opacities, p.depths, W, H, TILE)
    background = torch.nn.functional.pad(s.bg.reshape(1, -1), (0, 1))
    image, _ = ops.blend(means2d, p.conics, opacities, colors, background, None, bins.ids, bins.offsets, W, H, TILE, ALPHA_MAX, True)
    planes = image[0].permute(2, 0, 1).contiguous()
    return planes[:-1], radii[0], planes[-1:]


def _intrinsics(s: GaussianRasterizationSettings, viewmats: Tensor) -> Tensor:
    """Ks `[1, 3, 3]`: focal lengths of the fields of view, and the principal point of the projection, P e_z with P V = projmatrix^T."""
    W, H = s.image_width, s.image_height
    K = s.viewmatrix.new_tensor([[0.5 * W / float(s.tanfovx), 0.0, 0.5 * W], [0.0, 0.5 * H / float(s.tanfovy), 0.5 * H], [0.0, 0.0, 1.0]])
    forward = viewmats[0, 2, :3].detach()
    off = (s.projmatrix.detach()[:3, :2] * forward[:, None]).sum(0)                         # [2], in units of half the image
    K[:2, 2] *= 1 + off
    return K[None]


def _radii(means2d: Tensor, conics: Tensor, W: int, H: int) -> Tensor:
    """Int32 `[1, N]`: ceil(3 sqrt(larger eigenvalue)), 0 where it touches no tile."""
    a, b, c = conics.unbind(-1)
    det = 1 / (a * c - b * b)                           # of the covariance; infinite for what the core has culled
    middle = 0.5 * (a + c) * det
    radii = (3 * (middle + (middle * middle - det).clamp_min(SPREAD_MIN).sqrt()).sqrt()).ceil()
    corner = means2d - 0.5                              # Inria's pixel centres are at integers
    tiles = torch.tensor([-(-W // BLOCK), -(-H // BLOCK)], device=corner.device)
    first = torch.minimum(((corner - radii[..., None]) / BLOCK).floor().clamp_min(0), tiles)
    end = torch.minimum(((corner + radii[..., None] + BLOCK - 1) / BLOCK).floor().clamp_min(0), tiles)
    seen = (end > first).all(-1) & radii.isfinite()
    return torch.where(seen, radii, 0.0).to(torch.int32)


def _check(means3D: Tensor, means2D: Tensor, sh: Tensor | None, colors: Tensor | None, opacities: Tensor, scales: Tensor | None,
           rotations: Tensor | None, covars: Tensor | None, s: GaussianRasterizationSettings) -> None:
    check_tensor("means3D", means3D, ("N", 3))
    N = len(means3D)
    if (sh is None) == (colors is None):
        raise ValueError("shs, colors_precomp: expected exactly one of the two")
    if (scales is None) != (rotations is None) or (scales is None) == (covars is None):
        raise ValueError("scales, rotations, cov3D_precomp: expected either scales and rotations or cov3D_precomp")
    check_tensor("means2D", means2D, (N, 3), like=means3D)
    check_tensor("opacities", opacities, (N, 1) if getattr(opacities, "ndim", 1) == 2 else (N,), like=means3D)
    bases = (s.sh_degree + 1) ** 2
    shapes: dict[str, tuple[Tensor | None, tuple[int | str, ...]]] = {
        "shs": (sh, (N, f"K >= {bases}", "D")), "colors_precomp": (colors, (N, "D")), "scales": (scales, (N, 3)), "rotations": (rotations, (N, 4)),
        "cov3D_precomp": (covars, (N, 6))}
    for name, (value, shape) in shapes.items():
        if value is not None:
            check_tensor(name, value, shape, like=means3D)
    if sh is not None and sh.shape[1] < bases:
        raise ValueError(f"shs: expected at least {bases} coefficients for sh_degree {s.sh_degree}; got {list(sh.shape)}")
    channels = (sh if colors is None else colors).shape[-1]  # type: ignore[union-attr]
    cameras = {"viewmatrix": (4, 4), "projmatrix": (4, 4), "campos": (3,), "bg": (channels,)}
    for name, size in cameras.items():
        check_tensor(name, getattr(s, name), size, like=means3D)
    check_size("image_width", s.image_width)
    check_size("image_height", s.image_height)
