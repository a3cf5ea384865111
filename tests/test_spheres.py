"""Spheres three times: in blocks with closed-form gradients (what runs), by the reference's formula, and by `plain_spheres`."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest
import scenes
import torch
from backends import Backend
from compare import assert_close, leaves
from hypothesis import given, settings
from hypothesis import strategies as st
from sphere_cases import FAR, NEAR, assert_agree, both, options
from torch import Tensor

import tsplat
from tsplat import Camera


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
    *mine, viewmat, K, gamma, background = leaves(*s, camera.viewmats, camera.Ks, *backend.put((torch.tensor(0.1), torch.ones(3))))
    r = tsplat.render_spheres(mine[0], mine[1], mine[2], Camera(viewmat, K, 9, 9), opacities=mine[3], gamma=gamma, background=background,
                              depth="expected", n_track=2, **options())
    assert torch.equal(r.image, torch.ones_like(r.image))
    assert float(r.alpha.detach().abs().max()) == 0
    assert r.hits is not None
    assert bool((r.hits.ids == -1).all())
    assert not bool(r.visible.any())
    *zeros, v_background = torch.autograd.grad(r.image.sum() + r.alpha.sum() + r.hits.weights.sum(), [*mine, viewmat, K, gamma, background])
    for v in zeros:
        assert torch.equal(v, torch.zeros_like(v))
    assert torch.equal(v_background, torch.full_like(v_background, 81.0))


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


@pytest.mark.parametrize("gamma", [1e-3, 1e-4, 1e-5])
def test_small_gamma_in_float32(backend: Backend, gamma: float) -> None:
    """Where nothing is hit, alpha is 0 to the bit. Of gamma's gradient, what is relative to a pixel's sum is rounded: per pixel some eps times the
    image's gradient, over gamma (and a logit by eps/gamma). With absolute logarithms, which are 1/gamma, it was 1e5 times that."""
    s, camera = scenes.spheres(20), scenes.camera(None, 13, 11)
    v = scenes.normal(11, 13, 4, seed=scenes.generator(1))
    gradients, alphas = [], []
    for dtype in (torch.float64, torch.float32):
        p, f, R, o = (x.to(backend.device, dtype) for x in s)
        g = torch.tensor(gamma, dtype=dtype, device=backend.device, requires_grad=True)
        r = tsplat.render_spheres(p, f, R, camera.to(backend.device, dtype), opacities=o, gamma=g, near=NEAR, far=FAR, background_depth=0.3)
        loss = (torch.cat([r.image, r.alpha[..., None]], -1) * v.to(backend.device, dtype)).sum()
        gradients.append(float(torch.autograd.grad(loss, g)[0]))
        alphas.append(r.alpha.detach().double())
    assert bool((alphas[1][alphas[0] == 0] == 0).all())
    assert bool((alphas[0] == 0).any())
    assert float((alphas[1] - alphas[0]).abs().max()) < 1e-3 + 6e-8 / gamma
    assert abs(gradients[1] - gradients[0]) <= 143 * 4 * 6e-8 / gamma + 10 * 6e-8 / gamma * abs(gradients[0])


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
