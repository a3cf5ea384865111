"""The Triton kernels of binning and blending, in the interpreter without a GPU, against the reference."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator

import pytest
import scenes
import torch
import tsplat_reference as reference
from compare import assert_close, guarded, strided
from torch import Tensor
from tsplat_reference.constants import ALPHA_MIN, TRANSMITTANCE_MIN
from tsplat_reference.footprint import log_alpha

pytest.importorskip("triton", reason="Triton is not installed here")

from tsplat.kernels import binning, blending

TILE = 8
ALPHA_MAX = 0.99


@dataclasses.dataclass
class Case:
    """2D splats with their lists, in the middle of larger buffers full of NaN, so that a read out of bounds shows."""

    splats: scenes.Splats2D
    bins: reference.Bins
    width: int
    height: int
    drop_last: bool = False
    alpha_max: float = ALPHA_MAX

    @property
    def arguments(self) -> tuple[Tensor | int | float | None, ...]:
        return *self.splats[:5], *self.bins, self.width, self.height, TILE, self.alpha_max, self.drop_last

    @property
    def exact(self) -> list[Tensor | int | float | None]:
        """The same numbers for the reference: in float64, on the CPU."""
        return [x.cpu().double() if isinstance(x, Tensor) and x.is_floating_point() else x.cpu() if isinstance(x, Tensor) else x
                for x in self.arguments]


def case(cameras: int, n: int, width: int, height: int, *, dtype: torch.dtype = torch.float64, device: str = "cpu",
         drop_last: bool = False, alpha_max: float = ALPHA_MAX, **options: object) -> Case:
    s = scenes.splats2d(cameras, n, width, height, **options)  # type: ignore[arg-type]
    bins = reference.bin_splats(s.means2d, s.radii, s.conics, s.opacities, s.depths, width, height, TILE)
    put = [None if x is None else guarded(x.to(dtype) if x.is_floating_point() else x, device) for x in s]
    return Case(scenes.Splats2D(*put), reference.Bins(*(guarded(b, device) for b in bins)), width, height, drop_last, alpha_max)


@pytest.fixture
def deterministic(request: pytest.FixtureRequest) -> Iterator[bool]:
    """On, or as the test's parameter says."""
    on: bool = getattr(request, "param", True)
    torch.use_deterministic_algorithms(on)
    yield on
    torch.use_deterministic_algorithms(False)


DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
CASES = {
    "one channel": {"cameras": 1, "n": 9, "width": 21, "height": 17, "channels": 1},
    "RGB, shared colours, no background": {"cameras": 2, "n": 12, "width": 17, "height": 9, "channels": 3, "shared_colors": True,
                                           "background": False},
    "four channels": {"cameras": 1, "n": 12, "width": 33, "height": 5, "channels": 4},
    "matrix products": {"cameras": 2, "n": 14, "width": 19, "height": 18, "channels": 21, "shared_colors": True},
    "saturated": {"cameras": 1, "n": 60, "width": 16, "height": 10, "channels": 3, "size": (4.0, 9.0), "opacity": (0.6, 0.999)},
    "saturated, many channels": {"cameras": 1, "n": 60, "width": 10, "height": 16, "channels": 5, "size": (4.0, 9.0),
                                 "opacity": (0.6, 0.999)},
    "the peers' end of a pixel": {"cameras": 1, "n": 60, "width": 16, "height": 10, "channels": 3, "size": (4.0, 9.0), "opacity": (0.6, 0.999),
                                 "drop_last": True},
    "the peers' end of a pixel, many channels": {"cameras": 1, "n": 60, "width": 10, "height": 16, "channels": 5, "size": (4.0, 9.0),
                                                "opacity": (0.6, 0.999), "drop_last": True},
    "one pixel": {"cameras": 1, "n": 3, "width": 1, "height": 1, "channels": 3},
    "no splats": {"cameras": 2, "n": 0, "width": 18, "height": 3, "channels": 3},
}


@pytest.mark.parametrize("name", CASES)
def test_forward_and_backward_agree_with_the_reference(name: str) -> None:
    """To 1e-12 of the largest: both evaluate the same formula, with sums in another order."""
    c = case(**CASES[name], device=DEVICE)
    cpu = [x.cpu() if isinstance(x, Tensor) else x for x in c.arguments]
    want = reference.blend_blocks(*cpu)
    got = blending.blend(*c.arguments)
    assert_close([g.cpu() for g in got], want, 1e-12)
    v = [torch.randn_like(w) for w in want]
    v_want = reference.blend_blocks_backward(*cpu[:7], *want, *v, *cpu[7:], True)
    v_got = blending.blend_backward(*c.arguments[:7], *(guarded(x, DEVICE) for x in (*want, *v)), *c.arguments[7:], True)
    assert_close([g.cpu() for g in v_got], v_want, 1e-12)


