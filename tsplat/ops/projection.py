"""Projection of Gaussians to 2D splats as a custom op: CPU tensors run the reference, others the Triton kernels."""

from __future__ import annotations

from typing import Any

import torch
import tsplat_reference as reference
from torch import Tensor
from tsplat_reference import Projection

from tsplat.ops.common import Op, at, contiguous, rows_of, run_kernel, second_derivative, spread

Five = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
Six = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


def project(means: Tensor, quats: Tensor | None, scales: Tensor | None, covars: Tensor | None, opacities: Tensor, viewmats: Tensor,
            Ks: Tensor, width: int, height: int, model: str, near: float, far: float, eps2d: float, antialiased: bool) -> Projection:
    """`tsplat_reference.project` as an op, with gradients to means, quats, scales, covars, viewmats and Ks."""
    return Projection(*project_op(means, quats, scales, covars, opacities, viewmats, Ks, width, height, model, near, far, eps2d,
                                  antialiased))


def _project(means: Tensor, quats: Tensor | None, scales: Tensor | None, covars: Tensor | None, opacities: Tensor, viewmats: Tensor,
             Ks: Tensor, width: int, height: int, model: str, near: float, far: float, eps2d: float, antialiased: bool) -> Five:
    """radii, means2d, depths, conics, compensations."""
    radii, means2d, depths, conics, compensations = run_kernel(
        "projection", "project", means, means, quats, scales, covars, opacities, viewmats, Ks, width, height, model, near, far, eps2d,
        antialiased)
    return radii, means2d, depths, conics, compensations


def _project_backward(means: Tensor, quats: Tensor | None, scales: Tensor | None, covars: Tensor | None, opacities: Tensor,
                      viewmats: Tensor, Ks: Tensor, width: int, height: int, model: str, near: float, far: float, eps2d: float,
                      antialiased: bool, radii: Tensor, v_means2d: Tensor, v_depths: Tensor | None, v_conics: Tensor,
                      v_compensations: Tensor | None, cameras: bool = True) -> Six:
    """Gradients of means, quats, scales, covars, viewmats and Ks, empty for those that are None, and without `cameras` for the last two."""
    return _some_empty(means, run_kernel(
        "projection", "project_backward", means, means, quats, scales, covars, viewmats, Ks, width, height, model, eps2d, antialiased,
        radii, v_means2d, v_depths, v_conics, v_compensations, cameras))


def _project_cpu(*args: Any) -> Five:
    radii, means2d, depths, conics, compensations = reference.project(*args)
    return radii, means2d, depths, conics, compensations


@contiguous
def _project_backward_cpu(means: Tensor, quats: Tensor | None, scales: Tensor | None, covars: Tensor | None, opacities: Tensor,
                          viewmats: Tensor, Ks: Tensor, width: int, height: int, model: str, near: float, far: float, eps2d: float,
                          antialiased: bool, radii: Tensor, v_means2d: Tensor, v_depths: Tensor | None, v_conics: Tensor,
                          v_compensations: Tensor | None, cameras: bool = True) -> Six:
    rows = rows_of(radii[..., 0] > 0, v_means2d, v_depths, v_conics, v_compensations)
    results = reference.project_backward(
        at(means, rows), at(quats, rows), at(scales, rows), at(covars, rows), viewmats, Ks, width, height, model, eps2d, antialiased,
        at(radii, rows, 1), at(v_means2d, rows, 1), at(v_depths, rows, 1), at(v_conics, rows, 1), at(v_compensations, rows, 1), cameras)
    return _some_empty(means, (*(spread(v, rows, len(means)) for v in results[:4]), *results[4:]))


def _some_empty(means: Tensor, results: tuple[Tensor | None, ...]) -> Six:
    """An op returns tensors only."""
    return tuple(means.new_empty(0) if r is None else r for r in results)  # type: ignore[return-value]


def _project_fake(means: Tensor, quats: Any, scales: Any, covars: Any, opacities: Any, viewmats: Tensor, *_: Any) -> Five:
    shape = viewmats.shape[0], means.shape[0]
    return (means.new_empty(*shape, 2, dtype=torch.int32), means.new_empty(*shape, 2), means.new_empty(*shape), means.new_empty(*shape, 3),
            means.new_empty(*shape))


def _project_backward_fake(means: Tensor, quats: Tensor | None, scales: Tensor | None, covars: Tensor | None, opacities: Tensor,
                           viewmats: Tensor, Ks: Tensor, width: int, height: int, model: str, near: float, far: float, eps2d: float,
                           antialiased: bool, radii: Tensor, v_means2d: Tensor, v_depths: Tensor | None, v_conics: Tensor,
                           v_compensations: Tensor | None, cameras: bool = True) -> Six:
    inputs = means, quats, scales, covars, *((viewmats, Ks) if cameras else (viewmats[:0], Ks[:0]))
    return tuple(means.new_empty(0 if x is None else x.shape) for x in inputs)  # type: ignore[return-value]


def _save(ctx: Any, inputs: tuple[Any, ...], output: Five) -> None:
    tensors, ctx.options = inputs[:7], inputs[7:]
    ctx.mark_non_differentiable(output[0])
    ctx.set_materialize_grads(False)                    # depths and compensations seldom have one, and zeros would be written and read
    ctx.save_for_backward(*tensors, output[0])


def _backward(ctx: Any, _: Any, *gradients: Tensor | None) -> tuple[Any, ...]:
    *tensors, radii = ctx.saved_tensors
    if all(v is None for v in gradients):
        return (None,) * 14
    v_means2d, v_depths, v_conics, v_compensations = (None if v is None else v.contiguous() for v in gradients)
    shape, means = radii.shape[:2], tensors[0]
    v_means2d = means.new_zeros(*shape, 2) if v_means2d is None else v_means2d
    v_conics = means.new_zeros(*shape, 3) if v_conics is None else v_conics
    cameras = any(ctx.needs_input_grad[5:7])            # seldom wanted, and 8 more operations of torch
    results = project_backward_op(*tensors, *ctx.options, radii, v_means2d, v_depths, v_conics, v_compensations, cameras)
    v_shapes = (None if x is None else r for x, r in zip(tensors[:4], results, strict=False))
    return *v_shapes, None, *(results[4:] if cameras else (None, None)), *[None] * 7


def _save_backward(ctx: Any, inputs: tuple[Any, ...], output: Six) -> None:
    ctx.options, ctx.cameras = inputs[7:14], all(inputs[19:])
    ctx.save_for_backward(*inputs[:7], *inputs[15:19])


def _double_backward(ctx: Any, *v_gradients: Tensor) -> tuple[Any, ...]:
    means, quats, scales, covars, opacities, viewmats, Ks, *cotangents = ctx.saved_tensors

    def forward(means: Tensor, quats: Any, scales: Any, covars: Any, viewmats: Tensor, Ks: Tensor) -> list[Tensor]:
        return list(reference.project(means, quats, scales, covars, opacities, viewmats, Ks, *ctx.options)[1:])

    v_inputs, v_cotangents = second_derivative(forward, (means, quats, scales, covars, viewmats, Ks), cotangents,
                                               v_gradients if ctx.cameras else (*v_gradients[:4], None, None))
    return *v_inputs[:4], None, *v_inputs[4:], *[None] * 8, *v_cotangents, None


project_op = Op("tsplat::project", _project, cpu=_project_cpu, fake=_project_fake, setup=_save, backward=_backward, vmap=True)
project_backward_op = Op("tsplat::project_backward", _project_backward, cpu=_project_backward_cpu, fake=_project_backward_fake,
                         setup=_save_backward, backward=_double_backward, vmap=True)
