"""Spheres three times: in blocks with closed-form gradients (what runs), by the reference's formula, and by `plain_spheres`."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import plain_spheres
import pytest
import scenes
import torch
import tsplat_reference as reference
from backends import Backend
from compare import Peak, assert_close, assert_same_bits, gradients, leaves, strided, threads
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck
from tsplat_reference import walk

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


@pytest.mark.parametrize("model", ["pinhole", "orthographic"])
@pytest.mark.parametrize("distance", ["orthogonal", "chord"])
def test_models_and_distances(backend: Backend, model: str, distance: str) -> None:
    assert_agree(scenes.spheres(20), scenes.camera(2, 13, 11, model=model), backend, distance=distance)


@pytest.mark.parametrize("channels", [1, 2, 4, 17, 40])
def test_channels(backend: Backend, channels: int) -> None:
    assert_agree(scenes.spheres(12, channels=channels), scenes.camera(None, 9, 10), backend)


def test_very_many_channels() -> None:
    assert_agree(scenes.spheres(12, channels=512), scenes.camera(None, 9, 10))


def test_a_geometry_for_each_camera(backend: Backend) -> None:
    s = scenes.spheres(12, cameras=2)
    assert_agree(s, scenes.camera(2, 9, 10), backend)
    shared = scenes.spheres(12)
    assert_agree(s._replace(features=shared.features, radii=shared.radii), scenes.camera(2, 9, 10), backend, background=torch.ones(
        3, dtype=torch.float64))


@pytest.mark.parametrize("gamma", [1.0, 0.03, 1e-3, 1e-5])
def test_gamma(backend: Backend, gamma: float) -> None:
    """A logit is up to 1/gamma, whose rounding the softmax sees: 1e5 eps at the most, and gradients by z are 1/gamma of it.

    Where one sphere has all the weight, the gradients by opacity and gamma are differences that cancel, in sums over 143 pixels, times
    1/gamma and 1/gamma^2.
    """
    (want, v_want), (got, v_got) = both(scenes.spheres(20), scenes.camera(None, 13, 11), backend, gamma=gamma)
    assert_close(got, want, max(1e-12, 1e-14 / gamma))
    noise = {3: 143 * 1e-15 / gamma, 5: 143 * 1e-15 / gamma**2}
    for i, (v, w) in enumerate(zip(v_got, v_want, strict=True)):
        assert float((v.cpu() - w).abs().max()) <= max(1e-8, 1e-13 / gamma) * float(w.abs().max()) + noise.get(i, 0.0), i


@pytest.mark.parametrize("tile", [1, 4, 5, 16])
@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 31), (8, 8), (33, 17)])
def test_tiles_and_sizes(backend: Backend, width: int, height: int, tile: int) -> None:
    assert_agree(scenes.spheres(30, spread=0.4), scenes.camera(None, width, height), backend, tile=tile)


def test_more_spheres_than_a_chunk_holds(backend: Backend) -> None:
    assert_agree(scenes.spheres(150, spread=0.3), scenes.camera(None, 9, 7), backend)


def test_spheres_that_reach_through_the_cameras_plane(backend: Backend) -> None:
    """They are large enough to be seen, though their centres are beside or behind the camera, and their outlines no ellipses."""
    s = scenes.Spheres(torch.tensor([[2.1, 0.1, 0.3], [-2.0, 0.4, 1.8], [0.2, -3.0, -0.2]], dtype=torch.float64),
                       torch.eye(3, dtype=torch.float64), torch.tensor([1.9, 2.2, 2.9], dtype=torch.float64),
                       torch.tensor([0.9, 0.7, 0.8], dtype=torch.float64))
    camera = scenes.camera(None, 21, 19, turn=0.0)
    camera = dataclasses.replace(camera, Ks=camera.Ks * torch.tensor([[0.2, 1, 1], [1, 0.2, 1], [1, 1, 1]], dtype=torch.float64))
    (want, v_want), (got, v_got) = both(s, camera, backend, background_depth=1e-6)
    assert float(got[1].detach().max()) > 0.9
    assert_close(got, want, 1e-12)
    assert_close(v_got, v_want, 1e-9)


def test_near_and_far_end_hits_not_spheres(backend: Backend) -> None:
    s = scenes.spheres(40, depth=(0.2, 9.0), size=(0.3, 1.0), spread=0.6)
    assert_agree(s, scenes.camera(None, 13, 11), backend)
    assert_agree(s, scenes.camera(None, 13, 11, model="orthographic"), backend)


def one_sphere(backend: Backend, **others: Any) -> tuple[scenes.Spheres, Camera]:
    """A sphere whose centre is on the ray of the middle pixel of 9 x 9."""
    K = torch.tensor([[9.0, 0, 4.5], [0, 9, 4.5], [0, 0, 1]], dtype=torch.float64)
    s = scenes.Spheres(torch.tensor([[0.0, 0, 3]], dtype=torch.float64), torch.tensor([[0.2, 0.5, 0.9]], dtype=torch.float64),
                       torch.tensor([1.0], dtype=torch.float64), torch.tensor([0.8], dtype=torch.float64))
    camera = Camera(torch.eye(4, dtype=torch.float64), K, 9, 9)
    return backend.put(s._replace(**others)), backend.put(camera)


@pytest.mark.parametrize("distance", ["orthogonal", "chord"])
def test_a_ray_through_a_centre(backend: Backend, distance: str) -> None:
    """d has a cone's tip there: the derivative across the ray is 0, as that of the distance; radius and opacity have theirs."""
    s, camera = one_sphere(backend)
    mine = leaves(*s)
    p, f, R, o = mine
    r = tsplat.render_spheres(p, f, R, camera, opacities=o, gamma=0.1, distance=distance, **options())
    v_p, v_f, v_R, v_o = torch.autograd.grad(r.image[4, 4].sum(), mine)
    z = (FAR - 2) / (FAR - NEAR)
    term = 0.8 * math.exp(0.8 * z / 0.1)
    weight = term / (term + math.exp(1e-5))
    assert abs(float(r.alpha[4, 4].detach()) - weight) < 1e-14
    by_logit = weight * (1 - weight) * float((s.features - 1).sum())
    slope = by_logit * 0.8 / 0.1 / (FAR - NEAR)                                             # dL/d(-D)
    assert_close(v_p.cpu(), torch.tensor([[0, 0, -slope]], dtype=torch.float64), 1e-9)
    assert_close(v_R.cpu(), torch.tensor([slope], dtype=torch.float64), 1e-9)               # D = 3 - R
    assert_close(v_o.cpu(), torch.tensor([by_logit * (1 / 0.8 + z / 0.1)], dtype=torch.float64), 1e-9)
    assert_close(v_f.cpu(), torch.full((1, 3), weight, dtype=torch.float64), 1e-12)


