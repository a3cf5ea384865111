"""What can be asked of `render_spheres`: an early end, tracked hits, fading of small spheres, a capacity; and its errors."""

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
from compare import assert_close, gradients, leaves
from sphere_cases import FAR, NEAR, early_end, options
from torch import Tensor
from torch.autograd import gradcheck

import tsplat


@pytest.mark.parametrize("tolerance", [0.5, 1e-2, 1e-4])
@pytest.mark.parametrize("gamma", [1e-3, 0.02, 1.0])
def test_early_end_is_within_its_tolerance(tolerance: float, gamma: float) -> None:
    """What is left out weighs at most the tolerance, in all: so does the image change, for features in [0, 1]."""
    s, camera = scenes.spheres(400, spread=0.3, opacity=(0.5, 1.0)), scenes.camera(None, 17, 16)
    exact, early = (tsplat.render_spheres(s.positions, s.features, s.radii, camera, opacities=s.opacities, gamma=gamma, near=NEAR, far=FAR,
                                          percent_allowed_difference=t) for t in (0.0, tolerance))
    assert float((early.image - exact.image).abs().max()) <= tolerance
    assert float((early.alpha - exact.alpha).abs().max()) <= tolerance


def test_an_early_end_bounds_all_that_is_left_out_together() -> None:
    """Behind 64 equal spheres another 192, each of which weighs a 96th of the tolerance: not all may go. Where they are below it together, they
    do. (That the kernels end where the reference does is in test_kernels_spheres.py.)"""
    p = torch.tensor([[0.0, 0, 2], [0, 0, 3]], dtype=torch.float64).repeat_interleave(torch.tensor([64, 192]), 0)
    f, R = p[:, 2:] - 2, torch.full((256,), 0.9, dtype=torch.float64)                       # white behind black
    K = torch.tensor([[1e9, 0, 0.5], [0, 1e9, 0.5], [0, 0, 1]], dtype=torch.float64)        # all rays of a tile go through the centres
    camera = tsplat.Camera(torch.eye(4, dtype=torch.float64), K, 1, 1)

    def white(tolerance: float) -> float:
        return float(tsplat.render_spheres(p, f, R, camera, background=f[0], gamma=0.08, near=1.0, far=5.0,
                                           percent_allowed_difference=tolerance).image)

    share = 1 / (1 + math.exp(0.25 / 0.08) / 3)                                             # z is 0.975 and 0.725
    assert abs(white(0.0) - share) < 1e-6                                                   # but for the background
    assert white(0.0) - white(share / 2) <= share / 2
    assert white(2 * share) == 0.0


@pytest.mark.parametrize("channels", [1, 5])
@pytest.mark.parametrize("bad", [None, math.nan, math.inf])
def test_an_early_end_is_within_its_tolerance_for_opacities_above_1(backend: Backend, channels: int, bad: float | None) -> None:
    """Behind 64 opaque black spheres 64 white ones of opacity 2, whose terms are exp(2 z/gamma): they have all the weight. One whose opacity is no
    number is left out."""
    p = torch.tensor([[0.0, 0, 2], [0, 0, 3], [0, 0, 4]], dtype=torch.float64).repeat_interleave(torch.tensor([64, 64, 1]), 0)
    f, R = (p[:, 2:] > 2).double().expand(-1, channels), torch.full((129,), 0.9, dtype=torch.float64)
    o = torch.tensor([1.0, 2, 0 if bad is None else bad], dtype=torch.float64).repeat_interleave(torch.tensor([64, 64, 1]), 0)
    K = torch.tensor([[1e9, 0, 0.5], [0, 1e9, 0.5], [0, 0, 1]], dtype=torch.float64)        # all rays of a tile go through the centres
    camera = tsplat.Camera(torch.eye(4, dtype=torch.float64), K, 1, 1)
    exact, early = (tsplat.render_spheres(*backend.put((p, f, R)), backend.put(camera), opacities=backend.put(o), gamma=0.05, near=1.0, far=5.0,
                                          percent_allowed_difference=tolerance).image for tolerance in (0.0, 1e-2))
    assert float(exact.min()) > 0.99
    assert float((exact - early).abs().max()) <= 1e-2


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
    ({"tracked_only": "no"}, TypeError, "tracked_only: expected True or False; got 'no'"),
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
