"""Draws `spheres.png`: 40 random spheres, from soft to hard.

python bench/pictures/spheres.py bench/pictures/spheres.png
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch

import tsplat
from tsplat.scene import write_image

SIDE = 320


def main(out: Path) -> None:
    torch.manual_seed(3)
    positions = torch.rand(40, 3) * 10 + torch.tensor([-5.0, -5.0, 25.0])
    features, radii = torch.rand(40, 3), 0.4 + 1.2 * torch.rand(40)
    K = torch.tensor([[2.4 * SIDE, 0, SIDE / 2], [0, 2.4 * SIDE, SIDE / 2], [0, 0, 1]])
    camera = tsplat.Camera(torch.eye(4), K, SIDE, SIDE)
    pictures = [tsplat.render_spheres(positions, features, radii, camera, gamma=gamma, near=20.0, far=40.0).image
                for gamma in (1.0, 0.1, 0.02, 1e-4)]
    write_image(out, torch.cat(pictures, 1).clamp(0, 1))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
