"""The ops over the Triton kernels: in the interpreter, on CPU tensors with the reference out of the way, or on a GPU where there is one."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest
import scenes
import torch
import tsplat_reference as reference
from backends import KERNELS, OPS
from compare import assert_close
from torch import Tensor
from torch.library import opcheck
from torch.testing._internal.optests import aot_autograd_check

import tsplat

triton = pytest.importorskip("triton", reason="Triton is not installed here")

from tsplat.kernels import launch  # noqa: E402

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
WIDTH, HEIGHT = 19, 13


def render(*inputs: Tensor, width: int = WIDTH, height: int = HEIGHT, model: str = "pinhole", covars: bool = False, **options: Any
           ) -> tuple[Tensor, Tensor, Tensor]:
    """Everything at once: SH colours, a batch of cameras, background, depth, antialiasing."""
    means, quats, scales, opacities, sh, viewmats, Ks, background = inputs
    shape = (None, None, reference.covariances(quats, scales)) if covars else (quats, scales, None)
    r = tsplat.rasterize(means, *shape[:2], opacities, sh, tsplat.Camera(viewmats, Ks, width, height, model=model), sh_degree=2, covars=shape[2],
                         background=background, depth="expected", antialiased=True, tile=8, **options)
    assert r.depth is not None
    return r.image, r.alpha, r.depth


def inputs(n: int = 8, device: str = DEVICE, cameras: int = 2, *, width: int = WIDTH, height: int = HEIGHT, channels: int = 3,
           model: str = "pinhole", **options: Any) -> list[Tensor]:
    s, camera = scenes.splats(n, seed=3, **options), scenes.camera(cameras, width, height, model=model)
    background = torch.linspace(0.2, 0.9, channels, dtype=torch.float64)
    every = *s[:4], scenes.sh_coefficients(n, 2, channels), camera.viewmats, camera.Ks, background
    return [x.to(device).requires_grad_() for x in every]


def render_spheres(*inputs: Tensor) -> tuple[Tensor, ...]:
    """All that spheres have."""
    positions, features, radii, opacities, viewmats, Ks, gamma = inputs
    r = tsplat.render_spheres(positions, features, radii, tsplat.Camera(viewmats, Ks, WIDTH, HEIGHT), opacities=opacities, gamma=gamma, near=0.5,
                              far=8.0, depth="expected", n_track=2)
    assert r.depth is not None
    assert r.hits is not None
    return r.image, r.alpha, r.depth, r.hits.weights


def sphere_inputs(device: str = DEVICE) -> list[Tensor]:
    camera = scenes.camera(2, WIDTH, HEIGHT)
    every = *scenes.spheres(8), camera.viewmats, camera.Ks, torch.tensor(0.1, dtype=torch.float64)
    return [x.to(device).requires_grad_() for x in every]


def values_and_gradients(function: Callable[..., tuple[Tensor, ...]], leaves: list[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
    outputs = function(*leaves)
    v = [torch.linspace(-1, 1, x.numel(), dtype=x.dtype, device=x.device).view_as(x) for x in outputs]
    return [x.detach().cpu() for x in outputs], [g.cpu() for g in torch.autograd.grad(outputs, leaves, v)]


def test_images_and_all_gradients_are_those_of_the_reference() -> None:
    """To 1e-11 of the largest: rounding, divided by a transmittance of 1e-2, and by the alpha of expected depth."""
    want = values_and_gradients(render, inputs(device="cpu"))
    with KERNELS.active():
        got = values_and_gradients(render, inputs())
    assert_close(got[0], want[0], 1e-11)
    assert_close(got[1], want[1], 1e-11)


SMALL = {"width": 9, "height": 7}
IN_FRONT = {"spread": 0.3, "size": (0.3, 1.0)}
OPAQUE = {"spread": 0.05, "size": (4.0, 6.0), "opacity": (0.975, 0.985)}


@pytest.mark.parametrize(("scene", "options"), [
    (IN_FRONT, {}), (IN_FRONT | {"channels": 8}, {}), (IN_FRONT | {"model": "fisheye"}, {"model": "fisheye"}),
    (IN_FRONT | {"model": "orthographic"}, {"model": "orthographic"}), (IN_FRONT, {"covars": True}), (OPAQUE, {"drop_last": True})],
    ids=["pinhole", "8 channels", "fisheye", "orthographic", "covars", "drop_last"])
def test_gradcheck_on_the_kernels_themselves(scene: dict[str, Any], options: dict[str, Any]) -> None:
    """Of all inputs and outputs; two tiles, at a border, and all splats seen. (Absent upstream gradients take a third of the time: not with all
    options.)"""
    leaves = inputs(3, cameras=1, **SMALL, **scene)
    with KERNELS.active():
        image, _, _ = render(*leaves, **SMALL, **options)
        v, = torch.autograd.grad(image.sum(), leaves[3])
        assert (v != 0).all()
        if "drop_last" in options:
            assert not torch.allclose(image, render(*leaves, **SMALL)[0], atol=1e-4)
        assert torch.autograd.gradcheck(lambda *x: render(*x, **SMALL, **options), leaves, fast_mode=True, check_undefined_grad=not options)


def test_second_derivatives() -> None:
    """Through the reference, whatever runs the first."""
    leaves = inputs(2, cameras=1, **SMALL, **IN_FRONT)

    def image(means: Tensor, opacities: Tensor) -> Tensor:
        return render(means, *leaves[1:3], opacities, *leaves[4:], **SMALL)[0]

    with KERNELS.active():
        v, = torch.autograd.grad(image(leaves[0], leaves[3]).sum(), leaves[3])
        assert (v != 0).all()
        assert torch.autograd.gradgradcheck(image, (leaves[0], leaves[3]), fast_mode=True)


def test_strided_upstream_gradients() -> None:
    leaves = inputs()
    reference = inputs(device="cpu")
    want = torch.autograd.grad(render(*reference)[0].sum(), reference)
    with KERNELS.active():
        got = torch.autograd.grad(render(*leaves)[0].sum(), leaves)
    assert_close([g.cpu() for g in got], want, 1e-11)


@pytest.mark.parametrize("dynamic", [False, True])
def test_compiles_whole(dynamic: bool) -> None:
    compiled = torch.compile(render, fullgraph=True, dynamic=dynamic, backend="aot_eager")
    with KERNELS.active():
        for n in (5, 7) if dynamic else (6,):
            got, want = values_and_gradients(compiled, inputs(n)), values_and_gradients(render, inputs(n))
            assert_close([*got[0], *got[1]], [*want[0], *want[1]], 1e-12)


def test_opcheck_of_every_op() -> None:
    calls: dict[str, tuple[Any, ...]] = {}
    leaves = inputs(4)
    with KERNELS.active():
        with record(calls):
            values_and_gradients(render, leaves)
            render(*leaves, capacity=200)
            values_and_gradients(render_spheres, sphere_inputs())
            means, _, scales, opacities, _, viewmats, Ks, _ = leaves
            tsplat.ops.may_see(means, scales.amax(1), opacities, viewmats, Ks, WIDTH, HEIGHT, "pinhole", 0.01, 1e10, 0.3)
        assert set(calls) == {op.custom._qualname for op in OPS}
        for op in OPS:
            args = calls[op.custom._qualname]
            opcheck(op.custom, args, test_utils=("test_schema", "test_faketensor"))
            if op.eager is not None and not op.name.endswith("backward"):       # of which the second derivative is the reference, and not traced
                args = tuple(a.requires_grad_() if isinstance(a, Tensor) and a.is_floating_point() else a for a in args)
            opcheck(op.custom, args, test_utils="test_autograd_registration")

            def floating(*args: Any, op: Any = op) -> list[Tensor]:             # what opcheck itself would trace fails if ints come first
                results = op.custom(*args)
                return [r for r in ([results] if isinstance(results, Tensor) else results) if r.is_floating_point()] or list(results)

            # static but for bin_splats: how many hits there are depends on the data, and a static trace has no symbol for it
            aot_autograd_check(floating, args, {}, dynamic=op.name == "bin_splats", check_gradients="auto")


@contextlib.contextmanager
def record(calls: dict[str, tuple[Any, ...]]) -> Iterator[None]:
    """Keep the arguments of each op's last call."""
    from torch.utils._python_dispatch import TorchDispatchMode

    class Recorder(TorchDispatchMode):
        def __torch_dispatch__(self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None) -> Any:
            if func.namespace == "tsplat":
                calls[func._schema.name] = tuple(a.detach() if isinstance(a, Tensor) else a for a in args)
            return func(*args, **(kwargs or {}))

    with Recorder():
        yield


