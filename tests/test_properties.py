"""What must hold of any scene, on scenes drawn by hypothesis. All in float64."""

from __future__ import annotations

import dataclasses
from typing import Any

import plain
import scenes
import torch
from backends import BACKENDS, Backend
from compare import assert_close, assert_same_bits, gradients, leaves
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tsplat import Camera, Rendering, rasterize

ROUNDING = 1e-11
"""log alpha is a polynomial about a tile's centre with terms of up to some hundred: evaluated otherwise, alpha differs by 1e2
eps = 2e-14, and what saturates multiplies that by up to 1/(1 - alpha_max) = 100 in the gradients, sums over splats and
cancellation by some ten more.
"""

some = settings(max_examples=12, deadline=None, derandomize=True)
seeds = st.integers(0, 10**6)
models = st.sampled_from(["pinhole", "orthographic", "fisheye"])
backends = st.sampled_from([BACKENDS[name] for name in BACKENDS])


@st.composite
def drawn(draw: st.DrawFn, cameras: int = 2) -> tuple[Backend, scenes.Splats3D, Camera, dict[str, Any]]:
    """A backend, splats with SH or colours, cameras and options."""
    backend = draw(backends)
    n, seed = draw(st.integers(1, 40)), draw(seeds)
    splats = scenes.splats(n, seed=seed, channels=draw(st.integers(1, 4)), spread=draw(st.floats(0.3, 2.5)),
                           size=draw(st.sampled_from([(0.03, 0.5), (0.003, 0.05), (0.01, 2.0)])),
                           opacity=draw(st.sampled_from([(0.05, 0.95), (0.9, 1.0), (0.0, 0.05)])))
    degree = draw(st.sampled_from([None, 0, 2]))
    if degree is not None:
        splats = splats._replace(colors=scenes.sh_coefficients(n, degree, splats.colors.shape[1], seed=seed))
    cam = scenes.camera(cameras, draw(st.integers(1, 30)), draw(st.integers(1, 30)), model=draw(models), seed=seed, near=2.2)
    options = {"sh_degree": degree, "antialiased": draw(st.booleans()),
               "depth": draw(st.sampled_from([None, "accumulated", "expected"]))}
    return backend, backend.put(splats), backend.put(cam), options


def outputs(r: Rendering) -> list[Tensor]:
    return [x for x in r[:3] if x is not None]


@some
@given(drawn(), seeds)
def test_the_order_of_the_splats_does_not_matter(scene: Any, seed: int) -> None:
    """But for the last bit of functions that are computed for several splats together."""
    _, splats, cam, options = scene
    order = torch.randperm(len(splats.means), generator=scenes.generator(seed))
    inputs, shuffled = leaves(*splats), leaves(*(x[order] for x in splats))
    want, got = outputs(rasterize(*inputs, cam, **options)), outputs(rasterize(*shuffled, cam, **options))
    assert_close(got, want, ROUNDING)
    assert_close(gradients(got, shuffled), [v[order] for v in gradients(want, inputs)], ROUNDING)


@some
@given(drawn(3))
def test_the_order_of_the_cameras_does_not_matter(scene: Any) -> None:
    _, splats, cam, options = scene
    order = torch.tensor([2, 0, 1])
    assert_close([x[order] for x in outputs(rasterize(*splats, cam, **options))],
                 outputs(rasterize(*splats, cam[order], **options)), ROUNDING)


@some
@given(drawn(), st.sampled_from([(4, 8), (8, 16), (16, 5), (5, 1), (8, 64)]))
def test_the_size_of_tiles_does_not_matter(scene: Any, tiles: tuple[int, int]) -> None:
    _, splats, cam, options = scene
    inputs = leaves(*splats)
    a, b = (outputs(rasterize(*inputs, cam, tile=tile, **options)) for tile in tiles)
    assert_close(a, b, ROUNDING)
    assert_close(gradients(a, inputs), gradients(b, inputs), 100 * ROUNDING)


@some
@given(drawn(3))
def test_a_batch_is_a_loop(scene: Any) -> None:
    """Images and gradients; cameras share splats, so gradients add up."""
    _, splats, cam, options = scene
    inputs = leaves(*splats, cam.viewmats, cam.Ks)
    cam = dataclasses.replace(cam, viewmats=inputs[5], Ks=inputs[6])
    batch = outputs(rasterize(*inputs[:5], cam, **options))
    loop = [torch.stack(x) for x in zip(*(outputs(rasterize(*inputs[:5], cam[i], **options)) for i in range(3)), strict=True)]
    assert_close(batch, loop, ROUNDING)
    assert_close(gradients(batch, inputs), gradients(loop, inputs), ROUNDING)


