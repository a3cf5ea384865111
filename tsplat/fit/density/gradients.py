"""Screen-space gradients, summed over steps: what tells where splats are missing."""

from __future__ import annotations

import functools

import torch
from torch import Tensor, nn

from tsplat.camera import Camera
from tsplat.rasterize import Meta


class ScreenGradients:
    """Sum of the norms of dL/dmean2d per splat, in units of half an image (NDC), and the number of views that saw it.

    Args:
        absolute: sum |dL/dmean2d| over pixels (AbsGS, Ye et al. 2024), where opposite pulls do not cancel.
        batch: photos whose mean loss is minimised; gradients are multiplied by it, to be those of one photo's.
    """

    def __init__(self, absolute: bool, batch: int = 1) -> None:
        self.absolute, self.batch = absolute, batch
        self.total: Tensor | None = None      # [N]
        self.views: Tensor | None = None      # [N]
        self._probe: Tensor | None = None

    def probes(self, scene: nn.Module, cameras: int) -> dict[str, Tensor]:
        """The argument for `rasterize`."""
        means = scene.get_parameter("means")
        self._probe = means.new_zeros(()).expand(cameras, len(means), 2).requires_grad_()       # zeros that take no memory; its gradient does
        return {"absgrad" if self.absolute else "screen_offset": self._probe}

    def observe(self, meta: Meta, camera: Camera) -> None:
        """Add what the backward pass left in the probe."""
        probe, self._probe = self._probe, None
        if probe is None or probe.grad is None:
            return
        half = probe.new_tensor([camera.width / 2, camera.height / 2]) * self.batch
        norms = functools.reduce(torch.add, ((gradient * half).norm(dim=-1) for gradient in probe.grad))         # camera by camera, for memory
        visible = meta.views.to(probe)
        if self.total is None or self.views is None or len(self.total) != len(norms):
            self.total, self.views = norms, visible
        else:
            self.total, self.views = self.total.to(norms) + norms, self.views.to(norms) + visible      # a checkpoint's are on the CPU

    def mean(self, n: int, like: Tensor) -> Tensor:
        """`[n]` mean over the views that saw a splat; 0 for splats never seen."""
        if self.total is None or self.views is None:
            return like.new_zeros(n)
        return (self.total / self.views.clamp(min=1)).to(like)

    def seen(self, n: int, like: Tensor) -> Tensor:
        """Bool `[n]`: which splats any view saw."""
        return like.new_zeros(n, dtype=torch.bool) if self.views is None else self.views.to(like.device) > 0

    def clear(self) -> None:
        """Start to sum anew."""
        self.total = self.views = None

    def state_dict(self) -> dict[str, Tensor | None]:
        """The sums."""
        return {"total": self.total, "views": self.views}

    def load_state_dict(self, saved: dict[str, Tensor | None]) -> None:
        """Take on what `state_dict` gave."""
        self.total, self.views = saved["total"], saved["views"]
