"""`may_see` keeps every splat that the projection keeps, and few others."""

import dataclasses
import math

import pytest
import torch
from backends import KERNELS
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from tsplat_reference.constants import ALPHA_MIN, EPS2D
from tsplat_reference.frustum import CHUNK

from tsplat import Camera, ops
from tsplat.camera import CameraModel


def random_camera(model: CameraModel, g: torch.Generator, *, near: float, far: float, distance: float) -> Camera:
    """At about `distance` from the origin, turned at random, with a principal point that may be outside of the image."""
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.linalg.qr(torch.randn(3, 3, generator=g)).Q
    viewmat[:3, 3] = distance * torch.randn(3, generator=g)
    width, height = (int(v) for v in torch.randint(1, 200, (2,), generator=g))
    fx, fy = (10 ** (3 * torch.rand(2, generator=g))).tolist()
    cx, cy = ((2 * torch.rand(2, generator=g) - 0.5) * torch.tensor([width, height])).tolist()
    return Camera(viewmat, torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), width, height, model, near, far)


def splats_at_the_borders(camera: Camera, n: int, g: torch.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Means, quaternions, scales and opacities. Most are just culled, or nearly: by near or far, by a side, as too faint."""
    def randn(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g)

    def one_of(*values: Tensor) -> Tensor:
        return torch.stack(values)[torch.randint(len(values), (n,), generator=g), torch.arange(n)]

    some = torch.rand(n, generator=g)
    near, far = max(camera.near, 1e-3), min(camera.far, 1e3)
    z = one_of(near + (far - near) * some**3, camera.near * (1 + 1e-6 * randn(n)), min(camera.far, 1e4) * (1 + 1e-6 * randn(n)), 10 * randn(n))
    opacity = one_of(some, some, ALPHA_MIN * (1 + 1e-6 * randn(n)))
    scales = (z.abs() * 10 ** (2 * randn(n) - 2))[:, None] * 10 ** randn(n, 3).clamp(max=0)
    # by the sides: off them by what a round splat reaches at most, or nearly that, and a bit
    e = (2 * torch.log((opacity / ALPHA_MIN).clamp(min=1))).sqrt()
    pinhole = camera.model == "pinhole"
    K, points = camera.Ks, []
    for axis, size in ((0, camera.width), (1, camera.height)):
        f, c = float(K[axis, axis]), float(K[axis, 2])
        w = z if pinhole else torch.ones(n)
        steep = math.hypot(1, max(abs(c), abs(size - c)) / f + 0.15 * size / f) if pinhole else 1.0
        radius = e * ((f * steep / w * scales.amax(1)) ** 2 + EPS2D).sqrt()
        off = radius * one_of(torch.zeros(n), torch.full((n,), 0.9), torch.ones(n)) + randn(n)
        u = one_of(size * some, -off, size + off)
        points.append((u - c) / f * w)
    p = torch.stack([*points, z], 1)
    means = (p - camera.viewmats[:3, 3]) @ camera.viewmats[:3, :3]
    return means, randn(n, 4), scales, opacity


def may_see(means: Tensor, sizes: Tensor, opacities: Tensor, camera: Camera, eps2d: float = EPS2D) -> Tensor:
    """The splats that a single camera may see, ascending."""
    return ops.may_see(means, sizes, opacities, camera.viewmats[None], camera.Ks[None], camera.width, camera.height, camera.model, camera.near,
                       camera.far, eps2d)[0].nonzero()[:, 0]


def drawn(camera: Camera, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, *, antialiased: bool = False,
          eps2d: float = EPS2D) -> Tensor:
    radii = ops.project(means, quats, scales, None, opacities, camera.viewmats[None], camera.Ks[None], camera.width, camera.height, camera.model,
                        camera.near, camera.far, eps2d, antialiased).radii
    return (radii[0] > 0).all(1).nonzero()[:, 0]


@settings(max_examples=150, deadline=None)
@given(model=st.sampled_from(["pinhole", "orthographic", "fisheye"]), seed=st.integers(0, 2**32), near=st.sampled_from([-1.0, 0.0, 0.01, 1.0]),
       far=st.sampled_from([2.0, 1e10]), distance=st.sampled_from([0.0, 3.0, 1e3]), antialiased=st.booleans(),
       eps2d=st.sampled_from([0.0, EPS2D, 5.0]), brightest=st.sampled_from([1.0, 50.0]))
def test_what_is_drawn_may_be_seen(model: CameraModel, seed: int, near: float, far: float, distance: float, antialiased: bool,
                                 eps2d: float, brightest: float) -> None:
    g = torch.Generator().manual_seed(seed)
    camera = random_camera(model, g, near=near, far=far, distance=distance)
    means, quats, scales, opacities = splats_at_the_borders(camera, 400, g)
    opacities *= brightest
    rows = may_see(means, scales.amax(1), opacities, camera, eps2d)
    lost = set(drawn(camera, means, quats, scales, opacities, antialiased=antialiased, eps2d=eps2d).tolist()) - set(rows.tolist())
    assert not lost


@pytest.mark.parametrize("model", ["pinhole", "orthographic"])
def test_little_else_is_chosen(model: CameraModel) -> None:
    """Of small splats all around a camera, those in a frame of a few pixels around the image."""
    g = torch.Generator().manual_seed(0)
    means, scales = 20 * torch.rand(20_000, 3, generator=g) - 10, torch.full((20_000, 3), 1e-3)
    opacities = torch.rand(20_000, generator=g)
    camera = Camera(torch.eye(4), torch.tensor([[100.0 if model == "pinhole" else 10.0, 0, 50], [0, 100.0 if model == "pinhole" else 10.0, 40],
                                                [0, 0, 1]]), 100, 80, model)
    seen, rows = drawn(camera, means, torch.randn(20_000, 4, generator=g), scales, opacities), may_see(means, scales[:, 0], opacities, camera)
    assert 500 < len(seen) <= len(rows) < (1 + 2 * 4 / 80) * (1 + 2 * 4 / 100) * len(seen)


def test_chunks_change_nothing() -> None:
    g = torch.Generator().manual_seed(0)
    n = 2 * CHUNK + 5
    means, sizes, opacities = torch.randn(n, 3, generator=g), torch.rand(n, generator=g) / 100, torch.rand(n, generator=g)
    camera = Camera.look_at((0, 0, -1), (0, 0, 0), width=40, height=30)
    parts = [may_see(means[i:i + 1000], sizes[i:i + 1000], opacities[i:i + 1000], camera) + i for i in range(0, n, 1000)]
    rows = may_see(means, sizes, opacities, camera)
    assert torch.equal(rows, torch.cat(parts))
    assert CHUNK < int(rows[-1])
    assert len(rows) < n
    assert len(may_see(means[:0], sizes[:0], opacities[:0], camera)) == 0


def test_what_is_not_finite_is_left_out() -> None:
    camera = Camera.look_at((0, 0, -4), (0, 0, 0), width=40, height=30)
    nan, inf = math.nan, math.inf
    means = torch.tensor([[0.0, 0, 0], [nan, 0, 0], [0, inf, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0]])
    sizes, opacities = torch.tensor([0.1, 0.1, 0.1, nan, inf, 0.1]), torch.tensor([0.5, 0.5, 0.5, 0.5, 0.5, nan])
    assert may_see(means, sizes, opacities, camera).tolist() == [0]


@pytest.mark.parametrize("model", ["pinhole", "orthographic", "fisheye"])
def test_several_cameras_on_the_kernel(model: CameraModel) -> None:
    """As each by itself on the reference: in float64, where none of these splats is at a border by rounding."""
    g = torch.Generator().manual_seed(1)
    one = random_camera(model, g, near=0.1, far=5.0, distance=2.0).to(torch.float64)
    viewmats = torch.stack([random_camera(model, g, near=0.1, far=5.0, distance=2.0).viewmats.double() for _ in range(3)])
    means, sizes, opacities = (x.double() for x in (4 * torch.randn(300, 3, generator=g), torch.rand(300, generator=g) / 2,
                                                    1.2 * torch.rand(300, generator=g)))
    means[0] = sizes[1] = opacities[2] = math.nan
    with KERNELS.active():
        put = KERNELS.put
        seen = ops.may_see(put(means), put(sizes), put(opacities), put(viewmats), put(one.Ks.expand(3, 3, 3)), one.width, one.height, model,
                           one.near, one.far, EPS2D)
    for viewmat, row in zip(viewmats, seen.cpu(), strict=True):
        assert row.nonzero()[:, 0].tolist() == may_see(means, sizes, opacities, dataclasses.replace(one, viewmats=viewmat)).tolist()
        assert 5 < int(row.sum()) < 250
