"""Blending three times: in blocks with closed-form gradients (what runs), by the reference's formula, and by `plain`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import plain
import pytest
import scenes
import torch
import tsplat_reference as reference
from backends import Backend
from compare import SMALL_BLOCKS, Peak, assert_close, assert_same_bits, gradients, leaves, strided, threads
from torch import Tensor
from tsplat_reference import blending, blocks, footprint, walk

from tsplat import ops

ALPHA_MAX = 0.99


def lists(s: scenes.Splats2D, width: int, height: int, tile: int) -> reference.Bins:
    return reference.bin_splats(s.means2d, s.radii, s.conics, s.opacities, s.depths, width, height, tile)


def blend(function: Callable[..., Any], s: scenes.Splats2D, width: int, height: int, tile: int, alpha_max: float = ALPHA_MAX,
          bins: reference.Bins | None = None, drop_last: bool = False) -> tuple[Tensor, Tensor]:
    """Through `ops.blend`, `reference.blend` or `plain.blend`."""
    if function is plain.blend:
        return plain.blend(*s, width, height, alpha_max, drop_last=drop_last)
    ids, offsets = lists(s, width, height, tile) if bins is None else bins
    probe = (None,) if function is ops.blend else ()
    return function(*s[:5], *probe, ids, offsets, width, height, tile, alpha_max, drop_last)


def differentiable(s: scenes.Splats2D) -> tuple[scenes.Splats2D, list[Tensor]]:
    """With leaves for what has a gradient, and the leaves."""
    new = leaves(*(x for x in s[:5] if x is not None))
    return scenes.Splats2D(*new, *([None] if s.backgrounds is None else []), s.depths, s.radii), new


def assert_all_three_agree(s: scenes.Splats2D, width: int, height: int, tile: int, alpha_max: float = ALPHA_MAX,
                           backend: Backend | None = None, drop_last: bool = False) -> None:
    """Values to 1e-13 and gradients to 1e-11 of the largest.

    The blocks evaluate log alpha as a polynomial about the tile's centre, whose terms reach some hundred: 1e2 eps. The backward
    divides the rest by the transmittance behind: another 1/(1 - alpha_max).
    """
    results = []
    for function in (plain.blend, reference.blend, ops.blend):
        mine = s if backend is None or function is not ops.blend else backend.put(s)
        mine, inputs = differentiable(mine)
        outputs = blend(function, mine, width, height, tile, alpha_max, drop_last=drop_last)
        results.append((outputs, gradients(outputs, inputs)))
    (want, v_want), *others = results
    for got, v_got in others:
        assert_close(got, want, 1e-13)
        assert_close(v_got, v_want, 1e-11)


@pytest.mark.parametrize("shared_colors", [False, True])
@pytest.mark.parametrize("background", [False, True])
@pytest.mark.parametrize("channels", [1, 3, 17, 130])
def test_channels_backgrounds_and_shared_colours(backend: Backend, channels: int, background: bool,
                                                 shared_colors: bool) -> None:
    s = scenes.splats2d(2, 40, 23, 19, channels=channels, background=background, shared_colors=shared_colors)
    assert_all_three_agree(s, 23, 19, 8, backend=backend)


def test_very_many_channels(backend: Backend) -> None:
    assert_all_three_agree(scenes.splats2d(1, 12, 9, 11, channels=512), 9, 11, 8, backend=backend)


@pytest.mark.parametrize("tile", [1, 4, 5, 16])
@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 31), (8, 8), (33, 17)])
def test_sizes_of_image_and_tile(backend: Backend, width: int, height: int, tile: int) -> None:
    assert_all_three_agree(scenes.splats2d(2, 25, width, height, size=(0.5, 6.0)), width, height, tile, backend=backend)


@pytest.mark.parametrize("seed", range(4))
def test_needles_and_washes(backend: Backend, seed: int) -> None:
    assert_all_three_agree(scenes.splats2d(2, 50, 22, 14, seed=seed, size=(0.55, 60.0)), 22, 14, 8, backend=backend)


@pytest.mark.parametrize("background", [False, True])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize(("width", "height"), [(1, 1), (8, 8), (5, 1)])
def test_an_image_of_one_tile(backend: Backend, width: int, height: int, channels: int, background: bool) -> None:
    """Where slices of the padded image are views of one memory, in another order than elsewhere."""
    s = scenes.splats2d(1, 9, width, height, channels=channels, background=background, size=(0.5, 6.0), opacity=(0.05, 0.5))
    assert_all_three_agree(s, width, height, 8, backend=backend)
    assert all(x.is_contiguous() for x in blend(ops.blend, backend.put(s), width, height, 8))


def test_many_cameras(backend: Backend) -> None:
    assert_all_three_agree(scenes.splats2d(33, 9, 13, 10), 13, 10, 8, backend=backend)


@pytest.mark.parametrize("alpha_max", [0.5, 0.99, 0.999])
def test_saturation_within_a_chunk(backend: Backend, alpha_max: float) -> None:
    s = scenes.splats2d(1, 60, 12, 12, size=(2.0, 9.0), opacity=(0.9, 1.0))
    weight = blend(plain.blend, s, 12, 12, 8, alpha_max)[1]
    assert (1 - weight < 1e-4).float().mean() > 0.5                               # else nothing ends early
    assert_all_three_agree(s, 12, 12, 8, alpha_max, backend=backend)


@pytest.mark.parametrize("channels", [3, 6])
def test_the_peers_end_of_a_pixel(backend: Backend, channels: int) -> None:
    """Lists of several chunks, in which pixels end at all places; and it is another result."""
    s = scenes.splats2d(1, 150, 13, 11, size=(1.0, 4.0), opacity=(0.5, 1.0), channels=channels)
    ours, peers = (blend(reference.blend, s, 13, 11, 8, drop_last=drop_last)[1] for drop_last in (False, True))
    assert ((ours - peers > 1e-4) & (peers < 1 - 1e-4)).float().mean() > 0.3
    assert_all_three_agree(s, 13, 11, 8, backend=backend, drop_last=True)


@pytest.mark.parametrize(("count", "opacity"), [(300, (0.01, 0.3)), (300, (0.3, 1.0)), (64, (0.3, 1.0)), (65, (0.004, 0.02)),
                                                (128, (0.1, 0.4))])
def test_lists_longer_than_a_chunk(backend: Backend, count: int, opacity: tuple[float, float]) -> None:
    """The light that a pixel keeps from chunk to chunk, pixels that end in the second chunk, and lists that end with a
    chunk.
    """
    s = scenes.splats2d(1, count, 10, 9, size=(3.0, 20.0), opacity=opacity)
    assert lists(s, 10, 9, 8).offsets.diff().max() > 0.8 * count >= 0.8 * walk.CHUNK
    assert_all_three_agree(s, 10, 9, 8, backend=backend)


@pytest.mark.parametrize(("chunk", "block", "group"), [(1, 1, 1), (7, 1 << 10, 64), (64, 1, 1 << 9), (1000, 1 << 18, 1 << 15)])
@pytest.mark.parametrize("channels", [3, 20])
def test_chunks_blocks_and_groups_change_nothing(monkeypatch: pytest.MonkeyPatch, channels: int, chunk: int, block: int,
                                                 group: int) -> None:
    s, inputs = differentiable(scenes.splats2d(2, 25, 13, 11, channels=channels, size=(0.5, 9.0), opacity=(0.05, 1.0)))
    probe = torch.zeros_like(s.means2d).requires_grad_()
    bins = lists(s, 13, 11, 8)

    def run() -> list[Tensor]:
        outputs = ops.blend(*s[:5], probe, *bins, 13, 11, 8, ALPHA_MAX)
        return [*outputs, *gradients(outputs, [*inputs, probe])]

    want = run()
    for name, value in (("CHUNK", chunk), ("BLOCK", block), ("GROUP", group), ("ALONE", group), ("SHAPES", 1), ("PLANES", 0), ("WORTH_WORKERS", 0)):
        monkeypatch.setattr(walk, name, value)
    with threads(1):
        got = run()
    assert_close(got[:2], want[:2], 1e-14)
    assert_close(got[2:], want[2:], 1e-12)
    with threads(2):
        assert_same_bits(run(), got)


@pytest.mark.parametrize("count", [1, 2, 3, 8, 9, 15, 16, 17, 18, 19, 36, 64, 101])
def test_running_sums_and_products(count: int) -> None:
    """Against torch's, to some roundings; in place, too."""
    g = scenes.generator(count)
    x, start = (torch.rand(shape, generator=g, dtype=torch.float64) * 0.1 + 0.95 for shape in ((2, count, 3), (2, 3)))
    out = torch.empty_like(x)
    blocks.Scan(x, out).run(torch.add, start)
    assert_close(out, x.cumsum(1) + start[:, None], 1e-14)
    total = torch.empty_like(x)
    blocks.Scan(x, total, blocks.Scan(total, total)).run(torch.add, start)
    assert_same_bits([total], [out])
    want = x.cumprod(1) * start[:, None]
    blocks.Scan(x, x).run(torch.mul, start)
    assert_close(x, want, 1e-14)


