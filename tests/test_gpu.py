"""What is too large for the interpreter, or is about devices."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import pytest
import scenes
import torch
import tsplat_reference as reference
from compare import assert_close, assert_same_bits
from torch import Tensor

from tsplat import Camera, ops, rasterize, render_spheres

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
ALPHA_MAX = 0.99


def blended(s: scenes.Splats2D, width: int, height: int, device: str) -> tuple[list[Tensor], list[Tensor]]:
    """Lists, image and alpha, and the gradients of all inputs, on the CPU."""
    put = [None if x is None else x.to(device) for x in s]
    inputs = [x.clone().requires_grad_() for x in put[:5] if x is not None]
    backgrounds = inputs[4] if len(inputs) == 5 else None
    bins = ops.bin_splats(put[0], put[6], put[1], put[2], put[5], width, height, 8)  # type: ignore[arg-type]
    outputs = ops.blend(*inputs[:4], backgrounds, None, *bins, width, height, 8, ALPHA_MAX)
    v = [torch.linspace(-1, 1, x.numel(), dtype=x.dtype, device=device).view_as(x) for x in outputs]
    return [x.detach().cpu() for x in (*bins, *outputs)], [g.cpu() for g in torch.autograd.grad(outputs, inputs, v)]


@pytest.mark.parametrize(("cameras", "n", "width", "height", "size"), [
    (1, 4000, 2100, 2101, (0.5, 6.0)),              # 69,169 tiles: more than 16 bits, and in odd numbers
    (70, 40, 250, 243, (0.5, 9.0)),                 # as many, of many cameras
    (1, 10_000, 8, 8, (2.0, 9.0)),                  # all in one tile
    (1, 1, 3001, 1, (4.0, 9.0)),
])
def test_sizes_that_only_a_gpu_can_do(cameras: int, n: int, width: int, height: int, size: tuple[float, float]) -> None:
    s = scenes.splats2d(cameras, n, width, height, size=size, opacity=(0.004, 0.1) if n == 10_000 else (0.1, 0.9))
    got, want = (blended(s, width, height, device) for device in ("cuda", "cpu"))
    assert torch.equal(got[0][0], want[0][0])
    assert torch.equal(got[0][1], want[0][1])
    assert_close(got[0][2:], want[0][2:], 1e-11)            # sums of up to 10,000 terms
    assert_close(got[1], want[1], 1e-10)


def rendered_spheres(s: scenes.Spheres, camera: Camera, device: str) -> tuple[list[Tensor], Tensor, list[Tensor]]:
    """Image, alpha, depth and the weights of the nearest hits, whose they are, and the gradients of all inputs, on the CPU."""
    inputs = [x.to(device).requires_grad_() for x in (*s, camera.viewmats, camera.Ks, torch.tensor(0.1, dtype=torch.float64))]
    positions, features, radii, opacities, viewmats, Ks, gamma = inputs
    r = render_spheres(positions, features, radii, Camera(viewmats, Ks, camera.width, camera.height), opacities=opacities, gamma=gamma, near=0.5,
                       far=9.0, depth="accumulated", n_track=2, percent_allowed_difference=0.0)
    assert r.depth is not None
    assert r.hits is not None
    assert bool(r.visible.all())
    outputs = r.image, r.alpha, r.depth, r.hits.weights
    v = [torch.linspace(-1, 1, x.numel(), dtype=x.dtype, device=device).view_as(x) for x in outputs]
    return [x.detach().cpu() for x in outputs], r.hits.ids.cpu(), [g.cpu() for g in torch.autograd.grad(outputs, inputs, v)]


@pytest.mark.parametrize(("cameras", "n", "width", "height", "size", "spread"), [
    (1, 4000, 2100, 2101, (0.02, 0.08), 0.5),       # 69,169 tiles
    (70, 40, 250, 243, (0.1, 0.6), 0.4),           # as many, of many cameras
    (1, 10_000, 8, 8, (0.1, 1.0), 0.2),             # all in one tile, as their centres are
])
def test_sizes_of_spheres_that_only_a_gpu_can_do(cameras: int, n: int, width: int, height: int, size: tuple[float, float], spread: float) -> None:
    """To 2e-10: a centre is rounded to eps |c|, and so the square of a ray's distance to it, in units of a radius as small as |c|/300, to eps 300^2 =
    2e-11. With a few such roundings so are the weights of rays that graze a sphere.
    """
    s, camera = scenes.spheres(n, size=size, spread=spread), scenes.camera(cameras, width, height)
    got, want = (rendered_spheres(s, camera, device) for device in ("cuda", "cpu"))
    assert torch.equal(got[1], want[1])
    assert_close(got[0], want[0], 2e-10)
    assert_close(got[2], want[2], 2e-10)


def test_tens_of_millions_of_hits() -> None:
    s = scenes.splats2d(1, 5000, 1920, 1080, size=(400.0, 900.0), opacity=(0.004, 0.006))
    put = [x.cuda() for x in (s.means2d, s.radii, s.conics, s.opacities, s.depths)]
    ids, offsets = ops.bin_splats(*put, 1920, 1080, 8)
    assert len(ids) == int(offsets[-1]) > 2e7
    lengths = offsets.diff()
    assert int(lengths.max()) <= 5000
    rank = torch.empty(5000, dtype=torch.int64, device="cuda").index_copy_(0, put[4][0].sort(stable=True).indices, torch.arange(5000, device="cuda"))
    order = rank[ids.long()] + torch.repeat_interleave(lengths) * 5000
    assert bool((order.diff() > 0).all())                   # in each list once, and front to back


def graph_and_eager(step: Callable[[], tuple[Tensor, ...]], moves: Tensor) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """What a CUDA graph of the step and the step itself give for another input, in the same place, than that of the capture."""
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(2):
            step()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = step()
    with torch.no_grad():
        moves += 0.05
    graph.replay()
    return captured, step()


def test_a_cuda_graph_renders_and_differentiates_with_a_capacity() -> None:
    splats, cam = scenes.splats(200), scenes.camera(1, 64, 48)
    inputs = [x.float().cuda().requires_grad_() for x in splats if x is not None]
    camera = cam.to("cuda", torch.float32)
    v = torch.randn(1, 48, 64, inputs[4].shape[-1], device="cuda")

    def step() -> tuple[Tensor, ...]:
        r = rasterize(*inputs, camera, capacity=20_000)
        return r.image, *torch.autograd.grad(r.image, inputs, v)

    captured, want = graph_and_eager(step, inputs[0])
    assert_same_bits(captured[0], want[0])
    assert_close(captured[1:], want[1:], 1e-5)              # atomics, in float32


def test_a_cuda_graph_of_spheres_renders_and_differentiates_with_a_capacity() -> None:
    inputs = [x.float().cuda().requires_grad_() for x in scenes.spheres(200)]
    positions, features, radii, opacities = inputs
    camera = scenes.camera(1, 64, 48).to("cuda", torch.float32)
    v = torch.randn(1, 48, 64, 3, device="cuda")

    def step() -> tuple[Tensor, ...]:
        r = render_spheres(positions, features, radii, camera, opacities=opacities, gamma=0.1, near=0.5, far=9.0, n_track=2, capacity=20_000)
        assert r.needed is not None
        assert r.hits is not None
        return r.image, r.hits.ids, r.hits.weights.detach(), r.needed, *torch.autograd.grad(r.image, inputs, v)

    captured, want = graph_and_eager(step, positions)
    assert 100 < int(want[3]) <= 20_000
    assert_same_bits(captured[:4], want[:4])
    assert_close(captured[4:], want[4:], 1e-5)              # atomics, in float32


def host_syncs(call: Callable[[], Any]) -> int:
    """How many of torch's operations wait for the GPU, once all is compiled."""
    call()
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            call()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    return sum("synchronizing CUDA operation" in str(w.message) for w in caught)


