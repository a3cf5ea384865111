"""The same fits over another rasteriser: gsplat's (1.5.3) in the place of ours, with trainer, loss, optimiser and density control as they are."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

import tsplat.fit.drawing
from tsplat.camera import Camera
from tsplat.rasterize import DepthMode, Meta, Rendering

RASTERIZERS = "tsplat", "gsplat"
MODES: dict[DepthMode | None, str] = {None: "RGB", "accumulated": "RGB+D", "expected": "RGB+ED"}


def check_rasterizer(name: str, config: tsplat.fit.FitConfig) -> None:
    """ValueError if fits with this config cannot draw by it."""
    if name == "tsplat":
        return
    if config.primitive != "gaussians" or config.offload:
        raise ValueError("--rasterizer: expected tsplat for spheres and with --offload; got gsplat")
    try:
        import gsplat  # noqa: F401
    except ImportError as error:
        raise ValueError(f"--rasterizer: gsplat cannot be imported ({error}): pip install gsplat==1.5.3, which is for CUDA") from None


@contextmanager
def drawn_by(name: str) -> Iterator[None]:
    """Within this, fits and their evaluation draw Gaussians by that rasteriser: there is one place where they call it."""
    ours = tsplat.fit.drawing.rasterize
    tsplat.fit.drawing.rasterize = ours if name == "tsplat" else by_gsplat
    try:
        yield
    finally:
        tsplat.fit.drawing.rasterize = ours


def by_gsplat(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, camera: Camera, *, sh_degree: int,
              background: Tensor | None, antialiased: bool, depth: DepthMode | None, screen_offset: Tensor | None, absgrad: Tensor | None,
              group: Any) -> Rendering:
    """`tsplat.rasterize` as fits call it, by `gsplat.rasterization`. Probes of density control get the gradients that gsplat keeps for its own:
    of `means2d`, or its `absgrad`."""
    from gsplat import rasterization

    assert group is None
    one = camera.viewmats.ndim == 2
    viewmats, Ks = camera.viewmats.view(-1, 4, 4), camera.Ks.view(-1, 3, 3)
    backgrounds = None if background is None else background.expand(len(viewmats), -1)
    image, alpha, found = rasterization(
        means, quats, scales, opacities, colors, viewmats, Ks, camera.width, camera.height, near_plane=camera.near, far_plane=camera.far,
        sh_degree=sh_degree, packed=False, backgrounds=backgrounds, render_mode=MODES[depth], absgrad=absgrad is not None,
        rasterize_mode="antialiased" if antialiased else "classic")
    means2d, probe = found["means2d"], screen_offset if absgrad is None else absgrad
    if probe is not None and means2d.requires_grad:
        # after the node that blends, whose backward sets .absgrad
        means2d.register_hook(lambda gradient: setattr(probe, "grad", gradient if absgrad is None else means2d.absgrad))
    meta = Meta(found["radii"], means2d, found["depths"], torch.zeros(0, dtype=torch.int64), (0, 0))
    parts = image[..., :3], alpha[..., 0], None if depth is None else image[..., 3]
    return Rendering(*(part[0] if one and part is not None else part for part in parts), meta)
