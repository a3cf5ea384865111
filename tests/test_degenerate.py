"""Empty scenes, and splats that are no splats: culled, without a trace in the image or in another splat's gradient."""

from __future__ import annotations

import math
from typing import Any

import pytest
import scenes
import torch
from backends import Backend
from compare import assert_close, assert_same_bits, gradients, leaves
from torch import Tensor

from tsplat import Camera, ops, rasterize

NAN, INF = math.nan, math.inf
MEANS, QUATS, SCALES, OPACITIES, COLORS = range(5)
BROKEN: dict[str, tuple[int, Any]] = {
    "mean NaN": (MEANS, [NAN, 0.0, 3.0]), "mean infinite": (MEANS, [0.0, INF, 3.0]), "depth infinite": (MEANS, [0.0, 0.0, INF]),
    "depth minus infinity": (MEANS, [0.0, 0.0, -INF]), "mean beyond all": (MEANS, [0.0, 0.0, 1e30]),
    "mean at the camera": (MEANS, None), "quaternion NaN": (QUATS, [1.0, 0.0, NAN, 0.0]),
    "quaternion zero": (QUATS, [0.0, 0.0, 0.0, 0.0]), "quaternion infinite": (QUATS, [1.0, INF, 0.0, 0.0]),
    "quaternion huge": (QUATS, [1e30, 0.0, 0.0, 1e30]), "scales zero": (SCALES, [0.0, 0.0, 0.0]),
    "scale NaN": (SCALES, [NAN, 0.1, 0.1]), "scale infinite": (SCALES, [0.1, 0.1, INF]),
    "scale 1e30": (SCALES, [1e30, 0.1, 0.1]), "scales 1e30": (SCALES, [1e30, 1e30, 1e30]), "opacity NaN": (OPACITIES, NAN),
    "opacity infinite": (OPACITIES, INF), "opacity negative": (OPACITIES, -1.0), "opacity zero": (OPACITIES, 0.0),
    "SH NaN": (COLORS, NAN), "SH infinite": (COLORS, INF), "SH minus infinity": (COLORS, -INF),
}
BAD = 5                                                                           # its index


def scene(dtype: torch.dtype, what: str | None) -> list[Tensor]:
    """Arguments up to SH coefficients, view matrix and intrinsics, with the splat BAD broken; for None, behind the camera."""
    s, cam = scenes.splats(12), scenes.camera(1)
    tensors = [x.to(dtype) for x in (*s[:4], scenes.sh_coefficients(12, 2), cam.viewmats, cam.Ks)]
    tensors[MEANS][BAD] = torch.tensor([0.1, 0.1, 3.0])
    if what is None:
        tensors[MEANS][BAD, 2] = -3.0
    else:
        which, value = BROKEN[what]
        center = -(cam.viewmats[0, :3, :3].T @ cam.viewmats[0, :3, 3])
        tensors[which][BAD] = center.to(dtype) if value is None else torch.tensor(value, dtype=dtype)
    return leaves(*tensors)


def render(inputs: list[Tensor], antialiased: bool) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
    """Outputs, inputs with the probes, and whether BAD was drawn."""
    probes = [torch.zeros(1, 12, 2, dtype=inputs[0].dtype, requires_grad=True) for _ in range(2)]
    r = rasterize(*inputs[:5], Camera(*inputs[5:], 24, 17), sh_degree=2, depth="expected", antialiased=antialiased,
                  background=torch.ones(3, dtype=inputs[0].dtype), screen_offset=probes[0], absgrad=probes[1])
    return list(r[:3]), [*inputs, *probes], r.meta.visible[0, BAD]


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("what", BROKEN)
def test_a_degenerate_splat_leaves_no_trace(what: str, dtype: torch.dtype, antialiased: bool) -> None:
    """Image and gradients, the camera's included, have the same bits as with the splat behind the camera; its own are zero."""
    want, inputs, _ = render(scene(dtype, None), antialiased)
    v_want = gradients(want, inputs)
    got, inputs, visible = render(scene(dtype, what), antialiased)
    assert not visible
    assert_same_bits(got, want)
    v_got = gradients(got, inputs)
    assert_same_bits(v_got, v_want)
    for v in v_got[:5]:
        assert (v[BAD] == 0).all()
        assert (v != 0).any()


@pytest.mark.parametrize("what", BROKEN)
def test_nor_in_the_second_derivative(what: str) -> None:
    results = []
    for case in (None, what):
        outputs, inputs, _ = render(scene(torch.float64, case), True)
        first = gradients(outputs, inputs[:7], create_graph=True)
        results.append(gradients(first, inputs[:7]))
    want, got = results
    for v in got[:5]:
        assert (v[BAD] == 0).all()
    assert_close(got, want, 1e-12)


