"""Cameras of web pages and of the library are the same."""

import math

import pytest
import torch

from tsplat import Camera
from tsplat.scene import Capture, Gaussians
from tsplat.viewer import Views
from tsplat.viewer.viewpoint import Viewpoint, stance

UP = torch.tensor([0.0, -1.0, 0.0])
F32 = 2e-6           # some roundings of numbers up to 5


def seen_from(place: tuple[float, ...], look_at: tuple[float, ...], up: tuple[float, ...]) -> torch.Tensor:
    """The view matrix of a page that was told to stand there."""
    return Camera.look_at(place, look_at, up, width=4, height=4).viewmats


def test_a_quaternion_turns_the_camera_to_the_world() -> None:
    s = math.sqrt(0.5)
    camera = Viewpoint((s, 0.0, s, 0.0), (1.0, 2.0, 3.0), math.pi / 2, 40, 30).camera()          # by 90 degrees about y: z becomes x
    want = torch.tensor([[0.0, 0.0, -1.0, 3.0], [0.0, 1.0, 0.0, -2.0], [1.0, 0.0, 0.0, -1.0], [0.0, 0.0, 0.0, 1.0]])
    torch.testing.assert_close(camera.viewmats, want, rtol=0, atol=F32)
    torch.testing.assert_close(camera.Ks, torch.tensor([[15.0, 0.0, 20.0], [0.0, 15.0, 15.0], [0.0, 0.0, 1.0]]))     # 45 degrees up and down
    assert (camera.width, camera.height) == (40, 30)


def test_a_coarse_camera_sees_the_same() -> None:
    viewpoint = Viewpoint((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.8, 50, 3)
    camera, fine = viewpoint.camera(8), viewpoint.camera()
    assert (camera.width, camera.height) == (6, 1)
    scale = torch.tensor([[6 / 50], [1 / 3], [1.0]])
    torch.testing.assert_close(camera.Ks, fine.Ks * scale)


def test_a_stance_shows_what_the_camera_sees() -> None:
    camera = Camera.look_at((1.0, -2.0, -4.0), (0.5, 0.0, 0.2), width=60, height=40, fov=70)
    there = stance(camera, torch.tensor([0.5, 0.0, 0.2]), UP)
    torch.testing.assert_close(seen_from(*there[:3]), camera.viewmats, rtol=0, atol=F32)
    assert there.up == pytest.approx((0.0, -1.0, 0.0), abs=F32)                                 # and up stays up
    assert there.look_at == pytest.approx((0.5, 0.0, 0.2), abs=F32)
    height = 2 * float(camera.Ks[1, 1]) * math.tan(there.fov / 2)
    assert height == pytest.approx(40, rel=F32)
    wide, narrow = (stance(camera, torch.zeros(3), UP, aspect=aspect).fov for aspect in (3.0, 0.5))
    assert wide == there.fov
    assert math.tan(narrow / 2) * 0.5 == pytest.approx(math.tan(math.radians(35)))              # all of the width


@pytest.mark.parametrize("degrees", [20.0, 90.0, 180.0])
def test_a_camera_turned_about_its_axis(degrees: float) -> None:
    level = Camera.look_at((1.0, -2.0, -4.0), (0.0, 0.0, 0.0), width=60, height=40)
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    roll = torch.tensor([[c, -s, 0.0, 0.0], [s, c, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    camera = Camera(roll @ level.viewmats, level.Ks, 60, 40)
    torch.testing.assert_close(seen_from(*stance(camera, torch.zeros(3), UP)[:3]), camera.viewmats, rtol=0, atol=F32)


@pytest.mark.parametrize("middle", [(0.0, 0.0, -9.0), (0.0, 0.0, -3.0)])
def test_the_camera_turns_around_a_point_in_front_of_it(middle: tuple[float, ...]) -> None:
    camera = Camera.look_at((0.0, 0.0, -3.0), (0.0, 0.0, 0.0), width=4, height=4)
    assert stance(camera, torch.tensor(middle), UP).look_at[2] > -3.0


def test_views_of_a_capture(capture: Capture) -> None:
    views = Views.of_capture(capture)
    assert list(views.photos) == capture.names
    assert torch.equal(views.photos[capture.names[3]].viewmats, capture.viewmats[3])
    assert torch.equal(views.start.viewmats, capture.viewmats[0])
    assert (capture.viewmats[:, 1, :3] @ views.up < 0).all()                                     # down in each photo
    assert Views.of_capture(capture, (0.0, 0.0, 1.0)).up.tolist() == [0.0, 0.0, 1.0]


def test_views_of_a_scene() -> None:
    scene = Gaussians.from_points(torch.tensor([[1.0, 2.0, 3.0], [1.0, 2.0, 3.0]]))
    with torch.no_grad():
        scene.means[1] = math.nan
    views = Views.of_scene(scene, (0.0, 0.0, 1.0))
    assert views.middle.tolist() == [1.0, 2.0, 3.0]
    there = views.start.viewmats[:3, :3] @ views.middle + views.start.viewmats[:3, 3]
    assert there[:2].abs().max() < 1e-5                                                          # in the middle of the picture
    assert views.start.viewmats[1, 2] < 0                                                        # z, which is up, is not down
    assert Views.of_scene(Gaussians.random(0), (0.0, -1.0, 0.0)).middle.tolist() == [0.0, 0.0, 0.0]
