"""Projection against `plain`, which takes Jacobians and gradients by autograd, splat by splat."""

from __future__ import annotations

import functools
import importlib
import math
from collections.abc import Sequence
from typing import Any

import plain
import pytest
import scenes
import torch
import tsplat_reference as reference
from backends import Backend
from compare import assert_close, assert_same_bits, gradients, leaves, strided, threads
from torch import Tensor

from tsplat import Camera, ops

projection = importlib.import_module("tsplat_reference.projection")          # the package has a function of that name
MODELS = ("pinhole", "orthographic", "fisheye")


def arguments(splats: scenes.Splats3D, cam: Camera, *, covars: Tensor | None = None, eps2d: float = 0.3,
              antialiased: bool = False) -> tuple[Any, ...]:
    """What `project` takes, of a batch of cameras."""
    quats, scales = (None, None) if covars is not None else (splats.quats, splats.scales)
    return (splats.means, quats, scales, covars, splats.opacities, cam.viewmats, cam.Ks, cam.width, cam.height, cam.model,
            cam.near, cam.far, eps2d, antialiased)


def differentiable(args: Sequence[Any]) -> tuple[list[Any], list[Tensor]]:
    """The arguments with leaves in place of those that have a gradient, and the leaves."""
    new = list(args)
    which = [i for i in (0, 1, 2, 3, 5, 6) if args[i] is not None]
    for i in which:
        new[i] = args[i].detach().clone().requires_grad_()
    return new, [new[i] for i in which]


def far_and_wide(model: str) -> tuple[scenes.Splats3D, Camera]:
    """Splats around the view, some so wide that they are visible from beyond where the pinhole's Jacobian is clamped."""
    return scenes.splats(80, spread=2.6, size=(0.05, 0.8)), scenes.camera(3, model=model)


def test_the_wide_scene_has_visible_splats_beyond_the_clamp() -> None:
    splats, cam = far_and_wide("pinhole")
    seen = (plain.project(*arguments(splats, cam)).radii > 0).all(-1)
    clamped = 0
    for viewmat, K, visible in zip(cam.viewmats, cam.Ks, seen, strict=True):
        p = splats.means[visible] @ viewmat[:3, :3].T + viewmat[:3, 3]
        clamped += sum(not torch.allclose(plain.jacobian_point(q, K, cam.width, cam.height, "pinhole"), q) for q in p)
    assert clamped >= 10
    assert (~seen).sum() >= 10


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("eps2d", [0.0, 0.3])
@pytest.mark.parametrize("model", MODELS)
def test_values_and_gradients_match_the_plain_formulation(backend: Backend, model: str, eps2d: float,
                                                          antialiased: bool) -> None:
    args = arguments(*far_and_wide(model), eps2d=eps2d, antialiased=antialiased)
    plain_args, plain_leaves = differentiable(args)
    want = plain.project(*plain_args)
    got_args, got_leaves = differentiable(backend.put(args))
    got = ops.project(*got_args)
    assert torch.equal(got.radii.cpu(), want.radii)
    # entries are sums of some ten products, the inverse of a covariance of condition up to 1e3: 1e3 eps
    assert_close(got[1:], want[1:], 2e-13)
    # gradients of the inverse are proportional to its square, those of quaternions and view matrices are sums over all splats
    assert_close(gradients(got[1:], got_leaves), gradients(want[1:], plain_leaves), 1e-11)


@pytest.mark.parametrize("model", MODELS)
def test_closed_form_backward_is_autograd_of_the_formula(model: str) -> None:
    args, inputs = differentiable(arguments(*far_and_wide(model), antialiased=True))
    formula = reference.project(*args)
    op = ops.project(*args)
    assert_same_bits(op, formula)
    assert_close(gradients(op[1:], inputs), gradients(formula[1:], inputs), 1e-12)


