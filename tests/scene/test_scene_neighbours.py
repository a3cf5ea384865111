"""Nearest neighbours: exact against all pairs, on clouds that are hard for trees and grids."""

import pytest
import torch

from tsplat.scene.neighbours import nearest_squared_distances

CLOUDS = {
    "uniform": lambda n, g: torch.rand(n, 3, generator=g),
    "outliers": lambda n, g: torch.randn(n, 3, generator=g) / torch.rand(n, 1, generator=g).clamp(min=1e-3),
    "line": lambda n, g: torch.rand(n, 1, generator=g) * torch.tensor([1.0, 2.0, 3.0]),
    "duplicates": lambda n, g: torch.rand(n, 3, generator=g)[torch.arange(n) // 3],
    "one place": lambda n, g: torch.ones(n, 3),
    "lattice": lambda n, g: torch.randint(0, 9, (n, 3), generator=g).float(),
}


@pytest.mark.parametrize("n", [1, 2, 3, 4, 31, 32, 33, 65, 1000, 3000])
@pytest.mark.parametrize("cloud", CLOUDS)
def test_exact(cloud: str, n: int) -> None:
    points = CLOUDS[cloud](n, torch.Generator().manual_seed(n)).double()
    everything = (points[:, None] - points[None]).square().sum(-1).fill_diagonal_(torch.inf)
    k = min(3, n - 1)
    expected = everything.topk(k, largest=False).values
    found = nearest_squared_distances(points, 3)
    assert found.shape == (n, k)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=0)


def test_empty() -> None:
    assert nearest_squared_distances(torch.zeros(0, 3), 3).shape == (0, 0)