def test_opacity_zero_has_a_gradient(backend: Backend) -> None:
    """The weight is 0, its derivative by o is not."""
    s, camera = one_sphere(backend, opacities=torch.zeros(1, dtype=torch.float64))
    o = s.opacities.clone().requires_grad_()
    r = tsplat.render_spheres(s.positions, s.features, s.radii, camera, opacities=o, gamma=0.1, **options())
    assert torch.equal(r.image, torch.ones_like(r.image))
    v_o, = torch.autograd.grad(r.image[4, 4].sum(), o)
    assert_close(v_o.cpu(), torch.tensor([float((s.features - 1).sum()) / math.exp(1e-5)], dtype=torch.float64), 1e-12)


@pytest.mark.parametrize("case", ["radius 0", "radius < 0", "behind", "beyond far", "inside", "none", "NaN position", "NaN feature",
                                  "infinite radius", "NaN opacity", "negative opacity"])
def test_nothing_to_see(backend: Backend, case: str) -> None:
    """The background, alpha 0, zero gradients, and no NaN in what is beside it."""
    nan, f64 = math.nan, torch.float64
    others = {"radius 0": {"radii": torch.zeros(1, dtype=f64)}, "radius < 0": {"radii": -torch.ones(1, dtype=f64)},
              "behind": {"positions": torch.tensor([[0.0, 0, -3]], dtype=f64)},
              "beyond far": {"positions": torch.tensor([[0.0, 0, 10]], dtype=f64)}, "inside": {"radii": torch.tensor([4.0], dtype=f64)},
              "none": dict(zip(scenes.Spheres._fields, scenes.spheres(0), strict=True)),
              "NaN position": {"positions": torch.tensor([[0, nan, 3.0]], dtype=f64)},
              "NaN feature": {"features": torch.tensor([[0, nan, 3.0]], dtype=f64)},
              "infinite radius": {"radii": torch.tensor([math.inf], dtype=f64)},
              "NaN opacity": {"opacities": torch.tensor([nan], dtype=f64)}, "negative opacity": {"opacities": -torch.ones(1, dtype=f64)}}
    s, camera = one_sphere(backend, **others[case])
    mine = leaves(*s)
    r = tsplat.render_spheres(mine[0], mine[1], mine[2], camera, opacities=mine[3], gamma=0.1, depth="expected", n_track=2, **options())
    assert torch.equal(r.image, torch.ones_like(r.image))
    assert float(r.alpha.abs().max()) == 0
    assert r.hits is not None
    assert bool((r.hits.ids == -1).all())
    assert not bool(r.visible.any())
    for v in torch.autograd.grad(r.image.sum() + r.alpha.sum() + r.hits.weights.sum(), mine):
        assert torch.equal(v, torch.zeros_like(v))


