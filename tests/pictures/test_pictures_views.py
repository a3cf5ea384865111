"""Circles around scenes, and paths through cameras."""

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tsplat.camera import Camera
from tsplat.pictures import capture_path, orbit
from tsplat.pictures.spline import Poses, round_trip, spline
from tsplat.scene import Capture, Gaussians, Spheres, load_capture, synthetic_cameras, write_synthetic_capture


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """12 photos in a ring around the scene, by turns from higher and from lower."""
    return load_capture(write_synthetic_capture(tmp_path_factory.mktemp("capture"), views=12, size=(16, 12)), test_every=0)


def eyes(cameras: list[Camera]) -> Tensor:
    viewmats = torch.stack([camera.viewmats for camera in cameras])
    return -(viewmats[:, :3, :3].mT @ viewmats[:, :3, 3:])[..., 0]


def ring(n: int) -> Poses:
    """Poses on a circle, which look at its centre."""
    cameras = [Camera.look_at((3 * math.cos(a), -1, 3 * math.sin(a)), (0, 0, 0), width=8, height=6, dtype=torch.float64)
               for a in (2 * math.pi * i / n for i in range(n))]
    return Poses.of(torch.stack([camera.viewmats for camera in cameras]))


def test_poses_and_back() -> None:
    viewmats = synthetic_cameras(5, 8, 6).viewmats.double()
    torch.testing.assert_close(Poses.of(viewmats).viewmats(), viewmats, atol=1e-6, rtol=0)       # these come from float32


def test_a_spline_goes_through_its_keys_and_reproduces_a_screw() -> None:
    """Even steps along a line and about an axis, to rounding: all that is mixed is between two of its poses."""
    at = torch.arange(5, dtype=torch.float64)

    def screw(t: Tensor) -> Poses:
        angle = 0.3 * t
        quats = torch.stack([angle.cos(), 0 * angle, 0.6 * angle.sin(), 0.8 * angle.sin()], 1)
        return Poses(torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64) + t[:, None] * torch.tensor([0.5, -0.25, 1.0], dtype=torch.float64), quats)

    path = spline(screw(at), 17, 2.0, closed=False)
    expected = screw(torch.arange(17, dtype=torch.float64) / 4)
    torch.testing.assert_close(path.eyes, expected.eyes, atol=1e-12, rtol=0)
    torch.testing.assert_close((path.quats * expected.quats).sum(1).abs(), torch.ones(17, dtype=torch.float64), atol=1e-12, rtol=0)


def test_a_closed_spline_goes_round_evenly() -> None:
    """On keys of a circle it is the circle, to the fourth order, in even steps, the last to the first included."""
    errors = [float((spline(ring(n), 10 * n, 3.0, closed=True).eyes[:, [0, 2]].norm(dim=1) - 3).abs().max()) for n in (12, 24, 48)]
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(16, rel=0.1)
    path = spline(ring(24), 100, 3.0, closed=True)
    steps = path.distance(path.at((torch.arange(100) + 1) % 100), 3.0)
    assert float(steps.max() / steps.min()) < 1.001
    towards = path.viewmats()[:, 2, :3]                                                 # the direction of view
    centre = torch.nn.functional.normalize(-path.eyes, dim=1)
    assert float((towards * centre).sum(1).min()) > math.cos(1e-3)


def test_keys_that_are_unevenly_spread_or_equal() -> None:
    places = torch.tensor([0.0, 0.01, 1.0, 1.0, 5.0], dtype=torch.float64)
    keys = Poses(torch.stack([places, 0 * places, 0 * places], 1), torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).repeat(5, 1))
    path = spline(keys, 200, 1.0, closed=False)
    x = path.eyes[:, 0]
    assert x[0] == pytest.approx(0, abs=1e-9)
    assert x[-1] == pytest.approx(5, abs=1e-9)
    assert (x.diff() >= -1e-6).all()                                                    # no step back
    assert float(x.diff().max()) < 1.1 * 5 / 199
    one = spline(keys.at(torch.tensor([2])), 3, 1.0, closed=True)
    assert torch.equal(one.eyes, keys.eyes[[2, 2, 2]])


