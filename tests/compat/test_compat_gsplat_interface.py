"""The drop-in for gsplat: its documented interface."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import math
from typing import Any

import numpy
import pytest
import torch
from backends import Backend, reference_again
from compare import assert_close
from gsplat_scenes import loss_of, scene
from scenes import camera, generator, uniform
from torch import Tensor

from tsplat import rasterize
from tsplat.compat import gsplat
from tsplat.compat.gsplat import fully_fused_projection, quat_scale_to_covar_preci, rasterization, rasterize_to_pixels, spherical_harmonics

MODES = "RGB", "D", "ED", "RGB+D", "RGB+ED"


def test_the_signatures_are_the_documented_ones() -> None:
    """Names, order and defaults of gsplat 1.5.3."""
    want = {
        "rasterization": "means quats scales opacities colors viewmats Ks width height near_plane=0.01 far_plane=10000000000.0 radius_clip=0.0 "
                         "eps2d=0.3 sh_degree=None packed=True tile_size=16 backgrounds=None render_mode=RGB sparse_grad=False absgrad=False "
                         "rasterize_mode=classic channel_chunk=32 distributed=False camera_model=pinhole segmented=False covars=None with_ut=False "
                         "with_eval3d=False radial_coeffs=None tangential_coeffs=None thin_prism_coeffs=None ftheta_coeffs=None "
                         "rolling_shutter=RollingShutterType.GLOBAL viewmats_rs=None",
        "fully_fused_projection": "means covars quats scales viewmats Ks width height eps2d=0.3 near_plane=0.01 far_plane=10000000000.0 "
                                  "radius_clip=0.0 packed=False sparse_grad=False calc_compensations=False camera_model=pinhole opacities=None",
        "isect_tiles": "means2d radii depths tile_size tile_width tile_height sort=True segmented=False packed=False n_images=None image_ids=None "
                       "gaussian_ids=None",
        "isect_offset_encode": "isect_ids n_images tile_width tile_height",
        "rasterize_to_pixels": "means2d conics colors opacities image_width image_height tile_size isect_offsets flatten_ids backgrounds=None "
                               "masks=None packed=False absgrad=False",
        "spherical_harmonics": "degrees_to_use dirs coeffs masks=None",
        "quat_scale_to_covar_preci": "quats scales compute_covar=True compute_preci=True triu=False",
        "export_splats": "means scales quats opacities sh0 shN format=ply save_to=None",
        "SelectiveAdam": "params eps betas",
        "DefaultStrategy": "prune_opa=0.005 grow_grad2d=0.0002 grow_scale3d=0.01 grow_scale2d=0.05 prune_scale3d=0.1 prune_scale2d=0.15 "
                           "refine_scale2d_stop_iter=0 refine_start_iter=500 refine_stop_iter=15000 reset_every=3000 refine_every=100 "
                           "pause_refine_after_reset=0 absgrad=False revised_opacity=False verbose=False key_for_gradient=means2d",
        "MCMCStrategy": "cap_max=1000000 noise_lr=500000.0 refine_start_iter=500 refine_stop_iter=25000 refine_every=100 min_opacity=0.005 "
                        "verbose=False",
    }
    for name, text in want.items():
        parameters = inspect.signature(getattr(gsplat, name)).parameters.values()
        assert " ".join(p.name if p.default is p.empty else f"{p.name}={p.default}" for p in parameters) == text, name


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("antialiased", [True, False])
def test_render_modes_are_the_core_s(mode: str, antialiased: bool, packed: bool) -> None:
    """With all gradients."""
    args, cam = scene(), camera(2)
    background = torch.rand(2, 3, dtype=torch.float64, requires_grad=True)
    got, alpha, _ = rasterization(**args, packed=packed, render_mode=mode, backgrounds=background,
                                  rasterize_mode="antialiased" if antialiased else "classic")
    on = dataclasses.replace(cam, viewmats=args["viewmats"], Ks=args["Ks"])
    splats = [args[k] for k in ("means", "quats", "scales", "opacities", "colors")]
    r = rasterize(*splats, on, background=background, antialiased=antialiased, depth="expected" if "ED" in mode else "accumulated", alpha_max=0.999,
                  drop_last=True)
    assert r.depth is not None
    want = torch.cat([*([r.image] if "RGB" in mode else []), *([r.depth[..., None]] if "D" in mode else [])], -1)
    assert got.shape == (2, cam.height, cam.width, 3 * ("RGB" in mode) + ("D" in mode))
    assert_close([got, alpha[..., 0]], [want, r.alpha], 1e-14)
    inputs = [*splats, on.viewmats, on.Ks, background]
    found, expected = (torch.autograd.grad(loss_of(*o), inputs, materialize_grads=True) for o in ((got, alpha), (want, r.alpha[..., None])))
    assert_close(found, expected, 1e-12)


@pytest.mark.parametrize("packed", [True, False])
def test_harmonics_are_half_and_above_zero(packed: bool) -> None:
    """Colours are max(SH + 0.5, 0), as Inria has them: the same as these as colours."""
    args = scene()
    bands = args["colors"].detach()[:, None] * 8 - 4
    colors = (spherical_harmonics(0, torch.ones(12, 3, dtype=torch.float64), bands) + 0.5).clamp_min(0.0)
    assert 0.2 < (colors == 0).double().mean() < 0.8
    got, _, _ = rasterization(**(args | {"colors": bands}), sh_degree=0, packed=packed)
    want, _, _ = rasterization(**(args | {"colors": colors}), packed=packed)
    assert_close(got, want, 1e-14)


def test_alpha_is_at_most_that_of_1_5_3() -> None:
    """0.999, at the centre of a splat of opacity 1; with the gradient 0."""
    opacity = torch.ones(1, requires_grad=True)
    K = torch.tensor([[[10.0, 0.0, 8.5], [0.0, 10.0, 8.5], [0.0, 0.0, 1.0]]])
    _, alpha, _ = rasterization(torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.ones(1, 3), opacity, torch.ones(1, 3),
                                torch.eye(4)[None], K, 17, 17)
    assert alpha.max().item() == alpha[0, 8, 8, 0].item() == pytest.approx(0.999, abs=1e-7)
    alpha[0, 8, 8, 0].backward()
    assert opacity.grad == 0


@pytest.mark.parametrize(("name", "model"), [("ortho", "orthographic"), ("fisheye", "fisheye")])
@pytest.mark.parametrize("packed", [True, False])
def test_camera_models(name: str, model: str, packed: bool) -> None:
    args = scene(model=model)
    with torch.no_grad():
        got, _, _ = rasterization(**args, camera_model=name, packed=packed)
        want = rasterize(*(args[k] for k in ("means", "quats", "scales", "opacities", "colors")), camera(2, model=model), alpha_max=0.999,
                         drop_last=True).image
    assert want.std() > 0.05
    assert_close(got, want, 1e-14)


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("harmonics", [True, False])
@pytest.mark.parametrize("dims", [(), (2,), (2, 3)])
def test_batches_and_colours_of_each_camera(dims: tuple[int, ...], harmonics: bool, packed: bool) -> None:
    """Each scene of the batch as if it were alone, colours shared by the cameras, and of each."""
    base, g = scene(), generator(5)
    tail = (9, 3) if harmonics else (4,)
    args = {k: v.detach().expand(*dims, *v.shape).clone() for k, v in base.items() if isinstance(v, Tensor)}
    args["means"] = args["means"] + uniform(-0.1, 0.1, *args["means"].shape, seed=g)
    for per_camera in (False, True):
        args["colors"] = uniform(-0.3, 0.9, *dims, *((2,) if per_camera else ()), 12, *tail, seed=g)
        options = {"width": 24, "height": 17, "sh_degree": 2 if harmonics else None, "packed": packed, "render_mode": "RGB+ED"}
        image, alpha, meta = rasterization(**args, **options)
        assert image.shape == (*dims, 2, 17, 24, 4 if harmonics else 5)
        assert alpha.shape == (*dims, 2, 17, 24, 1)
        assert meta["isect_offsets"].shape == (*dims, 2, 2, 2)
        assert (meta["n_batches"], meta["n_cameras"]) == (math.prod(dims), 2)
        for at in numpy.ndindex(*dims):
            one = {k: v[at] for k, v in args.items()}
            for c in range(2):
                single = one | {k: one[k][c:c + 1] for k in ("viewmats", "Ks")} | ({"colors": one["colors"][c]} if per_camera else {})
                assert_close(image[at][c], rasterization(**single, **options)[0][0], 1e-13)


def test_meta_has_every_key() -> None:
    """With gsplat's shapes and dtypes; the lists are consistent with each other."""
    keys = ["batch_ids", "camera_ids", "gaussian_ids", "radii", "means2d", "depths", "conics", "opacities", "tile_width", "tile_height",
            "tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets", "width", "height", "tile_size", "n_batches", "n_cameras"]
    args = scene()
    for packed in (True, False):
        _, _, meta = rasterization(**args, packed=packed, rasterize_mode="antialiased")
        assert list(meta) == keys
        assert all(key in meta for key in keys)
        rows = (len(meta["gaussian_ids"]),) if packed else (2, 12)
        assert meta["radii"].dtype == torch.int32
        for key, tail in (("radii", (2,)), ("means2d", (2,)), ("depths", ()), ("conics", (3,)), ("opacities", ()), ("tiles_per_gauss", ())):
            assert meta[key].shape == (*rows, *tail), key
        assert (meta["tile_width"], meta["tile_height"], meta["tile_size"]) == (2, 2, 16)
        assert (meta["width"], meta["height"], meta["n_batches"], meta["n_cameras"]) == (24, 17, 1, 2)
        if packed:
            assert (meta["radii"] > 0).all()
            assert all(meta[k].dtype == torch.int64 for k in keys[:3])
        else:
            assert [meta[k] for k in keys[:3]] == [None] * 3
        assert dict(meta)["isect_ids"] is meta["isect_ids"]
        assert meta["isect_offsets"].dtype == meta["flatten_ids"].dtype == torch.int32


