"""The fixed scenes of `bench/gpu.py`: random ones, trained ones and the points of a photographed garden."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch
from scenes import Scene, random_scene

import tsplat

SIZES = {"1080p": (1920, 1080), "4K": (3840, 2160)}
COUNTS = 100_000, 1_000_000, 5_000_000
CHANNELS = 3, 32, 128


def fixed_scenes(data: Path, quick: bool) -> list[tuple[str, int, Callable[[], Scene]]]:
    """Name, channels and maker (on the CPU) of each; quick: 1080p, up to 1M splats, 3 channels. Names what is not there."""
    scenes: list[tuple[str, int, Callable[[], Scene]]] = []
    for n in COUNTS[:2] if quick else COUNTS:
        for size in list(SIZES)[:1 if quick else None]:
            for channels in CHANNELS[:1] if quick else CHANNELS:
                scenes.append((f"random {n // 1000}k, {size}", channels, partial(of_channels, n, size, channels)))
    folder = data / "data" / "splats"
    scenes += [(path.stem, 3, partial(trained, path)) for path in sorted(folder.glob("*.ply")) if ".compressed" not in path.name]
    garden = data / "data" / "garden" / "test_garden.npz"
    scenes += [("garden points", 3, partial(garden_points, garden))] if garden.exists() else []
    for path in (folder, garden):
        if not path.exists():
            print(f"no {path}: left out")
    return scenes


def of_channels(n: int, size: str, channels: int) -> Scene:
    """A random scene with random features."""
    g = torch.Generator().manual_seed(0)
    return random_scene(n, *SIZES[size])._replace(colors=torch.rand(n, channels, generator=g), background=torch.rand(channels, generator=g))


def trained(path: Path) -> Scene:
    """A trained scene, seen from in front of it, with all its spherical harmonics."""
    g = tsplat.Gaussians.load(path)
    with torch.no_grad():
        centre = g.means.median(0).values
        reach = float((g.means - centre).norm(dim=1).quantile(0.9))
        eye = centre + torch.tensor([0.5, -0.4, -1.0]) * 2 * reach
        camera = tsplat.Camera.look_at(eye, centre, width=1920, height=1080)
        return Scene(g.means.detach(), g.quats.detach(), g.scales.detach(), g.opacities.detach(), g.sh.detach(), torch.ones(3), camera, g.sh_degree)


def garden_points(path: Path) -> Scene:
    """Coloured points of a photographed garden as small random Gaussians."""
    d = np.load(path)
    means = torch.from_numpy(d["means3d"])
    inside = (means.abs() <= 2).all(1)
    means, n, g = means[inside], int(inside.sum()), torch.Generator().manual_seed(0)
    K = torch.from_numpy(d["Ks"][0]) * torch.tensor([[1920 / 648], [1080 / 420], [1.0]])
    return Scene(means, torch.randn(n, 4, generator=g), torch.rand(n, 3, generator=g) * 0.02 + 1e-4, torch.rand(n, generator=g),
                 torch.from_numpy(d["colors"])[inside].float() / 255, torch.zeros(3),
                 tsplat.Camera(torch.from_numpy(d["viewmats"][0]), K, 1920, 1080))
