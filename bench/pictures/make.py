"""Draws `playbot.png`: a trained scene and its depth, side by side.

    python bench/pictures/make.py playbot_lod3_31k.ply bench/pictures/playbot.png

The scene is PLAYBOT by Stephane Agullo (CC-BY-4.0), as .ply.
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch

import tsplat
from tsplat.scene import write_image


def main(scene: Path, out: Path) -> None:
    gaussians = tsplat.Gaussians.load(scene)
    camera = tsplat.Camera.look_at((1.1, -1.1, -2.7), (0.0, -0.42, 0.0), width=520, height=440, fov=47)
    with torch.no_grad():
        rendering = tsplat.rasterize(gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh, camera,
                                     sh_degree=gaussians.sh_degree, background=torch.ones(3), depth="expected")
    assert rendering.depth is not None
    solid = rendering.alpha > 0.5
    near, far = rendering.depth[solid].aminmax()
    shade = torch.where(solid, 1 - 0.85 * (rendering.depth - near) / (far - near), 1.0)
    write_image(out, torch.cat([rendering.image.clamp(0, 1), shade.clamp(0, 1)[..., None].expand(-1, -1, 3)], 1))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
