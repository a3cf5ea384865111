"""Fits over another rasteriser: the loop of `bench/quality` with gsplat in it, whose interface `tsplat.compat.gsplat` has, on a CPU."""

import sys
from collections.abc import Iterator
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch
from compare import assert_close
from test_bench_json import BENCH
from torch.autograd import DeviceType

import tsplat.compat.gsplat
import tsplat.fit.drawing
from tsplat import Camera
from tsplat.fit import FitConfig, draw, fit
from tsplat.rasterize import rasterize
from tsplat.scene import Capture, Gaussians


@pytest.fixture
def peer(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """`bench/quality/peer.py`, which finds our drop-in where it looks for gsplat."""
    monkeypatch.syspath_prepend(BENCH / "quality")
    monkeypatch.setitem(sys.modules, "gsplat", tsplat.compat.gsplat)
    import peer as module
    yield module
    assert tsplat.fit.drawing.rasterize is rasterize


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("probe", ["screen_offset", "absgrad", None])
@pytest.mark.parametrize("depth", [None, "accumulated", "expected"])
def test_it_draws_what_a_fit_asks_for(peer: ModuleType, antialiased: bool, probe: str | None, depth: Any) -> None:
    """Image, alpha, depth, what is visible, and all gradients, also that of density control: to rounding in float64, where no rule of a pixel's end
    differs, as with few and faint splats."""
    scene = Gaussians.random(40, sh_degree=2, generator=torch.Generator().manual_seed(0)).double()
    torch.nn.init.constant_(scene.opacity_logits, -1.0)
    torch.nn.init.constant_(scene.log_scales, -1.5)
    camera = Camera.look_at((0, 0, -4), (0, 0, 0), width=30, height=20, dtype=torch.float64)
    pull, background = torch.rand(20, 30, 3, dtype=torch.float64), torch.tensor([0.2, 0.4, 0.9], dtype=torch.float64)
    results = []
    for name in peer.RASTERIZERS:
        probes = {} if probe is None else {probe: torch.zeros(1, 40, 2, dtype=torch.float64, requires_grad=True)}
        scene.zero_grad()
        with peer.drawn_by(name):
            r = draw(scene, camera, background, sh_degree=1, antialiased=antialiased, depth=depth, probes=probes)
        (r.image * pull).sum().backward()
        gradients = [p.grad for p in (*scene.parameters(), *probes.values()) if p.grad is not None]
        results.append([r.image, r.alpha, *([] if r.depth is None else [r.depth]), r.meta.depths, r.meta.means2d, *gradients])
        assert bool(r.meta.visible.any())
    assert len(results[0]) == len(results[1])
    assert_close(results[1], results[0], 1e-12)


def test_it_is_another_rasteriser(peer: ModuleType) -> None:
    """By gsplat's rule an opaque splat has an alpha of 0.999, not of 0.99."""
    scene = Gaussians(torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.zeros(1, 3), torch.full((1,), 20.0), torch.zeros(1, 1, 3),
                      torch.zeros(1, 0, 3))
    camera = Camera.look_at((0, 0, -4), (0, 0, 0), width=9, height=9)
    for name, alpha in (("tsplat", 0.99), ("gsplat", 0.999)):
        with peer.drawn_by(name):
            assert float(draw(scene, camera).alpha[4, 4].detach()) == pytest.approx(alpha, abs=1e-6)


def test_a_fit_is_as_good(peer: ModuleType, capture: Capture) -> None:
    """With density control, which has gsplat's gradients of the screen. In so few steps nothing gets as opaque as to be clamped by either rule, and
    what a pixel's end leaves out weighs 1e-4 at most where it does not: 0.01 dB for that."""
    config = FitConfig(steps=20, splats=200, density="adaptive", density_threshold=1e-5, max_splats=300, reset_every=0)
    results = []
    for name in peer.RASTERIZERS:
        with peer.drawn_by(name):
            results.append(fit(capture, config, progress=False))
    ours, theirs = (result.mean for result in results)
    assert ours is not None
    assert theirs is not None
    assert theirs.psnr == pytest.approx(ours.psnr, abs=0.01)
    assert 200 < len(results[1].gaussians) == len(results[0].gaussians)


def test_what_it_cannot_draw(peer: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    peer.check_rasterizer("gsplat", FitConfig())
    for config in (FitConfig(primitive="spheres"), FitConfig(offload=True)):
        peer.check_rasterizer("tsplat", config)
        with pytest.raises(ValueError, match="--rasterizer: expected tsplat for spheres and with --offload; got gsplat"):
            peer.check_rasterizer("gsplat", config)
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(ValueError, match=r"--rasterizer: gsplat cannot be imported \(.*\): pip install gsplat==1\.5\.3"):
        peer.check_rasterizer("gsplat", FitConfig())


def test_stages_on_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of averages as a profile of a GPU has them: kernels, what started them, and marks, which span both."""
    monkeypatch.syspath_prepend(BENCH / "quality")
    from callbacks import stage_times

    def event(key: str, where: DeviceType, own: float, all_: float, mark: bool = False) -> Any:
        return SimpleNamespace(key=key, device_type=where, self_device_time_total=own, device_time_total=all_, is_user_annotation=mark,
                               self_cpu_time_total=7.0, cpu_time_total=9.0)

    cpu, cuda = DeviceType.CPU, DeviceType.CUDA
    events = [event("project", cpu, 30, 30), event("_kernel_a", cuda, 30, 30), event("blendBackward", cpu, 0, 50),
              event("_RasterizeToPixelsBackward", cpu, 4, 4), event("autograd::engine::evaluate_function: blendBackward", cpu, 0, 50),
              event("_kernel_b", cuda, 54, 54), event("binning", cpu, 0, 16, True), event("binning", cuda, 20, 20, True), event("sort", cuda, 16, 16)]
    total, stages = stage_times(events, gpu=True)
    assert total == 100
    assert {stage: us for stage, us in stages.items() if us} == {"projection": 30, "blending, backward": 54, "binning": 16}
    total, stages = stage_times(events, gpu=False)
    assert total == 5 * 7
    assert {stage: us for stage, us in stages.items() if us} == {"projection": 9, "blending, backward": 18, "binning": 9}
