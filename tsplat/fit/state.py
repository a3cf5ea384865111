"""`FitState`: everything of a fit that changes from step to step, and so all that a checkpoint has to hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import torch
from torch.optim import Adam

from tsplat.fit.config import FitConfig
from tsplat.fit.density import Control
from tsplat.fit.optimiser import make_adam
from tsplat.fit.photos import PhotoParameters
from tsplat.fit.primitive import Scene, primitive_of
from tsplat.fit.ranks import ALONE, Ranks, even
from tsplat.fit.report import History
from tsplat.fit.shards import map_rows
from tsplat.fit.visible_adam import VisibleAdam
from tsplat.scene import Capture


@dataclass
class FitState:
    """A fit between two steps.

    Args:
        gaussians: the scene, of several ranks the own part.
        adam: its optimiser.
        control: its density control.
        photos: what is fitted to each photo.
        generator: the source of all that is random (on the CPU, whatever the device).
        device: where a step is computed, and `photos` are; not always where the scene is (`FitConfig.offload`).
        step: photos done.
        drawn: the most splats that a step drew, since the fit was last started; counted where the scene is drawn elsewhere than it is.
        queue: photos yet to come before all are shuffled anew, last first.
        seconds: wall time spent so far.
        history: of loss, PSNR and splats.
        ranks: the processes of the fit. What is no splat's is the same on all.
    """

    gaussians: Scene
    adam: Adam | VisibleAdam
    control: Control
    photos: PhotoParameters
    generator: torch.Generator
    device: torch.device
    step: int = 0
    drawn: int = 0
    queue: list[int] = field(default_factory=list)
    seconds: float = 0.0
    history: History = field(default_factory=History)
    ranks: Ranks = ALONE

    @classmethod
    def of(cls, scene: Scene, capture: Capture, config: FitConfig, generator: torch.Generator, device: torch.device, ranks: Ranks = ALONE
           ) -> FitState:
        """The state before the first step."""
        control = primitive_of(config).control(config, capture.extent, ranks.total(len(scene)), ranks)
        photos = PhotoParameters(len(capture), config).to(device)
        scene = scene.to(config.home(device))
        return cls(scene, make_adam(scene, visible_only=config.optimiser == "visible"), control, photos, generator, device, ranks=ranks)

    def next_view(self, views: Sequence[int]) -> int:
        """One of `views` at random, without replacement until all had their turn."""
        if not self.queue:
            self.queue = [views[i] for i in torch.randperm(len(views), generator=self.generator).tolist()]
        return self.queue.pop()

    def state_dict(self) -> dict[str, Any]:
        """Tensors and plain values, as `torch.load(..., weights_only=True)` reads them."""
        return {"gaussians": self.gaussians.state_dict(), "adam": self.adam.state_dict(), "control": self.control.state_dict(),
                "photos": self.photos.state_dict(), "photos_adam": None if self.photos.adam is None else self.photos.adam.state_dict(),
                "generator": self.generator.get_state(), "step": self.step, "queue": self.queue, "seconds": self.seconds,
                "history": asdict(self.history)}

    @classmethod
    def from_state_dict(cls, saved: dict[str, Any], capture: Capture, config: FitConfig, device: torch.device, ranks: Ranks = ALONE) -> FitState:
        """The state that `state_dict` described, of a fit that goes on on `device`."""
        state = cls.of(primitive_of(config).load(saved["gaussians"]), capture, config, torch.Generator(), device, ranks)
        state.adam.load_state_dict(saved["adam"])
        state.control.load_state_dict(saved["control"])
        state.photos.load_state_dict(saved["photos"])
        if state.photos.adam is not None:
            state.photos.adam.load_state_dict(saved["photos_adam"])
        state.generator.set_state(saved["generator"])
        state.step, state.queue, state.seconds = saved["step"], saved["queue"], saved["seconds"]
        state.history = History(**saved["history"])
        return state

    def whole_scene(self, config: FitConfig) -> Scene:
        """The scene of all ranks, on the CPU of rank 0; on the others, or if there is one rank, what it has."""
        rows = {name: self.ranks.collected(value) for name, value in self.gaussians.state_dict().items()} if self.ranks.count > 1 else {}
        return primitive_of(config).load(rows) if rows and self.ranks.rank == 0 else self.gaussians

    def rebalance(self, sizes: list[int], capture: Capture, config: FitConfig) -> None:
        """Move splats, with all that is known of them, until the ranks, which have `sizes` of them, differ by at most 1 (`Ranks.moved`)."""
        moved = map_rows(self.state_dict(), lambda _, rows: self.ranks.moved(rows, sizes, even(sum(sizes), len(sizes))))
        state = FitState.from_state_dict(moved, capture, config, self.device, self.ranks)
        self.gaussians, self.adam, self.control = state.gaussians, state.adam, state.control
