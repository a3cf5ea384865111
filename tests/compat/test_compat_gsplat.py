"""The drop-in for gsplat against recorded results of its reference, and of itself on CUDA."""

from __future__ import annotations

import functools
import json
import math
from pathlib import Path
from typing import Any

import numpy
import pytest
import torch
from compare import assert_close, error, leaves
from gsplat_scenes import loss_of
from torch import Tensor

from tsplat.compat.gsplat import (
    fully_fused_projection,
    isect_offset_encode,
    isect_tiles,
    quat_scale_to_covar_preci,
    rasterization,
    rasterize_to_pixels,
    spherical_harmonics,
    stages,
)

FILES = "random_anisotropic_edge_pinhole", "random_batch2x3_rgbed"
INPUTS = "means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "backgrounds"
WITH_GRADIENT = tuple(name for name in INPUTS if name != "Ks")
BOUNDS = {torch.float64: (1e-6, 1e-5), torch.float32: (2e-5, 1e-4)}
"""Of the image, and of gradients relative to the largest. In float64 what is left is the rounding of the file."""


@functools.cache
def load(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    with numpy.load(path) as file:
        return {k: torch.from_numpy(file[k]) for k in file.files if k != "config"}, json.loads(str(file["config"])) if "config" in file else {}


@pytest.fixture(params=FILES)
def golden(request: pytest.FixtureRequest, shared: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """A recorded scene (or batch of 2), with the alpha that the recorded version clamps to."""
    arrays, config = load(shared / "golden" / "gsplat" / f"{request.param}.npz")
    monkeypatch.setattr(stages, "ALPHA_MAX", config["max_alpha"])
    return arrays, config


@pytest.mark.parametrize("dtype", BOUNDS)
@pytest.mark.parametrize("packed", [True, False])
def test_images_and_gradients_are_the_recorded_ones(golden: Any, packed: bool, dtype: torch.dtype) -> None:
    """Of everything, with and without batches; in float32 where no decision is closer than its rounding."""
    arrays, config = golden
    inputs = leaves(*(arrays[name].to(dtype) for name in INPUTS))
    colors, alphas, meta = rasterization(*inputs[:7], config["width"], config["height"], eps2d=config["eps2d"], backgrounds=inputs[7], packed=packed,
                                         render_mode=config["render_mode"], absgrad=True)
    meta["means2d"].retain_grad()
    want = [arrays["f64_render_colors"], arrays["f64_render_alphas"]]
    assert [colors.shape, alphas.shape] == [w.shape for w in want]
    image_bound, gradient_bound = BOUNDS[dtype]
    where = arrays["stable"] | (dtype == torch.float64)
    for got, w in zip((colors, alphas), want, strict=True):
        assert ((got - w).abs().amax(-1) / w.abs().max().clamp_min(1.0))[where].max() <= image_bound
    loss = (colors * arrays["loss_w"]).sum() + (alphas * arrays["loss_v"]).sum()
    loss.backward()
    for name, leaf in zip(INPUTS, inputs, strict=True):
        if name in WITH_GRADIENT:
            assert error(leaf.grad, arrays[f"f64_v_{name}"]) <= gradient_bound, name
    for found, key in ((meta["means2d"].grad, "f64_v_means2d"), (meta["means2d"].absgrad, "v_means2d_abs")):
        w = arrays[key]
        if packed:
            assert error(found, w.flatten(0, -3)[meta["batch_ids"] * meta["n_cameras"] + meta["camera_ids"], meta["gaussian_ids"]]) <= gradient_bound
        else:
            assert error(found, w) <= gradient_bound


def test_projection_is_the_recorded_one(golden: Any) -> None:
    """Radii by the rule without and with opacities; the rest was recorded in float32."""
    arrays, config = golden
    args = [arrays[k].double() for k in ("means", "quats", "scales", "viewmats", "Ks")]
    means, quats, scales, viewmats, Ks = args
    size = config["width"], config["height"], config["eps2d"]
    plain = fully_fused_projection(means, None, quats, scales, viewmats, Ks, *size, calc_compensations=True)
    aware = fully_fused_projection(means, None, quats, scales, viewmats, Ks, *size, opacities=arrays["opacities"].double())
    assert aware[4] is None
    assert torch.equal(plain[0], arrays["radii"])
    assert torch.equal(aware[0], arrays["radii_opacity_aware"])
    visible = (plain[0] > 0).all(-1)
    for name, got, tolerance in zip(("means2d", "depths", "conics"), plain[1:4], (2e-7, 7e-8, 7e-6), strict=True):
        assert error(got[visible], arrays[name][visible]) <= tolerance, name
    a, b, c = plain[3][visible].unbind(-1)
    blurred = torch.stack([c, -b, -b, a], -1).view(-1, 2, 2) / (a * c - b * b)[:, None, None]
    ratio = torch.linalg.det(blurred - config["eps2d"] * torch.eye(2)) / torch.linalg.det(blurred)
    assert_close(plain[4][visible], ratio.clamp_min(0.005**2).sqrt(), 1e-6)
    covars, _ = quat_scale_to_covar_preci(quats, scales, triu=True, compute_preci=False)
    by_covars = fully_fused_projection(means, covars, None, None, viewmats, Ks, *size)
    assert error(by_covars[3][visible], plain[3][visible]) <= 1e-10
    packed = fully_fused_projection(means, None, quats, scales, viewmats, Ks, *size, packed=True, calc_compensations=True)
    index = visible.view(-1, *visible.shape[-2:]).nonzero()
    assert torch.equal(torch.stack(packed[:3], 1), index)
    assert_close(packed[3:], [v[visible] for v in plain], 0.0)


def test_tiles_are_the_recorded_ones(golden: Any) -> None:
    """The lists of the recorded radii to the bit; with the radii of opacities, exact <= ours <= box."""
    arrays, config = golden
    grid = -(-config["width"] // 16), -(-config["height"] // 16)
    images = math.prod(arrays["depths"].shape[:-1])
    count, ids, flat = isect_tiles(arrays["means2d"], arrays["radii"], arrays["depths"], 16, *grid)
    assert torch.equal(count, arrays["tiles_per_gauss"].to(torch.int32))
    assert torch.equal(ids, arrays["isect_ids"])
    assert torch.equal(flat, arrays["flatten_ids"])
    offsets = isect_offset_encode(ids, images, *grid)
    assert torch.equal(offsets.view(arrays["isect_offsets"].shape), arrays["isect_offsets"])
    inputs = [arrays[name].double() for name in INPUTS]
    for packed in (False, True):
        _, _, meta = rasterization(*inputs[:7], config["width"], config["height"], eps2d=config["eps2d"], packed=packed)
        ours = meta["tiles_per_gauss"]
        exact, box = (arrays[f"tiles_per_gauss{kind}"] for kind in ("_exact", ""))
        if packed:
            at = meta["batch_ids"] * meta["n_cameras"] + meta["camera_ids"], meta["gaussian_ids"]
            exact, box = exact.flatten(0, -2)[at], box.flatten(0, -2)[at]
        assert (exact <= ours).all()
        assert (ours <= box).all()
        assert ours.sum() == len(meta["flatten_ids"])


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("tile_size", [16, 8, 5])
def test_the_stages_in_a_row_are_the_one_call(golden: Any, tile_size: int, packed: bool) -> None:
    """As gsplat chains them, in image and gradients; the order of sums differs."""
    arrays, config = golden
    inputs = leaves(*(arrays[name].double() for name in INPUTS))
    means, quats, scales, opacities, colors, viewmats, Ks, backgrounds = inputs
    size, N, C = (config["width"], config["height"]), means.shape[-2], viewmats.shape[-3]
    batch = means.shape[:-2]
    one = rasterization(*inputs[:7], *size, eps2d=config["eps2d"], backgrounds=backgrounds, packed=packed)
    want = torch.autograd.grad(loss_of(*one[:2]), [means, quats, scales, opacities, colors, viewmats, backgrounds])

    found = fully_fused_projection(means, None, quats, scales, viewmats, Ks, *size, eps2d=config["eps2d"], packed=packed)
    grid, images = (-(-size[0] // tile_size), -(-size[1] // tile_size)), math.prod(batch) * C
    if packed:
        b, c, g, radii, means2d, depths, conics, _ = found
        o, f = opacities.reshape(-1, N)[b, g], colors.reshape(-1, N, 3)[b, g]
        count, ids, flat = isect_tiles(means2d, radii, depths, tile_size, *grid, packed=True, n_images=images, image_ids=b * C + c, gaussian_ids=g)
    else:
        radii, means2d, depths, conics, _ = found
        o, f = opacities[..., None, :].expand(*batch, C, N), colors[..., None, :, :].expand(*batch, C, N, 3)
        count, ids, flat = isect_tiles(means2d, radii, depths, tile_size, *grid)
    offsets = isect_offset_encode(ids, images, *grid).view(*batch, C, *grid[::-1])
    got = rasterize_to_pixels(means2d, conics, f, o, *size, tile_size, offsets, flat, backgrounds, packed=packed, absgrad=True)
    assert_close(got, one[:2], 1e-12)
    loss_of(*got).backward()
    assert_close([v.grad for v in (means, quats, scales, opacities, colors, viewmats, backgrounds)], want, 1e-10)
    assert means2d.absgrad.shape == means2d.shape
    masks = torch.zeros_like(offsets, dtype=torch.bool)
    masks[..., 0, 0] = True
    masked, alpha = rasterize_to_pixels(means2d, conics, f, o, *size, tile_size, offsets, flat, backgrounds, masks, packed=packed)
    t = tile_size
    assert_close(masked[..., :t, :t, :], one[0][..., :t, :t, :], 1e-12)
    assert (alpha[..., t:, :, :] == 0).all()
    assert_close(masked[..., t:, :, :], backgrounds[..., None, None, :].expand_as(masked)[..., t:, :, :], 0.0)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_covariances_and_harmonics_are_the_recorded_ones(shared: Path, dtype: torch.dtype) -> None:
    tolerance = 6e-8 if dtype == torch.float64 else 2e-5
    units, _ = load(shared / "golden" / "gsplat" / "unit_covar.npz")
    quats, scales = leaves(units["quats"].to(dtype), units["scales"].to(dtype))
    covar, preci = quat_scale_to_covar_preci(quats, scales)
    assert_close([covar, preci], [units["f64_covar"], units["f64_preci"]], tolerance)
    loss = (covar * units["w_covar"]).sum() + (preci * units["w_preci"]).sum()
    assert_close(torch.autograd.grad(loss, [quats, scales]), [units["f64_v_quats"], units["f64_v_scales"]], tolerance)
    assert_close(quat_scale_to_covar_preci(quats, scales, triu=True), [units["covar_triu"], units["preci_triu"]], 2e-5)
    assert quat_scale_to_covar_preci(quats, scales, False, False) == (None, None)

    units, _ = load(shared / "golden" / "gsplat" / "unit_sh.npz")
    for degree in range(5):
        dirs, coeffs = leaves(units["dirs"].to(dtype), units["coeffs"].to(dtype))
        out = spherical_harmonics(degree, dirs, coeffs.expand(2, -1, -1, -1))
        found = torch.autograd.grad((out * units["w"]).sum(), [dirs, coeffs])
        assert_close([out, *found], [units[f"f64_{k}{degree}"] for k in ("out", "v_dirs", "v_coeffs")], tolerance)
    mask = torch.arange(200).view(2, 100) % 3 > 0
    masked = spherical_harmonics(4, dirs, coeffs.expand(2, -1, -1, -1), masks=mask)
    assert (masked[~mask] == 0).all()
    assert_close(masked, torch.where(mask[..., None], out, 0.0), 25 * torch.finfo(dtype).eps)      # 25 products, of fewer splats: rounded anew


@pytest.mark.parametrize("name", ["tiny", "basic"])
def test_images_of_gsplat_on_cuda(shared: Path, name: str) -> None:
    """Made by gsplat's CUDA kernels in float32 with the alpha of 1.5.3. Measured: 1.3e-6 and 6.5e-7."""
    with numpy.load(shared / "data" / "gsplat_reference_images" / f"{name}_case.npz") as file:
        data = {k: torch.from_numpy(file[k]) for k in file.files}
    viewmat, K = torch.eye(4), torch.tensor([[61.5, 0.0, 61.5], [0.0, 61.5, 41.0], [0.0, 0.0, 1.0]])
    viewmat[:3, 3] = -torch.tensor([0.123, 0.456, -8.0])
    image, alpha, _ = rasterization(data["means"], data["quats"], data["scales"].exp(), data["opacities"].sigmoid(), data["coeffs"], viewmat[None],
                                    K[None], 123, 82, sh_degree=3)
    assert (torch.cat([image, alpha], -1)[0] - data["out_img"]).abs().max() <= 2e-6
