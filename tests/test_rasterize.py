"""The one call: against the plain formulation end to end, its outputs, its probes, its errors."""

from __future__ import annotations

import dataclasses
import math
import re
from typing import Any

import plain
import pytest
import scenes
import torch
from backends import Backend
from compare import assert_close, assert_same_bits, gradients, leaves
from torch import Tensor

import tsplat
from tsplat import Camera, rasterize

MODELS = ("pinhole", "orthographic", "fisheye")

WITHOUT_INTERPRETER = True           # minutes there: test_kernels_ops.py takes a selection


def run(backend: Backend | None, splats: scenes.Splats3D, cam: Camera, options: dict[str, Any]
        ) -> tuple[list[Tensor], list[Tensor]]:
    """Outputs and gradients of all tensors given, by `rasterize` on a backend, or by `plain.render` for None."""
    if backend is not None:
        splats, cam, options = backend.put(splats), backend.put(cam), {k: backend.put(v) for k, v in options.items()}
    options = {k: v.clone().requires_grad_() if isinstance(v, Tensor) else v for k, v in options.items()}
    inputs = leaves(*(x for x in splats if x is not None), cam.viewmats, cam.Ks)
    *new, viewmats, Ks = inputs
    given = iter(new)
    splats = scenes.Splats3D(*(None if x is None else next(given) for x in splats))
    if backend is None:
        size = cam.width, cam.height
        outputs = plain.render(*splats, viewmats, Ks, *size, model=cam.model, near=cam.near, far=cam.far, **options)
    else:
        outputs = rasterize(*splats, dataclasses.replace(cam, viewmats=viewmats, Ks=Ks), **options)[:3]
    outputs = [x for x in outputs if x is not None]
    return outputs, gradients(outputs, [*inputs, *(v for v in options.values() if isinstance(v, Tensor))])


def assert_match(backend: Backend, splats: scenes.Splats3D, cam: Camera, **options: Any) -> None:
    """Values to 1e-13; gradients to 1e-10 of the largest, as those of projection multiply the errors of those of blending."""
    (got, v_got), (want, v_want) = run(backend, splats, cam, options), run(None, splats, cam, options)
    assert_close(got, want, 1e-13)
    assert_close(v_got, v_want, 1e-10)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("model", MODELS)
def test_camera_models(backend: Backend, model: str, antialiased: bool) -> None:
    """With everything else: SH, background, expected depth, an offset on the screen, and several cameras."""
    g = scenes.generator(7)
    splats = scenes.splats(60)._replace(colors=scenes.sh_coefficients(60, 3))
    assert_match(backend, splats, scenes.camera(3, model=model, near=2.5, far=5.5), antialiased=antialiased, sh_degree=3,
                 depth="expected", background=scenes.uniform(0.0, 1.0, 3, 3, seed=g),
                 screen_offset=scenes.normal(3, 60, 2, seed=g) * 0.1)


@pytest.mark.parametrize("degree", range(5))
def test_harmonics_of_every_degree(backend: Backend, degree: int) -> None:
    splats = scenes.splats(40)._replace(colors=scenes.sh_coefficients(40, 4))     # of which a lower degree uses some
    assert_match(backend, splats, scenes.camera(2), sh_degree=degree)


def test_harmonics_of_other_than_three_channels(backend: Backend) -> None:
    splats = scenes.splats(40)._replace(colors=scenes.sh_coefficients(40, 2, channels=5))
    assert_match(backend, splats, scenes.camera(2), sh_degree=2)


@pytest.mark.parametrize("depth", [None, "accumulated", "expected"])
@pytest.mark.parametrize("background", [None, "one", "each"])
def test_depth_and_background(backend: Backend, depth: str | None, background: str | None) -> None:
    options = {} if background is None else {"background": torch.tensor([0.2, 0.5, 0.9]).double()}
    if background == "each":
        options["background"] = torch.stack([options["background"], 1 - options["background"]])
    assert_match(backend, scenes.splats(40), scenes.camera(2), depth=depth, **options)


@pytest.mark.parametrize("channels", [1, 2, 7, 33])
@pytest.mark.parametrize("per_camera", [False, True])
def test_colours_of_any_number_for_all_cameras_or_each(backend: Backend, channels: int, per_camera: bool) -> None:
    splats = scenes.splats(40, channels=channels)
    if per_camera:
        splats = splats._replace(colors=torch.stack([splats.colors, 1 - splats.colors]))
    assert_match(backend, splats, scenes.camera(2), depth="accumulated")