@pytest.mark.parametrize("closed", [False, True])
def test_a_round_trip_is_found_in_a_shuffled_circle(closed: bool) -> None:
    n = 30
    shuffled = torch.randperm(n, generator=torch.Generator().manual_seed(3))
    poses = ring(n).at(shuffled)
    table = Poses(poses.eyes[:, None], poses.quats[:, None]).distance(poses, 3.0)
    order = round_trip(table, closed=closed)
    assert sorted(order.tolist()) == list(range(n))
    steps = shuffled[order].diff().abs()
    assert set(steps.tolist()) <= {1, n - 1}                                            # always to a neighbour
    assert not closed or order[0] == 0


def test_a_path_that_was_walked_keeps_its_order() -> None:
    x = torch.arange(9, dtype=torch.float64)
    assert round_trip((x[:, None] - x).abs(), closed=False).tolist() == list(range(9))


def test_a_path_through_a_capture(capture: Capture) -> None:
    path = capture_path(capture, 600)
    assert len(path) == 600
    assert {(camera.width, camera.height) for camera in path} == {(16, 12)}
    assert all(torch.equal(camera.Ks, capture.Ks[0]) for camera in path)
    at, keys = eyes(path), eyes([capture.camera(i) for i in range(12)])
    step = (at[1:] - at[:-1]).norm(dim=1)
    nearest = torch.cdist(keys, at).amin(1)
    assert float(nearest.max()) < float(step.max())                                     # it goes by each photo's place
    assert float(step.max()) < 1.5 * float(step.mean())
    centre = torch.tensor([0.0, -0.35, 0.0])                                            # what all photos look at
    views = torch.stack([camera.viewmats[2, :3] for camera in path])
    assert float((views * torch.nn.functional.normalize(centre - at, dim=1)).sum(1).min()) > math.cos(0.1)


def test_a_short_path_takes_every_other_photo(capture: Capture) -> None:
    """6 of 12 for 90 frames: those from lower only, so that the height does not change."""
    at = eyes(capture_path(capture, 90, closed=True))
    assert float(at[:, 1].max() - at[:, 1].min()) < 0.02
    gap = (at[0] - at[-1]).norm() / (at[1:] - at[:-1]).norm(dim=1).mean()
    assert float(gap) == pytest.approx(1, abs=0.1)


def test_a_path_keeps_to_photos_to_train_on(capture: Capture) -> None:
    capture = Capture(**{**vars(capture), "train": [0, 2], "test": list(range(3, 12))})
    at = eyes(capture_path(capture, 5))
    torch.testing.assert_close(at[[0, -1]], eyes([capture.camera(0), capture.camera(2)]), atol=1e-5, rtol=0)      # float32 at 3, through an inverse
    with pytest.raises(ValueError, match="^frames: expected at least 1; got 0"):
        capture_path(capture, 0)
    alone = Capture(**{**vars(capture), "train": [7], "test": []})
    assert all(torch.allclose(camera.viewmats, capture.viewmats[7], atol=1e-6) for camera in capture_path(alone, 3))


def test_paths_through_real_captures(shared: Path) -> None:
    """Hand-held, and from all around: no jump, no turn of the camera in one step that the photos do not have."""
    for name, frames in (("fox", 240), ("banana", 120)):
        capture = load_capture(shared / "data" / name, downscale=2, test_every=0)
        poses = Poses.of(torch.stack([camera.viewmats for camera in capture_path(capture, frames)]))
        steps = poses.at(torch.arange(frames - 1)).distance(poses.at(torch.arange(1, frames)), capture.extent)
        assert float(steps.max()) < 1.1 * float(steps.mean())


def test_an_orbit_frames_gaussians_and_spheres() -> None:
    centre = torch.tensor([1.0, 2.0, 3.0])
    points = centre + torch.randn(500, 3, generator=torch.Generator().manual_seed(0))
    for scene in (Gaussians.from_points(points), Spheres.from_points(points)):
        cameras = orbit(scene, 6, width=90, height=60, fov=40)
        assert len(cameras) == 6
        distances = (eyes(cameras) - centre).norm(dim=1)
        assert float(distances.max() / distances.min()) < 1.1
        for camera in cameras:
            x, y, z = ((camera.viewmats[:3, :3] @ points.T).T + camera.viewmats[:3, 3]).unbind(1)
            inside = ((x / z * camera.Ks[0, 0]).abs() < 45) & ((y / z * camera.Ks[1, 1]).abs() < 30)
            assert inside.float().mean() > 0.9
    for arguments, message in (({"frames": 0}, "^frames: expected at least 1; got 0"), ({"fov": 180.0}, "^fov: expected")):
        with pytest.raises(ValueError, match=message):
            orbit(scene, **{"frames": 2, "width": 9, "height": 9, **arguments})
