"""Drawing `Gaussians` as they are fitted: with some bands of their colours, over a background."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from tsplat.camera import Camera
from tsplat.fit.config import FitConfig
from tsplat.rasterize import DepthMode, Rendering, rasterize
from tsplat.scene import Gaussians

if TYPE_CHECKING:
    from torch.distributed import ProcessGroup


def draw(gaussians: Gaussians, camera: Camera, background: Tensor | None = None, *, sh_degree: int | None = None,
         antialiased: bool = False, depth: DepthMode | None = None, probes: Mapping[str, Tensor] | None = None,
         group: ProcessGroup | None = None) -> Rendering:
    """Render with the bands of spherical harmonics up to `sh_degree` (default: all). Bands not drawn get no gradient at all.

    Args:
        camera: one or a batch.
        background: `[3]`, default black.
        antialiased, depth, group: see `rasterize`.
        probes: `screen_offset` or `absgrad` of `rasterize`, for density control.
    """
    probes = probes or {}
    degree = gaussians.sh_degree if sh_degree is None else sh_degree
    rest = (degree + 1) ** 2 - 1
    sh = torch.cat([gaussians.sh0, gaussians.sh_rest[:, :rest]], dim=1) if rest else gaussians.sh0
    return rasterize(gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, sh, camera, sh_degree=degree,
                     background=background, antialiased=antialiased, depth=depth,
                     screen_offset=probes.get("screen_offset"), absgrad=probes.get("absgrad"), group=group)


def fixed_background(config: FitConfig) -> Tensor:
    """`[3]`, the background of the evaluation."""
    return torch.full((3,), 0.0 if config.background == "black" else 1.0)


def step_background(config: FitConfig, generator: torch.Generator) -> Tensor:
    """`[3]`, the background of one step."""
    return torch.rand(3, generator=generator) if config.background == "random" else fixed_background(config)