@some
@given(drawn(), st.integers(0, 9), st.integers(0, 9), st.integers(1, 12), st.integers(1, 12))
def test_a_crop_is_a_window(scene: Any, x: int, y: int, width: int, height: int) -> None:
    """Of an image of 24 x 24: with the principal point moved, what is inside does not see the border.

    A pinhole's Jacobian is clamped to the frustum of its own image, so for it only splats within that of the window are taken.
    """
    backend, splats, cam, options = scene
    cam = dataclasses.replace(cam, width=24, height=24)
    Ks = cam.Ks.clone()
    Ks[:, :2, 2] -= torch.tensor([x, y], dtype=Ks.dtype)
    window = dataclasses.replace(cam, Ks=Ks, width=width, height=height)
    if cam.model == "pinhole":
        inside = torch.ones(len(splats.means), dtype=torch.bool)
        for viewmat, K in zip(cam.viewmats, Ks, strict=True):
            for i, mean in enumerate(splats.means):
                p = viewmat[:3, :3] @ mean + viewmat[:3, 3]
                free = plain.jacobian_point(p, K, width, height, "pinhole")
                inside[i] &= bool(p[2] > 0) and torch.equal(free[:2], p[:2] / p[2] * p[2])
        splats = scenes.Splats3D(*(v[inside] for v in splats))
    whole, part = outputs(rasterize(*splats, cam, **options)), outputs(rasterize(*splats, window, **options))
    # the shift rounds positions of some ten pixels in the last place: 1e-14, over the least size of half a pixel
    assert_close(part, [v[:, y:y + height, x:x + width] for v in whole], 10 * ROUNDING)


@some
@given(drawn(), st.floats(0.01, 100.0))
def test_the_unit_of_length_does_not_matter(scene: Any, scale: float) -> None:
    """World, cameras and the range of depth scaled together; depth scales along."""
    _, splats, cam, options = scene
    viewmats = cam.viewmats.clone()
    viewmats[:, :3, 3] *= scale
    Ks = cam.Ks.clone()
    if cam.model == "orthographic":                                               # pixels per unit
        Ks[:, :2, :2] /= scale
    larger = dataclasses.replace(cam, viewmats=viewmats, Ks=Ks, near=cam.near * scale, far=cam.far * scale)
    want = outputs(rasterize(*splats, cam, **options))
    got = outputs(rasterize(splats.means * scale, splats.quats, splats.scales * scale, *splats[3:], larger, **options))
    if len(got) == 3:
        got[2] = got[2] / scale
    assert_close(got, want, 10 * ROUNDING)


@some
@given(drawn(), seeds)
def test_the_world_may_turn_with_its_cameras(scene: Any, seed: int) -> None:
    """With colours that do not depend on the direction."""
    backend, splats, cam, options = scene
    if options["sh_degree"] is not None:
        splats, options = splats._replace(colors=splats.colors[:, :1]), options | {"sh_degree": 0}
    turn = backend.put(plain.rotation(scenes.normal(1, 4, seed=scenes.generator(seed))))[0]
    viewmats = cam.viewmats.clone()
    viewmats[:, :3, :3] = cam.viewmats[:, :3, :3] @ turn.T
    covars = backend.put(plain.covariances(splats.quats.cpu().double(), splats.scales.cpu().double()))
    got = rasterize(splats.means @ turn.T, None, None, *splats[3:], dataclasses.replace(cam, viewmats=viewmats),
                    covars=turn @ covars @ turn.T, **options)
    assert_close(outputs(got), outputs(rasterize(*splats, cam, **options)), 10 * ROUNDING)


@some
@given(drawn(), seeds)
def test_the_background_is_seen_through(scene: Any, seed: int) -> None:
    """Image = image without it + (1 - alpha) background, and depth is not behind a background."""
    backend, splats, cam, options = scene
    channels = splats.colors.shape[-1]
    background = backend.put(scenes.uniform(0.0, 1.0, 2, channels, seed=scenes.generator(seed)))
    bare, full = rasterize(*splats, cam, **options), rasterize(*splats, cam, background=background, **options)
    assert_close(full.image, bare.image + (1 - bare.alpha)[..., None] * background[:, None, None], 1e-15)
    assert_same_bits(outputs(full)[1:], outputs(bare)[1:])


@some
@given(drawn(), st.floats(-3.0, 3.0))
def test_colours_go_in_linearly(scene: Any, factor: float) -> None:
    """And white splats on nothing are alpha."""
    _, splats, cam, options = scene
    options = options | {"sh_degree": None}
    colors = splats.colors.reshape(len(splats.means), -1)
    a, b = rasterize(*splats[:4], colors, cam, **options), rasterize(*splats[:4], factor * colors, cam, **options)
    assert_close(b.image, factor * a.image, 1e-14)
    white = rasterize(*splats[:4], torch.ones_like(colors[:, :1]), cam, **options)
    assert_close(white.image[..., 0], white.alpha, 1e-14)
    assert white.alpha.min() >= 0
    assert white.alpha.max() <= 1


@some
@given(drawn())
def test_it_is_the_plain_formulation(scene: Any) -> None:
    _, splats, cam, options = scene
    inputs, plain_inputs = leaves(*splats), leaves(*(x.cpu().double() for x in splats))
    want = [x for x in plain.render(*plain_inputs, cam.viewmats.cpu().double(), cam.Ks.cpu().double(), cam.width, cam.height,
                                    model=cam.model, near=cam.near, **options) if x is not None]
    got = outputs(rasterize(*inputs, cam, **options))
    assert_close(got, want, ROUNDING)
    assert_close(gradients(got, inputs), gradients(want, plain_inputs), 100 * ROUNDING)