@pytest.mark.parametrize("antialiased", [False, True])
def test_covariances_instead_of_quaternions_and_scales(backend: Backend, antialiased: bool) -> None:
    splats = scenes.splats(40)
    covars = plain.covariances(splats.quats, splats.scales)
    assert_match(backend, splats._replace(quats=None, scales=None), scenes.camera(2), covars=covars, antialiased=antialiased)


@pytest.mark.parametrize("eps2d", [0.0, 0.1, 1.0])
def test_blur(backend: Backend, eps2d: float) -> None:
    assert_match(backend, scenes.splats(40), scenes.camera(2), eps2d=eps2d, antialiased=True)


@pytest.mark.parametrize("alpha_max", [0.5, 0.99, 0.999])
def test_clamp_of_alpha(backend: Backend, alpha_max: float) -> None:
    splats = scenes.splats(60, opacity=(0.9, 1.0), size=(0.2, 0.6), spread=0.5)
    assert_match(backend, splats, scenes.camera(2), alpha_max=alpha_max)


def test_a_camera_inside_the_cloud(backend: Backend) -> None:
    splats = scenes.splats(80, depth=(-1.0, 3.0), spread=2.0)
    assert_match(backend, splats, scenes.camera(2, near=0.2), depth="expected")


def test_an_image_of_one_pixel(backend: Backend) -> None:
    assert_match(backend, scenes.splats(30, spread=0.2), scenes.camera(2, 1, 1), depth="expected")


def test_a_single_camera_is_a_batch_of_one_without_its_dimension(backend: Backend) -> None:
    splats, cam = backend.put((scenes.splats(40), scenes.camera(1)))
    batch = rasterize(*splats, cam, depth="expected", background=torch.ones(3, dtype=backend.dtype))
    single = rasterize(*splats, cam[0], depth="expected", background=torch.ones(3, dtype=backend.dtype))
    assert_same_bits(single[:3], [x[0] for x in batch[:3]])
    assert_same_bits(single.meta[:4], batch.meta[:4])
    assert single.meta.tiles == batch.meta.tiles


@pytest.mark.parametrize("count", [None, 1, 3])
@pytest.mark.parametrize("depth", [None, "accumulated"])
def test_shapes(backend: Backend, count: int | None, depth: str | None) -> None:
    splats, cam = backend.put((scenes.splats(40, channels=5), scenes.camera(count, 23, 18)))
    r = rasterize(*splats, cam, depth=depth, tile=8)
    lead, C = ((), 1) if count is None else ((count,), count)
    assert r.image.shape == (*lead, 18, 23, 5)
    assert r.alpha.shape == (*lead, 18, 23)
    assert r.depth is None if depth is None else r.depth.shape == (*lead, 18, 23)
    assert isinstance(r, tsplat.Rendering)
    assert isinstance(r.meta, tsplat.Meta)
    assert r.meta.radii.shape == (C, 40, 2)
    assert r.meta.radii.dtype == torch.int32
    assert r.meta.means2d.shape == (C, 40, 2)
    assert r.meta.depths.shape == (C, 40)
    assert r.meta.hits.shape == (C, 3, 3)
    assert r.meta.hits.dtype == torch.int64
    assert all(x.dtype == backend.dtype for x in (r.image, r.alpha, r.meta.means2d, r.meta.depths))


def test_meta_tells_what_was_drawn(backend: Backend) -> None:
    splats, cam = scenes.splats(40), scenes.camera(2)
    want = plain.project(*splats[:3], None, splats.opacities, cam.viewmats, cam.Ks, 24, 17, "pinhole", 0.01, 1e10, 0.3, False)
    meta = rasterize(*backend.put(splats), backend.put(cam)).meta
    visible = (want.radii > 0).all(-1)
    assert 0 < visible.sum() < visible.numel()
    assert torch.equal(meta.radii.cpu(), want.radii)
    assert torch.equal(meta.visible.cpu(), visible)
    assert torch.equal(meta.visible_ids.cpu(), visible.nonzero())
    assert_close([meta.means2d, meta.depths], [want.means2d, want.depths], 1e-14)
    hits = torch.zeros(2, 3, 3)  # tiles with at least this many splats in some pixel
    for c in range(2):
        alpha = plain.alphas_everywhere(want.means2d[c], want.conics[c], splats.opacities * visible[c], 24, 17, 0.99)
        padded = torch.zeros(24, 24, 40, dtype=torch.bool)
        padded[:17] = alpha > 0
        hits[c] = padded.view(3, 8, 3, 8, 40).any(3).any(1).sum(-1)
    assert (meta.hits.cpu() >= hits).all()
    assert meta.hits.sum() <= 1.1 * hits.sum()