def test_absgrad_and_the_gradient_of_means2d() -> None:
    """Packed and unpacked have the same, and |gradient| <= absgrad."""
    found = {}
    for packed in (True, False):
        args = scene()
        image, alpha, meta = rasterization(**args, packed=packed, absgrad=True)
        meta["means2d"].retain_grad()
        loss_of(image, alpha).backward()
        means2d = meta["means2d"]
        assert (means2d.grad.abs() <= means2d.absgrad + 1e-12).all()
        assert means2d.grad.abs().max() > 0
        at = (meta["camera_ids"], meta["gaussian_ids"]) if packed else (meta["radii"] > 0).all(-1).nonzero().unbind(-1)
        found[packed] = [v if packed else v[at] for v in (means2d.grad, means2d.absgrad)] + [args[k].grad for k in ("means", "quats", "Ks")]
    assert_close(found[True], found[False], 1e-13)


def test_sparse_gradients_are_the_dense_ones() -> None:
    """Of the visible rows; SparseAdam takes them."""
    dense, sparse = scene(40), scene(40)
    options = {"width": 24, "height": 17}
    meta: Any = None
    for args, on in ((dense, False), (sparse, True)):
        image, _, meta = rasterization(**args, sparse_grad=on)
        loss_of(image).backward()
    rows = meta["gaussian_ids"].unique()
    assert 0 < len(rows) < 40
    for name in ("means", "quats", "scales"):
        grad = sparse[name].grad
        assert grad.is_sparse
        assert torch.equal(grad.coalesce().indices()[0], rows)
        assert_close(grad.to_dense(), dense[name].grad, 1e-14)
    torch.optim.SparseAdam([sparse["means"]]).step()
    assert not torch.equal(sparse["means"], dense["means"])
    args = {k: v.detach().requires_grad_() for k, v in dense.items() if k in ("means", "quats", "scales")}
    results = fully_fused_projection(args["means"], None, args["quats"], args["scales"], dense["viewmats"], dense["Ks"], **options, packed=True,
                                     sparse_grad=True)
    results[4].sum().backward()
    assert args["means"].grad.is_sparse
    with pytest.raises(ValueError, match="sparse_grad"):
        rasterization(**scene(), packed=False, sparse_grad=True)


