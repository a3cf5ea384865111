"""Seeded benchmark scenes: splats of a few pixels in front of an identity camera, the same for every renderer.

Depths are uniform in [2, 10], centres uniform in the image plus 2 %, each splat's 3-sigma disc covers 50 to 400 pixels (log-uniform)
whatever the resolution, axis ratios are log-uniform within 0.6 of round, opacities uniform in [0.1, 0.9].
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
import tsplat_reference as reference
from torch import Tensor
from tsplat_reference import footprint
from tsplat_reference.constants import ALPHA_MIN, TRANSMITTANCE_MIN

import tsplat


class Scene(NamedTuple):
    """Inputs of `tsplat.rasterize` (float32). With sh_degree, colors are SH coefficients."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    background: Tensor
    camera: tsplat.Camera
    sh_degree: int | None = None

    def to(self, device: str) -> Scene:
        """The same on another device."""
        return Scene(*(x.to(device) for x in self[:6]), self.camera.to(device), self.sh_degree)


def random_scene(n: int, width: int, height: int, seed: int = 0, area: tuple[float, float] = (50.0, 400.0)) -> Scene:
    """N splats for a camera with fx = fy = width."""
    rng = np.random.default_rng([seed, n, width, height])
    z = rng.uniform(2.0, 10.0, n)
    u, v = rng.uniform(-0.02 * width, 1.02 * width, n), rng.uniform(-0.02 * height, 1.02 * height, n)
    pixels = np.exp(rng.uniform(*np.log(area), n))
    ratios = rng.uniform(math.log(0.6), -math.log(0.6), (n, 3))
    quats = rng.normal(size=(n, 4))
    opacities, colors = rng.uniform(0.1, 0.9, n), rng.uniform(0, 1, (n, 3))
    sigma = np.sqrt(pixels / (9 * np.pi)) * z / width
    arrays = (np.stack([(u - width / 2) / width * z, (v - height / 2) / width * z, z], 1),
              quats / np.linalg.norm(quats, axis=1, keepdims=True),
              sigma[:, None] * np.exp(ratios - ratios.mean(1, keepdims=True)), opacities, colors, np.array([0.1, 0.2, 0.3]))
    K = torch.tensor([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]])
    return Scene(*(torch.from_numpy(a.astype(np.float32)) for a in arrays), tsplat.Camera(torch.eye(4), K, width, height))


@torch.no_grad()
def count_pairs(scene: Scene, tile: int = 8, alpha_max: float = 0.999) -> int:
    """Pixel-splat pairs that a renderer has to blend: alpha >= 1/255, until the transmittance would fall to 1e-4."""
    camera = scene.camera
    p = reference.project(scene.means, scene.quats, scene.scales, None, scene.opacities, camera.viewmats[None], camera.Ks[None],
                          camera.width, camera.height, camera.model, camera.near, camera.far, 0.3, False)
    ids, offsets = reference.bin_splats(p.means2d, p.radii, p.conics, scene.opacities[None], p.depths, camera.width, camera.height, tile)
    tiles_x, _ = reference.tile_counts(camera.width, camera.height, tile)
    pixel = torch.arange(tile * tile)
    total = 0
    for t in range(len(offsets) - 1):
        splats = ids[offsets[t]:offsets[t + 1]].long()
        x, y = t % tiles_x * tile + pixel % tile, t // tiles_x * tile + pixel // tile
        inside = (x < camera.width) & (y < camera.height)
        mean = p.means2d[0, splats]
        log_alpha = footprint.log_alpha(x[:, None] + 0.5 - mean[:, 0], y[:, None] + 0.5 - mean[:, 1], p.conics[0, splats],
                                        scene.opacities[splats])
        alpha = log_alpha.exp().clamp_max(alpha_max)                                        # [P, K]
        alpha = torch.where((alpha >= ALPHA_MIN) & inside[:, None], alpha, 0.0)
        total += int(((alpha > 0) & ((1 - alpha).cumprod(1) > TRANSMITTANCE_MIN)).sum())
    return total