@pytest.mark.parametrize("antialiased", [False, True])
def test_opacities_above_1_are_as_the_formula_says_with_tiles_of_any_size(antialiased: bool) -> None:
    """They reach further than 3.33 standard deviations."""
    splats, cam = scenes.splats(40, spread=1.0, opacity=(1.0, 50.0)), scenes.camera(2, 40, 30)
    want = plain.render(*splats, cam.viewmats, cam.Ks, 40, 30, antialiased=antialiased)
    for tile in (1, 4, 16, 40):
        got = rasterize(*splats, cam, tile=tile, antialiased=antialiased)
        assert_close(got[:2], want[:2], 1e-11)


def test_the_screen_gradient_is_that_of_means2d(backend: Backend) -> None:
    """By retain_grad on `meta.means2d`, and by the gradient of a zero offset, which compiled code can have, too."""
    splats, cam = backend.put((scenes.splats(40), scenes.camera(2)))
    means, = leaves(splats.means)
    r = rasterize(means, *splats[1:], cam)
    r.meta.means2d.retain_grad()
    weights = torch.randn_like(r.image)
    (r.image * weights).sum().backward()
    offset = torch.zeros_like(r.meta.means2d).requires_grad_()
    shifted = rasterize(*splats, cam, screen_offset=offset)
    assert_same_bits([shifted.image], [r.image])
    (shifted.image * weights).sum().backward()
    assert_same_bits([offset.grad], [r.meta.means2d.grad])
    assert (offset.grad[r.meta.visible] != 0).any()
    assert (offset.grad[~r.meta.visible] == 0).all()


def test_an_offset_moves_the_image(backend: Backend) -> None:
    """By whole pixels, for splats that stay in view: the picture is the same, further right and down."""
    splats, cam = backend.put((scenes.splats(40, spread=0.3), scenes.camera(2, 60, 60)))
    still = rasterize(*splats, cam).image
    moved = rasterize(*splats, cam, screen_offset=torch.tensor([5.0, 3.0], dtype=backend.dtype).expand(2, 40, 2)).image
    assert_close(moved[:, 3:, 5:], still[:, :-3, :-5], 1e-12)


def test_absolute_gradient(backend: Backend) -> None:
    splats, cam = scenes.splats(40), scenes.camera(2)
    p = plain.project(*splats[:3], None, splats.opacities, cam.viewmats, cam.Ks, 24, 17, "pinhole", 0.01, 1e10, 0.3, False)
    g = scenes.generator(0)
    v_image, v_alpha = scenes.normal(2, 17, 24, 3, seed=g), scenes.normal(2, 17, 24, seed=g)
    want = plain.absolute_gradient(p.means2d, p.conics, splats.opacities.expand(2, -1), splats.colors[None], None, p.depths,
                                   p.radii, 24, 17, v_image, v_alpha)
    splats, cam = backend.put((splats, cam))
    probe = torch.zeros(2, 40, 2, dtype=backend.dtype, device=backend.device, requires_grad=True)
    r = rasterize(*splats, cam, absgrad=probe)
    assert_same_bits(r[:2], rasterize(*splats, cam)[:2])
    torch.autograd.backward([r.image, r.alpha], backend.put((v_image, v_alpha)))
    assert_close(probe.grad, want, 1e-11)


def test_float32_and_float64_agree_to_rounding() -> None:
    splats, cam = scenes.splats(60), scenes.camera(2)
    single = rasterize(*(x.float() for x in splats), cam.to(torch.float32), depth="expected")
    double = rasterize(*(x.float().double() for x in splats), cam.to(torch.float32).to(torch.float64), depth="expected")
    assert single.image.dtype == torch.float32
    # means2d of 24 pixels are off by 24 eps, alpha by that over the splat's size of half a pixel: 1e-5 with the conics'
    # condition
    assert_close(single[:3], double[:3], 1e-5)


def test_nothing_changes_its_arguments(backend: Backend) -> None:
    splats, cam = backend.put((scenes.splats(40)._replace(colors=scenes.sh_coefficients(40, 1)), scenes.camera(2)))
    inputs = leaves(*splats)
    before = [x.detach().clone() for x in (*inputs, cam.viewmats, cam.Ks)]
    versions = [x._version for x in (*inputs, cam.viewmats, cam.Ks)]
    rasterize(*inputs, cam, sh_degree=1, depth="expected", antialiased=True).image.sum().backward()
    assert_same_bits([x.detach() for x in (*inputs, cam.viewmats, cam.Ks)], before)
    assert [x._version for x in (*inputs, cam.viewmats, cam.Ks)] == versions