def test_covariances_instead_of_quats_and_scales() -> None:
    args = scene()
    want, _, _ = rasterization(**args)
    covars, _ = quat_scale_to_covar_preci(args["quats"], args["scales"])
    got, _, _ = rasterization(**(args | {"quats": None, "scales": None}), covars=covars)
    assert_close(got, want, 1e-10)
    names = [args[k] for k in ("means", "quats", "scales")]
    assert_close(torch.autograd.grad(loss_of(got), names), torch.autograd.grad(loss_of(want), names), 1e-9)


def test_on_the_kernels(backend: Backend) -> None:
    """The Triton kernels take what this makes of the arguments: batches, packed rows, and lists of larger tiles."""
    args = {k: backend.put(v.detach()) if isinstance(v, Tensor) else v for k, v in scene(5).items()}
    want = {k: v.detach().cpu() if isinstance(v, Tensor) else v for k, v in args.items()}
    with reference_again():
        image, alpha, _ = rasterization(**want, render_mode="RGB+ED", absgrad=True)
    for packed in (True, False):
        leaf = args["means"].clone().requires_grad_()
        got, got_alpha, meta = rasterization(**(args | {"means": leaf}), render_mode="RGB+ED", packed=packed, absgrad=True)
        assert_close([got, got_alpha], [image, alpha], 1e-12)
        got.sum().backward()
        assert meta["means2d"].absgrad.shape == meta["means2d"].shape
        colors = args["colors"][meta["gaussian_ids"]] if packed else args["colors"].expand(2, -1, -1)
        staged, _ = rasterize_to_pixels(meta["means2d"], meta["conics"], colors, meta["opacities"], 24, 17, 16, meta["isect_offsets"],
                                        meta["flatten_ids"], packed=packed)
        assert_close(staged, image[..., :3], 1e-12)


