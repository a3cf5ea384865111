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
from tsplat.fit.report import History
from tsplat.fit.visible_adam import VisibleAdam
from tsplat.scene import Capture


@dataclass
class FitState:
    """A fit between two steps.

    Args:
        gaussians: the scene.
        adam: its optimiser.
        control: its density control.
        photos: what is fitted to each photo.
        generator: the source of all that is random (on the CPU, whatever the device).
        device: where a step is computed, and `photos` are; not always where the scene is (`FitConfig.offload`).
        step: steps done.
        drawn: the most splats that one of them drew, since the fit was last started.
        queue: photos yet to come before all are shuffled anew, last first.
        seconds: wall time spent so far.
        history: of loss, PSNR and splats.
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

    @classmethod
    def of(cls, scene: Scene, capture: Capture, config: FitConfig, generator: torch.Generator, device: torch.device) -> FitState:
        """The state before the first step."""
        control = primitive_of(config).control(config, capture.extent, len(scene))
        photos = PhotoParameters(len(capture), config).to(device)
        scene = scene.to(config.home(device))
        return cls(scene, make_adam(scene, visible_only=config.optimiser == "visible"), control, photos, generator, device)

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
    def from_state_dict(cls, saved: dict[str, Any], capture: Capture, config: FitConfig, device: torch.device) -> FitState:
        """The state that `state_dict` described, of a fit that goes on on `device`."""
        state = cls.of(primitive_of(config).load(saved["gaussians"]), capture, config, torch.Generator(), device)
        state.adam.load_state_dict(saved["adam"])
        state.control.load_state_dict(saved["control"])
        state.photos.load_state_dict(saved["photos"])
        if state.photos.adam is not None:
            state.photos.adam.load_state_dict(saved["photos_adam"])
        state.generator.set_state(saved["generator"])
        state.step, state.queue, state.seconds = saved["step"], saved["queue"], saved["seconds"]
        state.history = History(**saved["history"])
        return state
