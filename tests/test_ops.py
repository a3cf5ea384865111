"""What torch expects of an operator: its schema, fake kernels, autocast, the two forms of a call, and errors instead of silence."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import pytest
import scenes
import torch
from backends import BACKENDS, Backend
from compare import assert_same_bits, each, gradients, leaves, permuted, strided
from op_cases import CASES, DIFFERENTIABLE, FORWARD, NO_GRADIENT, case, render, render_arguments, require_grad
from torch import Tensor
from torch._subclasses import FakeTensorMode
from torch.fx.experimental.symbolic_shapes import ShapeEnv
from torch.library import opcheck
from torch.testing._internal.optests import aot_autograd_check
from torch.utils._python_dispatch import TorchDispatchMode

import tsplat
from tsplat import Camera

WITHOUT_INTERPRETER = True           # ten minutes there: test_kernels_ops.py takes a selection


# Operator contracts


@pytest.mark.parametrize("name", CASES)
def test_opcheck(backend: Backend, name: str) -> None:
    """Backward ops are traced without gradients of their own: the second derivative is eager by design, as it runs the
    reference.
    """
    op, args = case(name, backend)
    if name in FORWARD:
        args = require_grad(args)
    checks = ["test_schema", "test_autograd_registration", "test_faketensor"]
    opcheck(op.custom, args, test_utils=checks)

    def floating(*args: Any) -> list[Tensor]:  # opcheck's own version of this fails if an int comes first
        results = op(*args)
        return [r for r in ([results] if isinstance(results, Tensor) else results) if r.is_floating_point()] or list(results)

    aot_autograd_check(floating, args, {}, dynamic=True, check_gradients="auto")


@pytest.mark.parametrize("layout", [lambda x: x, permuted, strided], ids=["contiguous", "permuted", "strided"])
@pytest.mark.parametrize("name", CASES)
def test_fake_kernels_agree_with_real_ones(backend: Backend, name: str, layout: Callable[[Tensor], Tensor]) -> None:
    """In shapes, dtypes and strides: a compiler plans with the fake ones, and Inductor asserts them."""
    op, args = case(name, backend)
    args = each(layout, args)
    real = op(*args)
    with FakeTensorMode(shape_env=ShapeEnv()) as mode:
        fake = op(*each(lambda x: mode.from_tensor(x, static_shapes=True), args))
    real, fake = ([x] if isinstance(x, Tensor) else x for x in (real, fake))
    for i, (r, f) in enumerate(zip(real, fake, strict=True)):
        assert r.dtype == f.dtype, i
        assert r.device == f.device, i
        assert r.ndim == f.ndim, i
        if any(isinstance(s, torch.SymInt) for s in f.shape):
            assert (name.split(",")[0], i) == ("bin_splats", 0)                   # the number of hits depends on the data
            assert r.stride() == (1,)
            continue
        assert r.shape == f.shape, i
        if r.numel() > 1:
            assert [s for s, n in zip(r.stride(), r.shape, strict=True) if n > 1] == [
                s for s, n in zip(f.stride(), f.shape, strict=True) if n > 1], i


@pytest.mark.parametrize("name", CASES)
def test_without_triton_other_devices_than_the_cpu_are_refused_clearly(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """With the CPU kernel out of the way, a CPU tensor stands for one on another device."""
    op, args = case(name, BACKENDS["reference"])
    for module in [m for m in sys.modules if m.startswith("tsplat.kernels.")]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "triton", None)  # an import of it fails as if it were not there
    message = rf"{name.split(',')[0]} on device 'cpu' needs Triton, which is not installed"
    with op.set_kernel_enabled("cpu", False), pytest.raises(NotImplementedError, match=message):
        op(*args)


@pytest.mark.parametrize("name", CASES)
def test_meta_tensors_go_to_the_fake_kernel(name: str) -> None:
    op, args = case(name, BACKENDS["reference"])
    if name.split(",")[0] == "bin_splats":                                          # how many hits there are depends on the data
        with pytest.raises(Exception, match="data"):
            op(*each(lambda x: x.to("meta"), args))
        return
    result = op(*each(lambda x: x.to("meta"), args))
    for got, want in zip(*([x] if isinstance(x, Tensor) else x for x in (result, op(*args))), strict=True):
        assert got.device.type == "meta"
        assert (got.shape, got.dtype) == (want.shape, want.dtype)


# The two forms of an op

EVERY_OP = list({id(op): op for op, _, _ in CASES.values()}.values())


@pytest.mark.parametrize("name", [name for name in CASES if not name.startswith(NO_GRADIENT)])
def test_both_forms_agree(backend: Backend, name: str) -> None:
    """In results, gradients and, from the forward ops, second derivatives."""
    op, args = case(name, backend)
    args = require_grad(args, (5,) if name.startswith("blend,") or name == "blend" else ())       # absgrad has no second derivative
    inputs = [a for a in args if isinstance(a, Tensor) and a.requires_grad]
    found = []
    for form in (op, op.custom):
        results = form(*args)
        results = [results] if isinstance(results, Tensor) else list(results)
        differentiable = results[:4] if name.startswith("blend_backward") else results                 # the absolute gradient is not
        loss = sum(r.square().sum() for r in differentiable if r.requires_grad)
        v = torch.autograd.grad(loss, inputs, create_graph=name in FORWARD, materialize_grads=True)
        if name in DIFFERENTIABLE:
            v += torch.autograd.grad(sum(x.square().sum() for x in v), inputs, materialize_grads=True)
        found.append([*results, *v])
    assert_same_bits(*found)


class Dispatched(Exception):
    """A call came to the custom op."""


@pytest.fixture
def no_dispatcher(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise Dispatched

    for op in EVERY_OP:
        monkeypatch.setattr(op, "custom", refuse)


@pytest.mark.usefixtures("no_dispatcher")
def test_eager_calls_and_their_gradients_go_past_the_dispatcher(backend: Backend) -> None:
    args = render_arguments(backend)
    v = torch.autograd.grad(sum(x.square().sum() for x in render(*args)), args, create_graph=True)
    torch.autograd.grad(sum(x.square().sum() for x in v), args)
    with torch.no_grad():
        render(*args)
    with torch.inference_mode():
        render(*args)
    render(*(torch.nn.Parameter(x.detach()) for x in args))


class Subclass(Tensor):
    """Some tensor of another kind."""


class Mode(TorchDispatchMode):
    """Looks on."""

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None) -> Any:
        return func(*args, **(kwargs or {}))


@pytest.mark.usefixtures("no_dispatcher")
@pytest.mark.parametrize("name", CASES)
def test_whoever_looks_on_sees_the_custom_op(backend: Backend, name: str) -> None:
    op, args = case(name, backend)
    with pytest.raises(Dispatched), torch.autocast(backend.device.type, torch.bfloat16):
        op(*args)
    with pytest.raises(Dispatched), Mode():
        op(*args)
    with pytest.raises(Dispatched):
        op(args[0].as_subclass(Subclass), *args[1:])
    with pytest.raises(Dispatched):
        op(*each(lambda x: x.to("meta"), args))
    with pytest.raises(Dispatched):
        torch.func.vmap(lambda x: op(x, *args[1:]))(args[0][None])


# Autocast


@pytest.mark.parametrize("name", FORWARD)
def test_ops_compute_in_float32_under_autocast(backend: Backend, name: str) -> None:
    """Half-precision arguments, as other layers under autocast leave them, are taken to float32."""
    op, args = case(name, backend)
    half = each(lambda x: x.to(torch.bfloat16) if x.is_floating_point() else x, args)
    full = each(lambda x: x.float() if x.is_floating_point() else x, half)
    with torch.autocast(backend.device.type, torch.bfloat16):
        got = op(*half)
    got, want = ([x] if isinstance(x, Tensor) else x for x in (got, op(*full)))
    assert torch.float32 in {x.dtype for x in got} or name.startswith(("bin_splats", "may_see", "nearest_hits"))
    assert_same_bits(got, want)


@pytest.mark.parametrize("sh_degree", [None, 2])
def test_autocast_does_not_change_the_renderer(backend: Backend, sh_degree: int | None) -> None:
    s = [x.float() for x in scenes.splats(20)]
    cam = scenes.camera(3).to(torch.float32)
    colors = s[4] if sh_degree is None else scenes.sh_coefficients(20, sh_degree).float()
    inputs = leaves(*s[:4], colors, cam.viewmats, cam.Ks)

    def run() -> list[Tensor]:
        r = tsplat.rasterize(*inputs[:5], Camera(*inputs[5:], 24, 17), sh_degree=sh_degree, depth="expected", antialiased=True)
        return [r.image, r.alpha, r.depth]

    want = run()
    with torch.autocast(backend.device.type, torch.bfloat16):
        got = run()
    assert_same_bits(got, want)
    assert_same_bits(gradients(got, inputs), gradients(want, inputs))
