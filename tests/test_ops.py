"""What torch expects of an operator: derivatives, fake kernels, compile, export, vmap, autocast, and errors instead of
silence.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import scenes
import torch
import tsplat_reference as reference
from backends import BACKENDS, Backend
from compare import assert_close, assert_same_bits, each, gradients, leaves, permuted, strided
from torch import Tensor
from torch._dynamo.testing import CompileCounterWithBackend
from torch._subclasses import FakeTensorMode
from torch.autograd import forward_ad, gradcheck, gradgradcheck
from torch.fx.experimental.symbolic_shapes import ShapeEnv
from torch.library import opcheck
from torch.testing._internal.optests import aot_autograd_check
from torch.utils._python_dispatch import TorchDispatchMode

import tsplat
from tsplat import Camera, ops

WITHOUT_INTERPRETER = True           # ten minutes there: test_kernels_ops.py takes a selection
WIDTH, HEIGHT, TILE = 7, 6, 4 if not torch.cuda.is_available() else 8
# the package has functions of these names
projection, frustum, harmonics, binning, blending, spheres = (importlib.import_module(f"tsplat.ops.{name}") for name in (
    "projection", "frustum", "harmonics", "binning", "blending", "spheres"))


def project_arguments(antialiased: bool = True, covars: bool = False, n: int = 6) -> tuple[Any, ...]:
    s, cam = scenes.splats(n, seed=1), scenes.camera(2, WIDTH, HEIGHT)
    shape = (None, None, reference.covariances(s.quats, s.scales)) if covars else (s.quats, s.scales, None)
    return (s.means, *shape, s.opacities, cam.viewmats, cam.Ks, WIDTH, HEIGHT, "pinhole", 0.01, 1e10, 0.3, antialiased)


def may_see_arguments(n: int = 6) -> tuple[Any, ...]:
    s, cam = scenes.splats(n, seed=1), scenes.camera(2, WIDTH, HEIGHT)
    return s.means, s.scales.amax(1), s.opacities, cam.viewmats, cam.Ks, WIDTH, HEIGHT, "pinhole", 0.01, 1e10, 0.3


def harmonics_arguments(degree: int = 2, n: int = 6) -> tuple[Any, ...]:
    g = scenes.generator(0)
    mask = torch.ones(2, n, dtype=torch.bool)
    mask[0, 1:2] = False
    return scenes.normal(n, 3, seed=g), scenes.normal(2, 3, seed=g), scenes.sh_coefficients(n, degree), degree, mask


def splats2d(n: int = 6) -> scenes.Splats2D:
    return scenes.splats2d(2, n, WIDTH, HEIGHT, seed=3, size=(0.8, 3.0))


def bin_arguments(n: int = 6) -> tuple[Any, ...]:
    s = splats2d(n)
    return s.means2d, s.radii, s.conics, s.opacities, s.depths, WIDTH, HEIGHT, TILE


def blend_arguments(n: int = 6, background: bool = True, absgrad: bool = True, shared_colors: bool = False, drop_last: bool = False
                    ) -> tuple[Any, ...]:
    s = splats2d(n)
    colors = s.colors[:1] if shared_colors else s.colors
    bins = reference.bin_splats(*bin_arguments(n))
    return (s.means2d, s.conics, s.opacities, colors, s.backgrounds if background else None,
            torch.zeros_like(s.means2d) if absgrad else None, *bins, WIDTH, HEIGHT, TILE, 0.99, drop_last)


def project_backward_arguments(antialiased: bool = True, covars: bool = False, n: int = 6, cameras: bool = True, sparse: bool = False
                               ) -> tuple[Any, ...]:
    args = project_arguments(antialiased, covars, n)
    radii, *outputs = reference.project(*args)
    v_means2d, v_depths, v_conics, v_compensations = (torch.randn_like(x) for x in outputs)
    return *args, radii, v_means2d, None if sparse else v_depths, v_conics, None if sparse else v_compensations, cameras


def harmonics_backward_arguments(degree: int = 2, n: int = 6, cameras: bool = True) -> tuple[Any, ...]:
    args = harmonics_arguments(degree, n)
    return *args, torch.randn_like(reference.harmonics(*args)), cameras


def blend_backward_arguments(n: int = 6, background: bool = True, absgrad: bool = True,
                             shared_colors: bool = False) -> tuple[Any, ...]:
    args = blend_arguments(n, background, absgrad, shared_colors)
    image, alphas = reference.blend(*args[:5], *args[6:])
    return (*args[:5], *args[6:8], image, alphas, torch.randn_like(image), torch.randn_like(alphas), *args[8:], absgrad)


def outline_arguments(n: int = 6, model: str = "pinhole") -> tuple[Any, ...]:
    s, cam = scenes.spheres(n, seed=1, spread=0.4), scenes.camera(2, WIDTH, HEIGHT, model=model)
    centers = torch.einsum("cij,nj->cni", cam.viewmats[:, :3, :3], s.positions) + cam.viewmats[:, None, :3, 3]
    return centers, s.radii[None], cam.Ks, WIDTH, HEIGHT, model, 0.5, 8.0


def sphere_bins(*args: Any) -> tuple[Tensor, Tensor]:
    o = reference.outlines(*args)
    return reference.bin_splats(o.means2d, o.radii, o.conics, o.opacities, o.depths, WIDTH, HEIGHT, TILE)


def nearest_arguments(n: int = 6) -> tuple[Any, ...]:
    centers, radii, Ks, *options = outline_arguments(n)
    return centers, radii, Ks, *sphere_bins(centers, radii, Ks, *options), 3, WIDTH, HEIGHT, TILE, "pinhole", 0.5, 8.0, False


def sphere_arguments(n: int = 6, model: str = "pinhole", chord: bool = False, depth: bool = True, cut: bool = False) -> tuple[Any, ...]:
    centers, radii, Ks, *_ = args = outline_arguments(n, model)
    s = scenes.spheres(n, seed=1)
    return (centers, radii, s.opacities[None], s.features[None], torch.rand(2, 3, dtype=torch.float64),
            torch.tensor(0.2, dtype=torch.float64), Ks, *sphere_bins(*args),
            torch.full((2, HEIGHT, WIDTH), 4.0, dtype=torch.float64) if cut else None, WIDTH, HEIGHT, TILE, model, 0.5, 8.0, 0.1, chord, depth, 0.0)


def sphere_backward_arguments(intrinsics: bool = True, depth: bool = True, **others: Any) -> tuple[Any, ...]:
    args = sphere_arguments(depth=depth, **others)
    images = reference.blend_spheres(*args[:-1])
    v_image, v_depth, v_logsumexp = (torch.randn_like(x) for x in images[:3])
    return *args[:10], *images, v_image, v_depth if depth else None, v_logsumexp if depth else None, *args[10:18], intrinsics


CASES: dict[str, tuple[Any, Callable[..., tuple[Any, ...]], dict[str, Any]]] = {
    "project": (projection.project_op, project_arguments, {}),
    "project, covars": (projection.project_op, project_arguments, {"covars": True, "antialiased": False}),
    "project, N = 0": (projection.project_op, project_arguments, {"n": 0}),
    "project_backward": (projection.project_backward_op, project_backward_arguments, {}),
    "project_backward, covars": (projection.project_backward_op, project_backward_arguments,
                                 {"covars": True, "antialiased": False}),
    "project_backward, N = 0": (projection.project_backward_op, project_backward_arguments, {"n": 0}),
    "project_backward, fixed cameras": (projection.project_backward_op, project_backward_arguments, {"cameras": False}),
    "project_backward, sparse": (projection.project_backward_op, project_backward_arguments, {"sparse": True}),
    "may_see": (frustum.may_see_op, may_see_arguments, {}),
    "may_see, N = 0": (frustum.may_see_op, may_see_arguments, {"n": 0}),
    "harmonics": (harmonics.harmonics_op, harmonics_arguments, {}),
    "harmonics, degree 0": (harmonics.harmonics_op, harmonics_arguments, {"degree": 0}),
    "harmonics, N = 0": (harmonics.harmonics_op, harmonics_arguments, {"n": 0}),
    "harmonics_backward": (harmonics.harmonics_backward_op, harmonics_backward_arguments, {}),
    "harmonics_backward, degree 0": (harmonics.harmonics_backward_op, harmonics_backward_arguments, {"degree": 0}),
    "harmonics_backward, N = 0": (harmonics.harmonics_backward_op, harmonics_backward_arguments, {"n": 0}),
    "harmonics_backward, fixed cameras": (harmonics.harmonics_backward_op, harmonics_backward_arguments, {"cameras": False}),
    "bin_splats": (binning.bin_splats_op, bin_arguments, {}),
    "bin_splats, N = 0": (binning.bin_splats_op, bin_arguments, {"n": 0}),
    "bin_splats_fixed": (binning.bin_splats_fixed_op, lambda: (*bin_arguments(), 40), {}),
    "bin_splats_fixed, too few": (binning.bin_splats_fixed_op, lambda: (*bin_arguments(), 3), {}),
    "blend": (blending.blend_op, blend_arguments, {}),
    "blend, bare": (blending.blend_op, blend_arguments, {"background": False, "absgrad": False, "shared_colors": True}),
    "blend, drop_last": (blending.blend_op, blend_arguments, {"drop_last": True}),
    "blend, N = 0": (blending.blend_op, blend_arguments, {"n": 0}),
    "blend_backward": (blending.blend_backward_op, blend_backward_arguments, {}),
    "blend_backward, bare": (blending.blend_backward_op, blend_backward_arguments,
                             {"background": False, "absgrad": False, "shared_colors": True}),
    "blend_backward, N = 0": (blending.blend_backward_op, blend_backward_arguments, {"n": 0}),
    "outlines": (spheres.outlines_op, outline_arguments, {}),
    "outlines, N = 0": (spheres.outlines_op, outline_arguments, {"n": 0}),
    "nearest_hits": (spheres.nearest_hits_op, nearest_arguments, {}),
    "nearest_hits, N = 0": (spheres.nearest_hits_op, nearest_arguments, {"n": 0}),
    "blend_spheres": (spheres.blend_spheres_op, sphere_arguments, {}),
    "blend_spheres, orthographic": (spheres.blend_spheres_op, sphere_arguments, {"model": "orthographic", "depth": False}),
    "blend_spheres, chord": (spheres.blend_spheres_op, sphere_arguments, {"chord": True}),
    "blend_spheres, N = 0": (spheres.blend_spheres_op, sphere_arguments, {"n": 0}),
    "blend_spheres_backward": (spheres.blend_spheres_backward_op, sphere_backward_arguments, {}),
    "blend_spheres_backward, bare": (spheres.blend_spheres_backward_op, sphere_backward_arguments, {"depth": False, "intrinsics": False}),
    "blend_spheres_backward, cut": (spheres.blend_spheres_backward_op, sphere_backward_arguments, {"cut": True}),
    "blend_spheres_backward, N = 0": (spheres.blend_spheres_backward_op, sphere_backward_arguments, {"n": 0}),
}
FORWARD = [name for name in CASES if "backward" not in name]
NO_GRADIENT = ("bin", "may_see", "outlines", "nearest")


def case(name: str, backend: Backend) -> tuple[Any, list[Any]]:
    op, make, options = CASES[name]
    return op, list(backend.put(make(**options)))


def require_grad(args: list[Any], but: tuple[int, ...] = ()) -> list[Any]:
    return [a.requires_grad_() if isinstance(a, Tensor) and a.is_floating_point() and i not in but else a for i,
            a in enumerate(args)]


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


# Derivatives


def differentiable_case(name: str, backend: Backend) -> tuple[Callable[..., Any], list[Tensor]]:
    """The public function of a case, of its differentiable arguments only, and these."""
    _, make, options = CASES[name]
    args = backend.put(make(**({"n": 3} | options)))
    stage = name.split(",")[0]
    which = {"project": (0, 1, 2, 3, 5, 6), "harmonics": (0, 1, 2), "blend": (0, 1, 2, 3, 4), "blend_spheres": range(7)}[stage]
    which = [i for i in which if args[i] is not None]
    inputs = leaves(*(args[i] for i in which))
    function = getattr(ops, stage)

    def call(*tensors: Tensor) -> list[Tensor]:
        mine = list(args)
        for i, tensor in zip(which, tensors, strict=True):
            mine[i] = (tensor + tensor.mT) / 2 if i == 3 and stage == "project" else tensor     # covariances are symmetric
        results = function(*mine)
        return [r for r in ([results] if isinstance(results, Tensor) else results) if r.is_floating_point() and r.requires_grad]

    return call, inputs


WITH_GRADIENT = [name for name in FORWARD if not name.startswith(NO_GRADIENT)]
DIFFERENTIABLE = [name for name in WITH_GRADIENT if "N = 0" not in name]


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


def render(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor, viewmats: Tensor, Ks: Tensor,
           background: Tensor, offset: Tensor, width: int = WIDTH, height: int = HEIGHT) -> tuple[Tensor, Tensor, Tensor]:
    """All stages and options at once."""
    r = tsplat.rasterize(means, quats, scales, opacities, sh, Camera(viewmats, Ks, width, height), sh_degree=1,
                         background=background, depth="expected", antialiased=True, screen_offset=offset)
    return r.image, r.alpha, r.depth


def render_arguments(backend: Backend, n: int = 6, width: int = WIDTH, height: int = HEIGHT) -> list[Tensor]:
    s, cam = scenes.splats(n, seed=2, size=(0.2, 0.6), spread=0.8), scenes.camera(2, width, height)
    return leaves(*backend.put((*s[:4], scenes.sh_coefficients(n, 1), cam.viewmats, cam.Ks, torch.tensor([0.1, 0.2, 0.3]),
                                torch.zeros(2, n, 2))))


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


# Compilers


@pytest.fixture
def fresh_dynamo() -> Iterator[None]:
    """Without what other tests compiled."""
    torch._dynamo.reset()
    yield
    torch._dynamo.reset()


@pytest.mark.usefixtures("fresh_dynamo")
def test_the_renderer_compiles_whole_with_its_gradients(backend: Backend) -> None:
    """The screen-space gradient that density control needs (that of the zero offset, the last argument) included."""
    args = render_arguments(backend)
    want = render(*args)
    got = torch.compile(render, fullgraph=True, backend="aot_eager", dynamic=False)(*args)
    assert_same_bits(got, want)
    v_got, v_want = gradients(got, args), gradients(want, args)
    assert_close(v_got, v_want, 1e-14)
    assert (v_got[-1] != 0).any()


@pytest.mark.usefixtures("fresh_dynamo")
def test_one_compilation_serves_all_sizes(backend: Backend) -> None:
    """Of splats and of the image, the gradient included; numbers of hits differ, too."""
    counter = CompileCounterWithBackend("aot_eager")
    compiled = torch.compile(render, fullgraph=True, backend=counter, dynamic=True)
    counts = []
    for n, width, height in ((6, 10, 9), (9, 10, 9), (14, 33, 17), (5, 12, 30)):
        args = render_arguments(backend, n, width, height)
        got, want = compiled(*args, width, height), render(*args, width, height)
        assert_same_bits(got, want)
        assert_close(gradients(got, args), gradients(want, args), 1e-14)
        counts.append(counter.frame_count)  # the first compilation may make several attempts
    assert counts == [counts[0]] * 4


@pytest.mark.usefixtures("fresh_dynamo")
def test_a_camera_object_passes_into_compiled_code(backend: Backend) -> None:
    s, cam = scenes.splats(6), scenes.camera(None, WIDTH, HEIGHT, model="fisheye")
    s, cam = backend.put((s, cam))

    def shot(splats: scenes.Splats3D, camera: Camera) -> tuple[Tensor, Tensor]:
        r = tsplat.rasterize(*splats, camera)
        return r.image, r.meta.hits

    assert_same_bits(torch.compile(shot, fullgraph=True, backend="aot_eager")(s, cam), shot(s, cam))


class Model(torch.nn.Module):
    """Parameters that render themselves."""

    def __init__(self, *parameters: Tensor) -> None:
        super().__init__()
        self.parameters_ = torch.nn.ParameterList([p.detach() for p in parameters])

    def forward(self, viewmats: Tensor, Ks: Tensor) -> Tensor:
        """The image."""
        return tsplat.rasterize(*self.parameters_, Camera(viewmats, Ks, WIDTH, HEIGHT), sh_degree=1).image


@pytest.mark.parametrize("strict", [False, True])
@pytest.mark.usefixtures("fresh_dynamo")
def test_a_model_that_renders_exports(backend: Backend, strict: bool) -> None:
    *parameters, viewmats, Ks, _, _ = (x.detach() for x in render_arguments(backend))
    model = Model(*parameters)
    program = torch.export.export(model, (viewmats, Ks), strict=strict)
    names = {str(node.target) for node in program.graph.nodes}
    assert {f"tsplat.{stage}.default" for stage in ("project", "harmonics", "bin_splats", "blend")} <= names
    other = viewmats.flip(0).clone()
    other[:, 0, 3] += 0.3  # another number of hits than when it was traced
    assert_same_bits([program.module()(other, Ks)], [model(other, Ks)])


def test_vmap_over_cameras_is_the_batch(backend: Backend) -> None:
    _, args = case("project", backend)
    viewmats, Ks = args[5:7]
    mapped = torch.func.vmap(lambda v, K: ops.project(*args[:5], v[None], K[None], *args[7:]))(viewmats, Ks)
    assert_same_bits([x[:, 0] for x in mapped], ops.project(*args))
    _, (means, centers, coeffs, degree, mask) = case("harmonics", backend)
    colors = torch.func.vmap(lambda c, m: ops.harmonics(means, c[None], coeffs, degree, m[None]))(centers, mask)
    assert_close(colors[:, 0], ops.harmonics(means, centers, coeffs, degree, mask), 1e-15)


def test_gradients_through_vmap_are_those_of_the_batch(backend: Backend) -> None:
    _, args = case("project", backend)
    inputs = leaves(*args[5:7])
    mapped = torch.func.vmap(lambda v, K: ops.project(*args[:5], v[None], K[None], *args[7:]))(*inputs)
    batch = ops.project(*args[:5], *inputs, *args[7:])
    assert_close(gradients([x[:, 0] for x in mapped[1:]], inputs), gradients(batch[1:], inputs), 1e-15)


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
