"""What all ops share: the op in its two forms, reaching the Triton kernels, and the second derivative."""

from __future__ import annotations

import contextlib
import functools
import importlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.library import custom_op

Maybe = TypeVar("Maybe", Tensor, Tensor | None)

LIBRARY = torch.library.Library("tsplat", "IMPL")  # type: ignore[no-untyped-call]
PLAIN = frozenset((Tensor, torch.nn.Parameter))
"""Tensors that have no `__torch_dispatch__` or `__torch_function__` of their own."""


class Op:
    """An op in two forms, made of the same functions: one in the dispatcher, and a short way for eager calls.

    Compilers, transforms, autocast, modes and tensor subclasses see a custom op. Where there is none of these, a call goes to the functions
    at once, with gradients through an autograd function: 18 us of Python instead of 90, and 6 instead of 21 where no gradient is needed.

    Args:
        name: in the dispatcher.
        function: for any device but the CPU; its annotations are the schema. The first argument is a tensor.
        cpu: for CPU tensors.
        fake: shapes and dtypes only.
        setup, backward: as `setup_context` and `backward` of `torch.library.register_autograd`; without these there is no gradient.
        vmap: whether to map the op, as a loop. (The ops have a camera dimension of their own, which is faster.)
    """

    def __init__(self, name: str, function: Callable[..., Any], *, cpu: Callable[..., Any], fake: Callable[..., Any],
                 setup: Callable[..., None] | None = None, backward: Callable[..., tuple[Any, ...]] | None = None, vmap: bool = False) -> None:
        self.name, self.function, self.cpu = name.split("::")[1], function, cpu
        self.cpu_enabled = True
        self.custom = custom_op(name, function, mutates_args=())
        self.custom.register_kernel("cpu", cpu)
        self.custom.register_fake(fake)
        self.eager: type[torch.autograd.Function] | None = None
        if setup is not None and backward is not None:
            self.custom.register_autograd(backward, setup_context=setup)
            self.eager = _autograd_function(self, setup, backward)
        for device in ("cpu", "cuda"):                  # depth order and transmittance do not survive half precision
            self.custom.register_autocast(device, torch.float32)
        if vmap:
            self.custom.register_vmap(_looped(self.custom))
        self._guard_autograd()

    def __call__(self, *args: Any) -> Any:
        if torch.compiler.is_compiling():
            return self._dispatch(args)
        if _forward_mode():
            self._reject_tangents(args)
        if not _alone(args):
            return self._dispatch(args)
        if not torch.is_grad_enabled():
            return self.run(*args)
        if self.eager is None:
            with torch.no_grad():
                return self.run(*args)
        if any(isinstance(a, Tensor) and a.requires_grad for a in args):
            return self.eager.apply(*args)  # type: ignore[no-untyped-call]
        return self.run(*args)

    def run(self, *args: Any) -> Any:
        """The function for the device of the first argument; no gradients."""
        return self.cpu(*args) if self.cpu_enabled and args[0].is_cpu else self.function(*args)

    @contextlib.contextmanager
    def set_kernel_enabled(self, device_type: str, enabled: bool) -> Iterator[None]:
        """As that of the custom op, for both forms: tests send CPU tensors to the (interpreted) kernels; the only device type is "cpu"."""
        before, self.cpu_enabled = self.cpu_enabled, enabled
        try:
            with self.custom.set_kernel_enabled(device_type, enabled):
                yield
        finally:
            self.cpu_enabled = before

    def _dispatch(self, args: tuple[Any, ...]) -> Any:
        if self.eager is None:
            args = tuple(a.detach() if isinstance(a, Tensor) else a for a in args)
        return self.custom(*args)

    def _guard_autograd(self) -> None:
        """Let the dispatcher, too, raise where there is a tangent: compiled code and direct calls do not come by `__call__`."""
        try:
            kernel = _autograd_kernel(getattr(torch.ops.tsplat, self.name).default, self.custom)
        except TypeError:                                   # not there, or not as it was
            return

        def guarded(keys: Any, *args: Any) -> Any:
            if _forward_mode():
                self._reject_tangents(args)
            return kernel(keys, *args)

        LIBRARY.impl(self.name, guarded, "Autograd", with_keyset=True, allow_override=True)  # type: ignore[no-untyped-call]

    def _reject_tangents(self, args: tuple[Any, ...]) -> None:
        """Raise where a tensor carries a forward-mode tangent, which either form would silently drop."""
        for a in args:
            if isinstance(a, Tensor) and forward_ad.unpack_dual(a).tangent is not None:  # type: ignore[no-untyped-call]
                raise NotImplementedError(f"tsplat: {self.name} has no forward-mode derivative (jvp); use reverse mode: backward() or "
                                          "torch.autograd.grad")


def _autograd_function(op: Op, setup: Callable[..., None], backward: Callable[..., tuple[Any, ...]]) -> type[torch.autograd.Function]:
    def forward(ctx: Any, *args: Any) -> Any:
        output = op.run(*args)
        setup(ctx, args, output)
        return output

    return type(op.name, (torch.autograd.Function,), {"forward": staticmethod(forward), "backward": staticmethod(backward)})


