"""Lenses: kornia's formulas against those of OpenCV's manual, sizes, and photos made straight again."""

import math
from pathlib import Path

import pytest
import torch

from tsplat.scene import Lens, Photo, write_image
from tsplat.scene.images import load_photo
from tsplat.scene.lens import undistortion_grid

OPENCV = (0.06, -0.08, -0.001, 0.0015, 0.02, 0.01, -0.02, 0.003)
FISHEYE = (0.03, -0.01, 0.004, -0.002)


def test_opencv_formula() -> None:
    lens = Lens(270, 480, 343.0, 341.0, 138.0, 241.0, OPENCV)
    rays = torch.rand(50, 2, dtype=torch.float64) * 1.4 - 0.7
    (x, y), (k1, k2, p1, p2, k3, k4, k5, k6) = rays.unbind(1), OPENCV
    r2 = x**2 + y**2
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    expected = torch.stack([343 * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)) + 138,
                            341 * (y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y) + 241], 1)
    torch.testing.assert_close(lens.project(rays), expected)


def test_fisheye_formula() -> None:
    lens = Lens(640, 480, 300.0, 310.0, 321.0, 239.0, FISHEYE, fisheye=True)
    rays = torch.rand(50, 2, dtype=torch.float64) * 4 - 2
    r, (k1, k2, k3, k4) = rays.norm(dim=1, keepdim=True), FISHEYE
    angle = r.atan()
    bent = angle * (1 + k1 * angle**2 + k2 * angle**4 + k3 * angle**6 + k4 * angle**8)
    torch.testing.assert_close(lens.project(rays), rays * bent / r * torch.tensor([300.0, 310.0]) + torch.tensor([321.0, 239.0]))
    torch.testing.assert_close(lens.project(torch.zeros(1, 2)), torch.tensor([[321.0, 239.0]]))


def test_from_names() -> None:
    assert Lens.of(8, 6, {"f": 5, "cx": 4, "cy": 3}) == Lens(8, 6, 5, 5, 4, 3)
    assert Lens.of(8, 6, {"fx": 5, "cx": 4, "cy": 3, "k1": 0.0}) == Lens(8, 6, 5, 5, 4, 3)
    assert Lens.of(8, 6, {"f": 5, "cx": 4, "cy": 3, "k3": 1, "p1": 2}).distortion == (0, 0, 2, 0, 1, 0, 0, 0)
    assert Lens.of(8, 6, {"f": 5, "cx": 4, "cy": 3, "k3": 1}, fisheye=True).distortion == (0, 0, 1, 0)
    assert Lens(8, 6, 5, 5, 4, 3, fisheye=True).distorted


def test_sizes() -> None:
    lens = Lens(1500, 996, 2604.0, 2600.0, 750.5, 499.0)
    small = lens.resized(375, 249)
    assert (small.fx, small.fy, small.cx, small.cy) == (651.0, 650.0, 187.625, 124.75)
    assert lens.fits(375, 249)
    assert lens.fits(500, 332)
    assert lens.fits(214, 142)
    assert lens.fits(3000, 1992)
    assert not lens.fits(996, 1500)
    assert not lens.fits(1500, 1000)


@pytest.mark.parametrize(("distortion", "fisheye", "zooms"), [
    ((-0.1, 0.01, 0, 0, 0, 0, 0, 0), False, False),         # barrel: what is left is inside
    ((0.1, 0.0, 0.001, 0, 0, 0, 0, 0), False, True),        # pincushion: looks beyond the photo
    ((), True, False),
])
def test_nothing_outside_the_photo(distortion: tuple[float, ...], fisheye: bool, zooms: bool) -> None:
    lens = Lens(120, 80, 90.0, 90.0, 61.0, 39.0, distortion, fisheye)
    straight = lens.undistorted()
    assert not straight.distorted
    assert (straight.fx > lens.fx) == zooms
    assert straight.fx == straight.fy
    assert (straight.width, straight.height, straight.cx, straight.cy) == (120, 80, 61.0, 39.0)
    assert undistortion_grid(lens).abs().max() <= 1.001


def test_impossible_distortion() -> None:
    with pytest.raises(ValueError, match="cannot be undone"):
        Lens(120, 80, 20.0, 20.0, 60.0, 40.0, (5.0, 0, 0, 0, 0, 0, 0, 0)).undistorted()


def pattern(rays: torch.Tensor) -> torch.Tensor:
    """A smooth colour for each direction."""
    x, y = rays.unbind(-1)
    return 0.5 + 0.4 * torch.stack([torch.sin(9 * x + 3 * y), torch.cos(8 * y), torch.sin(5 * x * y)], -1)


@pytest.mark.parametrize("lens", [Lens(160, 120, 100.0, 101.0, 82.0, 59.0, (-0.12, 0.02, 0.002, -0.001, 0, 0, 0, 0)),
                                  Lens(160, 120, 100.0, 101.0, 82.0, 59.0, (0.08, 0.01, 0.002, -0.001, 0, 0, 0, 0)),
                                  Lens(160, 120, 70.0, 70.0, 80.0, 60.0, fisheye=True)])
def test_photo_made_straight(tmp_path: Path, lens: Lens) -> None:
    def pixel_rays(of: Lens) -> torch.Tensor:
        y, x = torch.meshgrid(torch.arange(of.height) + 0.5, torch.arange(of.width) + 0.5, indexing="ij")
        return torch.stack([(x - of.cx) / of.fx, (y - of.cy) / of.fy], -1).double()

    if lens.fisheye:
        bent = pixel_rays(lens)
        angle = bent.norm(dim=-1, keepdim=True)
        rays = bent * angle.clamp(max=math.pi / 2 - 0.1).tan() / angle
    else:                                                           # a fixed point: the distortion is slight
        target, rays = pixel_rays(lens), pixel_rays(lens)
        scale = torch.tensor([lens.fx, lens.fy]).double()
        for _ in range(50):
            rays = rays + target - (lens.project(rays) - torch.tensor([lens.cx, lens.cy])) / scale
    write_image(tmp_path / "bent.png", pattern(rays))
    straight = load_photo(Photo(tmp_path / "bent.png", 160, 120, lens)) / 255
    error = (straight - pattern(pixel_rays(lens.undistorted()))).abs()
    assert error.max() < 0.03
    assert error.mean() < 0.004
