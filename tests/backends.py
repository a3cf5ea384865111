"""Where the ops of a test run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from tsplat import Camera


@dataclass(frozen=True)
class Backend:
    """Where the ops run, and in which precision their results are compared with `plain.py`."""

    name: str
    device: torch.device
    dtype: torch.dtype

    def put(self, value: Any) -> Any:
        """A tensor, a camera or a tuple of such, on this backend."""
        if isinstance(value, torch.Tensor):
            return value.to(self.device, self.dtype if value.is_floating_point() else value.dtype)
        if isinstance(value, Camera):
            return value.to(self.device, self.dtype)
        if isinstance(value, tuple):
            items = [self.put(v) for v in value]
            return type(value)(*items) if hasattr(value, "_fields") else tuple(items)
        return value


BACKENDS = {"reference": Backend("reference", torch.device("cpu"), torch.float64)}
"""Kernels join here: interpreted ones on CPU tensors (`op.set_kernel_enabled("cpu", False)` for each op, in the fixture), CUDA on its own."""
