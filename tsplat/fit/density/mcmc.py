"""3DGS as Markov chain Monte Carlo (Kheradmand et al. 2024): dead splats are relocated, all are shaken, the number is capped."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from tsplat.fit.density.control import NoControl, Schedule
from tsplat.fit.density.rows import forget, take_rows, turned
from tsplat.fit.ranks import ALONE, Ranks, even

MIN_OPACITY = 0.005
MAX_COPIES = 51       # of one splat in one action; equation 9 is a sum of that many binomials
GROWTH = 1.05
STEEP, NOISE = 100.0, 5e5


class MCMC(NoControl):
    """Relocate and grow at the schedule's steps; add noise at every step.

    The method wants opacities from 0.5 and scales from 0.1 of the neighbours' distance at the start, and L1 regularisers of 0.01
    on both, which make room for relocation.

    Args:
        schedule: when to relocate and grow; in the paper after every 100th step from 500 to 25,000.
        max_splats: grow by 5 % at a time up to this number.
        noise: of the means, per learning rate of theirs.
        ranks: of which each has some of the splats. Dead ones become copies of living ones of the same rank, and each rank grows by the same number:
            with blocks of a like mix of splats, as ranks have, that is as drawing from all.
    """

    def __init__(self, schedule: Schedule, max_splats: int, noise: float = NOISE, ranks: Ranks = ALONE) -> None:
        self.schedule, self.max_splats, self.noise, self.ranks = schedule, max_splats, noise, ranks

    def growth(self, scene: nn.Module, step: int) -> int:
        """5 %, up to the cap; of several ranks, the share of this one."""
        if not self.schedule.due(step):
            return 0
        n = self.ranks.total(len(scene.get_parameter("means")))
        return even(max(0, min(self.max_splats, int(GROWTH * n)) - n), self.ranks.count)[self.ranks.rank]

    @torch.no_grad()
    def update(self, scene: nn.Module, optimiser: Optimizer, step: int, generator: torch.Generator) -> None:
        """Relocate and grow, if it is time to; add noise of the size of the means' learning rate (group of that name)."""
        added = self.growth(scene, step)
        if self.schedule.due(step):
            opacities = scene.get_parameter("opacity_logits").sigmoid()
            dead = opacities <= MIN_OPACITY
            self._copy(scene, optimiser, dead.nonzero()[:, 0], torch.where(dead, 0, opacities), generator)
            opacities = scene.get_parameter("opacity_logits").sigmoid()
            n = len(opacities)
            if added and bool((opacities > MIN_OPACITY).any()):
                rows = torch.arange(n + added, device=opacities.device).clamp(max=n - 1)
                take_rows(scene, optimiser, rows, rows.new_ones(n + added).cumsum(0) > n)
                places = torch.arange(n, n + added, device=opacities.device)
                self._copy(scene, optimiser, places, torch.where(opacities > MIN_OPACITY, opacities, 0), generator)
        rate = next((group["lr"] for group in optimiser.param_groups if any(p is scene.get_parameter("means") for p in group["params"])), 0.0)
        self._shake(scene, float(rate), generator)

    def _copy(self, scene: nn.Module, optimiser: Optimizer, places: Tensor, weights: Tensor, generator: torch.Generator) -> None:
        """Make splats `places` `[P]` copies of ones drawn with probability proportional to `weights` `[n]`, n <= N.

        All copies of one share its opacity and size such that they look as it did (equation 9).
        """
        if not len(places) or not bool((weights > 0).any()):
            return
        cumulative = weights.double().cumsum(0)                        # not multinomial, which takes 2^24 weights at most
        drawn = torch.rand(len(places), dtype=torch.float64, generator=generator).to(cumulative.device) * cumulative[-1]
        alive = (weights > 0).nonzero()[:, 0]
        sources = alive[torch.searchsorted(cumulative[alive], drawn, right=True).clamp(max=len(alive) - 1)]
        copies = (torch.bincount(sources, minlength=len(weights)) + 1).clamp(max=MAX_COPIES)[sources]
        logits, log_scales = scene.get_parameter("opacity_logits"), scene.get_parameter("log_scales")
        opacities, shrink = shared_opacity(logits[sources].sigmoid(), copies)
        opacities = opacities.clamp(MIN_OPACITY, 1 - torch.finfo(opacities.dtype).eps)
        logits[sources] = torch.logit(opacities)
        log_scales[sources] = log_scales[sources] + shrink.log()[:, None]
        for parameter in scene.parameters():
            parameter[places] = parameter[sources]
        forget(scene, optimiser, torch.cat([sources, places]))

    def _shake(self, scene: nn.Module, rate: float, generator: torch.Generator) -> None:
        """Noise of the shape of each splat, for the faint ones (equation 8)."""
        means, quats = scene.get_parameter("means"), scene.get_parameter("quats")
        if not self.noise or not len(means):
            return
        faint = torch.sigmoid(-STEEP * (scene.get_parameter("opacity_logits").sigmoid() - MIN_OPACITY))
        noise = torch.randn(len(means), 3, generator=generator).to(means)
        inverse = quats * quats.new_tensor([1.0, -1.0, -1.0, -1.0])
        noise = turned(quats, turned(inverse, noise) * (2 * scene.get_parameter("log_scales")).exp())       # Sigma noise
        means.add_(noise * (rate * self.noise * faint)[:, None])

    def state_dict(self) -> dict[str, Any]:
        """Empty: it knows the scene alone."""
        return {}


def shared_opacity(opacities: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """What makes n equal splats at one place look like one (Kheradmand et al. 2024, equation 9).

    Args:
        opacities: `[P]`, of the one.
        copies: int64 `[P]`, 1 to 51.

    Returns:
        `[P]` opacity of each, 1 - (1 - o)^(1/n), and `[P]` factor of its scales.
    """
    o = opacities.double()
    new = -torch.expm1(torch.log1p(-o.clamp(max=1 - 1e-7)) / copies)
    most = int(copies.max())
    binomials = torch.tensor([[math.comb(i, k) for k in range(most)] for i in range(most)], dtype=torch.float64, device=o.device)
    k = torch.arange(most, dtype=torch.float64, device=o.device)
    terms = (-1) ** k * new[:, None] ** (k + 1) / (k + 1).sqrt()       # [P, k]
    sums = (terms @ binomials.T).cumsum(1)                             # [P, n]: of i up to n - 1
    shrink = o / sums.gather(1, (copies - 1)[:, None])[:, 0]
    return new.to(opacities), shrink.to(opacities)