@pytest.mark.parametrize("model", MODELS)
def test_covariances_given_are_as_good_as_quaternions_and_scales(backend: Backend, model: str) -> None:
    splats, cam = backend.put(far_and_wide(model))
    covars = backend.put(plain.covariances(*scenes_cpu(splats.quats, splats.scales)))
    by_quats, inputs = differentiable(arguments(splats, cam, antialiased=True))
    by_covars, covar_inputs = differentiable(arguments(splats, cam, covars=covars, antialiased=True))
    got, want = ops.project(*by_covars), ops.project(*by_quats)
    assert torch.equal(got.radii, want.radii)
    assert_close(got[1:], want[1:], 2e-13)                                       # the same up to rounding of the covariances
    v_got, v_want = gradients(got[1:], covar_inputs), gradients(want[1:], inputs)
    v_means, v_covars, *v_camera = v_got
    assert_close([v_means, *v_camera], [v_want[0], *v_want[3:]], 1e-12)
    assert_close(v_covars, v_covars.mT, 1e-15)                                   # of a symmetric matrix
    quats, scales = leaves(*scenes_cpu(splats.quats, splats.scales))
    chained = torch.autograd.grad(plain.covariances(quats, scales), [quats, scales], v_covars.cpu().double())
    assert_close(chained, v_want[1:3], 1e-12)


def scenes_cpu(*tensors: Tensor) -> list[Tensor]:
    return [t.detach().cpu().double() for t in tensors]


def test_covariances_are_those_of_rotated_ellipsoids() -> None:
    splats = scenes.splats(50)
    quats, scales = leaves(splats.quats, splats.scales)
    got, want = reference.covariances(quats, scales), plain.covariances(quats, scales)
    assert_close(got, want, 1e-15)
    assert_close(gradients([got], [quats, scales]), gradients([want], [quats, scales]), 1e-14)
    assert_close(torch.linalg.eigvalsh(got), (scales**2).sort(-1).values, 1e-14)


def test_cameras_and_splats_do_not_mix(backend: Backend) -> None:
    splats, cam = backend.put(far_and_wide("pinhole"))
    batch = ops.project(*arguments(splats, cam))
    for c in range(len(cam)):
        assert_same_bits(ops.project(*arguments(splats, cam[c:c + 1])), [x[c:c + 1] for x in batch])
    half = scenes.Splats3D(*[x[::2] for x in splats])
    assert_same_bits(ops.project(*arguments(half, cam)), [x[:, ::2] for x in batch])


def scene_at(*means: Sequence[float], scale: float = 0.1, opacity: float = 0.5) -> scenes.Splats3D:
    n = len(means)
    means, quats, scales = (torch.tensor(v, dtype=torch.float64) for v in (means, [[1.0, 0.2, 0.3, 0.4]], [[1.0, 0.8, 0.6]]))
    return scenes.Splats3D(means, quats.repeat(n, 1), scale * scales.repeat(n, 1), torch.full_like(means[:, 0], opacity),
                           torch.ones_like(means))


CULLED = {
    "behind": ({}, {"near": -1e3}, (0.0, 0.0, -3.0)),
    "at the camera": ({}, {"near": -1e3}, (0.0, 0.0, 0.0)),
    "before near": ({}, {"near": 2.0}, (0.0, 0.0, 2.0)),
    "beyond far": ({}, {"far": 3.0}, (0.0, 0.0, 3.0)),
    "left of the image": ({}, {}, (-6.0, 0.0, 3.0)),
    "right of the image": ({}, {}, (6.0, 0.0, 3.0)),
    "above the image": ({}, {}, (0.0, -6.0, 3.0)),
    "below the image": ({}, {}, (0.0, 6.0, 3.0)),
    "too faint": ({"opacity": 0.999 / 255}, {}, (0.0, 0.0, 3.0)),
}


@pytest.mark.parametrize(("why", "model"), [(why, model) for why in CULLED for model in MODELS
                                            # which it sees
                                            if model != "orthographic" or why not in ("behind", "at the camera")])
