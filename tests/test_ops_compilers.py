"""The renderer in compiled code, exported, and mapped: `torch.compile`, `torch.export`, `torch.func.vmap`."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator

import pytest
import scenes
import torch
from backends import Backend
from compare import assert_close, assert_same_bits, gradients, leaves
from op_cases import HEIGHT, WIDTH, case, render, render_arguments
from torch import Tensor
from torch._dynamo.testing import CompileCounterWithBackend
from torch.autograd import forward_ad

import tsplat
from tsplat import Camera, ops

WITHOUT_INTERPRETER = True           # minutes there: test_kernels_ops.py takes a selection


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
def test_the_default_compiler(backend: Backend) -> None:
    """A loss and its gradients, as Inductor makes them: the others stop in front of it."""
    if backend.device.type == "cpu" and shutil.which(os.environ.get("CXX", "g++")) is None:
        pytest.skip("Inductor needs a C++ compiler on a CPU: install g++, or set CXX")

    def loss(*args: Tensor) -> Tensor:
        image, alpha, *_ = render(*args)
        return (image.sigmoid() - 0.5).square().mean() + alpha.mean()

    args = render_arguments(backend)
    want = [loss(*args)]
    got = [torch.compile(loss, fullgraph=True)(*args)]
    assert_close(got, want, 1e-14)
    assert_close(gradients(got, args), gradients(want, args), 1e-14)


@pytest.mark.parametrize("dynamic", [False, True])
@pytest.mark.usefixtures("fresh_dynamo")
def test_density_control_gets_its_gradients_from_compiled_code(backend: Backend, dynamic: bool) -> None:
    """The screen-space gradient, and that of AbsGS."""
    def shot(offset: Tensor, absgrad: Tensor) -> Tensor:
        image: Tensor = tsplat.rasterize(*s, cam, screen_offset=offset, absgrad=absgrad).image.square().mean()
        return image

    s, cam = backend.put(scenes.splats(9)), backend.put(scenes.camera(2, WIDTH, HEIGHT))
    probes = [torch.zeros(2, 9, 2, dtype=backend.dtype, device=backend.device, requires_grad=True) for _ in range(2)]
    want = torch.autograd.grad(shot(*probes), probes)
    got = torch.autograd.grad(torch.compile(shot, fullgraph=True, backend="aot_eager", dynamic=dynamic)(*probes), probes)
    assert_close(got, want, 1e-14)
    assert bool((want[1] >= want[0].abs() * (1 - 1e-12)).all())
    assert bool((want[0] != 0).any())


@pytest.mark.parametrize("fullgraph", [False, True])
@pytest.mark.parametrize("way", ["dual numbers come in", "dual numbers within", "jvp", "jacfwd"])
@pytest.mark.usefixtures("fresh_dynamo")
def test_forward_mode_is_an_error_in_compiled_code(backend: Backend, way: str, fullgraph: bool) -> None:
    """Zeros, or no tangent at all, would be silent nonsense. A first call, without tangents, is compiled and stays of use."""
    first, *others = [a.detach() for a in render_arguments(backend)]

    def shot(means: Tensor) -> Tensor:
        return render(means, *others)[0].mean()

    def dual(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor | None:
        with forward_ad.dual_level():
            tangent: Tensor | None = forward_ad.unpack_dual(function(forward_ad.make_dual(x, torch.ones_like(x)))).tangent
            return tangent

    compiled = torch.compile(shot, fullgraph=fullgraph, backend="aot_eager")
    want = compiled(first)
    calls: dict[str, Callable[[Tensor], object]] = {
        "dual numbers come in": lambda x: dual(compiled, x),
        "dual numbers within": torch.compile(lambda x: dual(shot, x), fullgraph=fullgraph, backend="aot_eager"),
        "jvp": torch.compile(lambda x: torch.func.jvp(shot, (x,), (torch.ones_like(x),)), fullgraph=fullgraph, backend="aot_eager"),
        "jacfwd": torch.compile(torch.func.jacfwd(shot), fullgraph=fullgraph, backend="aot_eager")}
    with pytest.raises((NotImplementedError, torch._dynamo.exc.Unsupported), match="tsplat: project has no forward-mode derivative"):
        calls[way](first)
    assert torch.equal(compiled(first), want)


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
        means, quats, scales, opacities, sh = (self.parameters_[i] for i in range(5))
        return tsplat.rasterize(means, quats, scales, opacities, sh, Camera(viewmats, Ks, WIDTH, HEIGHT), sh_degree=1).image


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
