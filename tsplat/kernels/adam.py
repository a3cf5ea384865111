"""A step of Adam on the rows that are visible: one pass over parameter, gradient and moments, where torch has a dozen.

Bound by memory: a row that rests is not read, but for its flag. A block holds whole rows, so that the program that reads a row's count of
steps is the one that raises it.
"""

from __future__ import annotations

import math

import triton
import triton.language as tl
from torch import Tensor

from tsplat.kernels.launch import Launcher, ceil_div, launch

SMALL = tl.constexpr(0.1)
"""Below it 1 - exp(x) would lose more digits to cancellation than five terms of its series leave out."""


@triton.jit
def one_minus_exp(x):
    """1 - exp(x), to 1e-6 of it in float32 and 1e-9 in float64 for any x <= 0: of beta^1 = 0.999, too."""
    series = -x * (1.0 + x / 2.0 * (1.0 + x / 3.0 * (1.0 + x / 4.0 * (1.0 + x / 5.0 * (1.0 + x / 6.0)))))
    return tl.where(x > -SMALL, series, 1.0 - tl.exp(x))


@Launcher
@triton.jit(do_not_specialize=["N"])
def adam_rows_kernel(parameter, grad, exp_avg, exp_avg_sq, steps, visible, N, lr: tl.float64, rest1: tl.float64, rest2: tl.float64,
                     log_beta1: tl.float64, log_beta2: tl.float64, eps: tl.float64, K: tl.constexpr, WIDTH: tl.constexpr, ROWS: tl.constexpr):
    """Rows of K numbers, WIDTH >= K a power of 2; rest is 1 - beta, which float32 cannot take from beta to more than 4 digits."""
    dt: tl.constexpr = parameter.dtype.element_ty
    n = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    seen = tl.load(visible + n, mask=n < N, other=0) != 0
    k = tl.load(steps + n, mask=seen, other=0.0) + 1.0
    tl.store(steps + n, k, mask=seen)
    bias1 = one_minus_exp(k * tl.full((), log_beta1, dt))
    bias2 = one_minus_exp(k * tl.full((), log_beta2, dt))
    column = tl.arange(0, WIDTH)
    place = n[:, None] * K + column[None, :]                                      # [ROWS, WIDTH]
    mask = seen[:, None] & (column < K)[None, :]
    g = tl.load(grad + place, mask=mask, other=0.0)
    m = tl.load(exp_avg + place, mask=mask, other=0.0)
    v = tl.load(exp_avg_sq + place, mask=mask, other=0.0)
    m += (g - m) * tl.full((), rest1, dt)
    v += (g * g - v) * tl.full((), rest2, dt)
    tl.store(exp_avg + place, m, mask=mask)
    tl.store(exp_avg_sq + place, v, mask=mask)
    step = (m / bias1[:, None]) / (tl.sqrt(v / bias2[:, None]) + tl.full((), eps, dt))
    p = tl.load(parameter + place, mask=mask, other=0.0)
    tl.store(parameter + place, p - tl.full((), lr, dt) * step, mask=mask)


def adam_rows(parameter: Tensor, grad: Tensor, exp_avg: Tensor, exp_avg_sq: Tensor, steps: Tensor, visible: Tensor, lr: float, beta1: float,
              beta2: float, eps: float) -> None:
    """Launcher; see `tsplat.ops.adam_rows`.

    Raises:
        ValueError: what is written is not contiguous.
    """
    for name, tensor in (("parameter", parameter), ("exp_avg", exp_avg), ("exp_avg_sq", exp_avg_sq), ("steps", steps)):
        if not tensor.is_contiguous():
            raise ValueError(f"{name}: expected a contiguous tensor, as it is written in place; got strides {tensor.stride()}")
    if not parameter.numel():
        return
    N, K = len(parameter), parameter[0].numel()
    options = launch("adam")
    width = 1 << (K - 1).bit_length()
    rows = max(1, options.pop("BLOCK") // width)
    logs = (math.log(beta) if beta else -1e30 for beta in (beta1, beta2))
    adam_rows_kernel[(ceil_div(N, rows),)](
        parameter, grad.contiguous(), exp_avg, exp_avg_sq, steps, visible.contiguous(), N, float(lr), 1 - beta1, 1 - beta2, *logs, float(eps),
        K=K, WIDTH=width, ROWS=rows, **options)
