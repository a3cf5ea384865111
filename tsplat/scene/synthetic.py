"""A small capture made on the fly, for trying things out where there is no data: a sphere and a ring on a checkered ground.

The scene is itself made of Gaussians, so a trainer can come arbitrarily close to it. World axes: x right, y down, z forward.
"""

from __future__ import annotations

import math
import os
from pathlib import Path

import torch
from torch import Tensor

from tsplat.camera import Camera
from tsplat.scene.files import replacing
from tsplat.scene.image_files import write_image

GROUND, SPHERE, RING = 5000, 3000, 3500      # Gaussians
SPARSE_POINTS = 3000
POINT_NOISE = 0.01                           # world units
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


def synthetic_scene(seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Flat Gaussians on three surfaces, the same for the same `seed`, which sets the colours.

    Returns:
        means `[N, 3]`, quats `[N, 4]` (wxyz, unit), scales `[N, 3]`, opacities `[N]`, colors `[N, 3]` in 0..1; N = 11,500.
    """
    phases = torch.rand(3, 3, generator=torch.Generator().manual_seed(seed)) * 2 * math.pi
    parts = [_ground(GROUND), _sphere(SPHERE), _ring(RING)]
    means = torch.cat([part[0] for part in parts])                                       # [N, 3]
    normals = torch.cat([part[1] for part in parts])                                     # [N, 3]
    sizes = torch.cat([torch.full((len(part[0]),), 0.6 * math.sqrt(part[2] / len(part[0]))) for part in parts])     # [N]
    scales = sizes[:, None] * torch.tensor([1.0, 1.0, 0.15])                             # flat along the normal
    colors = torch.cat([_texture(part[0], phase) for part, phase in zip(parts, phases, strict=True)])
    checks = (torch.floor(means[:GROUND, 0] * 2) + torch.floor(means[:GROUND, 2] * 2)).remainder(2)
    colors[:GROUND] *= 0.3 + 0.7 * checks[:, None]
    return means, _turn_z_to(normals), scales, torch.full((len(means),), 0.95), colors


def synthetic_cameras(views: int, width: int, height: int) -> Camera:
    """`views` cameras on a ring around the scene, by turns at two heights: one batched `Camera`."""
    cameras = []
    for i in range(views):
        angle, up, radius = 2 * math.pi * i / views, (0.8, 1.8)[i % 2], (3.2, 2.6)[i % 2]
        eye = (radius * math.sin(angle), -up, -radius * math.cos(angle))
        cameras.append(Camera.look_at(eye, (0.0, -0.35, 0.0), width=width, height=height, fov=50))
    return Camera(torch.stack([c.viewmats for c in cameras]), torch.stack([c.Ks for c in cameras]), width, height)


def write_synthetic_capture(folder: str | os.PathLike[str], *, views: int = 40, size: tuple[int, int] = (160, 120),
                            seed: int = 0) -> Path:
    """Render the scene and write it as a COLMAP text model with PNG photos, as `load_capture` reads it.

    Args:
        folder: made if need be; files of the same names in it are replaced.
        views: number of photos.
        size: width and height of the photos, in pixels.
        seed: of the colours and the noise of the sparse points.

    Returns:
        The folder.
    """
    from tsplat.rasterize import rasterize

    folder = Path(folder)
    images, model = folder / "images", folder / "sparse" / "0"
    for directory in (images, model):
        directory.mkdir(parents=True, exist_ok=True)
    means, quats, scales, opacities, colors = synthetic_scene(seed)
    cameras = synthetic_cameras(views, *size)
    names = [f"view_{i:03d}.png" for i in range(views)]
    with torch.no_grad():
        for i, name in enumerate(names):
            write_image(images / name, rasterize(means, quats, scales, opacities, colors, cameras[i]).image)
    generator = torch.Generator().manual_seed(seed)
    chosen = torch.randperm(len(means), generator=generator)[:SPARSE_POINTS]
    points = means[chosen] + POINT_NOISE * torch.randn(len(chosen), 3, generator=generator)
    _write_colmap(model, cameras, names, points, colors[chosen])
    return folder


def _ground(n: int) -> tuple[Tensor, Tensor, float]:
    """Points, normals and area: a disc of radius 1.8 at y = 0, in a sunflower pattern."""
    i = torch.arange(n) + 0.5
    radius, angle = 1.8 * (i / n).sqrt(), i * GOLDEN_ANGLE
    points = torch.stack([radius * angle.cos(), torch.zeros(n), radius * angle.sin()], dim=1)
    return points, torch.tensor([0.0, -1.0, 0.0]).expand(n, 3), math.pi * 1.8**2


def _sphere(n: int) -> tuple[Tensor, Tensor, float]:
    """A sphere of radius 0.45 that stands on the ground, as a Fibonacci spiral."""
    i = torch.arange(n) + 0.5
    y, angle = 1 - 2 * i / n, i * GOLDEN_ANGLE
    around = (1 - y * y).sqrt()
    normals = torch.stack([around * angle.cos(), y, around * angle.sin()], dim=1)
    return 0.45 * normals + torch.tensor([0.0, -0.45, 0.0]), normals, 4 * math.pi * 0.45**2


def _ring(n: int) -> tuple[Tensor, Tensor, float]:
    """A torus of radii 0.95 and 0.16 around the sphere, wound like a coil."""
    turns = round(math.sqrt(n * 0.95 / 0.16))
    around = torch.arange(n) / n * 2 * math.pi
    tube = around * turns
    normals = torch.stack([tube.cos() * around.cos(), tube.sin(), tube.cos() * around.sin()], dim=1)
    circle = torch.stack([around.cos(), torch.zeros(n), around.sin()], dim=1)
    return 0.95 * circle + 0.16 * normals + torch.tensor([0.0, -0.3, 0.0]), normals, 4 * math.pi**2 * 0.95 * 0.16


def _texture(points: Tensor, phase: Tensor) -> Tensor:
    """`[n, 3]` smooth colours in 0..1."""
    frequencies = points.new_tensor([[3.0, 7.0, 0.0], [0.0, 4.0, -5.0], [6.0, 0.0, 4.0]])
    return 0.55 + 0.33 * torch.sin(points @ frequencies.T + phase)


def _turn_z_to(normals: Tensor) -> Tensor:
    """`[n, 4]` wxyz unit quaternions of the shortest rotations from +z to unit `normals`."""
    x, y, z = normals.unbind(1)
    quats = torch.stack([1 + z, -y, x, torch.zeros_like(z)], dim=1)
    quats[z < -1 + 1e-6] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    return torch.nn.functional.normalize(quats, dim=1)


def _write_colmap(model: Path, cameras: Camera, names: list[str], points: Tensor, colors: Tensor) -> None:
    from kornia.geometry.conversions import rotation_matrix_to_quaternion

    quats = rotation_matrix_to_quaternion(cameras.viewmats[:, :3, :3].double())          # [C, 4] wxyz
    poses = torch.cat([quats, cameras.viewmats[:, :3, 3].double()], dim=1).tolist()
    fx, fy, cx, cy = (float(cameras.Ks[0, i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    bytes_ = (colors * 255).round().int().tolist()
    texts = {
        "cameras": f"1 PINHOLE {cameras.width} {cameras.height} {fx!r} {fy!r} {cx!r} {cy!r}\n",
        "images": "".join(f"{i} {' '.join(map(repr, pose))} 1 {name}\n\n"
                          for i, (pose, name) in enumerate(zip(poses, names, strict=True), start=1)),
        "points3D": "".join(f"{i} {' '.join(map(repr, point))} {' '.join(map(str, color))} 0\n"
                            for i, (point, color) in enumerate(zip(points.tolist(), bytes_, strict=True), start=1)),
    }
    for name, text in texts.items():
        with replacing(model / f"{name}.txt") as temporary:
            temporary.write_text(text, encoding="utf-8")