def test_backward_twice_gives_the_same_and_does_not_use_up_what_it_saved(backend: Backend) -> None:
    inputs = leaves(*backend.put(scenes.splats(40)))
    r = rasterize(*inputs, backend.put(scenes.camera(2)))
    first = torch.autograd.grad(r.image.square().sum(), inputs, retain_graph=True)
    assert_same_bits(torch.autograd.grad(r.image.square().sum(), inputs), first)


# Errors

SPLATS, CAMERA = scenes.splats(5), scenes.camera(2)
f64 = torch.float64
WRONG: list[tuple[type[Exception], str, dict[str, Any]]] = [
    (TypeError, "means: expected a torch.Tensor of shape [N, 3]; got list", {"means": [[0.0, 0.0, 1.0]]}),
    (TypeError, "means: expected a floating-point tensor; got dtype torch.int64", {"means": SPLATS.means.long()}),
    (ValueError, "means: expected shape [N, 3]; got [5, 4]", {"means": SPLATS.quats}),
    (ValueError, "means: expected shape [N, 3]; got [15]", {"means": SPLATS.means.flatten()}),
    (ValueError, "quats: expected shape [5, 4]; got [5, 3]", {"quats": SPLATS.means}),
    (TypeError, "quats: expected a torch.Tensor of shape [5, 4]; got NoneType", {"quats": None}),
    (TypeError, "quats: expected dtype torch.float64, as the other arguments have; got torch.float32",
     {"quats": SPLATS.quats.float()}),
    (ValueError, "scales: expected shape [5, 3]; got [4, 3]", {"scales": SPLATS.scales[:4]}),
    (TypeError, "scales: expected a torch.Tensor of shape [5, 3]; got NoneType", {"scales": None}),
    (ValueError, "opacities: expected shape [5]; got [5, 1]", {"opacities": SPLATS.opacities[:, None]}),
    (ValueError, "opacities: expected device cpu, where the other arguments are; got meta",
     {"opacities": SPLATS.opacities.to("meta")}),
    (TypeError, "colors: expected a torch.Tensor of shape [5, D]; got NoneType", {"colors": None}),
    (ValueError, "colors: expected shape [5, D]; got [5]", {"colors": SPLATS.opacities}),
    (ValueError, "colors: expected shape [2, 5, D]; got [3, 5, 3]", {"colors": SPLATS.colors.expand(3, 5, 3)}),
    (ValueError, "colors: expected at least 1 channel; got shape [5, 0]", {"colors": SPLATS.colors[:, :0]}),
    (ValueError, "colors: expected shape [5, K >= 9, D]; got [5, 3]", {"sh_degree": 2}),
    (ValueError, "colors: expected at least 9 SH coefficients [N, K, D] for sh_degree 2; got [5, 4, 3]",
     {"sh_degree": 2, "colors": scenes.sh_coefficients(5, 1)}),
    (ValueError, "sh_degree: expected one of 0, 1, 2, 3, 4; got 5", {"sh_degree": 5, "colors": scenes.sh_coefficients(5, 5)}),
    (ValueError, "sh_degree: expected one of 0, 1, 2, 3, 4; got -1", {"sh_degree": -1}),
    (TypeError, "camera: expected a tsplat.Camera; got Tensor", {"camera": CAMERA.viewmats}),
    (TypeError, "camera: expected a tsplat.Camera; got NoneType", {"camera": None}),
    (TypeError, "camera.viewmats: expected dtype torch.float64, as the other arguments have; got torch.float32",
     {"camera": CAMERA.to(torch.float32)}),
    (ValueError, "covars: expected shape [5, 3, 3]; got [5, 3]", {"covars": SPLATS.means, "quats": None, "scales": None}),
    (ValueError, "covars: expected quats and scales to be None", {"covars": torch.eye(3, dtype=f64).expand(5, 3, 3)}),
    (ValueError, "covars: expected quats and scales to be None",
     {"covars": torch.eye(3, dtype=f64).expand(5, 3, 3), "quats": None}),
    (TypeError, "background: expected a torch.Tensor of shape [3]; got float", {"background": 1.0}),
    (ValueError, "background: expected shape [3]; got [4]", {"background": torch.ones(4, dtype=f64)}),
    (ValueError, "background: expected shape [2, 3]; got [3, 3]", {"background": torch.ones(3, 3, dtype=f64)}),
    (ValueError, "depth: expected one of 'accumulated', 'expected'; got 'z'", {"depth": "z"}),
    (ValueError, "eps2d: expected a number of at least 0, in pixels squared; got -0.1", {"eps2d": -0.1}),
    (ValueError, "eps2d: expected a number of at least 0, in pixels squared; got nan", {"eps2d": math.nan}),
    (ValueError, "eps2d: expected a number of at least 0, in pixels squared; got inf", {"eps2d": math.inf}),
    (ValueError, "alpha_max: expected a number in (0, 1); got 1.0", {"alpha_max": 1.0}),
    (ValueError, "alpha_max: expected a number in (0, 1); got 0", {"alpha_max": 0}),
    (ValueError, "screen_offset: expected shape [2, 5, 2]; got [5, 2]", {"screen_offset": SPLATS.means[:, :2]}),
    (ValueError, "absgrad: expected shape [2, 5, 2]; got [1, 5, 2]", {"absgrad": SPLATS.means[None, :, :2]}),
    (ValueError, "tile: expected at least 1; got 0", {"tile": 0}),
    (TypeError, "tile: expected an int of at least 1; got 8.0", {"tile": 8.0}),
    # wrong types of numbers, too, name the argument
    (TypeError, "eps2d: expected", {"eps2d": "0.3"}),
    (TypeError, "antialiased: expected True or False; got 'yes'", {"antialiased": "yes"}),
    (TypeError, "drop_last: expected True or False; got 1", {"drop_last": 1}),
    (TypeError, "alpha_max: expected", {"alpha_max": None}),
    (TypeError, "sh_degree: expected", {"sh_degree": 1.0, "colors": scenes.sh_coefficients(5, 1)}),
]