@pytest.mark.parametrize("tolerance", [0.5, 1e-2, 1e-4])
@pytest.mark.parametrize("gamma", [1e-3, 0.02, 1.0])
def test_early_end_is_within_its_tolerance(tolerance: float, gamma: float) -> None:
    """What is left out weighs at most the tolerance, in all: so does the image change, for features in [0, 1]."""
    s, camera = scenes.spheres(400, spread=0.3, opacity=(0.5, 1.0)), scenes.camera(None, 17, 16)
    exact, early = (tsplat.render_spheres(s.positions, s.features, s.radii, camera, opacities=s.opacities, gamma=gamma, near=NEAR, far=FAR,
                                          percent_allowed_difference=t) for t in (0.0, tolerance))
    assert float((early.image - exact.image).abs().max()) <= tolerance
    assert float((early.alpha - exact.alpha).abs().max()) <= tolerance


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


def test_gradient_of_an_early_end_is_that_of_what_was_rendered() -> None:
    images, (mine, rest) = early_end(scenes.spheres(1500, spread=0.5, opacity=(0.9, 1.0), size=(0.2, 0.6)), scenes.camera(2, 17, 16), 1e-2)
    counts = rest[8].diff()
    assert int((images.used < counts).sum()) >= 4
    assert bool((images.used % 64 == 0)[images.used < counts].all())
    want = reference.blend_spheres(*rest, images.used)
    assert_close(images[:3], want[:3], 1e-12)
    assert_close(gradients(images[:3], mine), gradients(want[:3], mine), 1e-9)


def test_tracking(backend: Backend) -> None:
    """Ids and depths are the nearest hits of all, weights those of the image, in which tracked and untracked ones make up alpha."""
    s, camera = scenes.spheres(30, spread=0.4), scenes.camera(2, 11, 9)
    want = plain_spheres.render(*s, torch.ones(3, dtype=torch.float64), torch.tensor(0.1, dtype=torch.float64), camera.viewmats, camera.Ks, 11,
                                9, near=NEAR, far=FAR)
    depths, order = want.depths.sort(-1)
    n = int((want.weights > 0).sum(-1).max()) + 2
    p, f, R, o = backend.put(s)
    for count in (1, 3, n):
        r = tsplat.render_spheres(p, f, R, backend.put(camera), opacities=o, gamma=0.1, n_track=count, **options())
        assert r.hits is not None
        near = depths[..., :count]
        assert torch.equal(r.hits.ids.cpu().long(), torch.where(near < torch.inf, order[..., :count], -1))
        assert_close(torch.where(near < torch.inf, r.hits.depths.cpu(), 0.0), torch.where(near < torch.inf, near, 0.0), 1e-12)
        assert bool((r.hits.depths.cpu() == torch.inf)[near == torch.inf].all())
        assert_close(r.hits.weights.cpu(), want.weights.gather(-1, order)[..., :count], 1e-11)
    assert_close(r.hits.weights.sum(-1), r.alpha, 1e-11)