@pytest.mark.parametrize("mode", MODES)
def test_the_image_may_be_written_into(mode: str) -> None:
    """As training loops do with masks; the gradient is that of the pixels that are left."""
    found = []
    for in_place in (True, False):
        args = scene()
        image, _, _ = rasterization(**args, render_mode=mode)
        mask = torch.arange(image.shape[2]) % 3 > 0
        if in_place:
            image[..., ~mask, :] = 0
        loss_of(image if in_place else image * mask[:, None]).backward()
        found.append([args[k].grad for k in ("means", "quats", "opacities", "viewmats")])
    assert_close(*found, 1e-14)


def test_the_image_of_the_stage_may_be_written_into() -> None:
    args = scene()
    image, _, meta = rasterization(**args)
    colors = args["colors"][meta["gaussian_ids"]]
    staged, _ = rasterize_to_pixels(meta["means2d"], meta["conics"], colors, meta["opacities"], 24, 17, 16, meta["isect_offsets"],
                                    meta["flatten_ids"], packed=True)
    staged.mul_(2)
    found = [torch.autograd.grad(loss_of(x), args["means"], retain_graph=True)[0] for x in (staged, 2 * image)]
    assert_close(*found, 1e-12)


@pytest.mark.parametrize("mode", ["D", "ED"])
def test_the_background_of_depth_is_zero(mode: str) -> None:
    """Whatever is given, of as many channels as it may have."""
    args = scene()
    want, _, _ = rasterization(**args, render_mode=mode)
    assert torch.equal(rasterization(**args, render_mode=mode, backgrounds=torch.ones(2, 1, dtype=torch.float64))[0], want)


def test_sizes_of_numpy() -> None:
    """As gsplat's parser gives them for cropped fisheye images."""
    args = scene()
    want, _, _ = rasterization(**args)
    image, _, meta = rasterization(**(args | {"width": numpy.int64(args["width"]), "height": numpy.int32(args["height"])}))
    assert torch.equal(image, want)
    assert meta["isect_offsets"].shape == (2, meta["tile_height"], meta["tile_width"])


def test_radius_clip_leaves_out_the_small() -> None:
    args = scene()
    _, _, meta = rasterization(**args, packed=False)
    radii = meta["radii"]
    clip = float(radii.amax(-1).median())
    got, _, clipped = rasterization(**args, packed=False, radius_clip=clip)
    assert torch.equal(clipped["radii"], radii * (radii > clip).any(-1, keepdim=True))
    visible = (clipped["radii"] > 0).all(-1)
    assert 0 < visible.sum() < (radii > 0).all(-1).sum()
    for c in range(2):
        some = {k: v[visible[c]] if k in ("means", "quats", "scales", "opacities", "colors") else v for k, v in args.items()}
        assert_close(got[c], rasterization(**some)[0][c], 1e-13)


