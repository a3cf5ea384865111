"""The adaptive density control of 3DGS (Kerbl et al. 2023, section 5.2): clone, split, prune, reset of the opacities."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from tsplat.camera import Camera
from tsplat.fit.density.control import NoControl, Schedule
from tsplat.fit.density.gradients import ScreenGradients
from tsplat.fit.density.rows import forget, grow, prune
from tsplat.fit.ranks import ALONE, Ranks, own_part
from tsplat.rasterize import Meta

DENSE = 0.01          # of the extent: larger splats are split, others cloned
HUGE = 0.1            # of the extent: larger splats are pruned once there was a reset
MIN_OPACITY = 0.005
RESET_OPACITY = 0.01


class AdaptiveControl(NoControl):
    """Splats whose place on the screen the loss pulls at are cloned or split; faint and huge ones are pruned.

    **Right after a reset** of the opacities the scene is not itself, and is not `settled` for a while. Nothing is judged by it then: gradients do not
    count, and what is due is left out. There is no reset that would not settle by the end of the schedule: a fit ends with a settled scene.

    Args:
        extent: of the scene (`Capture.extent`).
        schedule: when to act; in 3DGS after every 100th step from 500 to 15,000.
        threshold: of the mean norm of the screen-space gradient (NDC) of a splat that is cloned or split.
        absgrad: take gradients without regard to sign (AbsGS); its threshold is about 4 times as high.
        reset_every: steps between resets of the opacities to at most 0.01, within the schedule; 0: never. Every splat then
            has to earn its opacity anew, which removes floaters.
        settle: steps that begin with a reset, in which the scene is not settled; default less than a sixth of `reset_every`, 499 of 3000.
        max_splats: where more would be made, those with the largest gradients are, up to this number in all.
        ranks: of which each has some of the splats, and acts on these; `max_splats` is of all.

    Raises:
        ValueError: the scene would never settle.
    """

    def __init__(self, extent: float, schedule: Schedule, *, threshold: float | None = None, absgrad: bool = False,
                 reset_every: int = 3000, settle: int | None = None, max_splats: int | None = None, ranks: Ranks = ALONE) -> None:
        self.extent, self.schedule, self.ranks = extent, schedule, ranks
        self.threshold = (8e-4 if absgrad else 2e-4) if threshold is None else threshold
        self.reset_every, self.max_splats = reset_every, max_splats
        self.settle = max(1, (reset_every - 1) // 6) if settle is None else settle
        if reset_every and not 0 <= self.settle < reset_every:
            raise ValueError(f"reset_every: expected 0, or more than settle = {self.settle} steps, which are at least 0; got {reset_every}")
        self.gradients = ScreenGradients(absgrad, ranks.count)

    def probes(self, scene: nn.Module, step: int, cameras: int = 1) -> dict[str, Tensor]:
        """Of the screen-space gradient, where the scene is settled, up to the end of the schedule."""
        return self.gradients.probes(scene, cameras) if step < self.schedule.stop and self._was_settled(step) else {}

    def observe(self, meta: Meta, camera: Camera) -> None:
        """Add the screen-space gradients of one backward pass."""
        self.gradients.observe(meta, camera)

    def growth(self, scene: nn.Module, step: int) -> int:
        """At most one new splat for each that is above the threshold."""
        return len(self._parents(scene)) if self._judges(step) else 0

    @torch.no_grad()
    def update(self, scene: nn.Module, optimiser: Optimizer, step: int, generator: torch.Generator) -> None:
        """Clone and split, prune, reset."""
        if self._judges(step):
            parents = self._parents(scene)
            large = scene.get_parameter("log_scales").amax(1) > math.log(DENSE * self.extent)
            grow(scene, optimiser, parents, large[parents], generator)
            self.gradients.clear()
            keep = scene.get_parameter("opacity_logits").sigmoid() >= MIN_OPACITY
            if self._last_reset(step - self.schedule.batch):
                keep &= scene.get_parameter("log_scales").amax(1) <= math.log(HUGE * self.extent)
            prune(scene, optimiser, keep)
        if self._last_reset(step) > step - self.schedule.batch:
            scene.get_parameter("opacity_logits").clamp_(max=math.log(RESET_OPACITY / (1 - RESET_OPACITY)))
            forget(scene, optimiser, slice(None), ("opacity_logits",))

    def settled(self, step: int) -> bool:
        """False in the `settle` steps that begin with a reset, and true when the schedule ends."""
        last = self._last_reset(step)
        return not last or step >= last + self.settle

    def state_dict(self) -> dict[str, Any]:
        """The sums of gradients."""
        return {"gradients": self.gradients.state_dict()}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Take on what `state_dict` gave."""
        self.gradients.load_state_dict(saved["gradients"])

    def _last_reset(self, step: int) -> int:
        """The step of the last reset up to `step`; 0: there was none. One that would not settle before the schedule ends is not made."""
        return max(0, min(step, self.schedule.stop - self.settle) // self.reset_every * self.reset_every) if self.reset_every else 0

    def _was_settled(self, step: int) -> bool:
        """Whether the scene that step `step` draws, as the one before it left it, can be judged."""
        return self.settled(step - self.schedule.batch)

    def _judges(self, step: int) -> bool:
        """Whether splats come and go after step `step`, before a reset if there is one."""
        return self.schedule.due(step) and self._was_settled(step)

    def _parents(self, scene: nn.Module) -> Tensor:
        means = scene.get_parameter("means")
        norms, own = self.ranks.gather(self.gradients.mean(len(means), means.detach()))
        parents = (norms > self.threshold).nonzero()[:, 0]
        room = len(parents) if self.max_splats is None else max(0, self.max_splats - len(norms))
        return own_part(parents if len(parents) <= room else parents[norms[parents].topk(room).indices].sort().values, own)