def test_depths_and_weights_of_hits_have_gradients() -> None:
    s, camera = scenes.spheres(5, spread=0.3), scenes.camera(None, 4, 3)

    def hits(p: Tensor, R: Tensor, o: Tensor, g: Tensor, viewmats: Tensor, Ks: Tensor) -> tuple[Tensor, Tensor]:
        r = tsplat.render_spheres(p, s.features, R, dataclasses.replace(camera, viewmats=viewmats, Ks=Ks), opacities=o, gamma=g, n_track=2,
                                  **options())
        assert r.hits is not None
        return torch.where(r.hits.ids >= 0, r.hits.depths, 0.0), r.hits.weights

    assert gradcheck(hits, leaves(s.positions, s.radii, s.opacities, torch.tensor(0.2, dtype=torch.float64), camera.viewmats, camera.Ks))


def test_gradients_by_way_of_tracked_hits_only(backend: Backend) -> None:
    s, camera = scenes.spheres(30, spread=0.4), scenes.camera(2, 11, 9)
    gamma = torch.tensor(0.1, dtype=torch.float64)
    mine = leaves(*s)
    want = plain_spheres.render(*mine, torch.ones(3, dtype=torch.float64), gamma, camera.viewmats, camera.Ks, 11, 9, near=NEAR, far=FAR,
                                nearest=2)
    v_want = gradients([want.image], mine)
    mine = leaves(*backend.put(s))
    p, f, R, o = mine
    r = tsplat.render_spheres(p, f, R, backend.put(camera), opacities=o, gamma=0.1, n_track=2, tracked_only=True, **options())
    assert_close(gradients([r.image], mine), v_want, 1e-9)


@pytest.mark.parametrize("model", ["pinhole", "orthographic"])
def test_gradients_of_small_spheres_fade(model: str) -> None:
    """Those of positions and radii by a smooth step of the projected radius; all others, the camera's too, are what they were."""
    s = scenes.spheres(40, size=(0.02, 1.0))
    camera = scenes.camera(2, 17, 13, model=model)
    results = []
    for below in (0.0, 0.5):
        mine = leaves(*s, camera.viewmats, camera.Ks)
        p, f, R, o, viewmats, Ks = mine
        r = tsplat.render_spheres(p.expand(2, -1, 3), f, R.expand(2, -1), dataclasses.replace(camera, viewmats=viewmats, Ks=Ks), opacities=o,
                                  gamma=0.1, fade_below=below, **options())
        by_camera = [torch.autograd.grad(r.image[c].square().sum(), mine, retain_graph=True) for c in range(2)]
        results.append((r.image, [torch.stack(v) for v in zip(*by_camera, strict=True)]))
    (image, v), (faded_image, faded) = results
    assert torch.equal(image, faded_image)
    centers = torch.einsum("cij,nj->cni", camera.viewmats[:, :3, :3], s.positions) + camera.viewmats[:, None, :3, 3]
    pixels = s.radii * (camera.Ks[:, 0, 0] * camera.Ks[:, 1, 1]).sqrt()[:, None]
    pixels = pixels / centers.norm(dim=-1) if model == "pinhole" else pixels
    t = (pixels / 0.5).clamp(0, 1)
    step = 3 * t**2 - 2 * t**3
    assert 0 < int((step < 1).sum()) < step.numel()
    assert_close([faded[0], faded[2]], [v[0] * step[..., None], v[2] * step], 1e-12)
    assert_close([faded[i] for i in (1, 3, 4, 5)], [v[i] for i in (1, 3, 4, 5)], 1e-12)


def tiny_arguments(chord: bool, cut: bool, requires: bool = True) -> tuple[list[Tensor], tuple[Any, ...]]:
    """Leaves and the other arguments of `ops.blend_spheres`."""
    images, (mine, rest) = early_end(scenes.spheres(5, spread=0.4), scenes.camera(2, 5, 4), 0.0)
    cutoff = torch.full_like(images.logsumexp, 3.5) if cut else None
    return mine, (*rest[7:9], cutoff, *rest[10:16], 0.1, chord, True, 0.0)


