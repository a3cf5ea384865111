"""What every kind of density control is to a training loop, and when it acts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from tsplat.camera import Camera


@dataclass(frozen=True)
class Schedule:
    """Act after the steps that are multiples of `every`, from `start` on and before `stop` (counted from 1).

    Where a loop counts several steps at a time, `batch`, it acts when it came to or past one of these.
    """

    start: int
    stop: int
    every: int
    batch: int = 1

    def due(self, step: int) -> bool:
        """Whether to act after `step` steps."""
        return self.last(step, self.every) > max(self.start - 1, step - self.batch)

    def last(self, step: int, every: int) -> int:
        """The last multiple of `every` up to `step` and before `stop`."""
        return min(step, self.stop - 1) // every * every

    def part(self, step: int) -> float:
        """Which part of the actions is behind after that of `step`: above 0, and 1 for the last."""
        first, last = -(-self.start // self.every), (self.stop - 1) // self.every
        return min(1.0, (self.last(step, self.every) // self.every - first + 1) / max(1, last - first + 1))


class Control(Protocol):
    """Density control of a scene, in the loop that `tsplat.fit.density` shows.

    A scene is any module whose parameters share their first dimension, N, and have the names of `Gaussians`; `nn.ParameterDict`
    is one. Where N changes, its parameters are replaced by new ones, in the module and in the optimiser.
    """

    def probes(self, scene: nn.Module, step: int, cameras: int = 1) -> dict[str, Tensor]:
        """Arguments for `rasterize` in step `step` (counted from 1) that collect what `observe` needs to know."""
        ...

    def observe(self, meta: Any, camera: Camera) -> None:
        """Take note of one backward pass."""
        ...

    def update(self, scene: nn.Module, optimiser: Optimizer, step: int, generator: torch.Generator) -> None:
        """Act, if it is time to, after `step` steps."""
        ...

    def growth(self, scene: nn.Module, step: int) -> int:
        """How many splats `update` may add at most, now."""
        ...

    def settled(self, step: int) -> bool:
        """Whether the scene can be judged after `step` steps: not right after its opacities were reset. It can at the end of a fit."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """All that changes."""
        ...

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Take on what `state_dict` gave."""
        ...


class NoControl:
    """The scene keeps its splats. Also what the other kinds have in common."""

    def probes(self, scene: nn.Module, step: int, cameras: int = 1) -> dict[str, Tensor]:
        """None."""
        return {}

    def observe(self, meta: Any, camera: Camera) -> None:
        """Nothing."""

    def update(self, scene: nn.Module, optimiser: Optimizer, step: int, generator: torch.Generator) -> None:
        """Nothing."""

    def growth(self, scene: nn.Module, step: int) -> int:
        """0."""
        return 0

    def settled(self, step: int) -> bool:
        """Always."""
        return True

    def state_dict(self) -> dict[str, Any]:
        """Empty."""
        return {}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Nothing."""
