"""Spherical harmonics against their definition by Legendre functions."""

from __future__ import annotations

import importlib
import math

import numpy
import plain
import pytest
import scenes
import torch
import tsplat_reference as reference
from backends import Backend
from compare import assert_close, assert_same_bits, gradients, leaves, strided, threads
from torch import Tensor

from tsplat import ops

module = importlib.import_module("tsplat_reference.harmonics")               # the package has a function of that name
DEGREES = range(5)


def scene(degree: int, channels: int = 3, extra: int = 2) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Means, centres of two cameras, coefficients (`extra` more than used), and a mask."""
    g = scenes.generator(degree)
    means, centers = scenes.normal(40, 3, seed=g), scenes.normal(2, 3, seed=g)
    coeffs = scenes.normal(40, (degree + 1) ** 2 + extra, channels, seed=g)
    return means, centers, coeffs, scenes.uniform(0.0, 1.0, 2, 40, seed=g) < 0.8


def basis(directions: Tensor, degree: int) -> Tensor:
    """The basis `[n, (degree + 1)^2]`: colours of splats whose coefficients are the unit matrix."""
    n = len(directions)
    unit = torch.eye((degree + 1) ** 2, dtype=directions.dtype).expand(n, -1, -1)
    return reference.harmonics(directions, directions.new_zeros(1, 3), unit, degree, torch.ones(1, n, dtype=torch.bool))[0]


def test_the_basis_is_orthonormal() -> None:
    z, wz = (torch.from_numpy(v) for v in numpy.polynomial.legendre.leggauss(6))  # exact to degree 11 in z, 12 angles to m = 11
    phi = torch.arange(12, dtype=torch.float64) * (2 * math.pi / 12)
    z, phi = (v.flatten() for v in torch.meshgrid(z, phi, indexing="ij"))
    directions = torch.stack([(1 - z * z).sqrt() * phi.cos(), (1 - z * z).sqrt() * phi.sin(), z], -1)
    Y = basis(directions, 4)
    gram = torch.einsum("ni,nj,n->ij", Y, Y, wz.repeat_interleave(12) * (2 * math.pi / 12))
    assert_close(gram, torch.eye(25, dtype=torch.float64), 1e-14)


def test_the_constant_band_is_the_usual_number() -> None:
    assert basis(torch.tensor([[0.0, 0.6, 0.8]], dtype=torch.float64), 0).item() == 0.28209479177387814


@pytest.mark.parametrize("channels", [1, 3, 5])
@pytest.mark.parametrize("degree", DEGREES)
def test_values_and_gradients_match_the_definition(backend: Backend, degree: int, channels: int) -> None:
    *inputs, mask = scene(degree, channels)
    plain_inputs, inputs = leaves(*inputs), leaves(*backend.put(tuple(inputs)))
    want = torch.where(mask[..., None], plain.harmonics(*plain_inputs, degree), 0.0)
    got = ops.harmonics(*inputs, degree, backend.put(mask))
    assert_close(got, want, 1e-14)  # polynomials of degree <= 4 with factors up to 35
    assert_close(gradients([got], inputs), gradients([want], plain_inputs), 1e-13)


@pytest.mark.parametrize("degree", DEGREES)
def test_closed_form_backward_is_autograd_of_the_formula(degree: int) -> None:
    *inputs, mask = scene(degree)
    mask[0] |= ~mask[1]             # those that neither sees are left out, and another number of rows has another rounding
    inputs = leaves(*inputs)
    got, formula = ops.harmonics(*inputs, degree, mask), reference.harmonics(*inputs, degree, mask)
    assert_same_bits([got], [formula])
    assert_close(gradients([got], inputs), gradients([formula], inputs), 1e-14)


@pytest.mark.parametrize("degree", DEGREES)
def test_coefficients_beyond_the_degree_are_not_used(backend: Backend, degree: int) -> None:
    means, centers, coeffs, mask = backend.put(scene(degree))
    used = (degree + 1) ** 2
    inputs = leaves(means, centers, torch.cat([coeffs[:, :used], torch.full_like(coeffs[:, used:], math.nan)], 1))
    got = ops.harmonics(*inputs, degree, mask)
    assert_same_bits([got], [ops.harmonics(means, centers, coeffs[:, :used].contiguous(), degree, mask)])
    v_means, v_centers, v_coeffs = gradients([got], inputs)
    assert (v_coeffs[:, used:] == 0).all()
    assert v_means.isfinite().all()
    assert v_centers.isfinite().all()


def test_masked_pairs_give_nothing_and_take_no_gradient(backend: Backend) -> None:
    """Even where their numbers are not numbers."""
    means, centers, coeffs, mask = backend.put(scene(3))
    mask[:, 7] = False
    broken_means, broken_coeffs = means.clone(), coeffs.clone()
    broken_means[7], broken_coeffs[7] = math.nan, math.inf
    results = []
    for inputs in (leaves(means, centers, coeffs), leaves(broken_means, centers, broken_coeffs)):
        out = ops.harmonics(*inputs, 3, mask)
        v_means, v_centers, v_coeffs = gradients([out], inputs)
        assert (out[~mask] == 0).all()
        assert (v_means[7] == 0).all()
        assert (v_coeffs[7] == 0).all()
        results.append([out, v_means, v_centers, v_coeffs])
    assert_same_bits(*results)


def test_a_mean_at_the_camera_centre_is_seen_along_z_with_zero_gradient(backend: Backend) -> None:
    means, centers, coeffs, mask = backend.put(scene(4))
    means[3] = centers[0]
    mask[:, 3] = torch.tensor([True, False])
    inputs = leaves(means, centers, coeffs)
    got = ops.harmonics(*inputs, 4, mask)
    along_z = plain.harmonics_basis(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), 4)
    assert_close(got[0, 3], along_z @ coeffs[3, :25].cpu().double(), 1e-14)
    v_means, v_centers, v_coeffs = gradients([got[:, 3]], inputs)
    assert (v_means == 0).all()
    assert (v_centers == 0).all()
    assert (v_coeffs[3, :25] != 0).any()


@pytest.mark.parametrize("degree", [0, 3])
def test_chunks_change_nothing(monkeypatch: pytest.MonkeyPatch, degree: int) -> None:
    *inputs, mask = scene(degree)
    inputs = leaves(*inputs)
    whole = ops.harmonics(*inputs, degree, mask)
    v_whole = gradients([whole], inputs)
    monkeypatch.setattr(module, "CHUNK", 7)                                      # 40 splats: five chunks and a rest
    parts = ops.harmonics(*inputs, degree, mask)
    v_means, v_centers, v_coeffs = gradients([parts], inputs)
    # products of matrices of other sizes may round otherwise
    assert_close([parts, v_means, v_centers, v_coeffs], [whole, *v_whole], 1e-14)
    with threads(2):
        assert_same_bits(gradients([ops.harmonics(*inputs, degree, mask)], inputs), [v_means, v_centers, v_coeffs])


def test_float32_is_as_good_as_float32_can_be() -> None:
    *inputs, mask = scene(4)
    inputs32 = leaves(*(x.float() for x in inputs))
    inputs64 = leaves(*(x.double() for x in inputs32))
    got, want = ops.harmonics(*inputs32, 4, mask), ops.harmonics(*inputs64, 4, mask)
    assert got.dtype == torch.float32
    # 25 terms of degree 4 with factors up to 35: some ten eps = 6e-8; derivatives four times that
    assert_close(got, want, 1e-6)
    assert_close(gradients([got], inputs32), gradients([want], inputs64), 4e-6)


def test_differentiable_twice_after_a_first_use_in_inference_mode() -> None:
    """Nothing that is made in inference mode may stay behind: autograd could not save it."""
    *inputs, mask = scene(1)
    inputs = leaves(*inputs)
    cached = [f for f in vars(module).values() if hasattr(f, "cache_clear")]
    for f in cached:
        f.cache_clear()
    try:
        with torch.inference_mode():
            reference.harmonics(*inputs, 1, mask)
        first = gradients([ops.harmonics(*inputs, 1, mask)], inputs, create_graph=True)
        assert all(v.isfinite().all() for v in gradients(first, inputs))
    finally:
        for f in cached:
            f.cache_clear()


def test_layout_of_the_inputs_does_not_matter(backend: Backend) -> None:
    *inputs, mask = backend.put(scene(2))
    inputs = leaves(*inputs)
    want = ops.harmonics(*inputs, 2, mask)
    got = ops.harmonics(*(strided(x) for x in inputs), 2, strided(mask))
    assert_close([got, *gradients([got], inputs)], [want, *gradients([want], inputs)], 1e-15)
