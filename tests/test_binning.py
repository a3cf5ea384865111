"""Lists of splats per tile against brute force over pixel centres, and against the definition over the tile's rectangle."""

from __future__ import annotations

import itertools
import math

import plain
import pytest
import scenes
import torch
import tsplat_reference as reference
from backends import Backend
from torch import Tensor
from tsplat_reference import binning, constants

from tsplat import ops

SIZES = {"points": (0.05, 0.3), "usual": (0.4, 4.0), "needles": (0.3, 300.0), "washes": (30.0, 3000.0), "ends": (200.0, 1200.0)}


def bins(s: scenes.Splats2D, width: int, height: int, tile: int) -> reference.Bins:
    return ops.bin_splats(s.means2d, s.radii, s.conics, s.opacities, s.depths, width, height, tile)


def lists(result: reference.Bins) -> list[list[int]]:
    """Indices of the splats of each tile."""
    offsets = result.offsets.tolist()
    return [result.ids[a:b].tolist() for a, b in itertools.pairwise(offsets)]


def hit_table(s: scenes.Splats2D, width: int, height: int, tile: int) -> Tensor:
    """Bool `[C, tiles_y, tiles_x, N]`."""
    C, N = s.opacities.shape
    tiles_x, tiles_y = reference.tile_counts(width, height, tile)
    result = bins(s, width, height, tile)
    table = torch.zeros(C * tiles_y * tiles_x, C * N, dtype=torch.bool)
    owner = torch.repeat_interleave(result.offsets.cpu().diff())
    table[owner, result.ids.cpu().long()] = True
    assert table.sum() == len(result.ids)                                        # none twice
    table = table.view(C, tiles_y, tiles_x, C, N)
    assert not (table & ~torch.eye(C, dtype=torch.bool)[:, None, None, :, None]).any()  # none in another camera's tiles
    return torch.stack([table[c, :, :, c] for c in range(C)])


def touched(s: scenes.Splats2D, c: int, width: int, height: int, tile: int) -> Tensor:
    """Bool `[tiles_y, tiles_x, N]`: some pixel of the tile has alpha >= 1/255, in float64 on the given numbers."""
    tiles_x, tiles_y = reference.tile_counts(width, height, tile)
    alpha = plain.alphas_everywhere(s.means2d[c].double(), s.conics[c].double(), s.opacities[c].double(), width, height, 0.99)
    padded = torch.zeros(tiles_y * tile, tiles_x * tile, alpha.shape[-1], dtype=torch.bool)
    padded[:height, :width] = (alpha > 0) & (s.radii[c] > 0).all(-1)
    return padded.view(tiles_y, tile, tiles_x, tile, -1).any(3).any(1)


def least_distance(s: scenes.Splats2D, c: int, width: int, height: int, tile: int) -> Tensor:
    """`[tiles_y, tiles_x, N]`: the least a dx^2 + 2 b dx dy + c dy^2 over the rectangle of a tile's pixel centres.

    It is 0 with the mean inside; else it lies on one of the four sides, along which the form is a parabola.
    """
    tiles_x, tiles_y = reference.tile_counts(width, height, tile)
    mx, my = s.means2d[c].double().unbind(-1)
    a, b, cc = s.conics[c].double().unbind(-1)
    x0, y0 = torch.arange(tiles_x).double() * tile + 0.5, torch.arange(tiles_y).double() * tile + 0.5
    x1, y1 = (x0 + tile - 1).clamp(max=width - 0.5), (y0 + tile - 1).clamp(max=height - 0.5)
    left, right = (v[None, :, None] - mx for v in (x0, x1))
    top, bottom = (v[:, None, None] - my for v in (y0, y1))

    def form(dx: Tensor, dy: Tensor) -> Tensor:
        return a * dx * dx + 2 * b * dx * dy + cc * dy * dy

    def clamp(v: Tensor, low: Tensor, high: Tensor) -> Tensor:
        return torch.minimum(torch.maximum(v, low), high)

    sides = [form(dx, clamp(-b * dx / cc, top, bottom)) for dx in (left, right)]
    sides += [form(clamp(-b * dy / a, left, right), dy) for dy in (top, bottom)]
    inside = (left <= 0) & (right >= 0) & (top <= 0) & (bottom >= 0)
    return torch.where(inside, 0.0, torch.stack(torch.broadcast_tensors(*sides)).amin(0))


def put(s: scenes.Splats2D, backend: Backend) -> scenes.Splats2D:
    """On the device of a backend, in their own precision."""
    return scenes.Splats2D(*[None if x is None else x.to(backend.device) for x in s])


def splats(size: str, seed: int, width: int, height: int, dtype: torch.dtype) -> scenes.Splats2D:
    s = scenes.splats2d(2, 60, width, height, seed=seed, size=SIZES[size], opacity=(1 / 255, 1.0))
    s = needle_ends(s, seed) if size == "ends" else s
    return scenes.Splats2D(*[x.to(dtype) if x.is_floating_point() else x for x in s])


