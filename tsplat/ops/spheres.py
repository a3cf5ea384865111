"""Pulsar's spheres as custom ops: CPU tensors run the reference, in blocks, others the Triton kernels."""

from __future__ import annotations

from typing import Any

import torch
import tsplat_reference as reference
from torch import Tensor
from tsplat_reference import Outlines, SphereImages

from tsplat.ops.common import Op, contiguous, run_kernel, second_derivative

Four = tuple[Tensor, Tensor, Tensor, Tensor]
Five = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
Seven = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


def outlines(centers: Tensor, radii: Tensor, Ks: Tensor, width: int, height: int, model: str, near: float, far: float) -> Outlines:
    """`tsplat_reference.outlines` as an op. Not differentiable."""
    return Outlines(*outlines_op(centers, radii, Ks, width, height, model, near, far))


def nearest_hits(centers: Tensor, radii: Tensor, Ks: Tensor, ids: Tensor, offsets: Tensor, count: int, width: int, height: int, tile: int,
                 model: str, near: float, far: float, chord: bool) -> Tensor:
    """`tsplat_reference.nearest_hits` as an op. Not differentiable."""
    hits: Tensor = nearest_hits_op(centers, radii, Ks, ids, offsets, count, width, height, tile, model, near, far, chord)
    return hits


def blend_spheres(centers: Tensor, radii: Tensor, opacities: Tensor, features: Tensor, backgrounds: Tensor, gamma: Tensor, Ks: Tensor,
                  ids: Tensor, offsets: Tensor, cutoff: Tensor | None, width: int, height: int, tile: int, model: str, near: float, far: float,
                  background_depth: float, chord: bool, depth: bool, tolerance: float) -> SphereImages:
    """`tsplat_reference.blend_spheres` as an op, with gradients to centers, radii, opacities, features, backgrounds, gamma and Ks.

    A tile ends where all spheres behind, together, weigh at most `tolerance` at each of its pixels.
    """
    return SphereImages(*blend_spheres_op(centers, radii, opacities, features, backgrounds, gamma, Ks, ids, offsets, cutoff, width, height,
                                          tile, model, near, far, background_depth, chord, depth, tolerance))


def _outlines(centers: Tensor, radii: Tensor, Ks: Tensor, width: int, height: int, model: str, near: float, far: float) -> Five:
    """radii, means2d, conics, opacities, depths."""
    radii2d, means2d, conics, opacities, depths = run_kernel("spheres", "outlines", centers, centers, radii, Ks, width, height, model, near,
                                                             far)
    return radii2d, means2d, conics, opacities, depths


@contiguous
def _outlines_cpu(*args: Any) -> Five:
    radii2d, means2d, conics, opacities, depths = reference.outlines(*args)
    return radii2d, means2d, conics, opacities, depths


def _outlines_fake(centers: Tensor, *_: Any) -> Five:
    shape = centers.shape[:2]
    return (centers.new_empty(*shape, 2, dtype=torch.int32), centers.new_empty(*shape, 2), centers.new_empty(*shape, 3),
            centers.new_empty(shape), centers.new_empty(shape))


def _nearest_hits(centers: Tensor, radii: Tensor, Ks: Tensor, ids: Tensor, offsets: Tensor, count: int, width: int, height: int, tile: int,
                  model: str, near: float, far: float, chord: bool) -> Tensor:
    hits: Tensor = run_kernel("spheres", "nearest_hits", centers, centers, radii, Ks, ids, offsets, count, width, height, tile, model, near,
                              far, chord)
    return hits


def _nearest_hits_fake(centers: Tensor, radii: Tensor, Ks: Tensor, ids: Tensor, offsets: Tensor, count: int, width: int, height: int,
                       *_: Any) -> Tensor:
    return centers.new_empty(centers.shape[0], height, width, count, dtype=torch.int32)


def _blend_spheres(centers: Tensor, radii: Tensor, opacities: Tensor, features: Tensor, backgrounds: Tensor, gamma: Tensor, Ks: Tensor,
                   ids: Tensor, offsets: Tensor, cutoff: Tensor | None, width: int, height: int, tile: int, model: str, near: float,
                   far: float, background_depth: float, chord: bool, depth: bool, tolerance: float) -> Four:
    """Image, depth, log-sum-exp, and the number of hits used of each tile."""
    image, depths, logsumexp, used = run_kernel(
        "spheres", "blend_spheres", centers, centers, radii, opacities, features, backgrounds, gamma, Ks, ids, offsets, width, height, tile,
        model, near, far, background_depth, chord, depth, tolerance)
    return image, depths, logsumexp, used


def _blend_spheres_cpu(*args: Any) -> Four:
    image, depths, logsumexp, used = reference.blend_sphere_blocks(*args[:9], *args[10:])
    return image, depths, logsumexp, used


