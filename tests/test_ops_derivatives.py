"""Derivatives of the ops and of the renderer: first, second, of absent and expanded upstream gradients, and an error for forward mode."""

from __future__ import annotations

import pytest
import torch
import tsplat_reference as reference
from backends import Backend
from compare import assert_close, assert_same_bits
from op_cases import CASES, DIFFERENTIABLE, WITH_GRADIENT, case, differentiable_case, render, render_arguments, require_grad
from torch import Tensor
from torch.autograd import forward_ad, gradcheck, gradgradcheck

import tsplat
from tsplat import Camera, ops

WITHOUT_INTERPRETER = True           # minutes there: test_kernels_ops.py takes a selection


@pytest.mark.parametrize("name", DIFFERENTIABLE)
def test_gradients_are_finite_differences(backend: Backend, name: str) -> None:
    call, inputs = differentiable_case(name, backend)
    assert gradcheck(call, inputs)


@pytest.mark.parametrize("name", DIFFERENTIABLE)
def test_second_derivatives_are_finite_differences(backend: Backend, name: str) -> None:
    call, inputs = differentiable_case(name, backend)
    assert gradgradcheck(call, inputs, fast_mode=True)


@pytest.mark.parametrize("name", WITH_GRADIENT)
def test_expanded_upstream_gradients(backend: Backend, name: str) -> None:
    """That of a sum has stride 0 everywhere; gradcheck never makes one."""
    call, inputs = differentiable_case(name, backend)
    outputs = call(*inputs)
    dense = torch.autograd.grad(outputs, inputs, [torch.ones_like(o) for o in outputs], retain_graph=True)
    assert_same_bits(torch.autograd.grad(sum(o.sum() for o in outputs), inputs), dense)


@pytest.mark.parametrize("which", range(1, 5))
def test_upstream_gradients_that_are_absent_are_zeros(backend: Backend, which: int) -> None:
    """Of one output of the projection at a time; the first derivative and the second."""
    _, args = case("project", backend)
    args = require_grad(args, (4,))
    inputs = [a for a in args if isinstance(a, Tensor) and a.requires_grad]
    found = []
    for zeros in (False, True):
        outputs = ops.project(*args)
        loss = sum((x.square().sum() * (i == which) for i, x in enumerate(outputs) if i > 0 and (zeros or i == which)), torch.zeros(()))
        v = torch.autograd.grad(loss, inputs, create_graph=True)
        found.append([*v, *torch.autograd.grad(sum(x.square().sum() for x in v), inputs)])
    assert_close(*found, 1e-14)


def test_the_order_of_splats_has_no_gradient_and_needs_none(backend: Backend) -> None:
    _, args = case("bin_splats", backend)
    assert not any(x.requires_grad for x in ops.bin_splats(*require_grad(args)))


@pytest.mark.parametrize("name", DIFFERENTIABLE)
def test_forward_mode_is_an_error_not_silence(backend: Backend, name: str) -> None:
    call, inputs = differentiable_case(name, backend)
    for i in range(len(inputs)):
        with forward_ad.dual_level(), pytest.raises(NotImplementedError, match="no forward-mode derivative"):
            call(*(forward_ad.make_dual(x, torch.ones_like(x)) if i == j else x for j, x in enumerate(inputs)))


@pytest.mark.parametrize("name", [name for name in CASES if "N = 0" not in name])
def test_forward_mode_is_an_error_in_the_dispatcher_too(backend: Backend, name: str) -> None:
    """As `torch.ops.tsplat.*`, which code that was compiled or exported calls; with gradients and without, by dual numbers and by `torch.func`."""
    op, args = case(name, backend)
    call = getattr(torch.ops.tsplat, op.name)
    for i in [i for i, x in enumerate(args) if isinstance(x, Tensor) and x.is_floating_point()]:
        def of_one(x: Tensor, i: int = i) -> object:
            return call(*args[:i], x, *args[i + 1:])

        with forward_ad.dual_level():
            of_one(args[i])                                                 # no tangent, no error
            for x in (args[i], args[i].clone().requires_grad_()):
                with pytest.raises(NotImplementedError, match=f"tsplat: {op.name} has no forward-mode derivative"):
                    of_one(forward_ad.make_dual(x, torch.ones_like(x)))
        with pytest.raises(NotImplementedError, match=f"tsplat: {op.name} has no forward-mode derivative"):
            torch.func.jvp(of_one, (args[i],), (torch.ones_like(args[i]),))


def test_the_forward_mode_error_recommends_what_works(backend: Backend) -> None:
    """`torch.func` cannot differentiate a custom op (torch 2.13), so the way out is the ordinary backward."""
    call, inputs = differentiable_case("harmonics", backend)
    with forward_ad.dual_level(), pytest.raises(NotImplementedError, match="reverse mode") as caught:
        call(forward_ad.make_dual(inputs[0], torch.ones_like(inputs[0])), *inputs[1:])
    assert "torch.func" not in str(caught.value)


def test_the_absolute_gradient_has_no_derivative_and_says_so(backend: Backend) -> None:
    """It is a measure for density control; zeros in place of its derivative would be silent nonsense."""
    _, args = case("blend", backend)
    args = require_grad(args)
    image, _ = ops.blend(*args)
    v_abs, = torch.autograd.grad(image.square().sum(), args[5], create_graph=True)
    with pytest.raises((NotImplementedError, RuntimeError), match="absgrad|does not require grad"):
        torch.autograd.grad(v_abs.sum(), args[0])


def test_the_whole_renderer_has_first_and_second_derivatives(backend: Backend) -> None:
    args = render_arguments(backend, 3, 5, 4)
    assert gradcheck(lambda *a: render(*a, 5, 4), args, fast_mode=True)
    assert gradgradcheck(lambda *a: render(*a, 5, 4), args, fast_mode=True)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("option", ["colors", "sh", "depth", "covars"])
def test_the_renderer_is_differentiable_twice_with_every_option(backend: Backend, option: str, antialiased: bool) -> None:
    """Each way through the stages, against finite differences of the gradient."""
    means, quats, scales, opacities, sh, viewmats, Ks, background, _ = render_arguments(backend, 3, 5, 4)
    inputs = [means, opacities, background, viewmats]

    def call(means: Tensor, opacities: Tensor, background: Tensor, viewmats: Tensor) -> list[Tensor]:
        shape = {"covars": reference.covariances(quats, scales)} if option == "covars" else {}
        r = tsplat.rasterize(means, *((None, None) if shape else (quats, scales)), opacities,
                             sh if option == "sh" else sh[:, 0], Camera(viewmats, Ks, 5, 4),
                             sh_degree=1 if option == "sh" else None, background=background,
                             depth="accumulated" if option == "depth" else None, antialiased=antialiased, **shape)
        return [r.image, r.alpha, *([r.depth] if option == "depth" else [])]

    assert gradgradcheck(call, inputs, fast_mode=True)


def test_fixed_cameras_change_no_other_gradient(backend: Backend) -> None:
    """Neither the first nor the second derivative."""
    args = render_arguments(backend)
    fixed = [x.detach() if i in (5, 6) else x for i, x in enumerate(args)]
    moving, others = (inputs[:5] + inputs[7:] for inputs in (args, fixed))
    first = [torch.autograd.grad([x.square().sum() for x in render(*inputs)], leaves_, create_graph=True)
             for inputs, leaves_ in ((args, moving), (fixed, others))]
    assert_same_bits(*first)
    assert_close(*([*torch.autograd.grad([g.square().sum() for g in v], leaves_)] for v, leaves_ in zip(first, (moving, others), strict=True)),
                 1e-12)