def _forward_mode() -> bool:
    """Whether there can be tangents: to ask each tensor takes 1 us. (Without the private level, always asked.)"""
    return getattr(forward_ad, "_current_level", 0) >= 0


# private, and what torch.autograd.Function itself asks; should a release of torch be without them, all calls are custom ops
_transforms: Callable[[], bool] = getattr(torch._C, "_are_functorch_transforms_active", lambda: True)
_modes: Callable[[], int] = getattr(torch._C, "_len_torch_dispatch_stack", lambda: 1)
# what custom_op registers; that of torch.library.get_kernel calls itself when a mode is active (2.13)
_autograd_kernel: Any = getattr(torch._library.autograd, "make_autograd_impl", None)


def _alone(args: tuple[Any, ...]) -> bool:
    """Whether nothing but autograd looks on: no transform, mode, subclass, autocast, or device that has another kind of tensor (meta)."""
    if _transforms() or _modes():
        return False
    for a in args:
        if isinstance(a, Tensor) and type(a) not in PLAIN:
            return False
    device = "cuda" if args[0].is_cuda else "cpu" if args[0].is_cpu else None
    return device is not None and not torch.is_autocast_enabled(device)


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
    launcher = getattr(kernels, name)
    if tensor.is_cuda and tensor.device.index != torch.cuda.current_device():       # asked first: the guard takes 5 us, this less than one
        with torch.cuda.device(tensor.device):
            return launcher(*args)
    return launcher(*args)


def contiguous(function: Callable[..., tuple[Tensor, ...]]) -> Callable[..., Any]:
    """Results with the strides that the fake kernels promise, whatever those of the inputs are."""
    def call(*args: Any) -> Any:
        return tuple(r.contiguous() for r in function(*args))
    return functools.wraps(function)(call)


def rows_of(mask: Tensor, *gradients: Tensor | None) -> Tensor | None:
    """The rows n, int64, of pairs in `mask`, bool `[C, N]`, with any gradient `[C, N]` or `[C, N, D]` that is not 0; None if those are all.

    With these alone, a stage on a CPU spends nothing on splats that are not seen, and gives the others the same bits however many there
    are: products of matrices and sums over splats are rounded in another way with another number of rows.
    """
    given = [((v if v.ndim > 2 else v[..., None]) != 0).any(-1) for v in gradients if v is not None]
    seen = (mask & functools.reduce(torch.logical_or, given) if given else mask).any(0)
    return None if bool(seen.all()) else seen.nonzero()[:, 0]


def at(values: Maybe, rows: Tensor | None, dim: int = 0) -> Maybe:
    """`values` at `rows` along `dim`, as they are if either is None."""
    return values if values is None or rows is None else values.index_select(dim, rows)


def spread(values: Maybe, rows: Tensor | None, n: int, dim: int = 0) -> Maybe:
    """The inverse of `at`: `values` as `rows` of n along `dim`, the others 0."""
    if values is None or rows is None:
        return values
    return values.new_zeros(*values.shape[:dim], n, *values.shape[dim + 1:]).index_copy_(dim, rows, values)


def _looped(op: Callable[..., Any]) -> Callable[..., tuple[Any, Any]]:
    def rule(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[Any, Any]:
        results = [op(*(a if d is None else a.select(d, i) for a, d in zip(args, in_dims, strict=True))) for i in range(info.batch_size)]
        if isinstance(results[0], Tensor):
            return torch.stack(results), 0
        stacked = tuple(torch.stack(r) for r in zip(*results, strict=True))
        return stacked, (0,) * len(stacked)
    return rule


def second_derivative(function: Callable[..., Sequence[Tensor]], inputs: Sequence[Tensor | None], cotangents: Sequence[Tensor | None],
                      v_gradients: Sequence[Tensor | None]) -> tuple[list[Tensor | None], list[Tensor | None]]:
    """Backward of a backward op, by autograd through the reference, on any device.

    Args:
        function: the differentiable reference of the forward op, from `inputs` to its floating-point outputs.
        inputs: differentiable inputs of the forward op, None where absent.
        cotangents: gradients of the outputs that the backward op was given, None for zeros.
        v_gradients: gradients of the backward op's results, one for each input, None where there is none.

    Returns:
        Gradients with respect to `inputs` and to `cotangents`.
    """
    with torch.enable_grad():
        leaves = [None if x is None else x.detach().requires_grad_() for x in inputs]
        ups = [None if v is None else v.detach().requires_grad_() for v in cotangents]
        present, given = ([x for x in some if x is not None] for some in (leaves, ups))
        outputs = [(o, v) for o, v in zip(function(*leaves), ups, strict=True) if v is not None and o.requires_grad]
        gradients = iter(torch.autograd.grad([o for o, _ in outputs], present, [v for _, v in outputs], create_graph=True,
                                             materialize_grads=True))
        pairs = [(g, v) for g, v in ((next(gradients), v) for x, v in zip(leaves, v_gradients, strict=True) if x is not None)
                 if v is not None and g.requires_grad]
        if not pairs:
            return [None] * len(inputs), [None] * len(ups)
        found = iter(torch.autograd.grad([g for g, _ in pairs], [*present, *given], [v for _, v in pairs], allow_unused=True))
    return [None if x is None else next(found) for x in leaves], [None if v is None else next(found) for v in ups]
