"""Drawing a scene that stays in host memory: what a camera may see goes to its device, and gradients come back.

All that a fit knows of splats is then in host memory, with as many rows as the scene has: parameters, their gradients, the optimiser's
state, what density control sums up. Rows are put together in pinned memory, from where a GPU fetches them by itself. On a CPU the result
has the same bits as without: the splats left out are ones that would not be drawn, the others keep their order, and what is computed of
all (opacities, scales, regularisers) is computed of all here, too.

**What is pinned** is what moves: the rows that a camera may see, put together by the CPU in a buffer of page-locked memory that torch keeps for
the next step. The scene itself and the optimiser's state are not. A GPU copies what lies in one piece, and chosen rows do not: they would have to be
put together all the same, and to lock 944 bytes per splat takes them from everything else on the machine, and seconds when they grow.

**Nothing is fetched ahead.** What the next camera may see, and the values of it, can change until Adam, here on the CPU, has moved all rows; so
nothing is known that could be copied beside a step, on another stream, but the photo, which is (`PhotoStream`). It would gain little: for 23,390
of 1M splats 5.4 MiB go down and 5.9 up, half a millisecond at 25 GB/s, of a step of 500 on the CPU (`bench/offload.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from tsplat_reference.constants import EPS2D

from tsplat.camera import Camera
from tsplat.ops import may_see
from tsplat.ops.common import spread
from tsplat.rasterize import Rendering
from tsplat.scene import Gaussians


def draw_rows(draw: Callable[..., Rendering], gaussians: Gaussians, camera: Camera, probes: Mapping[str, Tensor]) -> Rendering:
    """`draw(gaussians, probes=probes)` on the device of the camera, a single one, with the splats that it may see.

    Args:
        draw: of Gaussians, or of what has their properties, and probes `[1, N, 2]` (see `tsplat.fit.draw`), all on one device.
        gaussians, probes: in host memory. Gradients get there.

    Returns:
        What `draw` gave, with a `meta` of all N splats in host memory, but for the lists of the tiles: those left out are culled.
    """
    with torch.no_grad():
        near = camera.to(gaussians.device)
        seen = may_see(gaussians.means, gaussians.log_scales.amax(1).exp(), gaussians.opacities, near.viewmats[None], near.Ks[None],
                       camera.width, camera.height, camera.model, camera.near, camera.far, EPS2D)
        rows = seen[0].nonzero()[:, 0]
    device, n = camera.viewmats.device, len(gaussians)
    rendering = draw(_Rows(gaussians, rows, device), probes={name: take(probe, rows, 1, device) for name, probe in probes.items()})
    meta = rendering.meta
    radii, means2d, depths = (spread(x.to(gaussians.device), rows, n, 1) for x in (meta.radii, meta.means2d, meta.depths))
    return rendering._replace(meta=meta._replace(radii=radii, means2d=means2d, depths=depths))


class _Rows:
    """Some of a scene's splats on another device: its properties, of which a tensor is copied when it is asked for."""

    def __init__(self, scene: Gaussians, rows: Tensor, device: torch.device) -> None:
        self._scene, self._rows, self._device = scene, rows, device

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._scene, name)
        return take(value, self._rows, 0, self._device) if isinstance(value, Tensor) else value


def take(values: Tensor, rows: Tensor, dim: int, device: torch.device) -> Tensor:
    """`values`, in host memory, at `rows` along `dim`, on `device`."""
    taken: Tensor = _Take.apply(values, rows, dim, device)  # type: ignore[no-untyped-call]
    return taken


class _Take(torch.autograd.Function):
    """`index_select` by way of pinned memory: a copy from there is direct, and the CPU does not wait for it."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, rows: Tensor, dim: int, device: torch.device) -> Tensor:
        ctx.save_for_backward(rows)
        ctx.dim, ctx.n, ctx.home = dim, values.shape[dim], values.device
        staging = _staging((*values.shape[:dim], len(rows), *values.shape[dim + 1:]), values.dtype, values.device, device)
        torch.index_select(values, dim, rows, out=staging)
        return staging.to(device, non_blocking=True)             # torch keeps pinned memory from being reused before the copy is done

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Any, ...]:
        (rows,) = ctx.saved_tensors
        if gradient.device != ctx.home:
            gradient = _staging(gradient.shape, gradient.dtype, ctx.home, gradient.device).copy_(gradient)
        return spread(gradient, rows, ctx.n, ctx.dim), None, None, None


def _staging(shape: tuple[int, ...], dtype: torch.dtype, home: torch.device, device: torch.device) -> Tensor:
    """At `home`, for a copy to or from `device`."""
    return torch.empty(shape, dtype=dtype, device=home, pin_memory=home.type == "cpu" and device.type == "cuda")
