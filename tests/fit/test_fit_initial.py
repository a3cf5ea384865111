"""The splats that a fit starts from."""

from collections.abc import Callable

import pytest
import torch

from tsplat.fit import FitConfig
from tsplat.fit.initial import fill_up, initial_gaussians, view_cube
from tsplat.scene import Capture

Make = Callable[..., FitConfig]


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_points_stay_and_gaps_are_filled(capture: Capture, config: Make) -> None:
    splats = initial_gaussians(capture, config(splats=500, init_opacity=0.3), generator())
    assert len(splats) == 500
    assert capture.points is not None
    assert torch.equal(splats.means[:200], capture.points)
    torch.testing.assert_close(splats.opacities, torch.full((500,), 0.3))
    assert len(initial_gaussians(capture, config(splats=10), generator())) == 200
    assert initial_gaussians(capture, config(sh_degree=1), generator()).sh_degree == 1


def test_init_scale(capture: Capture, config: Make) -> None:
    once, twice = (initial_gaussians(capture, config(init_scale=s), generator()).scales for s in (1.0, 2.0))
    torch.testing.assert_close(twice, 2 * once)


def test_copies_are_near_their_points_and_of_their_colours() -> None:
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [100, 0, 0], [110, 0, 0], [100, 10, 0], [110, 10, 0]])
    colors = torch.linspace(0, 1, 24).view(8, 3)
    more, more_colors = fill_up(points, colors, 8 * 51, generator())
    assert more_colors is not None
    source = (more_colors[:, None] == colors).all(-1).int().argmax(1)                  # [n] by colour
    assert (source.bincount() == 51).all()                                            # all points get as many
    distance = (more - points[source]).norm(dim=1)
    assert 0.5 < distance[source < 4].median() < 2                                     # neighbours are 1 and 10 away
    assert 5 < distance[source >= 4].median() < 20


def test_copies_of_a_single_point_and_without_colours() -> None:
    more, colors = fill_up(torch.ones(1, 3), None, 5, generator())
    assert torch.equal(more, torch.ones(5, 3))
    assert colors is None


def test_same_seed_same_splats(capture: Capture, config: Make) -> None:
    first, again, other = (initial_gaussians(capture, config(splats=300), generator(s)).means for s in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_random_start_is_where_the_cameras_look(capture: Capture, config: Make) -> None:
    capture.points = None
    low, high = (torch.tensor(corner) for corner in view_cube(capture))
    torch.testing.assert_close((low + high) / 2, torch.tensor([0.0, -0.35, 0.0]), atol=1e-3, rtol=0)      # the target of all, but for the ridge
    assert 1 < (high - low)[0] / 2 < 2
    splats = initial_gaussians(capture, config(splats=100), generator())
    assert len(splats) == 100
    assert ((splats.means >= low) & (splats.means <= high)).all()


@pytest.mark.parametrize("count", [1, 3])
def test_cube_of_parallel_cameras(capture: Capture, count: int) -> None:
    capture.viewmats = torch.eye(4).repeat(count, 1, 1)
    capture.viewmats[:, 0, 3] = -torch.arange(count, dtype=torch.float32)
    capture.Ks, capture.width, capture.height = capture.Ks[:count], capture.width[:count], capture.height[:count]
    low, high = (torch.tensor(corner) for corner in view_cube(capture))
    assert (low < high).all()
    torch.testing.assert_close((low + high) / 2, torch.tensor([(count - 1) / 2, 0.0, capture.extent]), atol=1e-6, rtol=1e-6)     # float32
