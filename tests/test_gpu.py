"""What is too large for the interpreter, or is about devices."""

from __future__ import annotations

import pytest
import scenes
import torch
import tsplat_reference as reference
from compare import assert_close, assert_same_bits
from torch import Tensor

from tsplat import ops, rasterize

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


def test_a_cuda_graph_renders_and_differentiates_with_a_capacity() -> None:
    splats, cam = scenes.splats(200), scenes.camera(1, 64, 48)
    inputs = [x.float().cuda().requires_grad_() for x in splats if x is not None]
    camera = cam.to("cuda", torch.float32)
    v = torch.randn(1, 48, 64, inputs[4].shape[-1], device="cuda")

    def step() -> tuple[Tensor, ...]:
        r = rasterize(*inputs, camera, capacity=20_000)
        return r.image, *torch.autograd.grad(r.image, inputs, v)

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
        inputs[0] += 0.05                                   # another input, in the same place
    graph.replay()
    want = step()
    assert_same_bits(captured[0], want[0])
    assert_close(captured[1:], want[1:], 1e-5)              # atomics, in float32


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