@pytest.mark.parametrize(("capacity", "count"), [(None, 1), (20_000, 0)])
def test_a_forward_waits_for_the_gpu_once_and_with_a_capacity_never(capacity: int | None, count: int) -> None:
    """For the number of hits. That it is seen once shows that torch looks."""
    camera = scenes.camera(2, 64, 48).to("cuda", torch.float32)
    splats, spheres = ([x.float().cuda().requires_grad_() for x in s] for s in (scenes.splats(200)[:4], scenes.spheres(200)))
    sh, background = scenes.sh_coefficients(200, 2).float().cuda().requires_grad_(), torch.rand(3, device="cuda")
    assert host_syncs(lambda: rasterize(*splats, sh, camera, sh_degree=2, background=background, depth="expected", antialiased=True,
                                        capacity=capacity)) == count
    assert host_syncs(lambda: render_spheres(*spheres[:3], camera, opacities=spheres[3], background=background, gamma=0.1, near=0.5, far=9.0,
                                             depth="expected", n_track=2, tracked_only=True, capacity=capacity)) == count


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")
def test_tensors_of_another_device_than_the_current_one() -> None:
    splats, cam = scenes.splats(40), scenes.camera(1)
    images = []
    for device in ("cuda:0", "cuda:1"):
        inputs = [x.to(device).requires_grad_() for x in splats if x is not None]
        image = rasterize(*inputs, cam.to(device)).image
        image.sum().backward()
        assert image.device == torch.device(device)
        images.append(image.detach().cpu())
    assert_same_bits(images[0], images[1])


def test_offsets_of_more_than_32_bits() -> None:
    """More than 2^31 coefficients."""
    n = 46_000_000
    g = torch.Generator(device="cuda").manual_seed(0)
    means, coeffs = torch.randn(n, 3, device="cuda", generator=g), torch.randn(n, 16, 3, device="cuda", generator=g)
    mask = torch.ones(1, n, dtype=torch.bool, device="cuda")
    got = ops.harmonics(means, torch.zeros(1, 3, device="cuda"), coeffs, 3, mask)[:, -1000:]
    want = reference.harmonics(means[-1000:].cpu().double(), torch.zeros(1, 3, dtype=torch.float64), coeffs[-1000:].cpu().double(), 3,
                               mask[:, -1000:].cpu())
    assert_close(got.cpu().double(), want, 1e-5)