@pytest.mark.parametrize(("chord", "cut"), [(False, False), (True, False), (False, True)])
def test_gradcheck_and_gradgradcheck(chord: bool, cut: bool) -> None:
    """(With a cutoff, the gradient is by intention not that of the function: only the second derivative is checked, of the first.)"""
    mine, rest = tiny_arguments(chord, cut)
    if not cut:
        assert gradcheck(lambda *a: ops.blend_spheres(*a, *rest)[:3], mine)
        assert gradgradcheck(lambda *a: ops.blend_spheres(*a, *rest)[:3], mine)
        return
    (first, second), (want, second_want) = (
        (g, gradients(g, mine)) for g in (gradients(function(*mine, *args)[:3], mine, create_graph=True)
                                          for function, args in ((ops.blend_spheres, rest), (reference.blend_spheres, rest[:-1]))))
    assert_close(first, want, 1e-11)
    assert_close(second, second_want, 1e-11)


def test_strided_inputs_and_gradients(backend: Backend) -> None:
    mine, rest = tiny_arguments(False, False)
    mine, rest = [backend.put(x.detach()) for x in mine], tuple(backend.put(x) if isinstance(x, Tensor) else x for x in rest)
    rest = (*rest[:5], 8, *rest[6:])
    plain, spaced = ([f(x).requires_grad_() for x in mine] for f in (torch.clone, strided))
    outputs = [ops.blend_spheres(*some, *rest)[:3] for some in (plain, spaced)]
    assert_same_bits(outputs[1], outputs[0])
    weights = [torch.randn_like(o) for o in outputs[0]]
    want = torch.autograd.grad(outputs[0], plain, weights)
    assert_close(torch.autograd.grad(outputs[1], spaced, [strided(w) for w in weights]), want, 1e-14)


def test_float32_against_float64() -> None:
    """An error of position, 4 eps |c|, is one of d in units of R; of the logit, 1/gamma eps. Pixels at an outline, where d is below that, aside."""
    s, camera = scenes.spheres(60, size=(0.2, 0.8)), scenes.camera(None, 40, 30)
    results = []
    for dtype in (torch.float64, torch.float32):
        p, f, R, o = (x.to(dtype) for x in s)
        results.append(tsplat.render_spheres(p, f, R, camera.to(dtype), opacities=o, gamma=0.05, **options()))
    off = (results[1].image.double() - results[0].image).abs()
    assert float(off.quantile(0.99)) < 4 * 6e-8 * 6 / 0.2 + 6e-8 / 0.05 * 10
    assert float(off.max()) < 1e-3


def peaks(n: int, side: int) -> int:
    """The peak of forward and backward in numbers of 8 bytes, with every sphere on every tile; on one thread."""
    s = scenes.spheres(n, size=(4.0, 5.0), depth=(7.0, 8.0), spread=0.0)
    K = torch.tensor([[side, 0, side / 2], [0, side, side / 2], [0, 0, 1]], dtype=torch.float64)
    rest = (s.positions[None], s.radii[None], s.opacities[None], s.features[None], torch.ones(1, 3, dtype=torch.float64),
            torch.tensor(0.1, dtype=torch.float64), K[None])
    outline = reference.outlines(rest[0], rest[1], K[None], side, side, "pinhole", NEAR, FAR)
    bins = reference.bin_splats(outline.means2d, outline.radii, outline.conics, outline.opacities, outline.depths, side, side, 8)
    assert len(bins.ids) == n * (side // 8) ** 2
    with torch.no_grad(), Peak() as peak:
        images = reference.blend_sphere_blocks(*rest, *bins, side, side, 8, "pinhole", NEAR, FAR, 1e-6, False, False, 0.0)
        reference.blend_sphere_blocks_backward(*rest, *bins, None, images, images.image, None, None, side, side, 8, "pinhole", NEAR, FAR, 1e-6,
                                               False, True)
    return peak.peak // 8


def test_working_memory_does_not_grow_with_the_pairs_of_pixels_and_spheres(monkeypatch: pytest.MonkeyPatch) -> None:
    """Some numbers for each sphere, for each pixel and channel, and constants; here with small constants, and every sphere on every pixel."""
    by_default = peaks(100, 24)
    constants = {"CHUNK": 32, "BLOCK": 1 << 12, "GROUP": 1 << 8, "FEW": 1 << 6, "GROUP_TILES": 1}
    for name, value in constants.items():
        monkeypatch.setattr(walk, name, value)
    for n, side in ((100, 24), (400, 24), (100, 48)):  # of which each but the first has four times the pairs
        allowed = 30 * n + 32 * side * side + 10 * constants["BLOCK"] + 150 * constants["GROUP"]
        assert peaks(n, side) < allowed
        assert by_default > 4 * allowed                                               # the measure does see the working memory


def test_threads_change_no_bit() -> None:
    s, camera = scenes.spheres(3000, size=(0.05, 0.3)), scenes.camera(2, 130, 90)
    results = []
    for count in (1, 3):
        with threads(count):
            mine = leaves(*s)
            p, f, R, o = mine
            r = tsplat.render_spheres(p, f, R, camera, opacities=o, gamma=0.05, near=NEAR, far=FAR)
            results.append([r.image, r.alpha, *gradients([r.image, r.alpha], mine)])
    assert_same_bits(*results)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(0, 30), width=st.integers(1, 20), height=st.integers(1, 20))
