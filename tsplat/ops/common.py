"""What all ops share: reaching the Triton kernels, forward mode, autocast, vmap, and the second derivative."""

from __future__ import annotations

import contextlib
import functools
import importlib
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch._library.custom_ops import CustomOpDef
from torch.autograd import forward_ad


def run_kernel(stage: str, name: str, tensor: Tensor, *args: Any) -> Any:
    """Call the launcher `name` of `tsplat.kernels.<stage>` on the device of `tensor`: Triton launches on the current one.

    Raises:
        NotImplementedError: where Triton is not installed (macOS, Windows).
    """
    try:
        kernels = importlib.import_module(f"tsplat.kernels.{stage}")
    except ModuleNotFoundError as error:
        if error.name is None or not error.name.startswith("triton"):
            raise
        raise NotImplementedError(f"tsplat: {name} on device {str(tensor.device)!r} needs Triton, which is not installed here; "
                                  "install it, or move the tensors to the CPU: .to('cpu')") from None
    with torch.cuda.device(tensor.device) if tensor.is_cuda else contextlib.nullcontext():
        return getattr(kernels, name)(*args)


def contiguous(function: Callable[..., tuple[Tensor, ...]]) -> Callable[..., Any]:
    """Results with the strides that the fake kernels promise, whatever those of the inputs are."""
    def call(*args: Any) -> Any:
        return tuple(r.contiguous() for r in function(*args))
    return functools.wraps(function)(call)


def reject_forward_mode(name: str, *tensors: Tensor | None) -> None:
    """Raise where a tensor carries a forward-mode tangent, which a custom op would silently drop."""
    if torch.compiler.is_compiling():
        return
    for tensor in tensors:
        if tensor is not None and forward_ad.unpack_dual(tensor).tangent is not None:  # type: ignore[no-untyped-call]
            raise NotImplementedError(f"tsplat: {name} has no forward-mode derivative (jvp); use reverse mode: backward() or "
                                      "torch.autograd.grad")


def register_autocast(*ops: CustomOpDef) -> None:
    """Run the ops in float32 under autocast: depth order and transmittance do not survive half precision."""
    for op in ops:
        for device in ("cpu", "cuda"):
            op.register_autocast(device, torch.float32)


def register_loop_vmap(*ops: CustomOpDef) -> None:
    """Vmap as a loop. (The ops have a camera dimension of their own, which is faster.)"""
    for op in ops:
        op.register_vmap(_looped(op))


def _looped(op: CustomOpDef) -> Callable[..., tuple[Any, Any]]:
    def rule(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[Any, Any]:
        results = [op(*(a if d is None else a.select(d, i) for a, d in zip(args, in_dims, strict=True))) for i in range(info.batch_size)]
        if isinstance(results[0], Tensor):
            return torch.stack(results), 0
        stacked = tuple(torch.stack(r) for r in zip(*results, strict=True))
        return stacked, (0,) * len(stacked)
    return rule


def second_derivative(function: Callable[..., Sequence[Tensor]], inputs: Sequence[Tensor | None], cotangents: Sequence[Tensor],
                      v_gradients: Sequence[Tensor | None]) -> tuple[list[Tensor | None], list[Tensor | None]]:
    """Backward of a backward op, by autograd through the reference, on any device.

    Args:
        function: the differentiable reference of the forward op, from `inputs` to its floating-point outputs.
        inputs: differentiable inputs of the forward op, None where absent.
        cotangents: gradients of the outputs that the backward op was given.
        v_gradients: gradients of the backward op's results, one for each input, None where there is none.

    Returns:
        Gradients with respect to `inputs` and to `cotangents`.
    """
    with torch.enable_grad():
        leaves = [None if x is None else x.detach().requires_grad_() for x in inputs]
        ups = [v.detach().requires_grad_() for v in cotangents]
        present = [x for x in leaves if x is not None]
        outputs = [(o, v) for o, v in zip(function(*leaves), ups, strict=True) if o.requires_grad]
        gradients = iter(torch.autograd.grad([o for o, _ in outputs], present, [v for _, v in outputs], create_graph=True,
                                             materialize_grads=True))
        pairs = [(g, v) for g, v in ((next(gradients), v) for x, v in zip(leaves, v_gradients, strict=True) if x is not None)
                 if v is not None and g.requires_grad]
        if not pairs:
            return [None] * len(inputs), [None] * len(ups)
        found = iter(torch.autograd.grad([g for g, _ in pairs], [*present, *ups], [v for _, v in pairs], allow_unused=True))
    return [None if x is None else next(found) for x in leaves], list(found)
