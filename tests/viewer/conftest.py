"""Shared by the tests of the viewer: scenes of a few splats, and a way to wait that says for what it waited."""

import time
from collections.abc import Callable

import pytest
import torch

from tsplat import Camera
from tsplat.scene import Gaussians, Spheres

PATIENCE = 60.0             # seconds; a slow machine must not fail, and what never comes must not hang


@pytest.fixture
def gaussians() -> Gaussians:
    """200 in the cube around the origin, of degree 2, large and rather opaque."""
    g = torch.Generator().manual_seed(1)
    scene = Gaussians.random(200, sh_degree=2, generator=g)
    torch.nn.init.normal_(scene.sh_rest, std=0.3, generator=g)
    torch.nn.init.constant_(scene.opacity_logits, 2.0)
    return scene


@pytest.fixture
def spheres() -> Spheres:
    """50 in that cube, of 3 channels."""
    g = torch.Generator().manual_seed(2)
    return Spheres.from_points(2 * torch.rand(50, 3, generator=g) - 1, torch.rand(50, 3, generator=g), near=1.0, far=6.0)


@pytest.fixture
def camera() -> Camera:
    """Looks at the origin, up being -y."""
    return Camera.look_at((0.5, -1.0, -3.0), (0.0, 0.0, 0.0), width=48, height=32)


@pytest.fixture(scope="session")
def wait() -> Callable[..., None]:
    """A function that returns as soon as a condition holds."""

    def until(condition: Callable[[], object], what: str, pause: Callable[[float], None] = time.sleep) -> None:
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end, f"waited {PATIENCE:.0f} s for {what}"
            pause(0.01)

    return until
