"""What drawing needs of splats in cameras, and their colours there: shared by one process and by many (`tsplat.distributed`)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from tsplat import ops

LEAST = 2.0**-126
"""The smallest normal number in float32."""


class Drawn(NamedTuple):
    """What binning and blending take of N splats in C cameras; or of V pairs of a camera and a splat, with V for C, N everywhere.

    radii: int32 `[C, N, 2]`, 0 for splats that are not drawn. means2d: `[C, N, 2]`. conics: `[C, N, 3]`. opacities: `[C, N]`.
    colors: `[C, N, D]`. depths: `[C, N]`. absgrad: `[C, N, 2]` or None. Opacities and colors may have 1 for C, if all cameras share them.
    """

    radii: Tensor
    means2d: Tensor
    conics: Tensor
    opacities: Tensor
    colors: Tensor
    depths: Tensor
    absgrad: Tensor | None


def shade(means: Tensor, centers: Tensor, coeffs: Tensor, degree: int, visible: Tensor) -> Tensor:
    """`[C, N, D]`, max(SH + 0.5, 0) in the directions from `centers` `[C, 3]`, where `visible`, bool `[C, N]`."""
    # with the gradient of 1 at 0 that lets a black splat become lighter: that of clamp_min is three kernels, this one
    return torch.nn.functional.threshold(ops.harmonics(means, centers, coeffs, degree, visible) + 0.5, -LEAST, 0.0)


def is_finite(colors: Tensor) -> Tensor:
    """Bool `[...]`, whether colours `[..., D]` can be drawn."""
    # 2 kernels where isfinite().all(-1) has 5; of all norms torch is fast on a CPU for this one only (17 times). Beyond 1e19 it is infinite
    norms: Tensor = torch.linalg.vector_norm(colors.detach(), 2, -1)
    return norms < torch.inf
