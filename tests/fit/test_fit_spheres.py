"""What fits of spheres are made of: gamma's course, what to drop, and splitting."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch

from tsplat import Camera, render_spheres
from tsplat.fit.spheres import gamma_at, refine, visibility, worth_keeping

PLANES = {"near": 1.0, "far": 5.0}


def test_gamma_falls_log_linearly_between_its_ends() -> None:
    gammas = [gamma_at(step, 5, 0.1, 1e-3) for step in range(5)]
    assert gammas[0] == pytest.approx(0.1, rel=1e-12)
    assert gammas[-1] == pytest.approx(1e-3, rel=1e-12)
    ratios = [b / a for a, b in pairwise(gammas)]
    assert ratios == pytest.approx([ratios[0]] * 4, rel=1e-12)
    assert gamma_at(0, 1, 0.5, 0.1) == 0.5
    assert gamma_at(2, 3, 1.0, 1e-5) >= 1e-5                                            # what render_spheres takes, in spite of rounding


@pytest.mark.parametrize(("arguments", "name"), [((5, 5), "step"), ((-1, 5), "step"), ((0, 0), "steps"), ((0, 5, 2.0), "first"),
                                                 ((0, 5, 0.1, 0.0), "last"), ((0, 5, math.nan), "first")])
def test_gamma_of_bad_arguments(arguments: tuple[float, ...], name: str) -> None:
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        gamma_at(*arguments)                                                            # type: ignore[arg-type]


def test_refinement_is_a_face_centred_cubic_shell() -> None:
    positions, radii = torch.randn(4, 3, dtype=torch.float64), torch.rand(4, dtype=torch.float64) + 0.1
    children = refine(positions, radii)
    assert children.parents.tolist() == [i for i in range(4) for _ in range(12)]
    offsets = (children.positions - positions[children.parents]).view(4, 12, 3)
    rho = radii / (2 + math.sqrt(2))
    torch.testing.assert_close(children.radii.view(4, 12), (math.sqrt(2) * rho)[:, None].expand(4, 12), rtol=1e-12, atol=0)
    torch.testing.assert_close(offsets.norm(dim=2), 2 * rho[:, None].expand(4, 12), rtol=1e-12, atol=0)
    torch.testing.assert_close(offsets.sum(1), torch.zeros(4, 3, dtype=torch.float64), rtol=0, atol=1e-14)
    between = torch.cdist(offsets, offsets) / rho[:, None, None]                        # 4 neighbours touch each, where spheres have rho
    between += 100 * torch.eye(12, dtype=torch.float64)
    assert between.amin() == pytest.approx(2, rel=1e-6)
    assert ((between < 2 + 1e-6).sum(2) == 4).all()
    reach = offsets.norm(dim=2) + children.radii.view(4, 12)
    torch.testing.assert_close(reach, radii[:, None].expand(4, 12), rtol=1e-12, atol=0)


def test_refinement_leaves_no_gaps() -> None:
    """From the middle, one of the twelve is in the way in any direction."""
    children = refine(torch.zeros(1, 3), torch.ones(1))
    directions = torch.nn.functional.normalize(torch.randn(2000, 3), dim=1)
    along = directions @ children.positions.T                                           # [2000, 12]
    across = (children.positions.square().sum(1) - along.square()).clamp(min=0).sqrt()
    assert ((across < children.radii) & (along > 0)).any(1).all()


def test_refinement_scales_with_reach_and_takes_none() -> None:
    one, two = (refine(torch.zeros(1, 3), torch.ones(1), reach) for reach in (1.0, 2.0))
    torch.testing.assert_close(two.positions, 2 * one.positions)
    torch.testing.assert_close(two.radii, 2 * one.radii)
    assert refine(torch.zeros(0, 3), torch.zeros(0)).positions.shape == (0, 3)
    with pytest.raises(ValueError, match=r"^reach: expected a number above 0; got 0"):
        refine(torch.zeros(1, 3), torch.ones(1), 0.0)
    with pytest.raises(ValueError, match=r"^radii: expected shape \[2\]; got \[3\]"):
        refine(torch.zeros(2, 3), torch.ones(3))


def test_visibility_is_the_sum_of_weights() -> None:
    """Two cameras, one on either side: of three spheres in a row, the middle one is hidden, and one of no opacity or out of view has 0.

    To 1e-12: a logarithm of a weight is up to 1/gamma, here 1e3, and rounded to half an eps, 1.1e-13 of it, some few times.
    """
    f64 = torch.float64
    positions = torch.tensor([[0.0, 0, -0.5], [0, 0, 0], [0, 0, 0.5], [0, 0, 0], [50.0, 0, 0]], dtype=f64)
    radii, opacities = torch.tensor([0.4, 0.1, 0.4, 0.4, 0.4], dtype=f64), torch.tensor([1.0, 1, 1, 0, 1], dtype=f64)
    cameras = [Camera.look_at((0, 0, z), (0, 0, 0), width=16, height=12, dtype=f64) for z in (-3.0, 3.0)]
    weights = visibility(positions, radii, opacities, cameras, gamma=1e-3, **PLANES)
    assert weights[0] > 10
    torch.testing.assert_close(weights[0], weights[2], rtol=1e-12, atol=0)              # the set-up is the same from behind
    assert weights[1] < 1e-6
    assert weights[3:].tolist() == [0, 0]
    alpha = sum(render_spheres(positions, torch.ones(5, 1, dtype=f64), radii, camera, opacities=opacities, gamma=1e-3, **PLANES).alpha.sum()
                for camera in cameras)
    torch.testing.assert_close(weights.sum(), alpha, rtol=1e-12, atol=0)


def test_visibility_leaves_gradients_alone() -> None:
    positions = torch.zeros(1, 3, requires_grad=True)
    camera = Camera.look_at((0, 0, -3.0), (0, 0, 0), width=8, height=8)
    with torch.no_grad():
        weights = visibility(positions, torch.ones(1), torch.ones(1), [camera], gamma=0.1, **PLANES)
    assert not weights.requires_grad
    assert positions.grad is None


def test_what_is_worth_keeping() -> None:
    background = torch.tensor([0.0, 0.5, 1.0])
    colors = background + torch.tensor([[0.0, 0, 0], [0.05, -0.05, 0], [0, 0, -0.2], [0.5, 0, 0], [0.5, 0, 0]])
    weights = torch.tensor([9.0, 9, 9, 9, 0])
    assert worth_keeping(colors, background, weights).tolist() == [False, False, True, True, False]
    assert worth_keeping(colors, background, weights, color_distance=0.3).tolist() == [False, False, False, True, False]
    assert not worth_keeping(colors, background, weights, least_weight=9.0).any()
    with pytest.raises(ValueError, match=r"^weights: expected shape \[5\]; got \[4\]"):
        worth_keeping(colors, background, weights[:4])
    with pytest.raises(ValueError, match=r"^color_distance: expected a number of at least 0; got -1"):
        worth_keeping(colors, background, weights, color_distance=-1)