def test_what_cannot_be_seen_is_culled_with_zeros_and_zero_gradient(backend: Backend, why: str, model: str) -> None:
    look, limits, mean = CULLED[why]
    splats = scene_at((0.0, 0.0, 2.5), mean, **look)
    splats.opacities[0] = 0.5
    args, inputs = differentiable(backend.put(arguments(splats, scenes.camera(1, turn=0.0, model=model, **limits),
                                                        antialiased=True)))
    got = ops.project(*args)
    assert (got.radii[0, 0] > 0).all()
    for values in got:
        assert (values[0, 1] == 0).all()
    for v in gradients(got[1:], inputs)[:3]:
        assert (v[0] != 0).any()
        assert (v[1] == 0).all()


def test_orthographic_cameras_see_negative_depths() -> None:
    got = reference.project(*arguments(scene_at((0.0, 0.0, -3.0)), scenes.camera(1, turn=0.0, model="orthographic", near=-5.0)))
    assert got.depths.item() == -3.0
    assert (got.radii > 0).all()


def test_antialiasing_may_make_a_splat_too_faint() -> None:
    """It is the compensated opacity that must reach 1/255: a point-like splat is visible without compensation only."""
    splats, cam = scene_at((0.0, 0.0, 3.0), scale=1e-3, opacity=0.3), scenes.camera(1, turn=0.0)
    assert (reference.project(*arguments(splats, cam)).radii > 0).all()
    assert (reference.project(*arguments(splats, cam, antialiased=True)).radii == 0).all()


@pytest.mark.parametrize("opacity", [1.001 / 255, 0.02, 0.3, 1.0, 5.0])
def test_the_box_holds_every_pixel_that_the_splat_can_touch_and_little_more(opacity: float) -> None:
    splats = scenes.splats(20, spread=0.3, size=(0.03, 0.2), opacity=(opacity, opacity))
    cam = scenes.camera(1, 90, 90, turn=0.0)
    got = reference.project(*arguments(splats, cam))
    pixels = plain.pixel_centers(90, 90)
    alpha = plain.alphas_everywhere(got.means2d[0], got.conics[0], splats.opacities, 90, 90, 0.99)
    for n in range(20):
        rx, ry = got.radii[0, n].tolist()
        reach = (pixels - got.means2d[0, n]).abs()[alpha[..., n] > 0]
        if len(reach):
            assert (reach <= torch.tensor([rx, ry])).all()
        # at the ellipse's outermost point alpha is 1/255: e sigma in front of ceil
        inverse = torch.linalg.inv(torch.stack([got.conics[0, n, :2], got.conics[0, n, 1:]]))
        exact = torch.diagonal(inverse).sqrt() * math.sqrt(2 * math.log(255 * opacity))
        assert (torch.tensor([rx, ry]) < exact * (1 + 1e-12) + 1).all()


def test_compensation_has_a_floor_with_zero_gradient() -> None:
    """A splat of no size would vanish: sqrt(det ratio) is at least 0.005."""
    splats = scene_at((0.0, 0.0, 3.0), scale=1e-5, opacity=0.99)
    args, inputs = differentiable(arguments(splats, scenes.camera(1, turn=0.0), antialiased=True, eps2d=0.3))
    got = ops.project(*args)
    assert got.compensations.item() == 0.005
    assert all((v == 0).all() for v in gradients([got.compensations], inputs))


@pytest.mark.parametrize("covariances", [False, True])
@pytest.mark.parametrize("model", MODELS)
def test_chunks_change_nothing(monkeypatch: pytest.MonkeyPatch, model: str, covariances: bool) -> None:
    splats, cam = far_and_wide(model)
    covars = plain.covariances(splats.quats, splats.scales) if covariances else None
    args, inputs = differentiable(arguments(splats, cam, covars=covars, antialiased=True))
    whole = ops.project(*args)
    v_whole = gradients(whole[1:], inputs)
    monkeypatch.setattr(projection, "CHUNK", 13)                                 # 80 splats: six chunks and a rest
    parts = ops.project(*args)
    v_parts = gradients(parts[1:], inputs)
    assert torch.equal(parts.radii, whole.radii)
    assert_close(parts[1:], whole[1:], 1e-15)  # a function may round otherwise at an array's end
    assert_close(v_parts, v_whole, 1e-14)                                        # sums over the splats come in another order
    with threads(2):
        assert_same_bits(gradients(ops.project(*args)[1:], inputs), v_parts)


