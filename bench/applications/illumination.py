"""Shape from shading (Pulsar, section 5.1, Figure 4b): a sphere of spheres becomes a cow, by images of it under coloured lights.

    python bench/applications/illumination.py

The spheres' features are normals, and a constant that tells the object from the background. Shading is a stage of its own, on the rendered normals:
diffuse, by four parallel lights, in red, green, blue and white. 144 cameras at random azimuth and elevation. The mesh itself is never drawn: the
targets are tsplat's own, of 20,000 small spheres at points on it with its normals, in the same shading. So the figure tells that shape comes back
from shading, not that the renderer or the shading agree with another's. Between rounds, spheres that no view sees, or that are nearly transparent,
are put beside others. Prints the Chamfer distance to the mesh, in parts of its radius, before and after: mean distance of the spheres' visible
sides to points on the mesh, and of these to them. Only spheres that the views see count there; how many these are, before and after, is printed
too. The picture: targets, the start, the result, and its normals.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import torch
from common import Spheres, Stage, Views, arguments, optimise_and_relocate, orbit, report, write_rows
from torch import Tensor
from torch.nn.functional import normalize

import tsplat
from tsplat.fit.spheres import visibility

DISTANCE, FOV = 3.0, 42.0
GAMMA = 0.5, 2e-2
SHARP = 2e-3                # gamma of the targets
LIGHTS = normalize(torch.tensor([[1.0, 1, 1], [-1, 1, -1], [1, -1, -1], [-1, -1, 1]]), dim=1)
COLORS = torch.tensor([[0.8, 0.1, 0.1], [0.1, 0.8, 0.1], [0.1, 0.1, 0.8], [0.4, 0.4, 0.4]])
AMBIENT = 0.15


class Samples(NamedTuple):
    """Points on a surface `[N, 3]`, with unit normals `[N, 3]`."""

    points: Tensor
    normals: Tensor


def read_obj(path: Path) -> tuple[Tensor, Tensor]:
    """Vertices `[V, 3]` and triangles `[F, 3]`."""
    vertices, faces = [], []
    for line in path.read_text().splitlines():
        kind, *rest = line.split() or [""]
        if kind == "v":
            vertices.append([float(x) for x in rest[:3]])
        elif kind == "f":
            faces.append([int(corner.split("/")[0]) - 1 for corner in rest])
    return torch.tensor(vertices), torch.tensor(faces)


def sample(vertices: Tensor, faces: Tensor, count: int, generator: torch.Generator) -> Samples:
    """Points that are uniform on the surface, moved and scaled so that it fits the unit ball, with interpolated vertex normals."""
    vertices = vertices - (vertices.amax(0) + vertices.amin(0)) / 2
    vertices = vertices / vertices.norm(dim=1).max()
    corners = vertices[faces]                                                               # [F, 3, 3]
    areas = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    at_vertices = torch.zeros_like(vertices)
    for corner in faces.T:
        at_vertices.index_add_(0, corner, areas)
    which = torch.multinomial(areas.norm(dim=1), count, replacement=True, generator=generator)
    u, v = torch.rand(2, count, 1, generator=generator)
    weights = torch.cat([1 - u.sqrt(), u.sqrt() * (1 - v), u.sqrt() * v], 1)[..., None]
    return Samples((corners[which] * weights).sum(1), normalize((normalize(at_vertices, dim=1)[faces[which]] * weights).sum(1), dim=1))


def shade(image: Tensor) -> Tensor:
    """Colours `[..., 3]` of rendered normals and alpha `[..., 4]`: light that falls on the surface, and some from everywhere."""
    normals, alpha = normalize(image[..., :3], dim=-1, eps=1e-4), image[..., 3:]
    return alpha * ((normals @ LIGHTS.T).clamp(min=0) @ COLORS + AMBIENT)


def chamfer(a: Tensor, b: Tensor) -> float:
    """Mean of the mean distances of points `[N, 3]` to the nearest of `[M, 3]`, and the other way round."""
    ab = torch.cat([torch.cdist(part, b).amin(1) for part in a.split(1000)]).mean()
    ba = torch.cat([torch.cdist(part, a).amin(1) for part in b.split(1000)]).mean()
    return float(ab + ba) / 2


def seen(spheres: Spheres, stage: Stage, views: Views, gamma: float) -> Tensor:
    """Which spheres weigh more than a fiftieth of a pixel in the mean view `[N]`."""
    weights = visibility(spheres.positions, spheres.radii, spheres.opacities, [views.cameras], gamma=gamma, **stage.planes)
    return weights > 0.02 * len(views)


def visible_sides(spheres: Spheres, stage: Stage, views: Views) -> Tensor:
    """Where the spheres that are seen end in the direction of their normals."""
    return (spheres.positions + spheres.radii[:, None] * normalize(spheres.features[:, :3], dim=1))[
        seen(spheres, stage, views, SHARP)]


def with_alpha(normals: Tensor) -> Tensor:
    """Features: normals, and a constant one."""
    return torch.cat([normals, torch.ones(len(normals), 1)], 1)


def main(argv: list[str] | None = None) -> tuple[float, float]:
    """Optimise, print and draw."""
    parser = arguments(__doc__, "illumination", steps=200, rounds=4, batch=4, spheres=3000, samples=20_000, cameras=144, size=128)
    parser.add_argument("--mesh", default="cow.obj", help="a file of triangles in the data's folder `meshes`")
    args = parser.parse_args(argv)
    generator = torch.Generator().manual_seed(args.seed)
    with report(args, "Chamfer distance to the mesh, radii of it") as document:
        stage = Stage(torch.zeros(3), 1.15, DISTANCE, torch.zeros(4), fade_below=0.5)
        surface = sample(*read_obj(args.data / "meshes" / args.mesh), args.samples, generator)
        eyes = DISTANCE * normalize(torch.randn(args.cameras, 3, generator=generator), dim=1)
        cameras = orbit(eyes, args.size, FOV)
        radius = 4 / math.sqrt(args.samples)
        dense = Spheres.of(surface.points - radius * surface.normals, torch.full((args.samples,), radius), with_alpha(surface.normals),
                           torch.full((args.samples,), 0.9999))                                 # they touch the surface from within
        with torch.no_grad():
            views = Views(cameras, shade(torch.stack([stage.render(dense, cameras[i], SHARP) for i in range(args.cameras)])))

        outwards = normalize(torch.randn(args.spheres, 3, generator=generator), dim=1)
        spheres = Spheres.of(0.6 * outwards, torch.full((args.spheres,), 2.0 / math.sqrt(args.spheres)), with_alpha(outwards),
                             torch.full((args.spheres,), 0.5))

        def render(spheres: Spheres, cameras: tsplat.Camera, gamma: float) -> Tensor:
            return stage.render(spheres, cameras, gamma, with_alpha(spheres.features[:, :3]))      # the constant stays one

        def loss(spheres: Spheres, some: Views, gamma: float) -> Tensor:
            return (shade(render(spheres, some.cameras, gamma)) - some.images).abs().mean()

        def alive(spheres: Spheres) -> Tensor:
            return seen(spheres, stage, views, GAMMA[1]) & (spheres.opacities > 0.1)

        shown = views.cameras[:5]
        with torch.no_grad():
            first = render(spheres, shown, GAMMA[1])
            old_sides = visible_sides(spheres, stage, views)
            before = chamfer(old_sides, surface.points)
        spheres, moved = optimise_and_relocate(spheres, views, loss, alive, rounds=args.rounds, steps=args.steps, size=1.0, speed=5.0,
                                               batch=args.batch, gamma=GAMMA, generator=generator, name="illumination")
        with torch.no_grad():
            last, sides = render(spheres, shown, GAMMA[1]), visible_sides(spheres, stage, views)
            after = chamfer(sides, surface.points)
        print(f"illumination: {args.spheres} spheres, {args.cameras} views of {args.size}x{args.size}, {args.steps} steps, Chamfer distance "
              f"{before:.4f} before ({len(old_sides)} spheres seen), {after:.4f} after ({len(sides)} seen; the rest do not count)")
        document |= {"figures": {"before": before, "after": after}, "counts": {"before": len(old_sides), "after": len(sides)},
                     "spheres": args.spheres, "steps": args.steps, "relocated": moved,
                     "note": "the targets are tsplat's own: spheres at points on the mesh, in the same shading; only spheres that are seen count"}
        normals = (normalize(last[..., :3], dim=-1) / 2 + 0.5) * (last[..., 3:] > 0.5)
        write_rows(args.picture, [shade(first), shade(last), normals], views.images[:5])
    return before, after


if __name__ == "__main__":
    main()