@pytest.mark.parametrize("drop_last", [False, True])
@pytest.mark.parametrize("predicates", [False, True])
def test_splats_that_are_not_shown_are_left_out_either_way(monkeypatch: pytest.MonkeyPatch, predicates: bool, drop_last: bool) -> None:
    """By a weight of 0, or by a predicate of the sums: one for some targets, one for the others."""
    target = dataclasses.replace(blending.current_target(), predicates=predicates)
    monkeypatch.setattr(blending, "current_target", lambda: target)
    c = case(1, 40, 21, 17, channels=4, device=DEVICE, drop_last=drop_last, size=(2.0, 9.0), opacity=(0.3, 0.999))
    want = reference.blend_blocks(*(x.cpu() if isinstance(x, Tensor) else x for x in c.arguments))
    assert_close([g.cpu() for g in blending.blend(*c.arguments)], want, 1e-12)


@pytest.mark.parametrize(("channels", "absgrad"), [(3, False), (3, True), (4, True), (6, False)])
def test_deterministic_mode_gives_the_same_gradients_and_the_same_bits(deterministic: bool, channels: int, absgrad: bool) -> None:
    """Those of the reference, as the other mode does: to 1e-12 of the largest, for the reasons there."""
    c = case(1, 15, 30, 18, channels=channels, device=DEVICE)
    want = reference.blend_blocks(*c.exact)
    v = [torch.randn_like(w) for w in want]
    v_want = reference.blend_blocks_backward(*c.exact[:7], *want, *v, *c.exact[7:], absgrad)
    upstream = [guarded(x, DEVICE) for x in (*want, *v)]
    first, second = (blending.blend_backward(*c.arguments[:7], *upstream, *c.arguments[7:], absgrad) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    assert_close(first, v_want, 1e-12)


def test_deterministic_absolute_gradients_of_many_channels_raise(deterministic: bool) -> None:
    c = case(1, 4, 8, 8, channels=5, device=DEVICE)
    image, alphas = blending.blend(*c.arguments)
    with pytest.raises(NotImplementedError, match="absgrad"):
        blending.blend_backward(*c.arguments[:7], image, alphas, image, alphas, *c.arguments[7:], True)


def test_float32_is_as_close_as_its_rounding() -> None:
    """60 splats deep: some 100 roundings of 6e-8 per pixel, and as much again in the records."""
    c = case(1, 60, 20, 20, dtype=torch.float32, device=DEVICE)
    exact = case(1, 60, 20, 20)
    assert_close([g.cpu().double() for g in blending.blend(*c.arguments)], reference.blend_blocks(*exact.arguments), 2e-5)


def far_from_thresholds(c: Case) -> Tensor:
    """Bool `[C, H, W]`: where rounding, of 1e-3, decides of no splat whether it shows, is clamped, or is behind the end of the pixel."""
    means2d, conics, opacities = c.exact[:3]
    y, x = torch.meshgrid(torch.arange(c.height) + 0.5, torch.arange(c.width) + 0.5, indexing="ij")
    views = []
    for i, depths in enumerate(c.splats.depths.cpu()):
        order = depths.argsort()
        mx, my = means2d[i, order].unbind(-1)
        alpha = log_alpha(x[..., None] - mx, y[..., None] - my, conics[i, order], opacities[i, order]).exp()          # [H, W, N]
        T = torch.where(alpha >= ALPHA_MIN, 1 - alpha.clamp(max=c.alpha_max), 1.0).cumprod(-1)
        assert (alpha > c.alpha_max).any()
        assert (T < TRANSMITTANCE_MIN).any()
        ratios = torch.cat([alpha / ALPHA_MIN, alpha / c.alpha_max, T / TRANSMITTANCE_MIN], -1)
        views.append(((ratios - 1).abs() > 1e-3).all(-1))
    return torch.stack(views)


@pytest.mark.parametrize(("channels", "deterministic", "absgrad"), [
    x for x in itertools.product([3, 4, 32], [False, True], [False, True]) if x != (32, True, True)], indirect=["deterministic"])
@pytest.mark.parametrize("drop_last", [False, True])
def test_float32_gradients_are_as_close_as_their_rounding(channels: int, drop_last: bool, deterministic: bool, absgrad: bool) -> None:
    """On a GPU these are the branches in PTX and the products in TF32, which no test in float64 comes to.

    With u = 6e-8: an exponent is off by some 20 u, as it has squares, up to 8, of sums with terms up to 7. So is alpha, and three splats deep, where
    most of the light is gone, a weight is by 60 u = 4e-6; and so what is linear in weights (colours) or adds up terms of one sign (absolute
    gradients). What is still to come is a difference, off by some 5 u of the whole, and counts alpha/(1 - alpha) times, 9 at the most with this
    alpha_max: that is 3e-6 of the largest terms of sums that partly cancel, to a fifth or so: 2e-5.
    """
    c = case(1, 24, 14, 10, dtype=torch.float32, device=DEVICE, drop_last=drop_last, alpha_max=0.9, channels=channels, size=(4.0, 9.0),
             opacity=(0.4, 0.999))
    sure = far_from_thresholds(c)
    assert sure.float().mean() > 0.9
    want, got = reference.blend_blocks(*c.exact), blending.blend(*c.arguments)
    v = torch.randn(want[0].shape) * sure[..., None], torch.randn(want[1].shape) * sure
    v_want = reference.blend_blocks_backward(*c.exact[:7], *want, *(x.double() for x in v), *c.exact[7:], absgrad)
    v_got = blending.blend_backward(*c.arguments[:7], *(guarded(x, DEVICE) for x in (*got, *v)), *c.arguments[7:], absgrad)
    assert all(x.dtype == torch.float32 for x in v_got)
    assert_close(v_got[:3], v_want[:3], 2e-5)
    assert_close(v_got[3:], v_want[3:], 5e-6)


def test_another_tile_raises() -> None:
    c = case(1, 2, 8, 8, device=DEVICE)
    with pytest.raises(ValueError, match="tile: expected 8"):
        blending.blend(*c.arguments[:-3], 16, ALPHA_MAX, False)


BINNED = {"batch": (3, 40, 70, 41, {}), "large splats": (1, 10, 100, 37, {"size": (10.0, 40.0)}), "nothing": (1, 0, 20, 20, {}),
          "invisible": (2, 9, 33, 33, {})}


def in_gaps(tensor: Tensor, device: str) -> Tensor:
    """On a device, with NaN between the numbers."""
    return strided(tensor.to(device))


@pytest.mark.parametrize("memory", [guarded, in_gaps])
@pytest.mark.parametrize("name", BINNED)
def test_bins_are_those_of_the_reference(name: str, memory: Callable[[Tensor, str], Tensor]) -> None:
    cameras, n, width, height, options = BINNED[name]
    s = scenes.splats2d(cameras, n, width, height, **options)
    radii = torch.zeros_like(s.radii) if name == "invisible" else s.radii
    arguments = s.means2d, radii, s.conics, s.opacities, s.depths
    want = reference.bin_splats(*arguments, width, height, TILE)
    put = [memory(x, DEVICE) for x in arguments]
    got = binning.bin_splats(*put, width, height, TILE)
    assert torch.equal(got[0].cpu(), want.ids)
    assert torch.equal(got[1].cpu(), want.offsets)
    ids, offsets, needed = binning.bin_splats_fixed(*put, width, height, TILE, len(want.ids) + 3)
    assert torch.equal(ids[:len(want.ids)].cpu(), want.ids)
    assert torch.equal(offsets.cpu(), want.offsets)
    assert int(needed) == len(want.ids)


@pytest.mark.parametrize("memory", [guarded, in_gaps])
def test_lists_in_float32_go_front_to_back_and_equals_by_index(memory: Callable[[Tensor, str], Tensor]) -> None:
    """The bits of a float are its key then: of either sign, and zeros of either sign, too."""
    s = scenes.splats2d(2, 30, 20, 12, size=(2.0, 9.0))
    depths = torch.randint(-3, 4, (2, 30), generator=scenes.generator(5)).float() * 1.5e3
    depths[:, ::7] *= 0.0
    arguments = s.means2d.float(), s.radii, s.conics.float(), s.opacities.float(), depths
    ids, offsets = (x.cpu() for x in binning.bin_splats(*(memory(x, DEVICE) for x in arguments), 20, 12, TILE))
    flat = depths.flatten().tolist()
    assert {math.copysign(1.0, d) for d in flat if d == 0} == {1.0, -1.0}
    lists = [ids[a:b].tolist() for a, b in itertools.pairwise(offsets.tolist())]
    assert min(map(len, lists)) > 5
    assert lists == [sorted(some, key=lambda i: (flat[i], i)) for some in lists]


def test_tiles_beyond_32_bits() -> None:
    """2^36 of them, in two images of 2^30 bins: their lists would not fit anywhere, but the hits of bins do."""
    side, size = 1 << 15, 1 << 21
    means2d = torch.tensor([[[0.5, 0.5], [size - 0.5, size - 0.5]], [[size - 0.5, 0.5], [size / 2 + 4.5, size - 0.5]]], dtype=torch.float64)
    wanted = torch.tensor([0, side * side - 1, side * side + side - 1, 2 * side * side - side // 2])
    radii, conics = torch.ones(2, 2, 2, dtype=torch.int32), torch.tensor([2.0, 0.0, 2.0], dtype=torch.float64).expand(2, 2, 3)
    put = [guarded(x, DEVICE) for x in (radii, means2d, conics, torch.full((2, 2), 0.9, dtype=torch.float64), torch.arange(4, dtype=torch.int32),
                                        torch.arange(1, 5))]
    keys, ids = torch.zeros(4, dtype=torch.int64, device=DEVICE), torch.zeros(4, dtype=torch.int32, device=DEVICE)
    binning.emit_kernel[(1,)](*put, keys, ids, 4, 2, size, size, side, side, 4, EPS=2.2e-16, TILE=TILE, SIDE=8, BLOCK=32)
    assert torch.equal(keys.cpu() >> 32, wanted)
    assert ids.tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(("columns", "rows"), [(256, 257)] if DEVICE == "cpu" else [(180, 182), (181, 182), (255, 257), (256, 257), (300, 300)])
def test_more_tiles_than_16_bits_count(columns: int, rows: int) -> None:
    """Around 2^15 and 2^16 of them, on a GPU; the interpreter takes 20 s for one number. A splat in the last tile of each row but one, in the first
    of the next, and in the last tile of all."""
    width, height = TILE * columns, TILE * rows
    s = scenes.splats2d(1, 20, width, height)
    last, row = columns - 1, rows - 1
    tiles = torch.tensor([[last, row - 1], [0, row], [last, row]])
    s.means2d[0, :3], s.conics[0, :3], s.radii[0, :3] = 8.0 * tiles + 4, torch.tensor([1.0, 0.0, 1.0]).double(), 4
    arguments = s.means2d, s.radii, s.conics, s.opacities, s.depths
    want = reference.bin_splats(*arguments, width, height, TILE)
    counts = want.offsets.diff().view(rows, columns)
    assert (counts[tiles[:, 1], tiles[:, 0]] > 0).all()
    assert len(want.ids) > 50
    got = binning.bin_splats(*(guarded(x, DEVICE) for x in arguments), width, height, TILE)
    assert torch.equal(got[0].cpu(), want.ids)
    assert torch.equal(got[1].cpu(), want.offsets)


@pytest.mark.parametrize("spare", [0, 7, -20])
def test_fixed_capacity_reports_overflow_and_corrupts_nothing(spare: int) -> None:
    """With room, the same lists; without, a prefix in depth order of each tile's list, and the number that would have been needed."""
    s = scenes.splats2d(2, 30, 50, 40)
    arguments = s.means2d, s.radii, s.conics, s.opacities, s.depths
    want = reference.bin_splats(*arguments, 50, 40, TILE)
    capacity = len(want.ids) + spare
    ids, offsets, hits = binning.bin_splats_fixed(*(guarded(x, DEVICE) for x in arguments), 50, 40, TILE, capacity)
    assert int(hits) == len(want.ids)
    assert ids.shape == (capacity,)
    assert int(offsets[-1]) == min(capacity, len(want.ids))
    for t in range(len(offsets) - 1):
        mine, theirs = ids[offsets[t]:offsets[t + 1]].cpu(), want.ids[want.offsets[t]:want.offsets[t + 1]]
        assert torch.equal(mine, theirs[:len(mine)])
        assert len(mine) == len(theirs) or spare < 0
