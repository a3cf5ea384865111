"""The Triton kernels of projection, in the interpreter where there is no GPU, against the reference."""

from __future__ import annotations

import math
import os
from typing import Any

import pytest
import scenes
import torch
import tsplat_reference as reference
from compare import assert_close, assert_same_bits, guarded, strided
from torch import Tensor

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
if DEVICE.type == "cpu":
    os.environ.setdefault("TRITON_INTERPRET", "1")                              # read when Triton is imported
pytest.importorskip("triton", reason="Triton is not installed here")

from tsplat.kernels.projection import project, project_backward  # noqa: E402

MODELS = ("pinhole", "orthographic", "fisheye")


def put(values: Any, function: Any = lambda x: guarded(x, DEVICE)) -> list[Any]:
    """The values with a function applied to tensors."""
    return [function(v) if isinstance(v, Tensor) else v for v in values]


def arguments(splats: scenes.Splats3D, cam: Any, *, covars: bool = False, antialiased: bool = False, eps2d: float = 0.3) -> list[Any]:
    """What `project` takes."""
    shape = (None, None, reference.covariances(splats.quats, splats.scales)) if covars else (splats.quats, splats.scales, None)
    return [splats.means, *shape, splats.opacities, cam.viewmats, cam.Ks, cam.width, cam.height, cam.model, cam.near, cam.far, eps2d, antialiased]


def far_and_wide(model: str, n: int = 40, cameras: int = 2) -> tuple[scenes.Splats3D, Any]:
    """Splats around the view, some so wide that they are visible from beyond where the pinhole's Jacobian is clamped."""
    return scenes.splats(n, spread=2.6, size=(0.05, 0.8)), scenes.camera(cameras, model=model)


def backward_arguments(args: list[Any], outputs: Any) -> list[Any]:
    """What `project_backward` takes, with a gradient that is NaN where the pair was culled: it must not matter."""
    radii, *values = outputs
    g = scenes.generator(5)
    visible = (radii > 0).all(-1)
    upstream = [scenes.normal(*v.shape, seed=g).to(v) for v in values]
    for v in upstream:
        v[~visible] = math.nan
    return [*args[:4], *args[5:10], *args[12:], radii, *upstream]


def present(results: Any) -> list[Tensor]:
    return [r for r in results if r is not None]


def check(args: list[Any], tolerance: float = 1e-12) -> None:
    """Values and gradients of the kernels are those of the reference."""
    want = reference.project(*args)
    got = project(*put(args))
    assert torch.equal(got[0].cpu(), want.radii)
    assert_close(got[1:], want[1:], tolerance)
    back = backward_arguments(args, want)
    v_got, v_want = project_backward(*put(back)), reference.project_backward(*back)
    assert [v is None for v in v_got] == [v is None for v in v_want]
    assert_close(present(v_got), present(v_want), tolerance)


@pytest.mark.parametrize("covars", [False, True])
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("model", MODELS)
def test_values_and_gradients_are_those_of_the_reference(model: str, antialiased: bool, covars: bool) -> None:
    check(arguments(*far_and_wide(model), antialiased=antialiased, covars=covars))


def test_without_blur_and_with_one_camera() -> None:
    check(arguments(*far_and_wide("pinhole", n=130, cameras=1), antialiased=True, eps2d=0.0))


def test_the_scene_has_what_it_is_for() -> None:
    splats, cam = far_and_wide("pinhole")
    seen = (reference.project(*arguments(splats, cam)).radii > 0).all(-1)
    p = torch.einsum("cij,nj->cni", cam.viewmats[:, :3, :3], splats.means) + cam.viewmats[:, None, :3, 3]
    beyond = torch.zeros_like(seen)
    for i, size in enumerate((cam.width, cam.height)):
        f, c, margin = cam.Ks[:, i, i, None], cam.Ks[:, i, 2, None], 0.15 * size
        ratio = p[..., i] / p[..., 2]
        beyond |= (ratio < -(c + margin) / f) | (ratio > (size - c + margin) / f)
    assert (seen & beyond).sum() >= 5
    assert (~seen.any(0)).any()                                                 # seen by no camera
    assert (seen.any(0) & ~seen.all(0)).any()                                   # by one of two


