"""`FitState`: everything of a fit that changes from step to step, and so all that a checkpoint has to hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch.optim import Adam

from tsplat.fit.optimiser import make_adam
from tsplat.scene import Gaussians


@dataclass
class FitState:
    """A fit between two steps.

    Args:
        gaussians: the scene.
        adam: its optimiser.
        generator: the source of all that is random (on the CPU, whatever the device).
        step: steps done.
        queue: photos yet to come before all are shuffled anew, last first.
        seconds: wall time spent so far.
    """

    gaussians: Gaussians
    adam: Adam
    generator: torch.Generator
    step: int = 0
    queue: list[int] = field(default_factory=list)
    seconds: float = 0.0

    def next_view(self, views: Sequence[int]) -> int:
        """One of `views` at random, without replacement until all had their turn."""
        if not self.queue:
            self.queue = [views[i] for i in torch.randperm(len(views), generator=self.generator).tolist()]
        return self.queue.pop()

    def state_dict(self) -> dict[str, Any]:
        """Tensors and plain values, as `torch.load(..., weights_only=True)` reads them."""
        return {"gaussians": self.gaussians.state_dict(), "adam": self.adam.state_dict(),
                "generator": self.generator.get_state(), "step": self.step, "queue": self.queue, "seconds": self.seconds}

    @classmethod
    def from_state_dict(cls, saved: dict[str, Any], device: torch.device) -> FitState:
        """The state that `state_dict` described, with its scene on `device`."""
        gaussians = Gaussians(**saved["gaussians"]).to(device)
        adam = make_adam(gaussians)
        adam.load_state_dict(saved["adam"])
        generator = torch.Generator()
        generator.set_state(saved["generator"])
        return cls(gaussians, adam, generator, saved["step"], saved["queue"], saved["seconds"])
