"""The Triton kernels of spheres, in the interpreter without a GPU, against the reference."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import scenes
import torch
import tsplat_reference as reference
from backends import KERNELS
from compare import assert_close, each, guarded, leaves, strided
from torch import Tensor

from tsplat import ops

pytest.importorskip("triton", reason="Triton is not installed here")

from tsplat.kernels import spheres as kernels
from tsplat.kernels.sphere_tracking import SLOTS

TILE = 8
NEAR, FAR = 1.2, 5.0
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


@dataclasses.dataclass
class Case:
    """Arguments of the launchers, on the CPU."""

    tensors: tuple[Tensor, ...]         # centers, radii, opacities, features, backgrounds, gamma, Ks
    cutoff: Tensor | None
    size: tuple[int, int]
    model: str
    chord: bool
    depth: bool

    @property
    def geometry(self) -> tuple[Tensor, Tensor, Tensor]:
        return self.tensors[0], self.tensors[1], self.tensors[6]

    @property
    def outlines(self) -> reference.Outlines:
        return reference.outlines(*self.geometry, *self.size, self.model, NEAR, FAR)

    @property
    def bins(self) -> reference.Bins:
        o = self.outlines
        return reference.bin_splats(o.means2d, o.radii, o.conics, o.opacities, o.depths, *self.size, TILE)

    @property
    def options(self) -> tuple[Any, ...]:
        return *self.size, TILE, self.model, NEAR, FAR, 0.1, self.chord

    def forward(self, tolerance: float = 0.0) -> tuple[Any, ...]:
        return *self.tensors, *self.bins, *self.options, self.depth, tolerance

    def backward(self, images: reference.SphereImages, seed: int = 0) -> tuple[Any, ...]:
        """With random gradients of the images."""
        g = scenes.generator(seed)
        v_image, v_depth, v_logsumexp = (scenes.normal(*x.shape, seed=g) for x in images[:3])
        return *self.tensors, *self.bins, self.cutoff, images, v_image, v_depth if self.depth else None, v_logsumexp, *self.options, True

    def track(self, count: int) -> tuple[Any, ...]:
        return *self.geometry, *self.bins, count, *self.size, TILE, self.model, NEAR, FAR, self.chord


def case(n: int, width: int, height: int, *, cameras: int = 1, channels: int = 3, shared: bool = False, model: str = "pinhole",
         chord: bool = False, depth: bool = False, cut: bool = False, gamma: float = 0.1, **others: Any) -> Case:
    g = scenes.generator(3)
    s = scenes.spheres(n, cameras=cameras, channels=channels, **others)
    s = s._replace(opacities=torch.where(torch.arange(n) % 7 == 3, 0.0, s.opacities))
    rows = [x[:1] if shared else x for x in (s.radii, s.opacities, s.features)]
    tensors = s.positions, *rows, scenes.uniform(0.0, 1.0, cameras, channels, seed=g), torch.tensor(gamma, dtype=torch.float64)
    cutoff = scenes.uniform(2.0, 6.0, cameras, height, width, seed=g) if cut else None
    return Case((*tensors, scenes.camera(cameras, width, height, model=model).Ks), cutoff, (width, height), model, chord, depth)


def put(arguments: Any, change: Any = guarded) -> list[Any]:
    """On the device, each tensor (also those of a tuple of images) in other memory."""
    def move(x: Tensor) -> Tensor:
        return change(x).to(DEVICE) if DEVICE == "cpu" else change(x.to(DEVICE))
    return [reference.SphereImages(*map(move, a)) if isinstance(a, tuple) else a for a in each(move, arguments)]


CASES: dict[str, dict[str, Any]] = {
    "one channel": {"n": 9, "width": 11, "height": 9, "channels": 1, "cut": True},
    "RGB, shared rows, depth": {"n": 12, "width": 17, "height": 9, "cameras": 2, "shared": True, "depth": True},
    "chord, four channels": {"n": 9, "width": 11, "height": 9, "channels": 4, "chord": True, "depth": True, "cut": True},
    "orthographic, two channels": {"n": 9, "width": 9, "height": 11, "cameras": 2, "channels": 2, "model": "orthographic", "depth": True},
    "wrapped around the camera": {"n": 9, "width": 9, "height": 9, "depth": True, "size": (1.5, 4.0)},
    "17 channels": {"n": 9, "width": 11, "height": 9, "cameras": 2, "channels": 17, "chord": True, "depth": True, "shared": True},
    "70 channels": {"n": 9, "width": 9, "height": 5, "channels": 70, "cut": True},
    "orthographic, 5 channels": {"n": 20, "width": 9, "height": 11, "channels": 5, "model": "orthographic"},
    "hard": {"n": 9, "width": 9, "height": 9, "gamma": 1e-2},
    "one pixel": {"n": 3, "width": 1, "height": 1},
    "no spheres": {"n": 0, "width": 18, "height": 3, "cameras": 2, "depth": True},
    "no spheres, many channels": {"n": 0, "width": 3, "height": 9, "channels": 6},
    "512 channels": {"n": 3, "width": 3, "height": 2, "channels": 512, "size": (0.6, 1.5), "spread": 0.2},
    "nothing hit": {"n": 3, "width": 9, "height": 9, "depth_range": (20.0, 30.0), "channels": 3},
}


def of(name: str) -> Case:
    options = dict(CASES[name])
    c = case(**{k: v for k, v in options.items() if k != "depth_range"})
    if "depth_range" in options:
        c.tensors[0][..., 2] += options["depth_range"][0]
    return c


@pytest.mark.parametrize("name", CASES)
def test_forward_and_backward_agree_with_the_reference(name: str) -> None:
    """To 1e-12 of the largest: both evaluate the same formula, with sums in another order."""
    c = of(name)
    want = reference.blend_sphere_blocks(*c.forward())
    got = kernels.blend_spheres(*put(c.forward()))
    assert_close([g.cpu() for g in got], want, 1e-12)
    v_want = reference.blend_sphere_blocks_backward(*c.backward(want))
    v_got = kernels.blend_spheres_backward(*put(c.backward(want)))
    assert_close([g.cpu() for g in v_got], v_want, 1e-12)


@pytest.mark.parametrize("channels", [3, 5])
def test_strides(channels: int) -> None:
    c = case(6, 9, 9, cameras=2, channels=channels, depth=True, cut=True)
    want = reference.blend_sphere_blocks(*c.forward())
    assert_close([g.cpu() for g in kernels.blend_spheres(*put(c.forward(), strided))], want, 1e-12)
    v_want = reference.blend_sphere_blocks_backward(*c.backward(want))
    assert_close([g.cpu() for g in kernels.blend_spheres_backward(*put(c.backward(want), strided))], v_want, 1e-12)
    assert torch.equal(kernels.nearest_hits(*put(c.track(2), strided)).cpu(), reference.nearest_hits(*c.track(2)))


@pytest.mark.parametrize(("channels", "model", "spread", "gamma"), [
    (3, "pinhole", 0.5, 0.03), (3, "orthographic", 0.7, 0.01), (5, "pinhole", 0.5, 0.03)])
def test_an_early_end_comes_where_that_of_the_reference_does(channels: int, model: str, spread: float, gamma: float) -> None:
    """For one of two tiles; and the gradient is that of what was rendered."""
    c = case(150, 15, 8, channels=channels, model=model, gamma=gamma, size=(0.3, 1.5), spread=spread)
    want = reference.blend_sphere_blocks(*c.forward(1e-2))
    assert int((want.used < c.bins.offsets.diff()).sum()) == 1
    got = kernels.blend_spheres(*put(c.forward(1e-2)))
    assert torch.equal(got[3].cpu(), want.used)
    assert_close([g.cpu() for g in got], want, 1e-12)
    v_want = reference.blend_sphere_blocks_backward(*c.backward(want))
    assert_close([g.cpu() for g in kernels.blend_spheres_backward(*put(c.backward(want)))], v_want, 1e-12)


@pytest.mark.parametrize("channels", [3, 6])
def test_deterministic_mode_gives_the_same_gradients_and_the_same_bits(channels: int) -> None:
    c = case(9, 17, 9, cameras=2, channels=channels, depth=True, shared=True, cut=True)
    images = reference.blend_sphere_blocks(*c.forward())
    arguments = put(c.backward(images))
    free = kernels.blend_spheres_backward(*arguments)
    torch.use_deterministic_algorithms(True)
    try:
        first, second = (kernels.blend_spheres_backward(*arguments) for _ in range(2))
    finally:
        torch.use_deterministic_algorithms(False)
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    assert_close(first, free, 1e-12)


@pytest.mark.parametrize("model", ["pinhole", "orthographic"])
def test_outlines_are_those_of_the_reference(model: str) -> None:
    """Also of spheres that are culled, and of numbers that are none."""
    c = case(40, 19, 13, cameras=2, model=model, shared=True, size=(0.05, 3.0))
    centers, radii = c.tensors[:2]
    centers[0, 5, 1], centers[1, 6, 2], centers[0, 7, 2] = float("nan"), float("inf"), -3.0
    radii[0, 8], radii[0, 9] = 0.0, float("nan")
    got = [x.cpu() for x in kernels.outlines(*put((*c.geometry, *c.size, model, NEAR, FAR)))]
    seen = got[0][..., 0] > 0
    assert 20 < int(seen.sum()) < 70
    assert torch.equal(got[0], c.outlines.radii)
    assert_close([x[seen] for x in got[1:]], [x[seen] for x in c.outlines[1:]], 1e-14)


@pytest.mark.parametrize(("count", "options"), [
    (1, {}), (5, {"cameras": 2, "shared": True}), (SLOTS + 2, {"chord": True, "size": (0.6, 1.5), "spread": 0.3}),
    (2 * SLOTS, {"model": "orthographic", "size": (0.6, 1.5), "spread": 0.3})])
def test_the_nearest_hits_are_those_of_the_reference(count: int, options: dict[str, Any]) -> None:
    c = case(40, 11, 9, **{"size": (0.2, 0.9), **options})
    want = reference.nearest_hits(*c.track(count))
    assert bool((want[..., -1] >= 0).any())
    assert bool((want[..., 0] < 0).any()) or count > 1
    assert torch.equal(kernels.nearest_hits(*put(c.track(count))).cpu(), want)


def test_the_same_sphere_many_times_is_as_many_hits() -> None:
    """Of equal depths, in more than one pass, each counts once."""
    c = case(1, 8, 8)
    c.tensors = tuple(x.expand(1, SLOTS + 3, *x.shape[2:]).clone() if x.shape[:2] == (1, 1) else x for x in c.tensors)
    c.tensors[0][:] = torch.tensor([0.1, 0.0, 3.0])
    hits = kernels.nearest_hits(*put(c.track(SLOTS + 4))).cpu()[0, 4, 4]
    assert sorted(hits.tolist()) == [-1, *range(SLOTS + 3)]


@pytest.mark.parametrize(("channels", "model"), [(3, "pinhole"), (5, "pinhole"), (1, "orthographic")])
def test_gradcheck_on_the_kernels_themselves(channels: int, model: str) -> None:
    """Of all inputs and outputs, with what each pixel hits kept."""
    c = case(3, 5, 4, channels=channels, model=model, depth=True, spread=0.3, size=(0.4, 0.9), chord=channels == 3)
    _, *arguments = put(c.forward(), torch.clone)
    bins, options = arguments[6:8], (None, *arguments[8:])
    inputs = [x.requires_grad_() for x in put(c.tensors, torch.clone)]
    with KERNELS.active():
        assert torch.autograd.gradcheck(lambda *x: ops.blend_spheres(*x, *bins, *options)[:3], inputs, fast_mode=True)


@pytest.mark.parametrize("channels", [3, 5])
def test_a_ray_through_a_centre_and_opacity_zero_have_finite_gradients(channels: int) -> None:
    """And the same as by the formula, not that of the blocks: these take differences where the kernels and the formula have exact zeros."""
    c = case(3, 5, 5, channels=channels, depth=True)
    c.tensors[6][:] = torch.tensor([[5.0, 0, 2.5], [0, 5, 2.5], [0, 0, 1]])
    c.tensors[0][0, 0] = torch.tensor([0.0, 0.0, 3.0])
    c.tensors[1][0, 0] = 0.8
    for opacity in (0.0, 0.7):
        c.tensors[2][0, 0] = opacity
        inputs = leaves(*c.tensors)
        want = reference.blend_spheres(*inputs, *c.bins, None, *c.options, True)
        arguments = c.backward(reference.SphereImages(*(x.detach() for x in want)))
        v_want = torch.autograd.grad(want[:3], inputs, arguments[11:14])
        v_got = [g.cpu() for g in kernels.blend_spheres_backward(*put(arguments))]
        assert_close(v_got[:5] + v_got[6:], v_want[:5] + v_want[6:], 1e-12)
        assert abs(float(v_got[5] - v_want[5])) <= 1e-12 * max(1.0, abs(float(v_want[5])))      # with opacity 0 a sum that vanishes


def test_float32_is_as_close_as_its_rounding() -> None:
    """A distance is rounded to 3e-7 and a logit is 1/(gamma 4) of that, in sums of 30 spheres: 1e-5; t to some eps |c|/R, 1e-5."""
    c = case(30, 17, 9, depth=True, size=(0.2, 0.9))
    want = reference.blend_sphere_blocks(*c.forward())
    v_want = reference.blend_sphere_blocks_backward(*c.backward(want))

    def single(x: Tensor) -> Tensor:
        return guarded(x.float() if x.is_floating_point() else x)

    assert_close([g.cpu().double() for g in kernels.blend_spheres(*put(c.forward(), single))], want, 2e-5)
    v_got = kernels.blend_spheres_backward(*put(c.backward(want), single))
    assert_close([g.cpu().double() for g in v_got[1:6]], v_want[1:6], 2e-3)
    assert_close(v_got[0].cpu().double(), v_want[0], 2e-3)


def test_another_tile_raises() -> None:
    c = case(2, 8, 8)
    arguments = put(c.forward())
    with pytest.raises(ValueError, match="tile: expected 8"):
        kernels.blend_spheres(*arguments[:11], 16, *arguments[12:])


def test_leaves_stay_as_they_are() -> None:
    """No kernel writes to its inputs."""
    c = case(5, 9, 9, depth=True)
    images = reference.blend_sphere_blocks(*c.forward())
    arguments = put(c.backward(images))
    before = [leaves(*a) if isinstance(a, tuple) else leaves(a) for a in arguments if isinstance(a, Tensor | tuple)]
    kernels.blend_spheres_backward(*arguments)
    after = [list(a) if isinstance(a, tuple) else [a] for a in arguments if isinstance(a, Tensor | tuple)]
    assert all(torch.equal(x, y) for a, b in zip(before, after, strict=True) for x, y in zip(a, b, strict=True))