def test_padding_changes_no_bit_of_running_sums() -> None:
    """Lists are padded to the length of the longest beside them."""
    x, start = torch.rand(2, 64, 3), torch.rand(2, 3)
    whole = torch.empty_like(x)
    blocks.Scan(x, whole).run(torch.add, start)
    for count in range(1, 64):
        part = torch.empty_like(x[:, :count])
        blocks.Scan(x[:, :count], part).run(torch.add, start)
        assert_same_bits([part], [whole[:, :count]])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("pairs", [1, 2])
def test_products_have_the_same_bits_on_one_and_two_threads(pairs: int, dtype: torch.dtype) -> None:
    """Where torch's do not, of a single pair of matrices."""
    a, results = torch.rand(6, 64, dtype=dtype), []
    for count in (1, 2):
        with threads(count):
            torch.manual_seed(0)
            results.append([walk.products(a, torch.rand(pairs, k, 64, dtype=dtype).mT) for k in (5, 17, 64, 127, 500, 3001)])
    assert_same_bits(*results)


def test_the_formula_does_not_depend_on_its_groups(monkeypatch: pytest.MonkeyPatch) -> None:
    s = scenes.splats2d(2, 40, 23, 19)
    want = blend(reference.blend, s, 23, 19, 8)
    monkeypatch.setattr(blending, "PAIRS", 1 << 10)
    assert_close(blend(reference.blend, s, 23, 19, 8), want, 1e-15)