def test_order_batch_and_window(seed: int, n: int, width: int, height: int) -> None:
    """Spheres and cameras in any order, a batch as a loop, and a part of an image as an image, give the same."""
    s, camera = scenes.spheres(n, seed=seed), scenes.camera(2, width, height, seed=seed)
    g = scenes.generator(seed)

    def render(some: scenes.Spheres, cam: Camera) -> Tensor:
        p, f, R, o = some
        return tsplat.render_spheres(p, f, R, cam, opacities=o, gamma=0.1, **options()).image

    image = render(s, camera)
    order = torch.randperm(n, generator=g)
    # a sum in another order; the logit is at most 10 and d as in assert_agree
    assert_close(render(scenes.Spheres(*(x[order] for x in s)), camera), image, 1e-12)
    assert_close(render(s, camera[torch.tensor([1, 0])]), image.flip(0), 1e-14)
    assert_close(torch.stack([render(s, Camera(camera.viewmats[c], camera.Ks[c], width, height)) for c in range(2)]), image, 1e-14)
    left, top = width // 3, height // 2
    Ks = camera.Ks - torch.tensor([[0, 0, left], [0, 0, top], [0, 0, 0]], dtype=torch.float64)
    window = dataclasses.replace(camera, Ks=Ks, width=width - left, height=height - top)
    assert_close(render(s, window), image[:, top:, left:], 1e-9)                           # other tile centres: see assert_agree


@pytest.mark.parametrize("dynamic", [False, True])
def test_compiles_without_graph_breaks(dynamic: bool) -> None:
    s, camera = scenes.spheres(12), scenes.camera(2, 9, 7)

    def step(p: Tensor, f: Tensor, R: Tensor, o: Tensor, g: Tensor, viewmats: Tensor, Ks: Tensor) -> tuple[Tensor, ...]:
        r = tsplat.render_spheres(p, f, R, dataclasses.replace(camera, viewmats=viewmats, Ks=Ks), opacities=o, gamma=g, depth="expected",
                                  n_track=2, fade_below=2.0, **options())
        assert r.depth is not None
        assert r.hits is not None
        return r.image, r.alpha, r.depth, r.hits.weights

    compiled = torch.compile(step, fullgraph=True, dynamic=dynamic, backend="aot_eager")
    for n in (12, 7):
        inputs = (*(x[:n] for x in s), torch.tensor(0.1, dtype=torch.float64), camera.viewmats, camera.Ks)
        mine, others = leaves(*inputs), leaves(*inputs)
        want, got = step(*mine), compiled(*others)
        assert_close(got, want, 1e-14)
        assert_close(gradients(got, others), gradients(want, mine), 1e-12)


def test_capacity_reports_what_it_needed(backend: Backend) -> None:
    s, camera = backend.put(scenes.spheres(20)), backend.put(scenes.camera(None, 13, 11))
    p, f, R, o = s
    want = tsplat.render_spheres(p, f, R, camera, opacities=o, gamma=0.1, **options())
    got = tsplat.render_spheres(p, f, R, camera, opacities=o, gamma=0.1, capacity=500, **options())
    assert want.needed is None
    assert got.needed is not None
    assert 0 < int(got.needed) <= 500
    assert torch.equal(got.image, want.image)
    few = tsplat.render_spheres(p, f, R, camera, opacities=o, gamma=0.1, capacity=3, **options())
    assert few.needed is not None
    assert int(few.needed) > 3


