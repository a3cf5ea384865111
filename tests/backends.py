"""Where the ops of a test run."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pytest
import torch

from tsplat import Camera
from tsplat.ops.common import Op


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


    @contextlib.contextmanager
    def active(self) -> Iterator[Backend]:
        """The ops run here: the interpreted kernels, too, take tensors of the CPU."""
        with contextlib.ExitStack() as stack:
            if self.name == "interpreter":
                pytest.importorskip("triton", reason="Triton is not installed here")
                for op in OPS:
                    stack.enter_context(op.set_kernel_enabled("cpu", False))
            yield self


OPS: list[Op] = [getattr(importlib.import_module(f"tsplat.ops.{module}"), f"{name}_op") for module, name in (
    ("projection", "project"), ("projection", "project_backward"), ("frustum", "may_see"),
    ("harmonics", "harmonics"), ("harmonics", "harmonics_backward"),
    ("binning", "bin_splats"), ("binning", "bin_splats_fixed"), ("blending", "blend"), ("blending", "blend_backward"),
    ("spheres", "outlines"), ("spheres", "nearest_hits"), ("spheres", "blend_spheres"), ("spheres", "blend_spheres_backward"))]
KERNELS = Backend("cuda", torch.device("cuda"), torch.float64) if torch.cuda.is_available() else Backend(
    "interpreter", torch.device("cpu"), torch.float64)
"""The Triton kernels: on a GPU if there is one, else interpreted."""
BACKENDS = {b.name: b for b in (Backend("reference", torch.device("cpu"), torch.float64), KERNELS)}


@contextlib.contextmanager
def reference_again() -> Iterator[None]:
    """CPU tensors run the reference, where they are sent to the interpreted kernels around this, too."""
    with contextlib.ExitStack() as stack:
        for op in OPS:
            stack.enter_context(op.set_kernel_enabled("cpu", True))
        yield