@pytest.mark.parametrize("model", MODELS)
def test_float32_is_as_good_as_float32_can_be(model: str) -> None:
    """Errors against float64 on the same (float32) numbers, in eps = 6e-8 of the largest, for condition numbers of some
    hundred.
    """
    splats, cam = scenes.splats(300, size=(0.05, 0.5)), scenes.camera(2, model=model)
    args32, inputs32 = differentiable([a.float() if isinstance(a, Tensor) else a
                                       for a in arguments(splats, cam, antialiased=True)])
    args64, inputs64 = differentiable([a.double() if isinstance(a, Tensor) else a for a in args32])
    got, want = ops.project(*args32), ops.project(*args64)
    assert all(x.dtype == torch.float32 for x in got[1:])
    both = ((got.radii > 0) == (want.radii > 0)).all(-1)[..., None]              # a box may end within rounding of the border
    assert (~both).sum() <= 2
    assert ((got.radii - want.radii).abs() <= 1).all()                           # ceil of numbers that differ by rounding
    for name, tolerance in (("means2d", 2e-7), ("depths", 2e-7), ("conics", 1e-5), ("compensations", 2e-5)):
        g, w = (getattr(x, name) for x in (got, want))
        keep = both if g.ndim == 3 else both[..., 0]
        assert_close(torch.where(keep, g, 0.0), torch.where(keep, w, 0.0), tolerance)
    assert_close(gradients(got[1:], inputs32), gradients(want[1:], inputs64), 1e-4)


def needles(ratio: float) -> tuple[scenes.Splats3D, Camera]:
    """Splats up to a few hundred pixels long, `ratio` times as long as they are thick, in float32."""
    s, cam = scenes.splats(500, size=(0.3, 1.0), opacity=(0.9, 0.9)), scenes.camera(2, 240, 170)
    thin = s._replace(scales=s.scales * torch.tensor([1.0, 1 / ratio, 1 / ratio], dtype=torch.float64))
    return scenes.Splats3D(*(x.float() for x in thin)), cam.to(torch.float32)


def foreshortening(splats: scenes.Splats3D, cam: Camera, conics: Tensor) -> Tensor:
    """`[C, N]`: how long a needle would be, seen from the side, over how long it is on the screen: at least |J| |S| / sqrt(trace Sigma')."""
    z = torch.einsum("cj,nj->cn", cam.viewmats[:, 2, :3], splats.means) + cam.viewmats[:, 2, 3, None]
    a, b, c = conics.double().unbind(-1)
    length = ((a + c) / (a * c - b * b)).sqrt()                                # sqrt(trace) of the inverse
    return 2 * cam.Ks[:, 0, 0, None] / z * splats.scales.amax(-1) / length       # |J| < 2 f/z, the clamp included


@pytest.mark.parametrize("eps2d", [0.0, 0.3])
@pytest.mark.parametrize("ratio", [1e2, 1e3, 1e4, 1e6])
def test_needles_keep_float32s_precision(ratio: float, eps2d: float) -> None:
    """The covariance is never formed from quaternion and scales, so its small eigenvalue is not lost: that takes (1/ratio)^2 > eps.

    A column of T = J W R S is off by 13 u of |J| s, u = eps/2: 6 from R, 4 from J W, 3 from the product. Sigma' and its determinant take
    two of them in each product, the conic one over the other: 52 u, and 6 more for the operations: 29 eps, times the foreshortening.
    """
    splats, cam = needles(ratio)
    args = arguments(splats, cam, eps2d=eps2d, antialiased=True)
    want = reference.project(*(a.double() if isinstance(a, Tensor) else a for a in args))
    seen = (want.radii > 0).all(-1)
    assert seen.sum() > 400
    bound = 29 * torch.finfo(torch.float32).eps * foreshortening(splats, cam, want.conics)[seen].clamp_min(1.0)
    got = ops.project(*args)
    assert torch.equal((got.radii > 0).all(-1), seen)
    off = torch.linalg.vector_norm(got.conics - want.conics, dim=-1) / torch.linalg.vector_norm(want.conics, dim=-1)
    assert (off[seen] <= bound).all()
    assert ((got.compensations / want.compensations - 1).abs()[seen] <= bound).all()


