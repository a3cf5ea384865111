"""The splats to start from: a capture's sparse points, filled up where they are few, or random ones where there are none."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from tsplat.fit.config import FitConfig
from tsplat.scene import Capture, Gaussians
from tsplat.scene.neighbours import nearest_squared_distances

PARALLEL = 1e-3      # weight of a guess against the optical axes: it decides only where they are parallel


def initial_gaussians(capture: Capture, config: FitConfig, generator: torch.Generator) -> Gaussians:
    """Round Gaussians at the `initial_points`, as in 3DGS (section 5.1)."""
    splats = Gaussians.from_points(*initial_points(capture, config, generator), config.sh_degree)
    with torch.no_grad():
        opacity = config.value("init_opacity")
        splats.opacity_logits.fill_(math.log(opacity / (1 - opacity)))
        splats.log_scales.add_(math.log(config.value("init_scale")))
    return splats


def initial_points(capture: Capture, config: FitConfig, generator: torch.Generator) -> tuple[Tensor, Tensor | None]:
    """Where splats start, `[N, 3]`, and their colours `[N, 3]`, or None for grey: the capture's sparse points, or random ones.

    With fewer points than `config.splats`, the cloud is filled up by `fill_up`. Without points, `config.splats` random
    ones lie in the cube of `view_cube`. There are never more than `config.max_splats`, if that is given: of more points, some
    at random.
    """
    most = config.max_splats or math.inf
    count = int(min(config.splats, most))
    if capture.points is None or not capture.has_points:
        low, high = (torch.tensor(corner) for corner in view_cube(capture))
        return low + (high - low) * torch.rand(count, 3, generator=generator), torch.rand(count, 3, generator=generator)
    points, colors = capture.points, capture.point_colors
    if len(points) > most:
        chosen = torch.randperm(len(points), generator=generator)[:config.max_splats]
        points, colors = points[chosen], None if colors is None else colors[chosen]
    return fill_up(points, colors, count, generator)


def fill_up(points: Tensor, colors: Tensor | None, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor | None]:
    """Add copies of points `[M, 3]`, M >= 1, until there are `count`: no point gets two before each has one.

    A copy has its point's colour `[M, 3]` and lies off it by a normal deviate per axis, of the size of the root mean
    squared distance to the point's 3 nearest neighbours over the square root of 3: about as far as those neighbours.
    """
    missing = count - len(points)
    if missing <= 0:
        return points, colors
    rounds = [torch.randperm(len(points), generator=generator) for _ in range(math.ceil(missing / len(points)))]
    source = torch.cat(rounds)[:missing]                                              # [missing]
    reach = nearest_squared_distances(points, 3).sum(1).sqrt() / 3                    # [M] per axis; 0 for a single point
    offsets = reach[source, None] * torch.randn(missing, 3, generator=generator)
    return (torch.cat([points, points[source] + offsets]),
            None if colors is None else torch.cat([colors, colors[source]]))


def view_cube(capture: Capture) -> tuple[list[float], list[float]]:
    """Lowest and highest corner of a cube around what the cameras look at.

    Its centre is nearest to all optical axes in the least-squares sense; half its side is what a camera at the median
    distance from there sees to either side, or the extent of the cameras if they stand around that centre, looking out.
    """
    rotations, translations = capture.viewmats[:, :3, :3].double(), capture.viewmats[:, :3, 3:].double()
    eyes = -(rotations.mT @ translations).squeeze(-1)                                 # [C, 3]
    axes = rotations[:, 2]                                                            # [C, 3] unit
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None]     # [C, 3, 3] project along the axes
    guess = (eyes + capture.extent * axes).mean(0)
    left = across.mean(0) + PARALLEL * torch.eye(3, dtype=torch.float64)
    right = (across @ eyes[:, :, None]).mean(0).squeeze(-1) + PARALLEL * guess
    centre = torch.linalg.solve(left, right)
    sizes = torch.tensor([[w, h] for w, h in zip(capture.width, capture.height, strict=True)])
    slope = (sizes / (2 * capture.Ks[:, (0, 1), (0, 1)])).amax(1)                     # [C] tan(fov / 2), the wider side
    half = float(((eyes - centre).norm(dim=1) * slope).median())
    half = max(half, 0.1 * capture.extent)
    return (centre - half).tolist(), (centre + half).tolist()
