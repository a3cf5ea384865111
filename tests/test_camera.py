"""Camera models against their definitions, and the `Camera` object."""

from __future__ import annotations

import functools
import math
import re

import mpmath
import plain
import pytest
import torch
import tsplat_reference as reference
from compare import assert_close, gradients, leaves
from scenes import camera, generator, normal, uniform
from tsplat_reference.camera import SERIES_BELOW, project_points, project_points_backward, split_intrinsics

from tsplat import Camera

MODELS = ("pinhole", "orthographic", "fisheye")
WIDTH, HEIGHT = 24, 17
f64 = functools.partial(torch.tensor, dtype=torch.float64)


def points(count: int, spread: float = 2.0) -> torch.Tensor:
    """`[3, 1, count]`: x/z and y/z up to `spread`, beyond every clamp of the frustum."""
    g = generator(3)
    z = uniform(0.5, 5.0, 1, count, seed=g)
    return torch.stack([uniform(-spread, spread, 1, count, seed=g) * z, uniform(-spread, spread, 1, count, seed=g) * z, z])


def definition(p: torch.Tensor, K: torch.Tensor, model: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Pixels `[n, 2]` and Jacobians `[n, 2, 3]` of `plain`, of points `[n, 3]`."""
    pixels = torch.func.vmap(lambda q: plain.pixel(q, K, model))(p)
    jacobian = torch.func.jacrev(plain.pixel)
    return pixels, torch.func.vmap(lambda q: jacobian(plain.jacobian_point(q, K, WIDTH, HEIGHT, model), K, model))(p)


def as_matrix(J: list[list[torch.Tensor | float]], like: torch.Tensor) -> torch.Tensor:
    """`[n, 2, 3]` from planes `[1, n]` or zeros."""
    return torch.stack([torch.stack([torch.as_tensor(v, dtype=like.dtype).expand_as(like) for v in row], -1) for row in J],
                       -2)[0]


@pytest.mark.parametrize("model", MODELS)
def test_pixels_and_jacobian_follow_the_model(model: str) -> None:
    K = camera(1, WIDTH, HEIGHT, model=model).Ks
    p = points(200)
    u, v, J = project_points(tuple(p), split_intrinsics(K), WIDTH, HEIGHT, model)
    pixels, jacobian = definition(p[:, 0].T, K[0], model)
    # a few products and quotients of rounded numbers: some eps = 2e-16 of the largest
    assert_close([torch.stack([u, v], -1)[0], as_matrix(J, u)], [pixels, jacobian], 2e-15)


@pytest.mark.parametrize("model", MODELS)
def test_backward_is_autograd_of_the_model(model: str) -> None:
    K, = leaves(camera(1, WIDTH, HEIGHT, model=model).Ks)
    p, = leaves(points(200)[:, 0].T)
    pixels, jacobian = definition(p, K[0], model)
    if model == "pinhole":                                                          # else the clamp is not tested
        assert (plain.jacobian_point(p[0], K[0], WIDTH, HEIGHT, model) - p[0]).abs().max() > 0
    v_pixels, v_jacobian = normal(200, 2, seed=generator(0)), normal(200, 2, 3, seed=generator(1))
    want = torch.autograd.grad([pixels, jacobian], [p, K], [v_pixels, v_jacobian])
    v_p, v_K = project_points_backward(tuple(p.detach().T[:, None]), split_intrinsics(K.detach()), WIDTH, HEIGHT, model,
                                       v_pixels[None, :, 0], v_pixels[None, :, 1], v_jacobian.permute(1, 2, 0)[:, :, None])
    got = torch.stack([torch.as_tensor(v, dtype=torch.float64).expand(1, 200)[0] for v in v_p], -1), v_K
    # second derivatives add up terms of either sign; the fisheye's closed form cancels to 1e-13 where it meets the series
    assert_close(got, want, 1e-13)


def exact_fisheye(axis: int, x: mpmath.mpf, y: mpmath.mpf, z: mpmath.mpf) -> mpmath.mpf:
    r = mpmath.sqrt(x * x + y * y)
    return (x, y)[axis] * (mpmath.atan2(r, z) / r if r else 1 / z)


@pytest.mark.parametrize("r", [0.0, 1e-12, 1e-6, 1e-3, 0.1, math.sqrt(SERIES_BELOW) * (1 - 1e-9),
                               math.sqrt(SERIES_BELOW) * (1 + 1e-9), 0.5, 3.0, 40.0])
def test_fisheye_is_exact_from_the_axis_to_the_rim(r: float) -> None:
    """Series and closed form meet at r/z = sqrt(SERIES_BELOW); both sides are held against 40 digits, second derivatives
    included.
    """
    at = (0.6 * r, -0.8 * r, 1.0)
    p = f64(at)[:, None, None]
    K = torch.eye(3, dtype=torch.float64)[None]
    K[:, :2, 2] = 0.0
    u, v, J = project_points(tuple(p), split_intrinsics(K), 2, 2, "fisheye")
    with mpmath.workdps(40):
        pixels = [float(exact_fisheye(i, *map(mpmath.mpf, at))) for i in range(2)]
        orders = [tuple(int(i == j) for j in range(3)) for i in range(3)]
        jacobian = [[float(mpmath.diff(lambda *q, i=i: exact_fisheye(i, *q), at, o)) for o in orders] for i in range(2)]
        second = [[[float(mpmath.diff(lambda *q, i=i: exact_fisheye(i, *q), at, tuple(map(sum, zip(o, a, strict=True)))))
                    for a in orders]
                   for o in orders] for i in range(2)]
    # rounding of s, k and m is multiplied by 1/t and 1/t^2, t = (r/z)^2 >= 0.05, and by x^2 and x^2 y again: 20 to 100 eps
    assert_close(torch.stack([u, v]).flatten(), f64(pixels), 2e-15)
    assert_close(as_matrix(J, u)[0], f64(jacobian), 1e-14)
    zero = torch.zeros(1, 1, dtype=torch.float64)
    for i in range(2):
        for j in range(3):
            v_J = [[torch.ones_like(zero) if (k, l) == (i, j) else zero for l in range(3)] for k in range(2)]
            v_p, _ = project_points_backward(tuple(p), split_intrinsics(K), 2, 2, "fisheye", zero, zero, v_J)
            want = f64(second[i][j])
            got = torch.stack([torch.as_tensor(q).flatten()[0] for q in v_p])
            assert (got - want).abs().max() <= 5e-14


def test_fisheye_jacobian_on_the_axis_is_that_of_a_pinhole() -> None:
    K = camera(1, WIDTH, HEIGHT).Ks
    on_axis = tuple(f64([0.0, 0.0, 2.5])[:, None, None])
    fisheye, pinhole = (project_points(on_axis, split_intrinsics(K), WIDTH, HEIGHT, model) for model in ("fisheye", "pinhole"))
    assert_close(as_matrix(fisheye[2], fisheye[0]), as_matrix(pinhole[2], pinhole[0]), 1e-15)


def test_camera_centers_are_where_the_view_matrix_maps_to_zero() -> None:
    viewmats = camera(4).viewmats
    assert_close(reference.camera_centers(viewmats), torch.linalg.inv(viewmats)[:, :3, 3], 1e-14)


def test_look_at_puts_target_up_and_field_of_view_in_place() -> None:
    eye, target, up = f64([1.0, 2.0, -3.0]), f64([0.5, 1.0, 4.0]), f64([0.1, -1.0, 0.2])
    cam = Camera.look_at(eye, target, up, width=40, height=30, fov=60.0, dtype=torch.float64)
    R, t = cam.viewmats[:3, :3], cam.viewmats[:3, 3]
    assert_close(R @ R.T, torch.eye(3, dtype=torch.float64), 1e-15)
    assert torch.linalg.det(R) > 0
    assert_close(reference.camera_centers(cam.viewmats), eye, 1e-14)
    seen = R @ target + t
    assert_close(plain.pixel(seen, cam.Ks, "pinhole"), f64([20.0, 15.0]), 1e-14)
    above = plain.pixel(R @ (target + 0.1 * up) + t, cam.Ks, "pinhole")
    assert above[1] < 15 - 0.1
    assert_close(above[0], f64(20.0), 1e-13)
    edge = f64([math.tan(math.radians(30.0)), 0.0, 1.0])
    assert_close(plain.pixel(edge, cam.Ks, "pinhole"), f64([40.0, 15.0]), 1e-14)
    assert cam.viewmats.dtype == torch.float64
    assert not cam.batched


def test_a_batch_indexes_like_a_tensor() -> None:
    batch = camera(4, model="fisheye", near=0.5, far=9.0)
    assert len(batch) == 4
    assert batch.batched
    one = batch[2]
    assert len(one) == 1
    assert not one.batched
    assert torch.equal(one.viewmats, batch.viewmats[2])
    assert torch.equal(one.Ks, batch.Ks[2])
    assert (one.width, one.height, one.model, one.near, one.far) == (24, 17, "fisheye", 0.5, 9.0)
    assert len(batch[1:3]) == 2
    assert torch.equal(batch[torch.tensor([3, 0])].Ks, batch.Ks[[3, 0]])
    with pytest.raises(TypeError, match="a single camera cannot be indexed"):
        one[0]


@pytest.mark.parametrize("model", MODELS)
def test_a_resized_camera_sees_the_same(model: str) -> None:
    before = camera(1, WIDTH, HEIGHT, model=model)
    after = before.resized(3 * WIDTH, 2 * HEIGHT)
    assert (after.width, after.height, after.model) == (3 * WIDTH, 2 * HEIGHT, model)
    p = points(5)[:, 0].T
    pixels = [definition(p, cam.Ks[0], model)[0] for cam in (before, after)]
    assert_close(pixels[1], pixels[0] * f64([3.0, 2.0]), 2e-15)                      # as above


def test_to_moves_both_matrices() -> None:
    moved = camera(2).to(torch.float32)
    assert moved.viewmats.dtype == moved.Ks.dtype == torch.float32


def test_gradients_pass_through_the_camera() -> None:
    viewmats, Ks = leaves(camera(2).viewmats, camera(2).Ks)
    cam = Camera(viewmats, Ks, WIDTH, HEIGHT)[1]
    v_viewmats, v_Ks = gradients([cam.viewmats, cam.Ks], [viewmats, Ks])
    assert (v_viewmats[0] == 0).all()
    assert (v_viewmats[1] != 0).all()
    assert (v_Ks[1] != 0).all()


EYE4, EYE3 = torch.eye(4), torch.eye(3)
WRONG = [
    (TypeError, "camera.viewmats: expected a torch.Tensor of shape [..., 4, 4]; got list", {"viewmats": [[1.0]]}),
    (TypeError, "camera.viewmats: expected a floating-point tensor; got dtype torch.int64", {"viewmats": EYE4.long()}),
    (ValueError, "camera.viewmats: expected shape [..., 4, 4]; got [3, 4]", {"viewmats": EYE4[:3]}),
    (ValueError, "camera.viewmats: expected shape [..., 4, 4]; got [4]", {"viewmats": EYE4[0]}),
    (ValueError, "camera.Ks: expected shape [..., 3, 3]; got [4, 4]", {"Ks": EYE4}),
    (TypeError, "camera.Ks: expected dtype torch.float32, as the other arguments have; got torch.float64",
     {"Ks": EYE3.double()}),
    (ValueError, "camera.Ks: expected device cpu, where the other arguments are; got meta", {"Ks": EYE3.to("meta")}),
    (ValueError, "expected [C, 4, 4] and [C, 3, 3], or [4, 4] and [3, 3]; got [4, 4] and [1, 3, 3]", {"Ks": EYE3[None]}),
    (ValueError, "expected [C, 4, 4] and [C, 3, 3], or [4, 4] and [3, 3]; got [2, 4, 4] and [3, 3, 3]",
     {"viewmats": EYE4.repeat(2, 1, 1), "Ks": EYE3.repeat(3, 1, 1)}),
    (ValueError, "got [1, 1, 4, 4] and [1, 1, 3, 3]", {"viewmats": EYE4[None, None], "Ks": EYE3[None, None]}),
    (ValueError, "camera.viewmats: expected finite numbers", {"viewmats": EYE4 * math.nan}),
    (ValueError, "camera.Ks: expected finite numbers", {"Ks": EYE3 / 0}),
    *[(ValueError, "camera.Ks: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], as skew", {"Ks": EYE3 + entry})
      for entry in torch.tensor([0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 1.0, 1.0, 1.0]).mul(2e-5).diag().view(9, 3, 3) if entry.any()],
    (ValueError, "camera.Ks: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], as skew and other homographies are not supported; got [[[",
     {"viewmats": EYE4.repeat(2, 1, 1), "Ks": torch.stack([EYE3, EYE3 + EYE3.flip(1)])}),
    (ValueError, "width: expected at least 1; got 0", {"width": 0}),
    (ValueError, "height: expected at least 1; got -3", {"height": -3}),
    (TypeError, "width: expected an int of at least 1; got 24.0", {"width": 24.0}),
    (TypeError, "height: expected an int of at least 1; got True", {"height": True}),
    (ValueError, "camera.model: expected one of pinhole, orthographic, fisheye; got 'panorama'", {"model": "panorama"}),
    (ValueError, "camera.near, camera.far: expected near < far; got 2.0 and 1.0", {"near": 2.0, "far": 1.0}),
    (ValueError, "camera.near, camera.far: expected near < far; got nan", {"near": math.nan}),
    (TypeError, "camera.near: expected", {"near": "0.1"}),
    (TypeError, "camera.far: expected", {"far": None}),
]


@pytest.mark.parametrize(("kind", "message", "changes"), WRONG, ids=[f"{m[1][:40]} {i}" for i, m in enumerate(WRONG)])
def test_errors_name_the_argument_what_came_and_what_is_expected(kind: type[Exception], message: str,
                                                                 changes: dict[str, object]) -> None:
    arguments = {"viewmats": EYE4, "Ks": EYE3, "width": 24, "height": 17} | changes
    with pytest.raises(kind, match=re.escape(message)):
        Camera(**arguments)


def test_rounding_is_no_skew_and_what_requires_grad_may_be_perturbed() -> None:
    K = torch.tensor([[1000.0, 0.009, 320.0], [-0.009, 1000.0, 240.0], [9e-6, -9e-6, 1 + 9e-6]])
    Camera(EYE4, K, 640, 480)
    skewed = K + torch.tensor([[0.0, 3.0, 0.0]] * 3)
    Camera(EYE4, skewed.requires_grad_(), 640, 480)
    with pytest.raises(ValueError, match=r"camera\.Ks"):
        Camera(EYE4, skewed.detach(), 640, 480)


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, 0.0, -3.0), (0.0, 1e-7, 1.0), (0.0, 0.0, 0.0), (0.0, math.nan, 1.0)])
def test_look_at_refuses_to_take_up_along_the_view(up: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match=r"^up: expected a direction that is not along the view, \[0\.0, 0\.0, 1\.0\]; got \["):
        Camera.look_at((1.0, 2.0, 3.0), (1.0, 2.0, 7.0), up, width=8, height=8)


def test_look_at_takes_up_at_a_small_angle_to_the_view() -> None:
    R = Camera.look_at((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1e-5, 1.0), width=8, height=8, dtype=torch.float64).viewmats[:3, :3]
    assert_close(R, torch.eye(3, dtype=torch.float64), 1e-15)


def test_vmap_over_cameras_is_told_of_batches() -> None:
    cam = camera(3)
    with pytest.raises(NotImplementedError, match=re.escape("give the viewmats [C, 4, 4] and Ks [C, 3, 3] of all cameras in one call")):
        torch.func.vmap(lambda v, K: Camera(v, K, WIDTH, HEIGHT).Ks)(cam.viewmats, cam.Ks)


def test_look_at_refuses_to_look_at_itself() -> None:
    with pytest.raises(ValueError, match=r"^eye, target: expected two points; got \[1\.0, 2\.0, 3\.0\] and"):
        Camera.look_at((1.0, 2.0, 3.0), (1.0, 2.0, 3.0), width=8, height=8)


@pytest.mark.parametrize("model", MODELS)
def test_resized_pictures_show_the_same(model: str) -> None:
    """A point is at the same part of the width and of the height, of one camera and of a batch."""
    one = Camera(torch.eye(4, dtype=torch.float64), f64([[20.0, 0, 11], [0, 25, 9], [0, 0, 1]]), WIDTH, HEIGHT, model=model)
    p = points(9)[:, 0].T.double()
    before = definition(p, one.Ks, model)[0] / f64([WIDTH, HEIGHT])
    for small in (one.resized(12, 51), Camera(one.viewmats[None], one.Ks[None], WIDTH, HEIGHT, model=model).resized(12, 51)[0]):
        assert (small.width, small.height, small.model) == (12, 51, model)
        assert_close(definition(p, small.Ks, model)[0] / f64([12, 51]), before, 1e-13)
