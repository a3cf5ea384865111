"""Draws `playbot.png`: a trained scene, its depth and its normals, side by side.

    python bench/pictures/make.py playbot_lod3_31k.ply bench/pictures/playbot.png

The scene is PLAYBOT by Stephane Agullo (CC-BY-4.0), as .ply.
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch

import tsplat
from tsplat.pictures import draw_layers, picture
from tsplat.scene import write_image


def main(scene: Path, out: Path) -> None:
    gaussians = tsplat.Gaussians.load(scene)
    camera = tsplat.Camera.look_at((1.1, -1.1, -2.7), (0.0, -0.42, 0.0), width=400, height=340, fov=47)
    layers = draw_layers(gaussians, camera)
    write_image(out, torch.cat([picture(layers, camera, mode, background=torch.ones(3)) for mode in ("color", "depth", "normals")], 1))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
