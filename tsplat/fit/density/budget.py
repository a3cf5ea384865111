"""An exact budget of splats, spent by score: as many at the end as were asked for, and never more on the way."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from tsplat.camera import Camera
from tsplat.fit.density.control import NoControl, Schedule
from tsplat.fit.density.gradients import ScreenGradients
from tsplat.fit.density.rows import grow, prune
from tsplat.fit.ranks import ALONE, Ranks, own_part
from tsplat.rasterize import Meta

MIN_OPACITY = 0.005
CLONED = 0.01         # of the extent: smaller splats are cloned, others split
# with as many splats, 0, 2 and 5 % gave 34.82, 34.88 and 34.71 dB for the made-up scene in 500 steps (34.08 without control), 0 and 2 % gave
# 30.38 and 30.56 dB for fox (29.54)
RECYCLED = 0.02


class Budget(NoControl):
    """The number of splats rises from that at the start to `max_splats`, steadily, as Taming 3DGS (Mallick et al. 2024) does.

    The score of a splat is its mean absolute screen-space gradient over the views that saw it since the last action. At each
    action the part `recycled` with the lowest scores goes, the faint (opacity below 0.005) in any case; those with the highest
    are cloned (small ones) or split, until the number is met. Splats that no view saw meanwhile have not been judged, and stay.
    Opacities are never reset: what a reset is for, recycling does, and there is no transient.

    Args:
        extent: of the scene.
        schedule: when to act.
        max_splats: at the end of the schedule.
        recycled: part of the splats.
        ranks: of which each has some of the splats. They see the scores of all (`Ranks.gather`), so that those go and are cloned or split that one
            process would choose, wherever they are; the budget is of all.
    """

    def __init__(self, extent: float, schedule: Schedule, max_splats: int, recycled: float = RECYCLED, ranks: Ranks = ALONE) -> None:
        self.extent, self.schedule, self.max_splats, self.recycled, self.ranks = extent, schedule, max_splats, recycled, ranks
        self.gradients = ScreenGradients(absolute=True, batch=ranks.count)
        self.first: int | None = None             # splats before the first action

    def probes(self, scene: nn.Module, step: int, cameras: int = 1) -> dict[str, Tensor]:
        """Of the absolute screen-space gradient, up to the end of the schedule."""
        return self.gradients.probes(scene, cameras) if step < self.schedule.stop else {}

    def observe(self, meta: Meta, camera: Camera) -> None:
        """Add the screen-space gradients of one backward pass."""
        self.gradients.observe(meta, camera)

    def growth(self, scene: nn.Module, step: int) -> int:
        """Up to the number that is due; of several ranks, the even share of one."""
        if not self.schedule.due(step):
            return 0
        n = self.ranks.total(len(scene.get_parameter("means")))
        return max(0, math.ceil((self._target(n, step) - n) / self.ranks.count))

    @torch.no_grad()
    def update(self, scene: nn.Module, optimiser: Optimizer, step: int, generator: torch.Generator) -> None:
        """Drop the least, and spend what there is on the most."""
        if not self.schedule.due(step):
            return
        means = scene.get_parameter("means")
        scores = self.gradients.mean(len(means), means)
        seen = self.gradients.seen(len(means), means)
        self.gradients.clear()
        faint = scene.get_parameter("opacity_logits").sigmoid() < MIN_OPACITY
        worth, own = self.ranks.gather(scores.where(seen, torch.inf).masked_fill(faint, -1.0))      # -1: faint, infinite: neither seen nor faint
        n, faints, judged = len(worth), int((worth == -1).sum()), int((worth < torch.inf).sum())
        target = self._target(n, step)
        self.first = self.first if self.first is not None else n
        dropped = max(faints, min(int(self.recycled * n), judged), n - target)
        rows = prune(scene, optimiser, (worth.argsort(stable=True).argsort() >= dropped)[own])
        scores = scores[rows]
        everyone, own = self.ranks.gather(scores)
        while 0 < len(everyone) < target:         # more than one round where more is missing than there are splats
            parents = own_part(everyone.topk(min(len(everyone), target - len(everyone))).indices, own)
            split = scene.get_parameter("log_scales")[parents].amax(1) > math.log(CLONED * self.extent)
            rows = grow(scene, optimiser, parents, split, generator)
            scores = scores[rows] / 2
            everyone, own = self.ranks.gather(scores)

    def state_dict(self) -> dict[str, Any]:
        """The sums of gradients, and between which numbers of splats it goes."""
        return {"gradients": self.gradients.state_dict(), "first": self.first, "max_splats": self.max_splats}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Take on what `state_dict` gave."""
        self.gradients.load_state_dict(saved["gradients"])
        self.first, self.max_splats = saved["first"], saved["max_splats"]

    def _target(self, n: int, step: int) -> int:
        first = min(n if self.first is None else self.first, self.max_splats)
        return first + round((self.max_splats - first) * self.schedule.part(step))