def stack(opacities: Sequence[float], colors: Sequence[float]) -> scenes.Splats2D:
    """Splats one behind the other on the centre of the only pixel, wide enough to be flat there."""
    n = len(opacities)
    f64 = {"dtype": torch.float64}
    return scenes.Splats2D(torch.full((1, n, 2), 0.5, **f64), torch.tensor([1e-2, 0.0, 1e-2], **f64).expand(1, n, 3),
                           torch.tensor([opacities], **f64), torch.tensor(colors, **f64)[None, :, None],
                           torch.zeros(1, 1, **f64), torch.arange(n, **f64)[None] + 1,
                           torch.full((1, n, 2), 40, dtype=torch.int32))


@pytest.mark.parametrize("function", [ops.blend, reference.blend, plain.blend])
@pytest.mark.parametrize(("front", "counts"), [(1.001e-4, True), (0.999e-4, False)])
@pytest.mark.parametrize("behind", [4, 70, 130])
def test_a_splat_counts_while_the_light_before_it_is_above_the_limit(function: Callable[..., Any], front: float, counts: bool,
                                                                     behind: int) -> None:
    """Whether the deciding splat is in the first chunk or in a later one; nothing behind it counts, however bright."""
    faint = behind - 4
    thin = 0.01
    light = (1 - thin) ** faint
    opacities = [thin] * faint + [0.95, 0.95, 1 - front / (light * 0.05**2), 0.9]
    s = stack([*opacities, 0.9], [0.0] * (faint + 3) + [1.0, 1e6])
    image, alpha = blend(function, s, 1, 1, 1)
    want = 0.9 * front if counts else 0.0
    assert image.item() == pytest.approx(want, rel=1e-10, abs=1e-12)
    assert alpha.item() == pytest.approx(1 - front * (0.1 if counts else 1.0), rel=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_what_the_stop_leaves_out_weighs_at_most_its_limit(backend: Backend, monkeypatch: pytest.MonkeyPatch,
                                                           seed: int) -> None:
    s = scenes.splats2d(1, 200, 16, 16, seed=seed, size=(2.0, 9.0), opacity=(0.3, 1.0), background=False)
    image, alpha = blend(ops.blend, backend.put(s), 16, 16, 8)
    monkeypatch.setattr(plain, "STOP", -1.0)
    exact, exact_alpha = blend(plain.blend, s, 16, 16, 8)
    left_out = exact_alpha - alpha.cpu()
    assert left_out.max() > 1e-6                                                  # else nothing was left out
    assert left_out.min() > -1e-12
    assert left_out.max() <= 1e-4
    assert (exact - image.cpu()).abs().max() <= 1e-4                              # colours are at most 1


@pytest.mark.parametrize("alpha_max", [0.6, 0.99])
def test_alpha_is_clamped_with_zero_gradient_there(backend: Backend, alpha_max: float) -> None:
    """Where it is clamped only the colour has a gradient; beside it the geometry, too."""
    s, inputs = differentiable(backend.put(stack([0.999], [1.0])))
    inputs = inputs[:4]
    ids, offsets = lists(s, 40, 1, 8)
    image, alpha = ops.blend(*s[:5], None, ids, offsets, 40, 1, 8, alpha_max)
    dx = plain.pixel_centers(40, 1)[0, :, 0] - 0.5
    free = 0.999 * torch.exp(-0.5e-2 * dx**2)
    clamped = free > alpha_max
    assert 0 < clamped.sum() < 40
    assert_close(alpha[0, 0], torch.where(free >= 1 / 255, free.clamp(max=alpha_max), 0.0), 1e-14)
    v_means2d, v_conics, v_opacities, v_colors = torch.autograd.grad(image[0, 0, clamped].sum(), inputs, retain_graph=True)
    for v in (v_means2d, v_conics, v_opacities):
        assert (v == 0).all()
    assert v_colors.item() == pytest.approx(alpha_max * clamped.sum().item())
    v_means2d, v_conics, v_opacities, v_colors = torch.autograd.grad(image[0, 0, ~clamped].sum(), inputs)
    assert v_means2d[0, 0, 0] > 0
    assert v_conics[0, 0, 0] < 0
    assert v_opacities.item() == pytest.approx(free[(free >= 1 / 255) & ~clamped].sum().item() / 0.999)


def test_below_one_part_in_255_there_is_nothing(backend: Backend) -> None:
    s, inputs = differentiable(backend.put(stack([0.999 / 255], [1.0])))
    image, alpha = blend(ops.blend, s, 9, 1, 8)
    assert (image == 0).all()
    assert (alpha == 0).all()
    assert all((v == 0).all() for v in gradients([image, alpha], inputs[:4]))
    s, _ = differentiable(backend.put(stack([1.001 / 255], [1.0])))
    assert blend(ops.blend, s, 1, 1, 8)[1].item() == pytest.approx(1.001 / 255)


@pytest.mark.parametrize("background", [False, True])
@pytest.mark.parametrize("shared_colors", [False, True])
def test_absolute_gradient_is_the_sum_over_pixels_of_magnitudes(backend: Backend, background: bool,
                                                                shared_colors: bool) -> None:
    s = scenes.splats2d(2, 40, 23, 19, background=background, shared_colors=shared_colors, opacity=(0.05, 1.0))
    v_image, v_alpha = scenes.normal(2, 19, 23, 3, seed=scenes.generator(1)), scenes.normal(2, 19, 23, seed=scenes.generator(2))
    want = plain.absolute_gradient(*s, 23, 19, v_image, v_alpha)
    mine, _ = differentiable(backend.put(s))
    probe = torch.zeros_like(mine.means2d).requires_grad_()
    outputs = ops.blend(*mine[:5], probe, *lists(mine, 23, 19, 8), 23, 19, 8, ALPHA_MAX)
    got, v_means2d = torch.autograd.grad(outputs, [probe, mine.means2d], backend.put((v_image, v_alpha)))
    assert_close(got, want, 1e-11)
    assert (got >= v_means2d.abs() - 1e-12).all()
    assert got.sum() > 1.5 * v_means2d.abs().sum()                                # signs do cancel in the ordinary gradient


def test_the_probe_of_the_absolute_gradient_changes_nothing(backend: Backend) -> None:
    s, inputs = differentiable(backend.put(scenes.splats2d(2, 40, 23, 19)))
    bins = lists(s, 23, 19, 8)
    plainly = ops.blend(*s[:5], None, *bins, 23, 19, 8, ALPHA_MAX)
    probed = ops.blend(*s[:5], torch.full_like(s.means2d, 7.0).requires_grad_(), *bins, 23, 19, 8, ALPHA_MAX)
    assert_same_bits(probed, plainly)
    assert_same_bits(gradients(probed, inputs), gradients(plainly, inputs))


@pytest.mark.parametrize("shared_colors", [False, True])
def test_numbers_of_culled_splats_do_not_matter(backend: Backend, shared_colors: bool) -> None:
    s = scenes.splats2d(2, 40, 23, 19, shared_colors=shared_colors)
    radii = s.radii.clone()
    radii[:, ::3] = 0
    conics = torch.where((radii > 0).all(-1, keepdim=True), s.conics, 0.0)        # as `project` leaves them
    broken = [x.clone() for x in (s.means2d, s.opacities, s.colors)]
    for x in broken:
        x[:, ::3] = float("nan")
    results = []
    for tensors in ((s.means2d, conics, *s[2:4]), (broken[0], conics, *broken[1:])):
        mine, inputs = differentiable(backend.put(scenes.Splats2D(*tensors, s.backgrounds, s.depths, radii)))
        outputs = blend(ops.blend, mine, 23, 19, 8)
        v = gradients(outputs, inputs)
        assert all((x[:, ::3] == 0).all() for x in v[:4])
        results.append([*outputs, *v])
    assert_same_bits(*results)


def test_the_order_of_the_splats_in_memory_does_not_matter(backend: Backend) -> None:
    """Bit for bit: lists go by depth."""
    s, order = backend.put(scenes.splats2d(2, 70, 23, 19)), torch.randperm(70)
    shuffled = scenes.Splats2D(*[x if x is s.backgrounds else x[:, order] for x in s])
    results = []
    for x in (s, shuffled):
        mine, inputs = differentiable(x)
        outputs = blend(ops.blend, mine, 23, 19, 8)
        results.append((outputs, gradients(outputs, inputs)))
    (want, v_want), (got, v_got) = results
    assert_same_bits(got, want)
    # summed over tiles in their order
    assert_close(v_got, [v if v.ndim == 2 and v.shape[1] == 3 else v[:, order] for v in v_want], 1e-14)


def test_layout_of_inputs_and_upstream_gradients_does_not_matter(backend: Backend) -> None:
    s, inputs = differentiable(backend.put(scenes.splats2d(2, 40, 23, 19)))
    bins = lists(s, 23, 19, 8)
    want = ops.blend(*s[:5], None, *bins, 23, 19, 8, ALPHA_MAX)
    v = torch.randn_like(want[0]), torch.randn_like(want[1])
    got = ops.blend(*(strided(x) for x in s[:5]), None, strided(bins.ids), strided(bins.offsets), 23, 19, 8, ALPHA_MAX)
    assert_same_bits(got, want)
    assert_close(torch.autograd.grad(got, inputs, [strided(x) for x in v]), torch.autograd.grad(want, inputs, v), 1e-14)     # atomics


@pytest.mark.parametrize("tile", [4, 8, 16])
def test_float32_stays_within_its_rounding_errors(tile: int) -> None:
    """|d log alpha| is eps times the terms of the polynomial, and |dC| <= 2 max|c| |d log alpha|, as sum_i |dC/dlog alpha_i| <=
    2 max|c|.

    Products and sums along a list of n splats add sqrt(n) eps, as rounding errors are random. Pixels where a decision (1/255,
    the stop) is as close as that may flip it.
    """
    s64 = scenes.splats2d(1, 200, 40, 32, size=(0.6, 9.0), background=False)
    s32, inputs32 = differentiable(scenes.Splats2D(*[x.float() if x is not None and x.is_floating_point() else x for x in s64]))
    s64, inputs64 = differentiable(scenes.Splats2D(*[x.double() if x is not None and x.is_floating_point() else x
                                                     for x in s32]))
    ids, offsets = lists(s64, 40, 32, tile)
    eps = torch.finfo(torch.float32).eps
    owner = torch.repeat_interleave(offsets.diff())
    record = footprint.records(s64.means2d[0], s64.conics[0], s64.opacities[0]).detach()[ids.long()].T[:, None]
    tiles_x = reference.tile_counts(40, 32, tile)[0]
    centre = [((v * tile + tile / 2) - m)[None] for v, m in ((owner % tiles_x, record[0, 0]), (owner // tiles_x, record[1, 0]))]
    coefficients, monomials = footprint.coefficients(record, *centre)[0].T, footprint.monomials(tile, torch.float64, ids.device)
    seen = coefficients @ monomials > math.log(1 / 255)                           # [hits, pixels]
    terms = (coefficients.abs() @ monomials.abs())[seen].detach()
    alpha = plain.alphas_everywhere(s64.means2d[0], s64.conics[0], s64.opacities[0], 40, 32, ALPHA_MAX)
    longest = int(offsets.diff().max())
    error = eps * (terms.max().item() + longest**0.5)
    d = plain.pixel_centers(40, 32)[:, :, None] - s64.means2d[0]
    log_alpha = footprint.log_alpha(d[..., 0], d[..., 1], s64.conics[0], s64.opacities[0])
    got, want = (blend(ops.blend, s, 40, 32, tile, bins=reference.Bins(ids, offsets)) for s in (s32, s64))
    order = plain.front_to_back(s64.depths[0], s64.radii[0])
    light = torch.cumprod(1 - alpha[..., order], -1)
    close = (log_alpha - math.log(1 / 255)).abs().amin(-1) < error
    close |= (torch.log(light / 1e-4).abs() < longest * error).any(-1)
    assert close.float().mean() < 0.05
    for g, w in zip(got, want, strict=True):
        difference = (g - w).abs()[0]
        assert difference[~close].max() <= 2 * error
        assert difference.max() <= 2 * error + 1 / 255
    # dL/dlog alpha_i = w_i (g_i - R_i/T_{i+1}) takes R by subtraction from a sum, with its error, and T with that of log alpha
    calm = (~close).float()[None]
    v32, v64 = (torch.autograd.grad([(image * calm[..., None]).sum() + (alpha * calm).sum()], inputs)
                for (image, alpha), inputs in ((got, inputs32), (want, inputs64)))
    assert_close(v32, v64, 2 * error)


def peaks(n: int, side: int) -> tuple[int, int]:
    """Peaks of forward and backward in numbers of 8 bytes, without the inputs, which are made before; on one thread."""
    s = scenes.splats2d(1, n, side, side, size=(20.0, 200.0), opacity=(0.01, 0.05))
    bins = lists(s, side, side, 8)
    assert len(bins.ids) > 0.9 * n * (side // 8) ** 2                              # every splat on every tile
    v_image, v_alpha = torch.ones(1, side, side, 3, dtype=torch.float64), torch.ones(1, side, side, dtype=torch.float64)
    with torch.no_grad():
        with Peak() as forward:
            outputs = reference.blend_blocks(*s[:5], *bins, side, side, 8, ALPHA_MAX, False)
        with Peak() as backward:
            reference.blend_blocks_backward(*s[:5], *bins, *outputs, v_image, v_alpha, side, side, 8, ALPHA_MAX, False, True)
    return forward.peak // 8, backward.peak // 8


def test_working_memory_does_not_grow_with_the_pairs_of_pixels_and_splats(monkeypatch: pytest.MonkeyPatch) -> None:
    """Some numbers for each splat, for each pixel and channel, and constants; here with small constants, and every splat on
    every pixel.

    Measured 24 numbers for each splat and 9 for each pixel in the forward, 33 and 12 in the backward.
    """
    by_default = peaks(100, 24)
    for name, value in SMALL_BLOCKS.items():
        monkeypatch.setattr(walk, name, value)
    for n, side in ((100, 24), (400, 24), (100, 48)):  # of which each but the first has four times the pairs
        allowed = 30 * n + 16 * side * side + 5 * SMALL_BLOCKS["BLOCK"] + 100 * SMALL_BLOCKS["GROUP"]
        assert max(peaks(n, side)) < allowed
        assert min(by_default) > 4 * allowed                                      # the measure does see the working memory
