"""Which splats cameras may see, as a custom op without gradients: CPU tensors run the reference, others the Triton kernel."""

from __future__ import annotations

import torch
import tsplat_reference as reference
from torch import Tensor

from tsplat.ops.common import Op, run_kernel


def may_see(means: Tensor, sizes: Tensor, opacities: Tensor, viewmats: Tensor, Ks: Tensor, width: int, height: int, model: str, near: float,
            far: float, eps2d: float) -> Tensor:
    """Bool `[C, N]`: what each camera may see, all that `project` keeps and few others. See `tsplat_reference.may_see` and `frustum_planes`.

    The cameras are looked at on the CPU, which waits for a GPU once.
    """
    seen: Tensor = may_see_op(means, sizes, opacities, viewmats, Ks, width, height, model, near, far, eps2d)
    return seen


def _may_see(means: Tensor, sizes: Tensor, opacities: Tensor, viewmats: Tensor, Ks: Tensor, width: int, height: int, model: str, near: float,
             far: float, eps2d: float) -> Tensor:
    planes = reference.frustum_planes(viewmats, Ks, width, height, model, near, far, eps2d)
    seen: Tensor = run_kernel("frustum", "may_see", means, means, sizes, opacities, planes)
    return seen


def _may_see_cpu(means: Tensor, sizes: Tensor, opacities: Tensor, viewmats: Tensor, Ks: Tensor, width: int, height: int, model: str, near: float,
                 far: float, eps2d: float) -> Tensor:
    planes = reference.frustum_planes(viewmats, Ks, width, height, model, near, far, eps2d)
    return reference.may_see(means, sizes, opacities, planes)


def _may_see_fake(means: Tensor, sizes: Tensor, opacities: Tensor, viewmats: Tensor, Ks: Tensor, width: int, height: int, model: str, near: float,
                  far: float, eps2d: float) -> Tensor:
    return means.new_empty(viewmats.shape[0], means.shape[0], dtype=torch.bool)


may_see_op = Op("tsplat::may_see", _may_see, cpu=_may_see_cpu, fake=_may_see_fake)
