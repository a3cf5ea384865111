"""A step of Adam on some rows as a custom op that writes in place: CPU tensors run torch, others the Triton kernel."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.library import custom_op

from tsplat.ops.common import run_kernel


def adam_rows(parameter: Tensor, grad: Tensor, exp_avg: Tensor, exp_avg_sq: Tensor, steps: Tensor, visible: Tensor, lr: float, beta1: float,
              beta2: float, eps: float) -> None:
    """One step of Adam (Kingma and Ba 2015, algorithm 1) on the rows where `visible`, in place; the others stay.

    Args:
        parameter, grad, exp_avg, exp_avg_sq: `[N, ...]`, of one shape and dtype, the parameter and its moments contiguous.
        steps: `[N]`, of the same dtype: how often each row was moved before; by it the moments are corrected.
        visible: bool `[N]`.
    """
    adam_rows_op(parameter, grad, exp_avg, exp_avg_sq, steps, visible, lr, beta1, beta2, eps)


@custom_op("tsplat::adam_rows", mutates_args=("parameter", "exp_avg", "exp_avg_sq", "steps"))
def adam_rows_op(parameter: Tensor, grad: Tensor, exp_avg: Tensor, exp_avg_sq: Tensor, steps: Tensor, visible: Tensor, lr: float, beta1: float,
                 beta2: float, eps: float) -> None:
    """By the kernel."""
    run_kernel("adam", "adam_rows", parameter, parameter, grad, exp_avg, exp_avg_sq, steps, visible, lr, beta1, beta2, eps)


@adam_rows_op.register_kernel("cpu")
def _adam_rows_cpu(parameter: Tensor, grad: Tensor, exp_avg: Tensor, exp_avg_sq: Tensor, steps: Tensor, visible: Tensor, lr: float, beta1: float,
                   beta2: float, eps: float) -> None:
    rows = visible.nonzero()[:, 0]
    k = steps[rows] + 1
    g, m, v = (x.index_select(0, rows) for x in (grad, exp_avg, exp_avg_sq))                # x[rows] takes 9 times as long
    m.lerp_(g, 1 - beta1)
    v.mul_(beta2).addcmul_(g, g, value=1 - beta2)
    column = (-1,) + (1,) * (g.ndim - 1)
    first, second = -torch.expm1(k * _log(beta1)), -torch.expm1(k * _log(beta2))
    step = (m / first.view(column)) / ((v / second.view(column)).sqrt() + eps)
    parameter.index_add_(0, rows, step, alpha=-lr)
    for saved, new in ((exp_avg, m), (exp_avg_sq, v), (steps, k)):
        saved.index_copy_(0, rows, new)


@adam_rows_op.register_fake
def _adam_rows_fake(parameter: Tensor, grad: Tensor, exp_avg: Tensor, exp_avg_sq: Tensor, steps: Tensor, visible: Tensor, lr: float, beta1: float,
                    beta2: float, eps: float) -> None:
    return None


def _log(beta: float) -> float:
    return math.log(beta) if beta else -math.inf