def needle_ends(s: scenes.Splats2D, seed: int) -> scenes.Splats2D:
    """The same centres as ends of needles, as thin as the blur allows; float32 leaves one digit of the conic's determinant."""
    g = scenes.generator(seed)
    angle, sd = scenes.uniform(0.0, 2 * math.pi, *s.opacities.shape, seed=g), scenes.uniform(*SIZES["ends"], *s.opacities.shape, seed=g)
    along = torch.stack([angle.cos(), angle.sin()], -1)
    reach = (2 * torch.log(255 * s.opacities)).sqrt() * sd * scenes.uniform(0.9, 1.02, *s.opacities.shape, seed=g)
    (ux, uy), p, q = along.unbind(-1), 1 / sd**2, 1 / constants.EPS2D
    conics = torch.stack([ux * ux * p + uy * uy * q, ux * uy * (p - q), uy * uy * p + ux * ux * q], -1)
    return s._replace(means2d=s.means2d - reach[..., None] * along, conics=conics, radii=torch.full_like(s.radii, 1 << 12))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("tile", [4, 5, 8, 16])
def test_no_pixel_is_lost(backend: Backend, size: str, tile: int, dtype: torch.dtype) -> None:
    for seed in range(3):
        s = splats(size, seed, 61, 47, dtype)
        ours = hit_table(put(s, backend), 61, 47, tile)
        for c in range(2):
            exact = touched(s, c, 61, 47, tile)
            assert exact.any()
            assert not (exact & ~ours[c]).any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("tile", [4, 5, 8, 16])
def test_a_tile_is_hit_only_if_the_ellipse_touches_its_pixel_centres_rectangle(backend: Backend, size: str, tile: int,
                                                                               dtype: torch.dtype) -> None:
    """But for the slack that `bin_splats` states: of the level; of c, rounded in w once more; and of positions, rounded once more."""
    s = splats(size, 0, 61, 47, dtype)
    ours = hit_table(put(s, backend), 61, 47, tile)
    slack = constants.BIN_ROUNDING * torch.finfo(dtype).eps
    s = scenes.Splats2D(*[x.double() if x.is_floating_point() else x for x in s])
    a, b, c = s.conics.unbind(-1)
    distance = (2 * torch.log(255 * s.opacities).clamp(min=0.0)).sqrt()
    distance = distance + 4 * slack * (s.means2d.abs().sum(-1) + 61 + 47) * (a + c).sqrt()
    level = distance**2 * (1 + constants.BIN_SLACK_RELATIVE) + constants.BIN_SLACK
    widest = s._replace(conics=torch.stack([a, b, c * (1 - 1.5 * slack)], -1))
    for i in range(2):
        may = least_distance(widest, i, 61, 47, tile) <= level[i] * (1 + 1e-9)
        assert may.sum() < may.numel() or size == "washes"
        assert not (ours[i] & ~may).any()
        exact = touched(s, i, 61, 47, tile)
        assert not (exact & ~ours[i]).any()
        if size in ("usual", "washes"):                  # points and needles may pass between the pixel centres of a tile
            assert ours[i].sum() <= 1.02 * exact.sum() + 1


def test_a_splat_hits_no_tile_outside_its_box(backend: Backend) -> None:
    cam = scenes.camera(2, 61, 47)
    p = scenes.splats(100)
    projected = reference.project(p.means, p.quats, p.scales, None, p.opacities, cam.viewmats, cam.Ks, 61, 47, "pinhole", 0.01,
                                  1e10, 0.3, False)
    s = scenes.Splats2D(projected.means2d, projected.conics, p.opacities.expand(2, -1), p.colors, None, projected.depths,
                        projected.radii)
    ours = hit_table(put(s, backend), 61, 47, 8)
    low, high = s.means2d - s.radii, s.means2d + s.radii
    x, y = torch.arange(8)[None, None, :, None] * 8, torch.arange(6)[None, :, None, None] * 8
    box = ((low[:, None, None, :, 0] < x + 8) & (high[:, None, None, :, 0] > x) & (low[:, None, None, :, 1] < y + 8)
           & (high[:, None, None, :, 1] > y) & (s.radii > 0).all(-1)[:, None, None])
    assert ours.sum() < 0.8 * box.sum()                                          # exact ellipses are worth something
    assert not (ours & ~box).any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_each_list_goes_front_to_back_and_equals_by_index(backend: Backend, dtype: torch.dtype) -> None:
    s = scenes.splats2d(3, 50, 32, 24, size=(2.0, 9.0))
    g = scenes.generator(5)
    depths = torch.randint(-3, 4, (3, 50), generator=g).to(dtype) * 1.5e3        # many equal ones, many negative
    depths[:, ::7] *= 0.0                                                        # of either sign
    result = bins(put(s._replace(depths=depths), backend), 32, 24, 8)
    flat = depths.flatten().double().tolist()
    assert max(map(len, lists(result))) > 20
    assert {math.copysign(1.0, d) for d in flat if d == 0} == {1.0, -1.0}
    for ids in lists(result):
        assert ids == sorted(ids, key=lambda i: (flat[i], i))