def test_nothing_to_draw() -> None:
    args = scene()
    background = torch.rand(2, 3, dtype=torch.float64)
    for packed in (True, False):
        for n in (0, 12):
            some = {k: v[:n] if k in ("means", "quats", "scales", "opacities", "colors") else v for k, v in args.items()}
            image, alpha, meta = rasterization(**some, packed=packed, backgrounds=background, far_plane=0.02, absgrad=True)
            assert torch.equal(image, background[:, None, None].expand_as(image))
            assert (alpha == 0).all()
            assert len(meta["isect_ids"]) == 0
            assert (meta["isect_offsets"] == 0).all()
            (image.sum() + alpha.sum()).backward()


def test_many_channels_and_the_options_that_change_nothing() -> None:
    args = scene()
    args["colors"] = torch.rand(12, 40, dtype=torch.float64)
    want, _, _ = rasterization(**args)
    assert want.shape[-1] == 40
    assert torch.equal(rasterization(**args, channel_chunk=8, segmented=True)[0], want)


@pytest.mark.parametrize("option", [{"with_ut": True}, {"with_eval3d": True}, {"radial_coeffs": torch.zeros(2, 4)},
                                    {"tangential_coeffs": torch.zeros(2, 2)}, {"thin_prism_coeffs": torch.zeros(2, 4)}, {"ftheta_coeffs": object()},
                                    {"rolling_shutter": gsplat.RollingShutterType.ROLLING_TOP_TO_BOTTOM}, {"viewmats_rs": torch.eye(4)}])
def test_options_that_are_not_there(option: dict[str, Any]) -> None:
    with pytest.raises(NotImplementedError, match=next(iter(option))):
        rasterization(**scene(), **option)


def test_the_modules_have_gsplat_s_names() -> None:
    """For those who import from where things are."""
    for module, name in (("rendering", "rasterization"), ("strategy", "DefaultStrategy"), ("strategy", "MCMCStrategy"),
                         ("optimizers", "SelectiveAdam"), ("exporter", "export_splats")):
        assert getattr(importlib.import_module(f"tsplat.compat.gsplat.{module}"), name) is getattr(gsplat, name)


def test_more_that_is_not_there() -> None:
    for model in ("ftheta", "lidar"):
        with pytest.raises(NotImplementedError, match=model):
            rasterization(**scene(), camera_model=model)
    with pytest.raises(NotImplementedError, match="2D Gaussian"):
        gsplat.rasterization_2dgs()


@pytest.mark.parametrize(("change", "message"), [
    ({"means": torch.zeros(12, 2)}, "means: expected shape"), ({"opacities": torch.zeros(11, dtype=torch.float64)}, "opacities: expected shape"),
    ({"colors": torch.zeros(3, 12, 3, dtype=torch.float64)}, "colors: expected shape"), ({"render_mode": "rgb"}, "render_mode: expected one of"),
    ({"rasterize_mode": "soft"}, "rasterize_mode: expected one of"), ({"camera_model": "pin"}, "camera_model: expected one of"),
    ({"sh_degree": 1}, "colors: expected shape"), ({"backgrounds": torch.zeros(3, dtype=torch.float64)}, "backgrounds: expected shape"),
    ({"tile_size": 0}, "tile_size: expected at least 1"), ({"Ks": torch.eye(3, dtype=torch.float64)}, "Ks: expected shape")])
def test_arguments_that_are_wrong(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rasterization(**(scene() | change))


@pytest.mark.parametrize("size", [(33, 17), (24, 33)])
def test_tiles_that_do_not_cover_the_image(size: tuple[int, int]) -> None:
    """For which those of the next row or image would be taken."""
    args = scene()
    _, _, meta = rasterization(**args, packed=False)
    with pytest.raises(ValueError, match="isect_offsets: expected tiles"):
        rasterize_to_pixels(meta["means2d"], meta["conics"], args["colors"].expand(2, -1, -1), meta["opacities"], *size, 16, meta["isect_offsets"],
                            meta["flatten_ids"])


def test_splats_that_are_not_finite_are_left_out() -> None:
    args = scene()
    want, _, _ = rasterization(**{k: v[1:] if k in ("means", "quats", "scales", "opacities", "colors") else v for k, v in args.items()})
    for name in ("means", "quats", "scales", "opacities", "colors"):
        for packed in (True, False):
            broken = args | {name: args[name].detach().clone()}
            broken[name][0] = math.nan
            assert_close(rasterization(**broken, packed=packed)[0], want, 1e-14)
