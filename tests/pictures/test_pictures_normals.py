"""Normals and depth against surfaces whose normals are known."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from tsplat.camera import Camera
from tsplat.pictures import camera_points, draw_layers, normals
from tsplat.scene import Gaussians, Spheres, synthetic_scene

CENTRE, RADIUS = torch.tensor([0.1, -0.2, 4.0], dtype=torch.float64), 1.0


def camera(size: int = 40, model: Any = "pinhole") -> Camera:
    """At the origin, along z; the principal point is off the middle."""
    f = {"pinhole": 1.2, "orthographic": 0.4, "fisheye": 1.2}[model] * size
    K = torch.tensor([[f, 0, 0.45 * size], [0, 1.1 * f, 0.6 * size], [0, 0, 1]], dtype=torch.float64)
    return Camera(torch.eye(4, dtype=torch.float64), K, size, size, model=model)


def rays(view: Camera) -> Tensor:
    """`[H, W, 3]` points at depth 1."""
    return camera_points(torch.ones(view.height, view.width, dtype=torch.float64), view)


def sphere_depth(view: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Depth, where it means something, and the true normals, of a sphere."""
    d = rays(view)
    a, b, c = d.square().sum(-1), (d @ CENTRE), CENTRE.square().sum() - RADIUS**2
    disc = b * b - a * c
    depth = ((b - disc.clamp(min=0).sqrt()) / a)
    return depth, disc > 0, normalize(d * depth[..., None] - CENTRE, dim=-1)


@pytest.mark.parametrize("model", ["pinhole", "orthographic", "fisheye"])
def test_points_are_where_the_camera_sees_them(model: str) -> None:
    view = camera(model=model)
    depth = 1 + torch.rand(40, 40, dtype=torch.float64)
    points = camera_points(depth, view)
    x, y, z = points.unbind(-1)
    if model == "pinhole":
        x, y = x / z, y / z
    elif model == "fisheye":
        radius = (x * x + y * y).sqrt()
        x, y = (v / radius * torch.atan2(radius, z) for v in (x, y))
    columns, rows = x * view.Ks[0, 0] + view.Ks[0, 2], y * view.Ks[1, 1] + view.Ks[1, 2]
    at = torch.arange(40, dtype=torch.float64) + 0.5
    torch.testing.assert_close(z, depth)
    torch.testing.assert_close(columns, at.expand(40, 40), atol=1e-11, rtol=0)          # rounding of float64 at 40
    torch.testing.assert_close(rows, at[:, None].expand(40, 40), atol=1e-11, rtol=0)


@pytest.mark.parametrize("model", ["pinhole", "orthographic", "fisheye"])
def test_a_plane_has_one_normal(model: str) -> None:
    """Differences of points in a plane lie in it: exact, at the border of the picture, too."""
    view, normal = camera(model=model), normalize(torch.tensor([0.4, -0.3, -1.0], dtype=torch.float64), dim=0)
    if model == "orthographic":
        xy = camera_points(torch.zeros(40, 40, dtype=torch.float64), view)
        depth = (4 * normal[2] - xy @ normal) / normal[2]
    else:
        depth = 4 * normal[2] / (rays(view) @ normal)
    result = normals(depth, torch.ones(40, 40, dtype=torch.bool), view)
    torch.testing.assert_close(result, normal.expand(40, 40, 3), atol=1e-11, rtol=0)    # differences of 0.02 of numbers of 4, in float64


def test_the_normals_of_a_sphere_are_of_second_order() -> None:
    """Half the pixel's size, a quarter of the error, away from the outline."""
    errors = []
    for size in (80, 160, 320):
        view = camera(size)
        depth, solid, truth = sphere_depth(view)
        facing = solid & ((truth * normalize(rays(view), dim=-1)).sum(-1) < -0.5)
        error = (normals(depth, solid, view) - truth).norm(dim=-1)[facing]
        errors.append(float(error.max()))
    assert errors[0] < 0.01
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.1)


def test_edges_have_the_normals_of_their_own_side() -> None:
    view = camera()
    depth = torch.full((40, 40), 4.0, dtype=torch.float64)
    depth[:, :17], depth[25:, 20:] = 2.0, 7.0
    solid = torch.ones(40, 40, dtype=torch.bool)
    solid[:5], solid[:, 33] = False, False
    result = normals(depth, solid, view)
    towards = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    torch.testing.assert_close(result[solid], towards.expand(int(solid.sum()), 3), atol=1e-12, rtol=0)
    assert result[~solid].isnan().all()