@pytest.mark.parametrize(("kind", "message", "changes"), WRONG, ids=[f"{m[1][:40]} {i}" for i, m in enumerate(WRONG)])
def test_errors_name_the_argument_what_came_and_what_is_expected(kind: type[Exception], message: str,
                                                                 changes: dict[str, Any]) -> None:
    arguments = {**SPLATS._asdict(), "camera": CAMERA, **changes}
    with pytest.raises((TypeError, ValueError), match=re.escape(message)) as caught:
        rasterize(**arguments)
    assert isinstance(caught.value, kind)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_refused(dtype: torch.dtype) -> None:
    """A position on the screen in 8 or 11 bits is no position: float16 overflows, bfloat16 is off by 8 percent here."""
    with pytest.raises(TypeError, match=r"means: expected .*float32"):
        rasterize(*(x.to(dtype) for x in SPLATS), CAMERA.to(dtype))


def test_a_batch_of_no_cameras_is_refused() -> None:
    with pytest.raises(ValueError, match="camera"):
        rasterize(*SPLATS, CAMERA[0:0])


@pytest.mark.parametrize("capacity", [400, 50])
def test_a_capacity_changes_nothing_but_the_room_and_tells_what_it_takes(backend: Backend, capacity: int) -> None:
    splats, cam = backend.put(scenes.splats(40)), backend.put(scenes.camera(2))
    free, fixed = rasterize(*splats, cam), rasterize(*splats, cam, capacity=capacity)
    assert fixed.meta.needed is not None
    assert 50 < int(fixed.meta.needed) == int(free.meta.offsets[-1]) < 400
    assert free.meta.needed is None
    if capacity == 400:
        assert_same_bits([fixed.image, fixed.alpha, fixed.meta.offsets], [free.image, free.alpha, free.meta.offsets])
    else:
        assert int(fixed.meta.offsets[-1]) == capacity


def test_a_capacity_keeps_shapes_from_data_out_of_compiled_code(backend: Backend) -> None:
    splats, cam = backend.put(scenes.splats(20)), backend.put(scenes.camera(1))
    inputs = leaves(*(x for x in splats if x is not None))
    compiled = torch.compile(lambda *x: rasterize(*x, cam, capacity=500).image, fullgraph=True, backend="aot_eager")
    want = rasterize(*inputs, cam).image
    got = compiled(*inputs)
    assert_close(got, want, 1e-14)
    assert_close(torch.autograd.grad(got.sum(), inputs), torch.autograd.grad(want.sum(), inputs), 1e-13)