def test_the_floor_of_the_compensation() -> None:
    splats, cam = far_and_wide("pinhole")
    args = arguments(splats._replace(scales=splats.scales * torch.tensor([1.0, 1e-4, 1e-4])), cam, antialiased=True)
    args[4] = torch.ones_like(splats.opacities)
    assert (project(*put(args))[4] == 0.005).sum() >= 5
    check(args)


def degenerate(covars: bool) -> tuple[scenes.Splats3D, dict[str, int]]:
    """Sane splats with, after each, one that is not; and which those are."""
    s = scenes.Splats3D(*(x.clone() for x in scenes.splats(30, spread=0.5, opacity=(0.5, 0.9))))
    nan, inf = math.nan, math.inf
    broken: list[tuple[str, str, Any]] = [
        ("means", "NaN", [nan, 0.0, 3.0]), ("means", "infinite", [0.0, 0.0, inf]), ("means", "huge", [0.0, 0.0, 2e12]),
        ("opacities", "NaN", nan), ("opacities", "infinite", inf), ("opacities", "negative", -0.5), ("opacities", "faint", 0.9 / 255)]
    broken += [("scales", "NaN", [0.1, nan, 0.1]), ("scales", "infinite", [0.1, 0.1, inf]), ("scales", "huge", [2e12, 0.1, 0.1]),
               ("scales", "zero", [0.0, 0.0, 0.0])]
    if not covars:
        broken += [("quats", "NaN", [nan, 0.0, 0.0, 1.0]), ("quats", "infinite", [inf, 0.0, 0.0, 1.0]), ("quats", "zero", [0.0] * 4)]
    rows = {}
    for i, (name, what, value) in enumerate(broken):
        rows[f"{name}, {what}"] = 2 * i + 1
        getattr(s, name)[2 * i + 1] = torch.tensor(value, dtype=torch.float64)
    return s, rows


@pytest.mark.filterwarnings("ignore:.*encountered in")                           # by numpy, under the interpreter
@pytest.mark.parametrize("covars", [False, True])
def test_degenerate_splats_are_culled_and_take_no_gradient(covars: bool) -> None:
    splats, rows = degenerate(covars)
    args = arguments(splats, scenes.camera(2), covars=covars, antialiased=True)
    radii, *values = project(*put(args))
    back = backward_arguments(args, [radii.cpu(), *(v.cpu() for v in values)])
    *by_splat, v_viewmats, v_Ks = present(project_backward(*put(back)))
    for what, row in rows.items():
        assert all((x[:, row] == 0).all() for x in (radii, *values)), what
        assert all((v[row] == 0).all() for v in by_splat), what
    assert (radii[:, ::2] > 0).sum() > 40
    assert v_viewmats.isfinite().all()
    assert v_Ks.isfinite().all()
    check(args)


def test_splats_out_of_depth_are_culled() -> None:
    splats = scenes.splats(6, spread=0.3)
    splats.means[:, 2] = torch.tensor([-3.0, 0.0, 2.0, 2.5, 4.0, 5.0])
    for model in MODELS:
        args = arguments(splats, scenes.camera(1, model=model, near=2.0, far=4.0, turn=0.0))
        assert (project(*put(args))[2] > 0).tolist() == [[False, False, False, True, False, False]]
        check(args)
    check(arguments(splats, scenes.camera(1, model="orthographic", near=-10.0, turn=0.0)))      # which sees behind itself
    check(arguments(splats, scenes.camera(1, near=-10.0, turn=0.0)))                            # a pinhole does not


