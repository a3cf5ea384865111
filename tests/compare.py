"""How far results are from what they should be."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

SMALL_BLOCKS = {"CHUNK": 32, "BLOCK": 1 << 12, "GROUP": 1 << 8, "ALONE": 1 << 8, "FEW": 1 << 6}
"""Constants of `tsplat_reference.walk` with which little of a block's working memory is constant."""


def error(got: Tensor, want: Tensor) -> float:
    """Largest difference, in units of the largest wanted magnitude (absolute where all are 0); infinite for NaN."""
    assert got.shape == want.shape, f"shape {list(got.shape)}, expected {list(want.shape)}"
    if got.numel() == 0:
        return 0.0
    got, want = got.detach().cpu().double(), want.detach().cpu().double()
    scale = want.abs().max().item()
    worst = ((got - want).abs().max() / (scale or 1.0)).item()
    return math.inf if math.isnan(worst) else worst


def assert_close(got: Tensor | Sequence[Tensor], want: Tensor | Sequence[Tensor], tolerance: float) -> None:
    """Each tensor within `tolerance` of the wanted one, as `error` measures it."""
    if isinstance(got, Tensor) or isinstance(want, Tensor):
        got, want = [got], [want]
    errors = [error(g, w) for g, w in zip(got, want, strict=True)]
    assert max(errors) <= tolerance, f"errors {[f'{e:.1e}' for e in errors]}, allowed {tolerance:.1e}"


def assert_same_bits(got: Sequence[Tensor], want: Sequence[Tensor]) -> None:
    """Equal shapes, dtypes and values."""
    for i, (g, w) in enumerate(zip(got, want, strict=True)):
        assert g.dtype == w.dtype, f"{i}: {g.dtype}, expected {w.dtype}"
        assert torch.equal(g, w), f"{i}: differs by {error(g, w):.1e}"


def saved_state(folder: Path) -> Any:
    """All of a fit that its checkpoint in `folder` holds but the time it took, with the bytes of tensors in place of tensors, for ==."""
    def comparable(state: Any) -> Any:
        if isinstance(state, dict):
            return {key: comparable(value) for key, value in state.items()}
        if isinstance(state, list | tuple):
            return [comparable(value) for value in state]
        return (state.shape, state.dtype, state.numpy().tobytes()) if isinstance(state, Tensor) else state

    state = torch.load(folder / "checkpoint.pt", weights_only=True)["state"]
    del state["seconds"]
    return comparable(state)


def leaves(*tensors: Tensor) -> list[Tensor]:
    """Copies that require grad, if they are of floating point."""
    return [t.detach().clone().requires_grad_(t.is_floating_point()) for t in tensors]


def gradients(outputs: Sequence[Tensor], inputs: Sequence[Tensor], seed: int = 0, **options: bool) -> list[Tensor]:
    """Gradients of the sum of outputs times fixed random weights; zeros where there is none."""
    outputs = [o for o in outputs if o.is_floating_point()]
    g = torch.Generator().manual_seed(seed)
    weights = [torch.randn(o.shape, generator=g, dtype=torch.float64).to(o) for o in outputs]
    outputs, weights = zip(*[(o, w) for o, w in zip(outputs, weights, strict=True) if o.requires_grad], strict=True)
    return list(torch.autograd.grad(outputs, inputs, weights, materialize_grads=True, **options))


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """So many torch threads for a while."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def guarded(tensor: Tensor | None, device: torch.device | str = "cpu") -> Tensor | None:
    """The same numbers with NaN (for indices, numbers far out of range; for flags, True) before and after them in memory, so that a read out of
    bounds shows."""
    if tensor is None:
        return None
    fill = math.nan if tensor.is_floating_point() else tensor.dtype == torch.bool or torch.iinfo(tensor.dtype).max // 2
    memory = torch.full((tensor.numel() + 128,), fill, dtype=tensor.dtype, device=device)
    inner = memory[64:64 + tensor.numel()].view(tensor.shape)
    return inner.copy_(tensor)


def strided(tensor: Tensor) -> Tensor:
    """The same values, with gaps in memory and the dimensions in reverse order."""
    reverse = list(range(tensor.ndim))[::-1]
    spaced = tensor.new_full([2 * s for s in reversed(tensor.shape)], math.nan if tensor.is_floating_point() else 0)
    every_other = spaced[tuple(slice(None, None, 2) for _ in reverse)]
    every_other.copy_(tensor.permute(reverse))
    return every_other.permute(reverse)


def permuted(tensor: Tensor) -> Tensor:
    """The same values, dense, with the dimensions in reverse order in memory."""
    reverse = list(range(tensor.ndim))[::-1]
    return tensor.permute(reverse).contiguous().permute(reverse)


def each(function: Callable[[Tensor], Tensor], arguments: Sequence[object]) -> list[object]:
    """The arguments with the function applied to tensors."""
    return [function(a) if isinstance(a, Tensor) else a for a in arguments]


class Peak(TorchDispatchMode):
    """The most bytes of tensors, made while it is active, that were alive at the same time."""

    def __init__(self) -> None:
        super().__init__()
        self.alive: dict[int, tuple[StorageWeakRef, int]] = {}
        self.peak = 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run the function and count."""
        result = function(*args, **(kwargs or {}))
        for tensor in tree_leaves(result):
            if isinstance(tensor, Tensor):
                storage = tensor.untyped_storage()
                self.alive[storage._cdata] = StorageWeakRef(storage), storage.nbytes()
        self.alive = {k: v for k, v in self.alive.items() if not v[0].expired()}
        self.peak = max(self.peak, sum(size for _, size in self.alive.values()))
        return result
