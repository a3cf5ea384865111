"""Shape from silhouettes (Pulsar, section 5.1, Figure 4a): 1352 spheres on a sphere become an airplane, by L1 on the images.

    python bench/applications/silhouettes.py

SoftRas's airplane: 120 silhouettes of 64x64 pixels, of which every eighth is held out. The paper starts with a sphere at each vertex of the mesh
that SoftRas starts with. The mesh of that name in the data has only 642 vertices, and SoftRas's result beside it, 1352; so the start is a sphere
of our own with as many: the vertices of a cube of 15x15 squares a side, blown up. L1 is all of the loss, but not all that happens: the steps
are done in rounds, and between these, spheres that vanished (opacity below 0.1, or smaller than a quarter of a pixel) are put beside random
others. Prints the mean intersection over union of held-out silhouettes, of the start and in the end, and how many spheres moved in
this way. The picture: what the spheres make of these silhouettes, and the spheres, shaded by depth.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from common import Spheres, Stage, Views, arguments, optimise_and_relocate, orbit, report, write_rows
from torch import Tensor

import tsplat

FOV = 30.0
HOLD_OUT = 8
SEGMENTS = 15
GOAL = 0.90
RADIUS = 1.0                # of a ball around the airplane
LEAST_RADIUS = 0.006        # a quarter of a pixel
GAMMA = 1.0, 0.5
"""Soft, so that spheres in the wrong place are not hidden by others: that is how they learn to leave."""


def cube_sphere(segments: int) -> Tensor:
    """Vertices `[6 n^2 + 2, 3]` of a cube with n x n squares a side, blown up to the unit sphere."""
    line = torch.arange(segments + 1)
    grid = torch.cartesian_prod(line, line, line)
    surface = grid[((grid == 0) | (grid == segments)).any(1)]
    return torch.nn.functional.normalize(surface * 2.0 - segments, dim=1)


def load(path: Path) -> Views:
    """Silhouettes `[120, 64, 64, 1]` and cameras."""
    data = np.load(path)
    distance, elevation, azimuth = torch.from_numpy(data["camera"]).double().T
    elevation, azimuth = elevation.deg2rad(), azimuth.deg2rad()
    eyes = distance[:, None] * torch.stack([elevation.cos() * azimuth.sin(), elevation.sin(), -elevation.cos() * azimuth.cos()], 1)
    images = torch.from_numpy(data["images"][:, 3]).float().flip(2) / 255                  # its x axis is up x forward, to the left of ours
    return Views(orbit(eyes, images.shape[-1], FOV), images[..., None])


def iou(image: Tensor, target: Tensor) -> float:
    """Intersection over union of what is above a half."""
    a, b = image > 0.5, target > 0.5
    return float((a & b).sum() / (a | b).sum().clamp(min=1))


def main(argv: list[str] | None = None) -> float:
    """Optimise, print and draw."""
    parser = arguments(__doc__, "silhouettes", steps=1200, rounds=6, batch=4, segments=SEGMENTS)
    args = parser.parse_args(argv)
    generator = torch.Generator().manual_seed(args.seed)
    with report(args, "held-out IoU", GOAL) as document:
        views = load(args.data / "softras_airplane" / "softras_airplane.npz")
        held_out = torch.arange(len(views)) % HOLD_OUT == HOLD_OUT // 2
        train, test = views[~held_out], views[held_out]
        positions = 0.5 * cube_sphere(args.segments)
        n = len(positions)
        spheres = Spheres.of(positions, torch.full((n,), 0.6 / args.segments), torch.ones(n, 1), torch.full((n,), 0.5))
        stage = Stage(torch.zeros(3), RADIUS, 2.732, torch.zeros(1))

        def loss(spheres: Spheres, some: Views, gamma: float) -> Tensor:
            image = stage.render(spheres, some.cameras, gamma, torch.ones(n, 1))
            return (image - some.images).abs().mean()

        def alive(spheres: Spheres) -> Tensor:
            return (spheres.opacities > 0.1) & (spheres.radii > LEAST_RADIUS)

        @torch.no_grad()
        def score(spheres: Spheres) -> float:
            return sum(map(iou, stage.render(spheres, test.cameras, GAMMA[1]), test.images)) / len(test)

        first = score(spheres)
        spheres, moved = optimise_and_relocate(spheres, train, loss, alive, rounds=args.rounds, steps=args.steps, size=RADIUS, speed=5.0,
                                               batch=args.batch, gamma=GAMMA, generator=generator, name="silhouettes")
        last = score(spheres)
        print(f"silhouettes: {n} spheres, {args.steps} steps, held-out IoU {last:.4f} of {len(test)} views ({first:.4f} at first), "
              f"{moved} spheres relocated between {args.rounds} rounds")
        document |= {"figures": {"start": first, "end": last}, "spheres": n, "steps": args.steps, "relocated": moved,
                     "note": f"the loss is L1 alone; between {args.rounds} rounds, spheres that vanished are put beside others"}
        with torch.no_grad():
            draw(args.picture, stage, spheres, test[torch.arange(0, len(test), 2)[:6]], args.targets)
    return last


def draw(path: Path, stage: Stage, spheres: Spheres, views: Views, targets: bool) -> None:
    """Two rows: silhouettes, and the spheres with a sharp gamma, shaded by depth, at twice the size."""
    silhouettes = stage.render(spheres, views.cameras, GAMMA[1])
    r = tsplat.render_spheres(spheres.positions, spheres.features, spheres.radii, views.cameras, background=torch.zeros(1), gamma=1e-3,
                              depth="expected", **stage.planes)
    shade = (stage.planes["far"] - r.depth) / (2 * stage.radius) * r.alpha
    *rows, above = ([image.repeat_interleave(2, 0).repeat_interleave(2, 1) for image in row]
                    for row in (silhouettes, shade[..., None], views.images))
    write_rows(path, rows, above if targets else None)


if __name__ == "__main__":
    main()
