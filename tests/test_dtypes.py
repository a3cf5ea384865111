"""The reference stages in any floating-point type, half precision too: the same picture and gradients, to the rounding of what goes in.

(Ops compute half precision in float32, under autocast; kernels are for float32 and float64.)
"""

from __future__ import annotations

import pytest
import scenes
import torch
import tsplat_reference as reference
from torch import Tensor

WIDTH, HEIGHT, TILE, N = 20, 16, 8, 12


def picture(dtype: torch.dtype, model: str) -> list[Tensor]:
    """Image, alpha, and closed-form gradients of sums of what the stages return, down to the splats."""
    splats, camera = scenes.splats(N), scenes.camera(2, WIDTH, HEIGHT)
    means, quats, scales, opacities, _ = (x.to(dtype) for x in splats)
    viewmats, Ks, coeffs = (x.to(dtype) for x in (camera.viewmats, camera.Ks, scenes.sh_coefficients(N, 4)))
    p = reference.project(means, quats, scales, None, opacities, viewmats, Ks, WIDTH, HEIGHT, model, 0.01, 1e10, 0.3, True)
    centers, seen = reference.camera_centers(viewmats), (p.radii > 0).all(-1)
    colors = reference.harmonics(means, centers, coeffs, 4, seen)
    each = opacities.expand(2, -1).contiguous()
    bins = reference.bin_splats(p.means2d, p.radii, p.conics, each, p.depths, WIDTH, HEIGHT, TILE)
    sizes = WIDTH, HEIGHT, TILE, 0.99
    plain, _ = reference.blend(p.means2d, p.conics, each, colors, None, *bins, *sizes)
    image, alpha = reference.blend_blocks(p.means2d, p.conics, each, colors, None, *bins, *sizes, False)
    v_means2d, v_conics, v_opacities, v_colors, _ = reference.blend_blocks_backward(
        p.means2d, p.conics, each, colors, None, *bins, image, alpha, torch.ones_like(image), None, *sizes, False, False)
    v = reference.project_backward(means, quats, scales, None, viewmats, Ks, WIDTH, HEIGHT, model, 0.3, True, p.radii, v_means2d,
                                   torch.ones_like(p.depths), v_conics, torch.ones_like(p.depths))
    v_colors = reference.harmonics_backward(means, centers, coeffs, 4, seen, v_colors)
    return [plain, image, alpha, v_opacities, *v_colors, *(x for x in v if x is not None)]


@pytest.mark.parametrize("model", ["pinhole", "orthographic", "fisheye"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.bfloat16], ids=str)
def test_every_stage_takes_any_floating_point_type(dtype: torch.dtype, model: str) -> None:
    """Rounding moves a splat by up to 10 eps pixels, of its size of a pixel or two, so single values by up to 10 eps of the largest: on the
    average less than that (at most 5 eps, of the camera centers, whose gradients are sums over all).
    """
    for got, want in zip(picture(dtype, model), picture(torch.float64, model), strict=True):
        assert got.dtype == dtype
        assert got.isfinite().all()
        assert (got.double() - want).abs().mean() <= 10 * torch.finfo(dtype).eps * want.abs().max()