def test_offsets_frame_the_lists(backend: Backend) -> None:
    ids, offsets = bins(put(scenes.splats2d(3, 20, 30, 20), backend), 30, 20, 8)
    assert ids.dtype == torch.int32
    assert offsets.dtype == torch.int64
    assert offsets.shape == (3 * 4 * 3 + 1,)
    assert offsets[0] == 0
    assert offsets[-1] == len(ids)
    assert (offsets.diff() >= 0).all()


@pytest.mark.parametrize("tile", [1, 8])
@pytest.mark.parametrize(("width", "height"), [(180, 182), (181, 182), (255, 257), (256, 257), (300, 300)])
def test_any_number_of_tiles(backend: Backend, width: int, height: int, tile: int) -> None:
    """Of one pixel, around 2^15 and 2^16, where narrower keys would overflow; of 8, for the kernels, which take 8 x 8 of them together, in whole and
    in broken groups. (As many of these as of pixels: in `test_kernels_blending.py`.)"""
    s = scenes.splats2d(1, 12, width, height, size=(0.5, 3.0))
    last = s.means2d.clone()
    last[0, -1] = torch.tensor([width - 0.5, height - 0.5])                      # into the last tile
    s = s._replace(means2d=last)
    ours = hit_table(put(s, backend), width, height, tile)
    assert ours.shape == (1, math.ceil(height / tile), math.ceil(width / tile), 12)
    assert ours[0, -1, -1, -1]
    exact = touched(s, 0, width, height, tile)
    assert not (exact & ~ours[0]).any()
    if tile == 1:
        assert ours[0].sum() <= exact.sum() * 1.01 + 2                           # one pixel is the whole rectangle


def test_tiles_with_one_splat_and_with_none(backend: Backend) -> None:
    s = scenes.splats2d(1, 1, 64, 8, size=(0.5, 0.6), opacity=(0.5, 0.5))
    s = s._replace(means2d=torch.tensor([[[28.0, 4.0]]]).double())
    assert lists(bins(put(s, backend), 64, 8, 8)) == [[], [], [], [0], [], [], [], []]


def test_a_splat_between_pixel_centres_may_hit_nothing(backend: Backend) -> None:
    """A point at the corner of four pixels is below 1/255 at all of their centres, and no tile need be paid for."""
    s = scenes.splats2d(1, 1, 16, 16, size=(0.1, 0.1), opacity=(0.5, 0.5))
    s = s._replace(means2d=torch.tensor([[[8.0, 8.0]]]).double())
    assert bins(put(s, backend), 16, 16, 8).ids.numel() == 0


@pytest.mark.parametrize("count", [0, 5])
def test_nothing_visible_gives_empty_lists(backend: Backend, count: int) -> None:
    s = scenes.splats2d(2, count, 30, 20)
    ids, offsets = bins(put(s._replace(radii=torch.zeros_like(s.radii)), backend), 30, 20, 8)
    assert ids.shape == (0,)
    assert torch.equal(offsets.cpu(), torch.zeros(2 * 12 + 1, dtype=torch.int64))


def test_culled_splats_do_not_appear_whatever_their_numbers(backend: Backend) -> None:
    s = scenes.splats2d(2, 30, 30, 20)
    want = lists(bins(put(s, backend), 30, 20, 8))
    radii, broken = s.radii.clone(), [x.clone() for x in (s.means2d, s.conics, s.opacities, s.depths)]
    radii[:, ::3] = 0
    for x in broken:
        x[:, ::3] = math.nan
    culled = scenes.Splats2D(broken[0], broken[1], broken[2], s.colors, None, broken[3], radii)
    got = lists(bins(put(culled, backend), 30, 20, 8))
    assert got == [[i for i in ids if i % 30 % 3] for ids in want]


def test_a_splat_visible_along_one_axis_only_is_culled(backend: Backend) -> None:
    s = scenes.splats2d(1, 2, 30, 20, size=(3.0, 4.0))
    radii = s.radii.clone()
    radii[0, 0, 1] = 0
    assert set(bins(put(s._replace(radii=radii), backend), 30, 20, 8).ids.tolist()) == {1}


@pytest.mark.parametrize("dtype", [torch.int16, torch.int32, torch.int64])
@pytest.mark.parametrize("count", [0, binning.RADIX // 4 - 1, binning.RADIX // 4, 20_000, binning.RADIX - 1, binning.RADIX])
def test_integers_are_sorted_stably_with_padding_and_without(count: int, dtype: torch.dtype) -> None:
    """The largest ones, which are those of padding, too."""
    info = torch.iinfo(dtype)
    keys = torch.tensor([info.max, 7, -3, info.min])[torch.randint(4, (count,), generator=scenes.generator(count))].to(dtype)
    for ours, torchs in zip(binning._sort(keys), keys.sort(stable=True), strict=True):
        assert torch.equal(ours, torchs)