@pytest.mark.parametrize("ratio", [1e2, 1e3, 1e4, 1e6])
def test_gradients_of_needles_keep_float32s_precision(ratio: float) -> None:
    """Of conic and compensation, in closed form: -Q v_Q Q T must not be off by the length of T.

    G = -2 Q V (Q T) is off by 100 u of |Q| |V| |Q T|: Q by 58, T by 13, the rest by products; |Q T| is at most 1/sqrt(2 eps2d), as
    t/(t^2 + eps2d) at most 1/(2 sqrt(eps2d)) for each of two singular values. Scales get it times |J|, quaternions times |J| |S|, twice.
    The compensation, between 0 and 1, has slopes of that size: at most 1/sqrt(eps2d) with respect to a singular value of T.
    """
    splats, cam = needles(ratio)
    args = arguments(splats, cam, antialiased=True)
    radii, *values = reference.project(*args)
    upstream = [torch.zeros_like(v) for v in values]
    upstream[2:] = [scenes.normal(*v.shape, seed=scenes.generator(i)).float() for i, v in enumerate(values[2:])]
    back = [*args[:4], *args[5:10], *args[12:], radii, *upstream]
    got = reference.project_backward(*back)
    want = reference.project_backward(*(a.double() if isinstance(a, Tensor) and a.is_floating_point() else a for a in back))
    z = values[1].double().clamp_min(cam.near)
    norm = functools.partial(torch.linalg.vector_norm, dim=-1)
    size = 2 * cam.Ks[:, 0, 0, None] / z * (2 * norm(values[2].double()) * norm(upstream[2].double()) + upstream[3].abs()) / math.sqrt(0.6)
    bound = 50 * torch.finfo(torch.float32).eps * (size * foreshortening(splats, cam, values[2]).clamp_min(1.0)).nan_to_num(0.0).sum(0)
    assert (norm(got.scales - want.scales) <= bound).all()
    assert (norm(got.quats - want.quats) <= 4 * bound * splats.scales.amax(-1) / norm(splats.quats)).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("scale", [1e3, 1e6, 1e9, 1e11])
def test_a_splat_huge_for_one_camera_and_culled_by_another_has_finite_gradients(dtype: torch.dtype, scale: float) -> None:
    """The second camera is far away and sees it as a wash of colour; for the first it is behind."""
    viewmats = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    viewmats[:, 2, 3] = torch.tensor([-10.0, 1e4])
    cam = Camera(viewmats, scenes.camera(2).Ks, 24, 17)
    splats = scene_at((0.0, 0.0, 1.0), scale=scale)
    args, inputs = differentiable([a.to(dtype) if isinstance(a, Tensor) else a
                                   for a in arguments(splats, cam, antialiased=True)])
    got = ops.project(*args)
    assert (got.radii[0] == 0).all()
    for values in [*got, *gradients(got[1:], inputs)]:
        assert values.isfinite().all()


def test_layout_of_the_inputs_does_not_matter(backend: Backend) -> None:
    args, inputs = differentiable(backend.put(arguments(*far_and_wide("pinhole"))))
    want = ops.project(*args)
    v_want = gradients(want[1:], inputs)
    spread = [strided(a) if isinstance(a, Tensor) else a for a in args]
    got = ops.project(*spread)
    assert_same_bits(got, want)
    assert_close(gradients(got[1:], inputs), v_want, 1e-15)                      # scalar products may add up in another order
