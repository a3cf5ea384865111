"""From layers to pictures: colours, backgrounds, colour maps and their range."""

import pytest
import torch
from torch import Tensor

from tsplat.camera import Camera
from tsplat.pictures import MODES, Layers, camera_points, depth_range, draw_layers, normals, picture, viridis
from tsplat.scene import Gaussians, Spheres

VIEW = Camera.look_at((0, 0, -4), (0, 0, 0), width=24, height=16, fov=50)
ROUNDING = 1e-6             # 8 units in the last place of float32 at 1: a picture is a handful of operations on numbers up to 1
WHITE = torch.ones(3)


@pytest.fixture
def cloud() -> Gaussians:
    """50 coloured splats around the origin, half transparent."""
    splats = Gaussians.random(50, generator=torch.Generator().manual_seed(0))
    torch.nn.init.constant_(splats.opacity_logits, 0.5)
    return splats


def flat(depth: float, alpha: float = 1.0) -> Layers:
    return Layers(torch.full((16, 24, 3), 0.5 * alpha), torch.full((16, 24), alpha), torch.full((16, 24), depth))


def over(image: Tensor, background: Tensor) -> Tensor:
    """Of `[H, W, 4]`, the picture over a background."""
    return image[..., :3] * image[..., 3:] + (1 - image[..., 3:]) * background


def test_colors_are_those_of_the_renderer(cloud: Gaussians) -> None:
    for background in (torch.zeros(3), torch.tensor([0.2, 0.5, 0.9])):
        expected = cloud.render(VIEW, background=background).image.detach().clamp(0, 1)
        torch.testing.assert_close(picture(draw_layers(cloud, VIEW), VIEW, background=background), expected, atol=ROUNDING, rtol=0)


@pytest.mark.parametrize("mode", ["color", "depth", "normals"])
def test_transparent_pictures_look_the_same_over_a_background(cloud: Gaussians, mode: str) -> None:
    layers = draw_layers(cloud, VIEW)
    clear = picture(layers, VIEW, mode)
    assert clear.shape == (16, 24, 4)
    assert 0 < clear[..., 3].mean() < 1
    torch.testing.assert_close(over(clear, WHITE), picture(layers, VIEW, mode, background=WHITE), atol=ROUNDING, rtol=0)


def test_spheres_of_one_channel_are_grey() -> None:
    ball = Spheres(torch.zeros(1, 3), torch.zeros(1), torch.full((1,), 30.0), torch.full((1, 1), 0.25), gamma=1e-3, near=1.0, far=6.0)
    image = picture(draw_layers(ball, VIEW), VIEW, background=WHITE)
    torch.testing.assert_close(image[8, 12], torch.full((3,), 0.25), atol=ROUNDING, rtol=0)
    torch.testing.assert_close(image[0, 0], WHITE)
    two = Spheres(torch.zeros(1, 3), torch.zeros(1), torch.zeros(1), torch.zeros(1, 2))
    with pytest.raises(ValueError, match="^scene: expected spheres of 1 or 3 channels to picture; got 2"):
        draw_layers(two, VIEW)


def test_depth_goes_from_yellow_to_violet() -> None:
    for depth, x in ((1.0, 1.0), (2.0, 1.0), (3.0, 0.5), (4.0, 0.0), (9.0, 0.0)):
        image = picture(flat(depth), VIEW, "depth", background=WHITE, depth_range=(2.0, 4.0))
        torch.testing.assert_close(image[0, 0], viridis(torch.tensor(x)), atol=ROUNDING, rtol=0)
    half = picture(flat(2.0, 0.25), VIEW, "depth", background=WHITE, depth_range=(2.0, 4.0))
    torch.testing.assert_close(half[0, 0], 0.25 * viridis(torch.tensor(1.0)) + 0.75, atol=ROUNDING, rtol=0)
    with pytest.raises(ValueError, match="^depth_range: expected 0 <= near < far; got 2 and 2"):
        picture(flat(2.0), VIEW, "depth", depth_range=(2, 2))


def test_normals_are_red_to_the_right_green_up_and_blue_towards_the_camera() -> None:
    layers = flat(2.0)
    torch.testing.assert_close(picture(layers, VIEW, "normals", background=WHITE)[5, 5], torch.tensor([0.5, 0.5, 1.0]), atol=ROUNDING, rtol=0)
    columns = torch.arange(24.0).expand(16, 24)
    red, green, blue = picture(layers._replace(depth=2 + 0.1 * columns), VIEW, "normals", background=WHITE)[5, 5]   # the right side of a box
    assert red > 0.6
    assert green == pytest.approx(0.5, abs=1e-5)
    assert blue > 0.5
    rows = torch.arange(16.0)[:, None].expand(16, 24)
    red, green, blue = picture(layers._replace(depth=4 - 0.1 * rows), VIEW, "normals", background=WHITE)[5, 5]      # a floor, seen from above
    assert green > 0.6
    assert red == pytest.approx(0.5, abs=1e-5)


