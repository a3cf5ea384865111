"""What the viewer draws is what the library renders."""

import numpy as np
import pytest
import torch
from torch import Tensor

from tsplat import Camera, rasterize
from tsplat.pictures import MODES, Mode, draw_layers, picture
from tsplat.scene import Gaussians, Spheres
from tsplat.viewer import Settings, draw_view
from tsplat.viewer.view import Pixels

WHITE = (1.0, 1.0, 1.0)


def pixels(image: Tensor) -> Pixels:
    return (255 * image.detach().clamp(0, 1)).round().to(torch.uint8).numpy()


def off_by_rounding(a: Pixels, b: Pixels) -> bool:
    """The same but where a sum in another order is rounded to the next of 256 levels: in one number of 500, at most."""
    off = np.abs(a.astype(int) - b)
    return bool(off.max() <= 1 and (off > 0).mean() < 2e-3)


@pytest.mark.parametrize(("size", "degree", "antialiased"), [(1.0, None, False), (0.4, 2, True), (1.7, 0, False)])
def test_gaussians(gaussians: Gaussians, camera: Camera, size: float, degree: int | None, antialiased: bool) -> None:
    g = gaussians
    r = rasterize(g.means, g.quats, g.scales * size, g.opacities, g.sh, camera, sh_degree=2 if degree is None else degree,
                  background=torch.ones(3), antialiased=antialiased)
    got = draw_view(g, camera, Settings(splat_size=size, sh_degree=degree, background=WHITE, antialiased=antialiased))
    assert got.dtype == np.uint8
    assert off_by_rounding(got, pixels(r.image))
    assert len(np.unique(got)) > 50                                    # not one colour
    alpha = draw_view(g, camera, Settings("alpha", splat_size=size, background=WHITE, antialiased=antialiased))
    assert off_by_rounding(alpha, pixels(r.alpha[..., None].expand(-1, -1, 3)))


def test_a_degree_that_the_scene_has_not(gaussians: Gaussians, camera: Camera) -> None:
    assert (draw_view(gaussians, camera, Settings(sh_degree=3)) == draw_view(gaussians, camera, Settings())).all()


def test_spheres(spheres: Spheres, camera: Camera) -> None:
    r = spheres.render(camera, background=torch.ones(3))
    assert off_by_rounding(draw_view(spheres, camera, Settings(background=WHITE)), pixels(r.image))
    assert (draw_view(spheres, camera, Settings("alpha")) == pixels(r.alpha[..., None].expand(-1, -1, 3))).all()
    larger = Spheres(spheres.positions, (2 * spheres.radii).log(), spheres.opacity_logits, spheres.features, gamma=spheres.gamma,
                     near=spheres.near, far=spheres.far)
    a, b = draw_view(larger, camera, Settings()), draw_view(spheres, camera, Settings(splat_size=2.0))
    assert off_by_rounding(a, b)
    assert (a != draw_view(spheres, camera, Settings())).any()


@pytest.mark.parametrize("mode", ["depth", "normals"])
@pytest.mark.parametrize("kind", ["gaussians", "spheres"])
def test_modes(kind: str, mode: Mode, camera: Camera, request: pytest.FixtureRequest) -> None:
    scene = request.getfixturevalue(kind)
    want = picture(draw_layers(scene, camera), camera, mode, background=torch.tensor([0.0, 1.0, 0.0]))
    got = draw_view(scene, camera, Settings(mode, background=(0.0, 1.0, 0.0)))
    assert (got == pixels(want)).all()
    assert len(np.unique(got)) > 50


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
@pytest.mark.parametrize("mode", MODES)
def test_on_a_gpu(mode: Mode, gaussians: Gaussians, camera: Camera) -> None:
    here = draw_view(gaussians, camera, Settings(mode))
    there = draw_view(gaussians.to("cuda"), camera, Settings(mode))
    assert np.abs(here.astype(int) - there).mean() < 0.1                # of 255: float32 in another order; a normal at an edge may be another


def test_it_leaves_no_traces(gaussians: Gaussians, camera: Camera) -> None:
    before, state = [p.detach().clone() for p in gaussians.parameters()], torch.get_rng_state()
    draw_view(gaussians, camera, Settings("depth"))
    assert torch.is_grad_enabled()
    assert torch.equal(torch.get_rng_state(), state)
    for p, old in zip(gaussians.parameters(), before, strict=True):
        assert torch.equal(p, old)
        assert p.requires_grad
        assert p.grad is None


def test_errors() -> None:
    with pytest.raises(ValueError, match="mode: expected one of 'color'.*got 'heat'"):
        Settings("heat")                # type: ignore[arg-type]
    with pytest.raises(ValueError, match="splat_size: expected above 0; got 0"):
        Settings(splat_size=0)
