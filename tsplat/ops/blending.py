"""Blending as a custom op: CPU tensors run the reference, in blocks, others the Triton kernels."""

from __future__ import annotations

from typing import Any

import torch
import tsplat_reference as reference
from torch import Tensor

from tsplat.ops.common import Op, contiguous, run_kernel, second_derivative

Five = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]


def blend(means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, backgrounds: Tensor | None, absgrad: Tensor | None,
          ids: Tensor, offsets: Tensor, width: int, height: int, tile: int, alpha_max: float, drop_last: bool = False
          ) -> tuple[Tensor, Tensor]:
    """`tsplat_reference.blend` as an op, with gradients to means2d, conics, opacities, colors and backgrounds.

    `absgrad` `[C, N, 2]` changes nothing in the result; as its gradient it receives the sum over pixels of |dL/dmeans2d|.
    """
    image, alphas = blend_op(means2d, conics, opacities, colors, backgrounds, absgrad, ids, offsets, width, height, tile, alpha_max,
                             drop_last)
    return image, alphas


def _blend(means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, backgrounds: Tensor | None, absgrad: Tensor | None,
           ids: Tensor, offsets: Tensor, width: int, height: int, tile: int, alpha_max: float, drop_last: bool) -> tuple[Tensor, Tensor]:
    """Image and alpha."""
    image, alphas = run_kernel("blending", "blend", means2d, means2d, conics, opacities, colors, backgrounds, ids, offsets, width, height,
                               tile, alpha_max, drop_last)
    return image, alphas


def _blend_backward(means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, backgrounds: Tensor | None, ids: Tensor,
                    offsets: Tensor, image: Tensor, alphas: Tensor, v_image: Tensor, v_alphas: Tensor | None, width: int, height: int,
                    tile: int, alpha_max: float, drop_last: bool, absgrad: bool) -> Five:
    """Gradients of means2d, conics, opacities and colors, and the absolute gradient, `[C, 0, 2]` unless asked for."""
    v_means2d, v_conics, v_opacities, v_colors, v_abs = run_kernel(
        "blending", "blend_backward", means2d, means2d, conics, opacities, colors, backgrounds, ids, offsets, image, alphas, v_image,
        v_alphas, width, height, tile, alpha_max, drop_last, absgrad)
    return v_means2d, v_conics, v_opacities, v_colors, v_abs


def _blend_cpu(means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, backgrounds: Tensor | None, absgrad: Tensor | None,
               *lists: Any) -> tuple[Tensor, Tensor]:
    return reference.blend_blocks(means2d, conics, opacities, colors, backgrounds, *lists)


def _blend_fake(means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, backgrounds: Tensor | None, absgrad: Tensor | None,
                ids: Tensor, offsets: Tensor, width: int, height: int, *_: Any) -> tuple[Tensor, Tensor]:
    shape = means2d.shape[0], height, width
    return colors.new_empty(*shape, colors.shape[2]), colors.new_empty(shape)


def _blend_backward_fake(means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, backgrounds: Tensor | None, ids: Tensor,
                         offsets: Tensor, image: Tensor, alphas: Tensor, v_image: Tensor, v_alphas: Tensor | None, width: int, height: int,
                         tile: int, alpha_max: float, drop_last: bool, absgrad: bool) -> Five:
    C, N = opacities.shape
    return (*(x.new_empty(x.shape) for x in (means2d, conics, opacities, colors)),
            means2d.new_empty(C, N if absgrad else 0, 2))  # type: ignore[return-value]


def _save(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
    means2d, conics, opacities, colors, backgrounds, absgrad, ids, offsets, *ctx.options = inputs
    ctx.absgrad = absgrad is not None
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(means2d, conics, opacities, colors, backgrounds, ids, offsets, *output)


def _backward(ctx: Any, v_image: Tensor | None, v_alphas: Tensor | None) -> tuple[Any, ...]:
    if v_image is None and v_alphas is None:
        return (None,) * 13
    tensors = ctx.saved_tensors
    v_image = torch.zeros_like(tensors[7]) if v_image is None else v_image.contiguous()
    *v_inputs, v_abs = blend_backward_op(*tensors, v_image, None if v_alphas is None else v_alphas.contiguous(), *ctx.options, ctx.absgrad)
    v_backgrounds = (v_image * (1 - tensors[8])[..., None]).sum((1, 2)) if ctx.needs_input_grad[4] else None
    return *v_inputs, v_backgrounds, v_abs if ctx.absgrad else None, *[None] * 7


def _save_backward(ctx: Any, inputs: tuple[Any, ...], output: Five) -> None:
    *differentiable, ids, offsets, _, _, v_image, v_alphas = inputs[:11]
    ctx.options = inputs[11:16]
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*differentiable, ids, offsets, v_image, v_alphas)


def _double_backward(ctx: Any, *v_gradients: Tensor) -> tuple[Any, ...]:
    if v_gradients[4] is not None:
        raise NotImplementedError("tsplat: absgrad has no derivative; it is a measure for density control")
    means2d, conics, opacities, colors, backgrounds, ids, offsets, v_image, v_alphas = ctx.saved_tensors

    def forward(means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, backgrounds: Tensor | None) -> tuple[Tensor, Tensor]:
        return reference.blend(means2d, conics, opacities, colors, backgrounds, ids, offsets, *ctx.options)

    v_inputs, v_cotangents = second_derivative(forward, (means2d, conics, opacities, colors, backgrounds), (v_image, v_alphas),
                                               (*v_gradients[:4], None))
    return *v_inputs, *[None] * 4, *v_cotangents, *[None] * 6


blend_op = Op("tsplat::blend", _blend, cpu=_blend_cpu, fake=_blend_fake, setup=_save, backward=_backward)
blend_backward_op = Op("tsplat::blend_backward", _blend_backward, cpu=contiguous(reference.blend_blocks_backward), fake=_blend_backward_fake,
                       setup=_save_backward, backward=_double_backward)