BAD: list[tuple[dict[str, Any], type[Exception], str]] = [
    ({"positions": torch.zeros(4, 2)}, ValueError, r"positions: expected shape \[N, 3\]; got \[4, 2\]"),
    ({"positions": torch.zeros(4, 3, dtype=torch.float16)}, TypeError, "positions: expected dtype"),
    ({"features": torch.zeros(3, 3)}, ValueError, r"features: expected shape \[4, D\]; got \[3, 3\]"),
    ({"features": torch.zeros(4, 0)}, ValueError, "features: expected at least 1 channel"),
    ({"radii": torch.zeros(4, 1)}, ValueError, r"radii: expected shape \[1, 4\]; got \[4, 1\]"),
    ({"radii": 1.0}, TypeError, "radii: expected a torch.Tensor"),
    ({"opacities": torch.zeros(5)}, ValueError, r"opacities: expected shape \[4\]; got \[5\]"),
    ({"background": torch.zeros(4)}, ValueError, r"background: expected shape \[3\]; got \[4\]"),
    ({"camera": None}, TypeError, "camera: expected a tsplat.Camera; got NoneType"),
    ({"gamma": 0.0}, ValueError, r"gamma: expected a number in \[1e-5, 1\]; got 0.0"),
    ({"gamma": torch.tensor(2.0)}, ValueError, r"gamma: expected a number in \[1e-5, 1\]; got 2.0"),
    ({"gamma": torch.ones(2)}, ValueError, r"gamma: expected shape \[\]; got \[2\]"),
    ({"gamma": "soft"}, TypeError, "gamma: expected a number"),
    ({"near": 3.0, "far": 2.0}, ValueError, "near, far: expected near < far, both finite; got 3.0 and 2.0"),
    ({"far": math.inf}, ValueError, "near, far: expected near < far, both finite"),
    ({"near": -1.0}, ValueError, "near: expected a distance of at least 0 for a pinhole camera; got -1.0"),
    ({"background_depth": 0.0}, ValueError, r"background_depth: expected a number in \(0, 1\); got 0.0"),
    ({"distance": "arc"}, ValueError, "distance: expected one of 'orthogonal', 'chord'; got 'arc'"),
    ({"depth": "metric"}, ValueError, "depth: expected one of"),
    ({"n_track": -1}, ValueError, "n_track: expected at least 1; got -1"),
    ({"tracked_only": True}, ValueError, "tracked_only: expected n_track of at least 1"),
    ({"percent_allowed_difference": 1.0}, ValueError, r"percent_allowed_difference: expected a number in \[0, 1\)"),
    ({"fade_below": -1}, ValueError, "fade_below: expected a radius in pixels of at least 0; got -1"),
    ({"tile": 0}, ValueError, "tile: expected at least 1; got 0"),
    ({"capacity": 0}, ValueError, "capacity: expected at least 1; got 0"),
]


@pytest.mark.parametrize(("change", "error", "message"), BAD, ids=[f"{next(iter(c))}-{i}" for i, (c, _, _) in enumerate(BAD)])
def test_errors_say_what_is_expected(change: dict[str, Any], error: type[Exception], message: str) -> None:
    arguments = {"positions": torch.zeros(4, 3), "features": torch.zeros(4, 3), "radii": torch.ones(4),
                 "camera": scenes.camera(None, 8, 8).to(torch.float32), "gamma": 0.1, "near": 0.1, "far": 5.0}
    with pytest.raises(error, match=message):
        tsplat.render_spheres(**{**arguments, **change})


def test_fisheye_is_refused() -> None:
    s, camera = scenes.spheres(4), scenes.camera(None, 8, 8, model="fisheye")
    with pytest.raises(NotImplementedError, match="render_spheres has pinhole and orthographic cameras; got 'fisheye'"):
        tsplat.render_spheres(s.positions, s.features, s.radii, camera, gamma=0.1, near=0.1, far=5.0)
