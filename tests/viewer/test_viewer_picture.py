"""What the viewer draws is what the library renders."""

import numpy as np
import pytest
import torch
from torch import Tensor

from tsplat import Camera, rasterize
from tsplat.scene import Gaussians, Spheres
from tsplat.viewer import Settings, picture
from tsplat.viewer.picture import DEPTH_COLORS, Pixels

WHITE = (1.0, 1.0, 1.0)


def pixels(image: Tensor) -> Pixels:
    return (255 * image.detach().clamp(0, 1)).round().to(torch.uint8).numpy()


@pytest.mark.parametrize(("size", "degree", "antialiased"), [(1.0, None, False), (0.4, 2, True), (1.7, 0, False)])
def test_gaussians(gaussians: Gaussians, camera: Camera, size: float, degree: int | None, antialiased: bool) -> None:
    g = gaussians
    r = rasterize(g.means, g.quats, g.scales * size, g.opacities, g.sh, camera, sh_degree=2 if degree is None else degree,
                  background=torch.ones(3), antialiased=antialiased)
    got = picture(g, camera, Settings(splat_size=size, sh_degree=degree, background=WHITE, antialiased=antialiased))
    assert got.dtype == np.uint8
    assert (got == pixels(r.image)).all()
    assert len(np.unique(got)) > 50                                    # not one colour
    alpha = picture(g, camera, Settings("alpha", splat_size=size, background=WHITE, antialiased=antialiased))
    assert (alpha == pixels(r.alpha[..., None].expand(-1, -1, 3))).all()


def test_a_degree_that_the_scene_has_not(gaussians: Gaussians, camera: Camera) -> None:
    assert (picture(gaussians, camera, Settings(sh_degree=3)) == picture(gaussians, camera, Settings())).all()


def test_spheres(spheres: Spheres, camera: Camera) -> None:
    r = spheres.render(camera, background=torch.ones(3))
    assert (picture(spheres, camera, Settings(background=WHITE)) == pixels(r.image)).all()
    assert (picture(spheres, camera, Settings("alpha")) == pixels(r.alpha[..., None].expand(-1, -1, 3))).all()
    larger = Spheres(spheres.positions, (2 * spheres.radii).log(), spheres.opacity_logits, spheres.features, gamma=spheres.gamma,
                     near=spheres.near, far=spheres.far)
    a, b = picture(larger, camera, Settings()), picture(spheres, camera, Settings(splat_size=2.0))
    assert np.abs(a.astype(int) - b).max() <= 1                        # exp(log(2 r)) is not quite 2 r
    assert (a != picture(spheres, camera, Settings())).any()


@pytest.mark.parametrize("channels", [1, 2, 5])
def test_spheres_of_other_features(spheres: Spheres, camera: Camera, channels: int) -> None:
    columns = [0, 1, 2, 0, 1][:channels]
    other = Spheres(spheres.positions, spheres.log_radii, spheres.opacity_logits, spheres.features[:, columns], gamma=spheres.gamma,
                    near=spheres.near, far=spheres.far)
    want = picture(spheres, camera, Settings())
    assert (picture(other, camera, Settings()) == (want if channels == 5 else want[..., :1])).all()


@pytest.mark.parametrize("kind", ["gaussians", "spheres"])
def test_depth_is_light_near_and_dark_far_over_the_background(kind: str, camera: Camera) -> None:
    centres = torch.tensor([[-0.6, 0.0, 0.0], [0.6, 0.0, 2.0]])
    scene: Gaussians | Spheres
    if kind == "spheres":
        scene = Spheres.from_points(centres, opacity=0.99, gamma=1e-3, near=0.5, far=9.0)
        torch.nn.init.constant_(scene.log_radii, -2.5)
    else:
        scene = Gaussians.from_points(centres, opacity=0.99)
        torch.nn.init.constant_(scene.log_scales, -2.5)
    camera = Camera.look_at((0.0, 0.0, -3.0), (0.0, 0.0, 0.0), width=240, height=160)
    got = picture(scene, camera, Settings("depth", background=(0.0, 1.0, 0.0))).astype(int)
    scale = camera.Ks[0, 0]
    (xa, xb) = (int(120 + scale * x / z) for x, z in ((-0.6, 3.0), (0.6, 5.0)))
    ends = (255 * DEPTH_COLORS[[0, -1]]).round().int().numpy()
    assert np.abs(got[80, xa] - ends[0]).max() <= 16                   # alpha is 0.99, and a sphere as deep as 4% of the range
    assert np.abs(got[80, xb] - ends[1]).max() <= 16
    assert (got[0, 0] == [0, 255, 0]).all()
    nothing = picture(Gaussians.random(0), camera, Settings("depth", background=WHITE))
    assert (nothing == 255).all()


def test_it_leaves_no_traces(gaussians: Gaussians, camera: Camera) -> None:
    before, state = [p.detach().clone() for p in gaussians.parameters()], torch.get_rng_state()
    picture(gaussians, camera, Settings("depth"))
    assert torch.is_grad_enabled()
    assert torch.equal(torch.get_rng_state(), state)
    for p, old in zip(gaussians.parameters(), before, strict=True):
        assert torch.equal(p, old)
        assert p.requires_grad
        assert p.grad is None


def test_errors() -> None:
    with pytest.raises(ValueError, match="mode: expected one of 'colour'.*got 'heat'"):
        Settings("heat")                # type: ignore[arg-type]
    with pytest.raises(ValueError, match="splat_size: expected above 0; got 0"):
        Settings(splat_size=0)