def test_the_arctangent_of_the_fisheye() -> None:
    """With unit focal lengths u is the angle to the axis: 1e-14 from the axis to its right angle."""
    r = 10.0 ** torch.linspace(-9.0, 9.0, 181, dtype=torch.float64)
    r = torch.cat([torch.zeros(1, dtype=torch.float64), r, torch.linspace(0.22, 0.23, 11, dtype=torch.float64)])      # the series ends at 0.2236
    n = len(r)
    splats = scenes.splats(n)._replace(means=torch.stack([r, torch.zeros_like(r), torch.ones_like(r)], -1), opacities=torch.ones_like(r))
    args = arguments(splats, scenes.camera(1, 4, 4, model="fisheye", turn=0.0))
    args[5], args[6] = torch.eye(4, dtype=torch.float64)[None], torch.diag(torch.tensor([1.0, 1.0, 1.0], dtype=torch.float64))[None]
    u = project(*put(args))[1][0, :, 0].cpu()
    assert (u - torch.atan2(r, torch.ones_like(r))).abs().div(r.atan().clamp(min=1e-300)).max() < 1e-14
    single = project(*put(args, lambda x: guarded(x.float(), DEVICE)))[1][0, :, 0].cpu().double()
    assert (single - torch.atan2(r, torch.ones_like(r))).abs().div(r.atan().clamp(min=1e-300)).max() < 1e-6


@pytest.mark.parametrize(("n", "cameras"), [(0, 2), (5, 0), (0, 0)])
def test_nothing_to_project(n: int, cameras: int) -> None:
    splats, cam = far_and_wide("pinhole", n=6, cameras=2)
    args = arguments(scenes.Splats3D(*(x[:n] for x in splats)), cam)
    args[5], args[6] = args[5][:cameras], args[6][:cameras]
    check(args)


@pytest.mark.parametrize("model", MODELS)
def test_float32_is_as_good_as_float32_can_be(model: str) -> None:
    args = put(arguments(*far_and_wide(model), antialiased=True), lambda x: x.float().double())
    want = reference.project(*args)
    back = backward_arguments(args, want)
    single = [guarded(x.float() if x.is_floating_point() else x, DEVICE) if isinstance(x, Tensor) else x for x in back]
    got = project(*put(args, lambda x: guarded(x.float(), DEVICE)))
    assert all(x.dtype == torch.float32 for x in got[1:])
    assert ((got[0].cpu() - want.radii).abs() <= 1).all()                        # a half size may be a rounding from an integer
    assert torch.equal(got[0].cpu() > 0, want.radii > 0)
    # covariances of condition up to 1e3, whose inverse enters gradients squared
    assert_close(got[1:], want[1:], 1e-5)
    assert_close(present(project_backward(*single)), present(reference.project_backward(*back)), 1e-4)


def test_needles_keep_their_width_in_float32() -> None:
    """Splats 1,000 times as long as wide, seen from near their end: the covariance in world space would lose the width to rounding."""
    splats, cam = far_and_wide("pinhole")
    splats = splats._replace(scales=torch.tensor([[2.0, 2e-3, 2e-3]], dtype=torch.float64).expand(len(splats.means), -1))
    args = put(arguments(splats, cam, antialiased=True, eps2d=1e-4), lambda x: x.float().double())
    want = reference.project(*args)
    both = (want.radii > 0).all(-1)
    _, _, _, conics, compensations = (x.cpu().double() for x in project(*put(args, lambda x: guarded(x.float(), DEVICE))))
    assert ((conics - want.conics).abs().amax(-1) / want.conics.abs().amax(-1))[both].max() < 1e-5
    assert ((compensations - want.compensations).abs() / want.compensations)[both].max() < 1e-5


def test_layout_of_the_inputs_does_not_matter_and_sums_have_one_order() -> None:
    args = put(arguments(*far_and_wide("pinhole")), lambda x: x.to(DEVICE))
    want = project(*args)
    assert_same_bits(project(*put(args, strided)), want)
    back = backward_arguments(args, want)
    v_want = present(project_backward(*back))
    assert_same_bits(present(project_backward(*back)), v_want)
    assert_same_bits(present(project_backward(*put(back, strided))), v_want)
