"""Spherical harmonics as a custom op: CPU tensors run the reference, others the Triton kernels."""

from __future__ import annotations

from typing import Any

import torch
import tsplat_reference as reference
from torch import Tensor

from tsplat.ops.common import Op, at, contiguous, rows_of, run_kernel, second_derivative, spread

Three = tuple[Tensor, Tensor, Tensor]


def harmonics(means: Tensor, centers: Tensor, coeffs: Tensor, degree: int, mask: Tensor) -> Tensor:
    """`tsplat_reference.harmonics` as an op, with gradients to means, centers and coeffs."""
    out: Tensor = harmonics_op(means, centers, coeffs, degree, mask)
    return out


def _harmonics(means: Tensor, centers: Tensor, coeffs: Tensor, degree: int, mask: Tensor) -> Tensor:
    """`[C, N, D]`."""
    out: Tensor = run_kernel("harmonics", "harmonics", means, means, centers, coeffs, degree, mask)
    return out


def _harmonics_backward(means: Tensor, centers: Tensor, coeffs: Tensor, degree: int, mask: Tensor, v_out: Tensor, cameras: bool = True
                        ) -> Three:
    """Gradients of means, centers (`[0, 3]` without `cameras`) and coeffs."""
    v_means, v_centers, v_coeffs = run_kernel("harmonics", "harmonics_backward", means, means, centers, coeffs, degree, mask, v_out, cameras)
    return v_means, v_centers, v_coeffs


def _harmonics_cpu(means: Tensor, centers: Tensor, coeffs: Tensor, degree: int, mask: Tensor) -> Tensor:
    rows = rows_of(mask)
    out = reference.harmonics(at(means, rows), centers, at(coeffs, rows), degree, at(mask, rows, 1))
    return spread(out, rows, len(means), 1).contiguous()


def _harmonics_fake(means: Tensor, centers: Tensor, coeffs: Tensor, degree: int, mask: Tensor) -> Tensor:
    return coeffs.new_empty(centers.shape[0], means.shape[0], coeffs.shape[2])


@contiguous
def _harmonics_backward_cpu(means: Tensor, centers: Tensor, coeffs: Tensor, degree: int, mask: Tensor, v_out: Tensor, cameras: bool = True
                            ) -> Three:
    rows, n = rows_of(mask, v_out), len(means)
    v_means, v_centers, v_coeffs = reference.harmonics_backward(at(means, rows), centers, at(coeffs, rows), degree, at(mask, rows, 1),
                                                                at(v_out, rows, 1))
    return spread(v_means, rows, n), v_centers if cameras else centers.new_empty(0, 3), spread(v_coeffs, rows, n)


def _harmonics_backward_fake(means: Tensor, centers: Tensor, coeffs: Tensor, degree: int, mask: Tensor, v_out: Tensor, cameras: bool = True
                             ) -> Three:
    return means.new_empty(means.shape), centers.new_empty(centers.shape if cameras else (0, 3)), coeffs.new_empty(coeffs.shape)


def _save(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    means, centers, coeffs, ctx.degree, mask = inputs
    ctx.save_for_backward(means, centers, coeffs, mask)


def _backward(ctx: Any, v_out: Tensor) -> tuple[Any, ...]:
    means, centers, coeffs, mask = ctx.saved_tensors
    cameras = ctx.needs_input_grad[1]
    v_means, v_centers, v_coeffs = harmonics_backward_op(means, centers, coeffs, ctx.degree, mask, v_out.contiguous(), cameras)
    return v_means, v_centers if cameras else None, v_coeffs, None, None


def _save_backward(ctx: Any, inputs: tuple[Any, ...], output: Three) -> None:
    means, centers, coeffs, ctx.degree, mask, v_out = inputs[:6]
    ctx.cameras = all(inputs[6:])
    ctx.save_for_backward(means, centers, coeffs, mask, v_out)


def _double_backward(ctx: Any, *v_gradients: Tensor) -> tuple[Any, ...]:
    means, centers, coeffs, mask, v_out = ctx.saved_tensors

    def forward(means: Tensor, centers: Tensor, coeffs: Tensor) -> list[Tensor]:
        finite = torch.where(coeffs.isfinite(), coeffs, 0.0)        # the colour of the others is not drawn: their gradient is 0, not NaN
        return [reference.harmonics(means, centers, finite, ctx.degree, mask)]

    v_means, v_centers, v_coeffs = v_gradients
    v_inputs, (v_v_out,) = second_derivative(forward, (means, centers, coeffs), (v_out,), (v_means, v_centers if ctx.cameras else None, v_coeffs))
    return *v_inputs, None, None, v_v_out, None


harmonics_op = Op("tsplat::harmonics", _harmonics, cpu=_harmonics_cpu, fake=_harmonics_fake, setup=_save, backward=_backward, vmap=True)
harmonics_backward_op = Op("tsplat::harmonics_backward", _harmonics_backward, cpu=_harmonics_backward_cpu,
                           fake=_harmonics_backward_fake, setup=_save_backward, backward=_double_backward, vmap=True)
