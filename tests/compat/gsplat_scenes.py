"""What the tests of the drop-in for gsplat share."""

from __future__ import annotations

from typing import Any

import torch
from compare import leaves
from scenes import camera, splats
from torch import Tensor


def scene(n: int = 12, cameras: int = 2, dtype: torch.dtype = torch.float64, **options: Any) -> dict[str, Any]:
    """The arguments of `rasterization` up to `height`, all of which require grad."""
    cam = camera(cameras, **options)
    names = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")
    tensors = leaves(*(t.to(dtype) for t in (*splats(n), cam.viewmats, cam.Ks)))
    return dict(zip(names, tensors, strict=True)) | {"width": cam.width, "height": cam.height}


def loss_of(*outputs: Tensor) -> Tensor:
    return sum((torch.sin(torch.arange(o.numel(), dtype=o.dtype)).view(o.shape) * o).sum() for o in outputs)  # type: ignore[return-value]