def test_a_pixel_alone_has_no_normal() -> None:
    solid = torch.zeros(40, 40, dtype=torch.bool)
    solid[3, 4] = solid[10, 10] = solid[10, 11] = True
    assert normals(torch.ones(40, 40, dtype=torch.float64), solid, camera()).isnan().all()


def test_a_sphere_has_its_own_depth_and_normals() -> None:
    """The ray's distance becomes camera z: as exact as the sphere is hard, which is to rounding in its middle."""
    view = camera(120)
    one = torch.ones(1, dtype=torch.float64)
    ball = Spheres(CENTRE[None], RADIUS * one.log(), 40 * one, torch.ones(1, 3, dtype=torch.float64), gamma=1e-3, near=1.0, far=6.0)
    depth, solid, truth = sphere_depth(view)
    layers = draw_layers(ball, view)
    assert layers.depth is not None
    facing = solid & ((truth * normalize(rays(view), dim=-1)).sum(-1) < -0.5)
    torch.testing.assert_close(layers.depth[facing], depth[facing], atol=1e-9, rtol=0)
    error = (normals(layers.depth, layers.alpha > 0.5, view) - truth).norm(dim=-1)[facing]
    assert error.max() < 0.005                                                         # 0.01 at 80 pixels, by the order of the test above


def test_a_plane_of_gaussians_has_one_normal() -> None:
    """Flat splats, close to each other: what their depth is off the plane is a small part of their distance."""
    n = 60
    across, down = (v.flatten() for v in torch.meshgrid(torch.linspace(-2, 2, n), torch.linspace(-2, 2, n), indexing="xy"))
    angle = 0.5                                                                        # turned about the x axis: up and towards the camera
    means = torch.stack([across, down * math.cos(angle), 4 + down * math.sin(-angle)], 1)
    quats = torch.tensor([math.cos(angle / 2), -math.sin(angle / 2), 0.0, 0.0]).expand(len(means), 4)
    splats = Gaussians.from_points(means)
    with torch.no_grad():
        splats.quats.copy_(quats)
        splats.log_scales.copy_(torch.tensor([0.06, 0.06, 0.001]).log().expand(len(means), 3))
        splats.opacity_logits.fill_(3.0)
    view = Camera.look_at((0, 0, 0), (0, 0, 1), width=100, height=80, fov=40)
    layers = draw_layers(splats, view)
    assert layers.depth is not None
    inside = layers.alpha > 0.99
    assert inside.float().mean() > 0.9
    result = normals(layers.depth, inside, view)[inside]
    truth = torch.tensor([0.0, -math.sin(angle), -math.cos(angle)])
    degrees = torch.rad2deg(((result * truth).sum(-1)).clamp(max=1).acos())
    assert degrees.median() < 1
    assert degrees.max() < 6


def test_a_sphere_of_gaussians_has_a_spheres_normals() -> None:
    """Flat splats that overlap (of splats that do not, the depth is a staircase). Those beneath pull the depth inwards near the outline."""
    means, quats, scales, _, colors = (v[5000:8000] for v in synthetic_scene())           # radius 0.45 around (0, -0.45, 0)
    splats = Gaussians.from_points(means, colors, 0)
    with torch.no_grad():
        splats.quats.copy_(quats)
        splats.log_scales.copy_((scales * torch.tensor([2.0, 2.0, 0.1])).log())
        splats.opacity_logits.fill_(0.4)                                                 # opacity 0.6
    view = Camera.look_at((0, -0.45, -2), (0, -0.45, 0), width=100, height=100, fov=30)
    layers = draw_layers(splats, view)
    assert layers.depth is not None
    result = normals(layers.depth, layers.alpha > 0.5, view)
    truth = normalize(camera_points(layers.depth, view) - torch.tensor([0.0, 0.0, 2.0]), dim=-1)
    facing = (layers.alpha > 0.9) & (truth[..., 2] < -0.5)
    assert facing.sum() > 5000
    degrees = torch.rad2deg((result * truth).sum(-1)[facing].clamp(max=1).acos())
    assert degrees.median() < 4
    assert degrees.max() < 7