@pytest.mark.parametrize("n", [0, 3])
def test_nothing_to_see(n: int) -> None:
    """No splats, or all behind the camera: the background, and zero gradients."""
    leaves = inputs(n)
    with torch.no_grad():
        leaves[0][:, 2].fill_(-5.0)
    with KERNELS.active():
        outputs, gradients = values_and_gradients(render, leaves)
    assert_close(outputs[0], leaves[7].detach().cpu().expand_as(outputs[0]), 1e-15)
    assert all(not bool(g.any()) for g in gradients[:5])


def test_a_cpu_tensor_never_touches_triton(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise AssertionError("a kernel ran")

    for module in ("projection", "harmonics", "binning", "blending", "spheres"):
        monkeypatch.setattr(importlib.import_module(f"tsplat.ops.{module}"), "run_kernel", fail)
    render(*inputs(device="cpu"))
    values_and_gradients(render_spheres, sphere_inputs(device="cpu"))


class Compiler:
    """Stands for a JIT function, for its binaries, and for the driver; keeps who launched what."""

    arg_names = "x", "y", "N", "eps", "D"
    function, packed_metadata = "function", "metadata"

    def __init__(self) -> None:
        self.launches: list[tuple[str, tuple[Any, ...]]] = []
        self.params = [SimpleNamespace(name=n, do_not_specialize=n == "N", annotation_type="fp64" if n == "eps" else "", is_constexpr=n == "D")
                       for n in self.arg_names]

    def __getitem__(self, grid: tuple[int, ...]) -> Callable[..., Compiler]:
        def launch(*args: Any, **constants: Any) -> Compiler:
            self.launches.append(("triton", args))
            return self
        return launch

    def run(self, *args: Any) -> None:
        """As that of a binary."""
        self.launches.append(("binary", args))

    def get_current_device(self) -> int:
        return 0

    def get_current_stream(self, device: int) -> str:
        return "stream"

    def get_current_target(self) -> Any:
        return SimpleNamespace(backend="cuda", arch=90, warp_size=32)


@pytest.fixture
def compiler(monkeypatch: pytest.MonkeyPatch) -> Compiler:
    """Kernels as on a GPU."""
    stand_in = Compiler()
    monkeypatch.setattr(launch, "INTERPRETED", False)
    monkeypatch.setattr(launch, "CompiledKernel", Compiler)
    monkeypatch.setattr(triton.runtime, "driver", SimpleNamespace(active=stand_in))
    return stand_in


def test_a_second_launch_goes_to_the_binary_of_the_first(compiler: Compiler) -> None:
    kernel, x, other = launch.Launcher(compiler), torch.zeros(8), torch.ones(3, 5)
    kernel[(3,)](x, None, 7, 0.5, D=4, num_warps=2)
    kernel[(5,)](other, None, 9, 1, D=4, num_warps=2)
    kernel[(5,)](other, None, 9, 0.25, D=4, num_warps=2)
    assert [who for who, _ in compiler.launches] == ["triton", "triton", "binary"]       # an int for a float is another key
    assert compiler.launches[2][1] == (5, 1, 1, "stream", "function", "metadata", None, None, None, other.data_ptr(), None, 9, 0.25, 4)


@pytest.mark.parametrize("change", [{"x": torch.zeros(8, dtype=torch.float64)}, {"x": torch.zeros(8)[1:]}, {"y": torch.zeros(8)}, {"N": 2**31},
                                    {"D": 3}, {"num_warps": 4}], ids=str)
def test_what_a_binary_is_compiled_for_is_not_mistaken(compiler: Compiler, change: dict[str, Any]) -> None:
    kernel = launch.Launcher(compiler)
    for options in ({}, change, {}, change):
        a = {"x": torch.zeros(8), "y": None, "N": 7, "eps": 0.5, "D": 4, "num_warps": 2} | options
        kernel[(3, 2)](a["x"], a["y"], a["N"], a["eps"], D=a["D"], num_warps=a["num_warps"])
    assert [who for who, _ in compiler.launches] == ["triton", "triton", "binary", "binary"]


def test_launches_that_triton_must_see_go_to_it(compiler: Compiler, monkeypatch: pytest.MonkeyPatch) -> None:
    """Integers whose value it looks at, profilers, and other GPUs than NVIDIA's."""
    kernel, x = launch.Launcher(compiler), torch.zeros(8)
    for _ in range(2):
        kernel[(3,)](x, 5, 7, 0.5, D=4)
    kernel[(3,)](x, x, 7, 0.5, D=4)
    with monkeypatch.context() as patch:
        patch.setattr(triton.knobs.runtime, "launch_enter_hook", lambda _: None)
        kernel[(3,)](x, x, 7, 0.5, D=4)
    monkeypatch.setattr(launch, "current_target", lambda: launch.Target(64, False))
    for _ in range(2):
        kernel[(3,)](x, x, 7, 0.5, D=5)
    assert [who for who, _ in compiler.launches] == ["triton"] * 6