def test_where_alpha_is_small_there_is_the_background() -> None:
    thin = flat(2.0, 0.3)
    torch.testing.assert_close(picture(thin, VIEW, "normals", background=WHITE), torch.ones(16, 24, 3))
    nothing = Layers(torch.zeros(16, 24, 3), torch.zeros(16, 24), torch.zeros(16, 24))
    for mode in ("color", "depth", "normals"):
        assert torch.equal(picture(nothing, VIEW, mode, background=WHITE), torch.ones(16, 24, 3))
        assert (picture(nothing, VIEW, mode)[..., 3] == 0).all()


def test_alpha_is_grey() -> None:
    torch.testing.assert_close(picture(flat(2.0, 0.3), VIEW, "alpha"), torch.full((16, 24, 3), 0.3))


def test_one_range_for_a_clip_and_no_regard_to_a_few_strays() -> None:
    g = torch.Generator().manual_seed(0)
    splats = Gaussians.random(3000, generator=g)
    with torch.no_grad():
        splats.opacity_logits.fill_(4.0)
        splats.means[:3] = torch.tensor([[0.0, 0.0, -3.8], [0.3, 0.0, -3.8], [0.0, 0.2, -3.8]])      # right before the camera
        splats.log_scales[:3] = -6.0
    near, far = (Camera.look_at((0, 0, z), (0, 0, 0), width=240, height=160, fov=50) for z in (-4, -6))
    near_only, both = depth_range(splats, [near]), depth_range(splats, [near, far])
    assert 2.8 < near_only[0] < 3.3                                              # the cube's front is at 3, and its splats are not points
    assert both[0] == pytest.approx(near_only[0], rel=0.1)
    assert both[1] > near_only[1] + 1
    assert depth_range(Gaussians.random(0), [VIEW]) == (0.0, 1.0)


def test_a_flat_picture_has_one_color() -> None:
    """Though depths differ by their rounding."""
    layers = flat(3.0)
    assert layers.depth is not None
    noisy = layers.depth * (1 + 2e-7 * torch.randn(16, 24))
    image = picture(layers._replace(depth=noisy), VIEW, "depth", background=WHITE)
    assert float((image - image.mean((0, 1))).abs().max()) < 1 / 255


def test_viridis() -> None:
    pyplot = pytest.importorskip("matplotlib", reason="compares with its viridis: pip install 'tsplat[bench]'")
    x = torch.linspace(0, 1, 256, dtype=torch.float64)
    truth = torch.tensor(pyplot.colormaps["viridis"].colors, dtype=torch.float64)
    torch.testing.assert_close(viridis(x), truth, atol=4.4 / 255, rtol=0)          # how far off the fit is said to be


def test_viridis_gets_lighter_and_clamps() -> None:
    luminance = viridis(torch.linspace(0, 1, 100)) @ torch.tensor([0.2126, 0.7152, 0.0722])
    assert (luminance.diff() > 0).all()
    ends = viridis(torch.tensor([0.0, 1.0]))
    assert torch.equal(viridis(torch.tensor([-3.0, float("inf")])), ends)
    assert torch.equal(viridis(torch.tensor(float("nan"))), ends[0])


def test_errors(cloud: Gaussians) -> None:
    batch = Camera(VIEW.viewmats[None], VIEW.Ks[None], 24, 16)
    with pytest.raises(ValueError, match="^camera: expected one camera; got a batch of 1"):
        draw_layers(cloud, batch)
    layers = draw_layers(cloud, VIEW, depth=False)
    with pytest.raises(ValueError, match="^layers: expected depth for the mode 'normals'; got None"):
        picture(layers, VIEW, "normals")
    with pytest.raises(ValueError, match="^mode: expected"):
        picture(layers, VIEW, "colour")         # type: ignore[arg-type]
    with pytest.raises(ValueError, match="^background: expected shape"):
        picture(layers, VIEW, background=torch.ones(4))
    with pytest.raises(ValueError, match=r"^depth: expected shape \[16, 24\]; got \[3, 3\]"):
        normals(torch.ones(3, 3), torch.ones(3, 3, dtype=torch.bool), VIEW)
    with pytest.raises(ValueError, match="^camera: expected one camera; got a batch of 1"):
        camera_points(torch.ones(16, 24), batch)
    assert set(MODES) == {"color", "depth", "alpha", "normals"}
