"""Which splats cameras may see: a thread per splat, a loop over the cameras, so that a splat is read once, 20 bytes, and a byte written for each.

The twin of `tsplat_reference.frustum`. Sums of six products, not a matrix product, which torch may be told to take in TF32: that loses splats.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor
from tsplat_reference.constants import ALPHA_MIN, VIEW_SLACK

from tsplat.kernels.camera import load_row
from tsplat.kernels.launch import Launcher, ceil_div, launch


@Launcher
@triton.jit(do_not_specialize=["N", "C"])
def may_see_kernel(means, sizes, opacities, planes, seen, N, C, PLANES: tl.constexpr, ALPHA_MIN: tl.constexpr, SLACK: tl.constexpr,
                   BLOCK: tl.constexpr):
    """One block of splats, all cameras in turn; what is not finite is on no plane's inner side."""
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = n < N
    x, y, z = load_row(means + n * 3, inside, 3, 1)
    opacity = tl.load(opacities + n, mask=inside, other=0.0)
    size = tl.load(sizes + n, mask=inside, other=0.0)
    drawn = opacity > (1.0 - SLACK) * ALPHA_MIN
    reach = size * tl.sqrt(tl.maximum(2.0 * tl.log(tl.where(drawn, opacity, 1.0) / ALPHA_MIN) + SLACK, 0.0))
    total = tl.abs(x) + tl.abs(y) + tl.abs(z)
    camera = tl.full((), 0, tl.int64)
    while camera < C:
        ahead = drawn
        beside = drawn
        for i in tl.static_range(PLANES):
            p = planes + (camera * PLANES + i) * 6
            within = (tl.load(p) * x + tl.load(p + 1) * y + tl.load(p + 2) * z + tl.load(p + 3) + tl.load(p + 4) * total
                      + tl.load(p + 5) * reach) > 0
            if i < 2:
                ahead &= within
            else:
                beside &= within
        tl.store(seen + camera * N + n, (ahead & (beside | (opacity > 1.0))).to(tl.int8), mask=inside)
        camera += 1


def may_see(means: Tensor, sizes: Tensor, opacities: Tensor, planes: Tensor) -> Tensor:
    """Launcher; see `tsplat_reference.may_see`."""
    (C, P), N = planes.shape[:2], len(means)
    seen = means.new_empty(C, N, dtype=torch.int8)
    if C * N > 0:
        options = launch("may_see")
        may_see_kernel[(ceil_div(N, options["BLOCK"]),)](
            means.contiguous(), sizes.contiguous(), opacities.contiguous(), planes.to(means).contiguous(), seen, N, C, PLANES=P,
            ALPHA_MIN=ALPHA_MIN, SLACK=VIEW_SLACK, **options)
    return seen.view(torch.bool)
