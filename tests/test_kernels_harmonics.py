"""The Triton kernels of spherical harmonics, in the interpreter where there is no GPU, against the reference."""

from __future__ import annotations

import math
import os

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

from tsplat.kernels.harmonics import harmonics, harmonics_backward  # noqa: E402

Scene = tuple[Tensor, Tensor, Tensor, int, Tensor]


def scene(degree: int, channels: int = 3, cameras: int = 2, n: int = 9, extra: int = 0) -> Scene:
    """Means, centres, coefficients (`extra` more than used, which are NaN), degree and mask."""
    g = scenes.generator(degree)
    means, centers = scenes.normal(n, 3, seed=g), scenes.normal(cameras, 3, seed=g)
    coeffs = scenes.normal(n, (degree + 1) ** 2 + extra, channels, seed=g)
    coeffs[:, (degree + 1) ** 2:] = math.nan
    return means, centers, coeffs, degree, scenes.uniform(0.0, 1.0, cameras, n, seed=g) < 0.6


def upstream(args: Scene) -> Tensor:
    """A gradient that is NaN where the pair is masked: it must not matter."""
    v = scenes.normal(*args[4].shape, args[2].shape[2], seed=scenes.generator(7))
    return torch.where(args[4][..., None], v, math.nan)


def run(args: Scene, dtype: torch.dtype = torch.float64) -> list[Tensor]:
    """Value and gradients of the kernels."""
    means, centers, coeffs, v_out = (guarded(x.to(dtype), DEVICE) for x in (*args[:3], upstream(args)))
    mask = guarded(args[4], DEVICE)
    return [harmonics(means, centers, coeffs, args[3], mask), *harmonics_backward(means, centers, coeffs, args[3], mask, v_out)]


def expected(args: Scene) -> list[Tensor]:
    return [reference.harmonics(*args), *reference.harmonics_backward(*args, upstream(args))]


@pytest.mark.parametrize(("degree", "channels"), [(0, 3), (1, 3), (2, 3), (3, 3), (4, 3), (0, 1), (2, 2), (1, 5), (2, 4), (3, 4), (4, 6)])
def test_values_and_gradients_are_those_of_the_reference(degree: int, channels: int) -> None:
    args = scene(degree, channels)
    assert_close(run(args), expected(args), 1e-12)


def test_several_blocks_of_splats() -> None:
    """Each direction has blocks of its own size, of which 150 is not a multiple."""
    args = scene(1, n=150)
    assert_close(run(args), expected(args), 1e-12)


@pytest.mark.parametrize(("degree", "extra", "cameras"), [(0, 15, 1), (1, 12, 3), (2, 7, 1), (3, 9, 0), (2, 16, 2)])
def test_coefficients_beyond_the_degree_are_not_used(degree: int, extra: int, cameras: int) -> None:
    args = scene(degree, extra=extra, cameras=cameras)
    got = run(args)
    assert_close(got, expected(args), 1e-12)
    assert (got[3][:, (degree + 1) ** 2:] == 0).all()


def test_masked_pairs_are_not_read() -> None:
    args = scene(3)
    means, coeffs, mask = args[0], args[2], args[4]
    mask[:, 7] = False
    sane = run(args)
    means[7], coeffs[7] = math.nan, math.inf
    got = run(args)
    assert_same_bits(got, sane)
    assert all((x == 0).all() for x in (got[0][~mask.to(DEVICE)], got[1][7], got[3][7]))


def test_a_mean_at_the_camera_centre_is_seen_along_z_with_zero_gradient() -> None:
    args = scene(4)
    args[0][3] = args[1][0]
    args[4][:, 3] = torch.tensor([True, False])
    got = run(args)
    assert_close(got, expected(args), 1e-12)
    assert (got[1][3] == 0).all()
    assert (got[3][3] != 0).any()


def test_coefficients_that_are_not_finite_do_no_harm_without_a_gradient_from_above() -> None:
    args = scene(3)
    args[4][:, 2] = True
    args[2][2, 5, 1] = math.nan
    v_out = upstream(args).nan_to_num(0.0)
    v_out[:, 2] = 0.0
    got = harmonics_backward(*(x.to(DEVICE) for x in args[:3]), args[3], args[4].to(DEVICE), v_out.to(DEVICE))
    assert all(v.isfinite().all() for v in got)
    assert_close(got, reference.harmonics_backward(*args, v_out), 1e-12)


@pytest.mark.parametrize(("n", "cameras"), [(0, 2), (5, 0), (0, 0)])
def test_nothing_to_evaluate(n: int, cameras: int) -> None:
    args = scene(2, n=n, cameras=cameras)
    for got, want in zip(run(args), expected(args), strict=True):
        assert got.shape == want.shape
        assert (got == 0).all()


def test_float32_is_as_good_as_float32_can_be() -> None:
    means, centers, coeffs, degree, mask = scene(4)
    args = (*(x.float().double() for x in (means, centers, coeffs)), degree, mask)
    got = run(args, torch.float32)
    assert all(x.dtype == torch.float32 for x in got)
    # 25 terms of degree 4 with factors up to 35: some ten eps = 6e-8; derivatives four times that
    assert_close(got, expected(args), 4e-6)


def test_layout_of_the_inputs_does_not_matter_and_sums_have_one_order() -> None:
    means, centers, coeffs, degree, mask = scene(2, n=40)
    inputs = [x.to(DEVICE) for x in (means, centers, coeffs, mask, upstream((means, centers, coeffs, degree, mask)))]
    results = []
    for means, centers, coeffs, mask, v_out in (inputs, inputs, [strided(x) for x in inputs]):
        results.append([harmonics(means, centers, coeffs, degree, mask), *harmonics_backward(means, centers, coeffs, degree, mask, v_out)])
    assert_same_bits(results[1], results[0])
    assert_same_bits(results[2], results[0])