def _blend_spheres_fake(centers: Tensor, radii: Tensor, opacities: Tensor, features: Tensor, backgrounds: Tensor, gamma: Tensor, Ks: Tensor,
                        ids: Tensor, offsets: Tensor, cutoff: Tensor | None, width: int, height: int, tile: int, model: str, near: float,
                        far: float, background_depth: float, chord: bool, depth: bool, tolerance: float) -> Four:
    C = centers.shape[0]
    return (centers.new_empty(C, height, width, features.shape[2]), centers.new_empty(C, height if depth else 0, width),
            centers.new_empty(C, height, width), centers.new_empty(offsets.shape[0] - 1, dtype=torch.int32))


def _blend_spheres_backward(centers: Tensor, radii: Tensor, opacities: Tensor, features: Tensor, backgrounds: Tensor, gamma: Tensor, Ks: Tensor,
                            ids: Tensor, offsets: Tensor, cutoff: Tensor | None, image: Tensor, depths: Tensor, logsumexp: Tensor,
                            used: Tensor, v_image: Tensor, v_depth: Tensor | None, v_logsumexp: Tensor | None, width: int, height: int,
                            tile: int, model: str, near: float, far: float, background_depth: float, chord: bool, intrinsics: bool) -> Seven:
    """Gradients of centers, radii, opacities, features, backgrounds, gamma and Ks (empty without `intrinsics`)."""
    return _seven(run_kernel(
        "spheres", "blend_spheres_backward", centers, centers, radii, opacities, features, backgrounds, gamma, Ks, ids, offsets, cutoff,
        SphereImages(image, depths, logsumexp, used), v_image, v_depth, v_logsumexp, width, height, tile, model, near, far, background_depth,
        chord, intrinsics), intrinsics)


@contiguous
def _blend_spheres_backward_cpu(*args: Any) -> Seven:
    arguments = *args[:10], SphereImages(*args[10:14]), *args[14:]
    return _seven(reference.blend_sphere_blocks_backward(*arguments), args[-1])


def _seven(gradients: tuple[Tensor, ...], intrinsics: bool) -> Seven:
    v_centers, v_radii, v_opacities, v_features, v_backgrounds, v_gamma, v_Ks = gradients
    return v_centers, v_radii, v_opacities, v_features, v_backgrounds, v_gamma, v_Ks if intrinsics else v_Ks.new_empty(0)


def _blend_spheres_backward_fake(*args: Any) -> Seven:
    return _seven(tuple(x.new_empty(x.shape) for x in args[:7]), args[-1])


def _save(ctx: Any, inputs: tuple[Any, ...], output: Four) -> None:
    ctx.options, ctx.depth = inputs[10:18], inputs[18]
    ctx.mark_non_differentiable(output[3])
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*inputs[:10], *output)


def _backward(ctx: Any, v_image: Tensor | None, v_depth: Tensor | None, v_logsumexp: Tensor | None, _: Any) -> tuple[Any, ...]:
    if v_image is None and v_depth is None and v_logsumexp is None:
        return (None,) * 20
    tensors, intrinsics = ctx.saved_tensors, ctx.needs_input_grad[6]
    v_image = torch.zeros_like(tensors[10]) if v_image is None else v_image.contiguous()
    v_depth, v_logsumexp = (None if v is None else v.contiguous() for v in (v_depth if ctx.depth else None, v_logsumexp))
    *v_inputs, v_Ks = blend_spheres_backward_op(*tensors, v_image, v_depth, v_logsumexp, *ctx.options, intrinsics)
    return *v_inputs, v_Ks if intrinsics else None, *[None] * 13


def _save_backward(ctx: Any, inputs: tuple[Any, ...], output: Seven) -> None:
    ctx.options, ctx.intrinsics = inputs[17:25], inputs[25]
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*inputs[:10], *inputs[13:17])


def _double_backward(ctx: Any, *v_gradients: Tensor | None) -> tuple[Any, ...]:
    *inputs, ids, offsets, cutoff, used, v_image, v_depth, v_logsumexp = ctx.saved_tensors

    def forward(centers: Tensor, radii: Tensor, opacities: Tensor, features: Tensor, backgrounds: Tensor, gamma: Tensor, Ks: Tensor
                ) -> list[Tensor]:
        options = *ctx.options, v_depth is not None, used
        return list(reference.blend_spheres(centers, radii, opacities, features, backgrounds, gamma, Ks, ids, offsets, cutoff, *options)[:3])

    v_inputs, v_cotangents = second_derivative(forward, inputs, (v_image, v_depth, v_logsumexp),
                                               v_gradients if ctx.intrinsics else (*v_gradients[:6], None))
    return *v_inputs, *[None] * 7, *v_cotangents, *[None] * 9


outlines_op = Op("tsplat::outlines", _outlines, cpu=_outlines_cpu, fake=_outlines_fake)
nearest_hits_op = Op("tsplat::nearest_hits", _nearest_hits, cpu=reference.nearest_hits, fake=_nearest_hits_fake)
blend_spheres_op = Op("tsplat::blend_spheres", _blend_spheres, cpu=_blend_spheres_cpu, fake=_blend_spheres_fake, setup=_save,
                      backward=_backward)
blend_spheres_backward_op = Op("tsplat::blend_spheres_backward", _blend_spheres_backward, cpu=_blend_spheres_backward_cpu,
                               fake=_blend_spheres_backward_fake, setup=_save_backward, backward=_double_backward)