@pytest.mark.parametrize("what", ["NaN", "infinite", "not symmetric to the least", "zero", "beyond all"])
def test_degenerate_covariances(what: str) -> None:
    s, cam = scenes.splats(12), scenes.camera(1)
    results = []
    for broken in (False, True):
        covars = torch.diag_embed(s.scales**2)
        means = s.means.clone()
        means[BAD] = torch.tensor([0.1, 0.1, 3.0 if broken else -3.0])
        if broken:
            covars[BAD] = {"NaN": covars[BAD] * NAN, "infinite": covars[BAD] + INF, "zero": covars[BAD] * 0,
                           "beyond all": covars[BAD] * 1e40, "not symmetric to the least": -covars[BAD]}[what]
        inputs = leaves(means, covars, s.opacities, s.colors)
        r = rasterize(inputs[0], None, None, *inputs[2:], cam, covars=inputs[1])
        assert not r.meta.visible[0, BAD]
        results.append([r.image, *gradients([r.image], inputs)])
    assert_same_bits(*results)
    assert (results[1][2][BAD] == 0).all()


def test_flat_and_thin_splats_are_drawn_with_finite_gradients(backend: Backend) -> None:
    """A scale of zero on one or two axes is a disc or a needle, which the blur gives a width."""
    s, cam = backend.put((scenes.splats(12), scenes.camera(2)))
    scales = s.scales.clone()
    scales[::2, 0] = 0.0
    scales[::4, 1] = 0.0
    inputs = leaves(s.means, s.quats, scales, s.opacities, s.colors, cam.viewmats, cam.Ks)
    r = rasterize(*inputs[:5], Camera(*inputs[5:], 24, 17), antialiased=True)
    assert r.meta.visible[:, ::2].any()
    assert all(v.isfinite().all() for v in [r.image, *gradients([r.image], inputs)])


def test_a_splat_hidden_by_its_colour_in_one_camera_is_seen_by_the_other(backend: Backend) -> None:
    s, cam = backend.put((scenes.splats(12), scenes.camera(2)))
    colors = s.colors.repeat(2, 1, 1)
    seen = rasterize(*s, cam).meta.visible.all(0).nonzero()[0, 0]
    colors[0, seen] = NAN
    inputs = leaves(*s[:4], colors)
    r = rasterize(*inputs, cam)
    assert r.meta.visible[:, seen].tolist() == [False, True]
    assert r.image.isfinite().all()
    v = gradients([r.image], inputs)
    assert all(x.isfinite().all() for x in v)
    assert (v[4][0, seen] == 0).all()
    assert (v[4][1, seen] != 0).any()


@pytest.mark.parametrize("covariances", [False, True])
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("count", [0, 4])
def test_nothing_to_see_is_the_background_and_differentiates_to_zeros(backend: Backend, count: int, antialiased: bool,
                                                                      covariances: bool) -> None:
    """N = 0, or all splats behind the camera; the first and second derivatives exist."""
    s, cam = backend.put((scenes.splats(count), scenes.camera(2)))
    means = s.means * torch.tensor([1.0, 1.0, -1.0], dtype=backend.dtype, device=backend.device)
    shape = [torch.diag_embed(s.scales**2)] if covariances else [s.quats, s.scales]
    inputs = leaves(means, s.opacities, backend.put(scenes.sh_coefficients(count, 1)), cam.viewmats, cam.Ks, *shape)
    background, = leaves(backend.put(torch.tensor([0.2, 0.4, 0.6])))
    probe = torch.zeros(2, count, 2, dtype=backend.dtype, device=backend.device, requires_grad=True)
    means, opacities, sh, viewmats, Ks, *shape = inputs
    options = {"covars": shape[0]} if covariances else {}
    r = rasterize(means, *((None, None) if covariances else shape), opacities, sh, Camera(viewmats, Ks, 24, 17), sh_degree=1,
                  background=background, depth="expected", antialiased=antialiased, absgrad=probe, **options)
    assert (r.image == background).all()
    assert (r.alpha == 0).all()
    assert (r.depth == 0).all()
    assert (r.meta.hits == 0).all()
    assert r.meta.visible_ids.shape == (0, 2)
    first = gradients(list(r[:3]), [*inputs, probe, background], create_graph=True)
    assert all((v == 0).all() for v in first[:-1])
    assert (first[-1] != 0).all()
    assert [v.shape for v in first[:-2]] == [x.shape for x in inputs]


def test_every_op_takes_nothing(backend: Backend) -> None:
    s, cam = backend.put((scenes.splats(0), scenes.camera(2)))
    p = ops.project(*s[:3], None, s.opacities, cam.viewmats, cam.Ks, 24, 17, "pinhole", 0.01, 1e10, 0.3, False)
    assert [tuple(x.shape) for x in p] == [(2, 0, 2), (2, 0, 2), (2, 0), (2, 0, 3), (2, 0)]
    sh = torch.zeros(0, 4, 3, dtype=backend.dtype)
    assert ops.harmonics(s.means, cam.viewmats[:, :3, 3], sh, 1, torch.zeros(2, 0, dtype=torch.bool)).shape == (2, 0, 3)
    bins = ops.bin_splats(p.means2d, p.radii, p.conics, s.opacities.expand(2, 0), p.depths, 24, 17, 8)
    assert bins.ids.shape == (0,)
    image, alpha = ops.blend(p.means2d, p.conics, s.opacities.expand(2, 0), s.colors[None], None, None, *bins, 24, 17, 8, 0.99)
    assert (image == 0).all()
    assert (alpha == 0).all()
    assert image.shape == (2, 17, 24, 3)
