"""Spheres (Pulsar) as what a fit is made of: gamma falls, spheres that nothing sees are dropped, and large ones become 12 (section 5.1)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from tsplat.camera import Camera
from tsplat.fit.config import FitConfig
from tsplat.fit.density import Control, NoControl
from tsplat.fit.density.rows import prune, take_rows
from tsplat.fit.drawing import fixed_background
from tsplat.fit.initial import initial_points
from tsplat.fit.losses import scene_regulariser
from tsplat.fit.ranks import ALONE, Ranks
from tsplat.fit.schedules import progress, rate_factor
from tsplat.fit.spheres import CHILDREN, gamma_at, refine, worth_keeping
from tsplat.scene import Capture, Spheres

RATES = {"positions": 4e-4, "log_radii": 2e-3, "opacity_logits": 1e-2, "features": 4e-3}
"""Learning rates of a fit of 30,000 steps; that of the positions per extent."""
ACTIONS = 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7
"""After which parts of the steps spheres are pruned and refined: 0.6 dB more than after 1/3 and 2/3 (massa, 400 steps)."""
COLOR_DISTANCE = 0.1
NEAREST, FARTHEST = 0.5, 1.5
"""Depths that count, from the distances of the first spheres to the cameras: from half the least to 1.5 times the largest, but for outliers."""
OUTLIERS = 5e-3
SAMPLE = 1_000_000


class SphereMeta(NamedTuple):
    """What a fit asks of a drawing. visible: bool `[C, N]`. depths: `[C, N]`, camera z."""

    visible: Tensor
    depths: Tensor
    pairs: None = None
    shape: tuple[int, int] = (0, 0)

    @property
    def views(self) -> Tensor:
        """Int64 `[N]`: how many of the cameras saw each sphere."""
        return self.visible.sum(0)


class SphereDrawing(NamedTuple):
    """As `Rendering`, without depth, which here is the distance along rays."""

    image: Tensor
    alpha: Tensor
    depth: None
    meta: SphereMeta


class SpherePrimitive:
    """Pulsar's spheres."""

    def start(self, capture: Capture, config: FitConfig, generator: Any) -> Spheres:
        """At the points that Gaussians would start from; near and far are what holds them, for all cameras."""
        points, colors = initial_points(capture, config, generator)
        eyes = -(capture.viewmats[:, :3, :3].mT @ capture.viewmats[:, :3, 3:]).squeeze(-1)
        near, far = 0.01 * capture.extent, 10 * capture.extent
        if len(points):
            few = points[::max(1, len(points) * len(eyes) // SAMPLE)]
            distances = torch.cdist(few, eyes.to(few)).flatten()[:SAMPLE]
            low, high = torch.quantile(distances, torch.tensor([OUTLIERS, 1 - OUTLIERS])).tolist()
            near, far = NEAREST * low, FARTHEST * high
        spheres = Spheres.from_points(points, colors, config.value("init_opacity"), gamma=config.gamma_last, near=near, far=far)
        with torch.no_grad():
            spheres.log_radii.add_(math.log(config.value("init_scale")))
        return spheres

    def load(self, saved: dict[str, Any]) -> Spheres:
        """From its state."""
        spheres = Spheres(**{name: saved[name] for name in Spheres.NAMES})
        spheres.set_extra_state(saved["_extra_state"])
        return spheres

    def draw(self, scene: Spheres, camera: Camera, background: Tensor, config: FitConfig, step: int | None = None, *, depth: bool = False,
             probes: Mapping[str, Tensor] | None = None, ranks: Ranks = ALONE) -> SphereDrawing:
        """With gamma as at `step`, or (None) as in the end."""
        if depth:
            raise NotImplementedError("depth_weight: depth maps do not supervise spheres yet; expected 0")
        gamma = scene.gamma if step is None else gamma_at(step, config.steps, config.gamma_first, config.gamma_last)
        r = scene.render(camera, background=background, gamma=gamma, fade_below=config.fade_below)
        viewmats = camera.viewmats.view(-1, 4, 4)
        depths = (scene.positions * viewmats[:, None, 2, :3]).sum(-1) + viewmats[:, None, 2, 3]
        return SphereDrawing(r.image, r.alpha, None, SphereMeta(r.visible.view(len(viewmats), -1), depths))

    def regulariser(self, scene: Spheres, rendering: SphereDrawing, extent: float, weights: Mapping[str, float],
                    ranks: Ranks = ALONE) -> Tensor | None:
        """See `scene_regulariser`."""
        return scene_regulariser(scene.opacities, scene.radii, rendering.meta, extent, **weights, ranks=ranks)

    def rates(self, config: FitConfig, extent: float, step: int, photos: int = 1) -> dict[str, float]:
        """`RATES`, times `rate_factor`; that of the positions falls as that of Gaussians' means."""
        factor = rate_factor(config, photos)
        scale = {"positions": extent * config.lr_means_decay ** progress(config, step)}
        return {name: factor * rate * scale.get(name, 1.0) for name, rate in RATES.items()}

    @torch.no_grad()
    def confine(self, scene: Spheres) -> None:
        """Colours stay in 0..1. Where they may leave it, some darker than black make up for others as long as gamma is soft, and show as it
        hardens; and spheres in front of the background do not take its colour, by which they are pruned (16.9 and 20.1 dB)."""
        scene.features.clamp_(0.0, 1.0)

    def control(self, config: FitConfig, extent: float, splats: int, ranks: Ranks = ALONE) -> Control:
        """Pruning and refining, or nothing with the density control `none`."""
        if config.density == "none":
            return NoControl()
        if config.density != "budget":
            raise ValueError(f"density: expected 'budget' (prune, and refine up to max_splats) or 'none' for spheres; got {config.density!r}")
        steps = [max(1, round(part * config.steps)) for part in ACTIONS]
        return PruneAndRefine(steps, config.max_splats or splats, None if config.background == "random" else fixed_background(config))


class PruneAndRefine(NoControl):
    """Drops spheres that got no gradient of their features since the last time, or look like the background, and splits the largest of the
    others into 12 each (`tsplat.fit.spheres.refine`), as many as the budget allows.

    Args:
        steps: after which it acts.
        budget: never more spheres than this.
        background: `[3]`, or None if that is random: then colours do not tell.
    """

    def __init__(self, steps: list[int], budget: int, background: Tensor | None) -> None:
        self.steps, self.budget, self.background = steps, budget, background
        self.seen: Tensor | None = None

    @torch.no_grad()
    def update(self, scene: nn.Module, optimiser: Optimizer, step: int, generator: torch.Generator) -> None:
        """See `Control.update`."""
        features = scene.get_parameter("features")
        if features.grad is not None:
            now = (features.grad != 0).any(1)
            self.seen = now if self.seen is None else self.seen | now
        if step not in self.steps or self.seen is None:
            return
        background = features.new_full((features.shape[1],), -math.inf) if self.background is None else self.background.to(features)
        prune(scene, optimiser, worth_keeping(features, background, self.seen.to(features), color_distance=COLOR_DISTANCE))
        _refine_largest(scene, optimiser, self.budget)
        self.seen = None

    def growth(self, scene: nn.Module, step: int) -> int:
        """See `Control.growth`."""
        return max(0, self.budget - len(scene.get_parameter("features"))) if step in self.steps else 0

    def state_dict(self) -> dict[str, Any]:
        """See `Control.state_dict`."""
        return {"seen": self.seen}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """See `Control.load_state_dict`."""
        self.seen = saved["seen"]


def _refine_largest(scene: nn.Module, optimiser: Optimizer, budget: int) -> None:
    """Put 12 in the place of as many of the largest spheres as the budget has room for."""
    log_radii = scene.get_parameter("log_radii")
    n = len(log_radii)
    count = min(n, max(0, budget - n) // (CHILDREN - 1))
    if not count:
        return
    largest = log_radii.topk(count).indices
    stay = torch.ones(n, dtype=torch.bool, device=log_radii.device)
    stay[largest] = False
    children = refine(scene.get_parameter("positions")[largest], log_radii[largest].exp())
    rows = torch.cat([stay.nonzero()[:, 0], largest[children.parents]])
    fresh = torch.arange(len(rows), device=rows.device) >= n - count
    take_rows(scene, optimiser, rows, fresh)
    scene.get_parameter("positions")[fresh] = children.positions
    scene.get_parameter("log_radii")[fresh] = children.radii.log()
