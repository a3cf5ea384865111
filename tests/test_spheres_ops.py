"""The op that blends spheres, as an operator: derivatives, layout, memory, threads and compilers."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import scenes
import torch
import tsplat_reference as reference
from backends import Backend
from compare import SMALL_BLOCKS, Peak, assert_close, assert_same_bits, gradients, leaves, strided, threads
from sphere_cases import FAR, NEAR, early_end, options
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck
from tsplat_reference import walk

import tsplat
from tsplat import ops


def tiny_arguments(chord: bool, cut: bool) -> tuple[list[Tensor], tuple[Any, ...]]:
    """Leaves and the other arguments of `ops.blend_spheres`."""
    images, (mine, rest) = early_end(scenes.spheres(5, spread=0.4), scenes.camera(2, 5, 4), 0.0)
    cutoff = torch.full_like(images.logsumexp, 3.5) if cut else None
    return mine, (*rest[7:9], cutoff, *rest[10:16], 0.1, chord, True, 0.0)


@pytest.mark.parametrize(("chord", "cut"), [(False, False), (True, False), (False, True)])
def test_gradcheck_and_gradgradcheck(chord: bool, cut: bool) -> None:
    """(With a cutoff, the gradient is by intention not that of the function: only the second derivative is checked, of the first.)"""
    mine, rest = tiny_arguments(chord, cut)
    if not cut:
        assert gradcheck(lambda *a: ops.blend_spheres(*a, *rest)[:3], mine)
        assert gradgradcheck(lambda *a: ops.blend_spheres(*a, *rest)[:3], mine)
        return
    (first, second), (want, second_want) = (
        (g, gradients(g, mine)) for g in (gradients(function(*mine, *args)[:3], mine, create_graph=True)
                                          for function, args in ((ops.blend_spheres, rest), (reference.blend_spheres, rest[:-1]))))
    assert_close(first, want, 1e-11)
    assert_close(second, second_want, 1e-11)


def test_strided_inputs_and_gradients(backend: Backend) -> None:
    mine, rest = tiny_arguments(False, False)
    mine, rest = [backend.put(x.detach()) for x in mine], tuple(backend.put(x) if isinstance(x, Tensor) else x for x in rest)
    rest = (*rest[:5], 8, *rest[6:])
    plain, spaced = ([f(x).requires_grad_() for x in mine] for f in (torch.clone, strided))
    outputs = [ops.blend_spheres(*some, *rest)[:3] for some in (plain, spaced)]
    assert_same_bits(outputs[1], outputs[0])
    weights = [torch.randn_like(o) for o in outputs[0]]
    want = torch.autograd.grad(outputs[0], plain, weights)
    assert_close(torch.autograd.grad(outputs[1], spaced, [strided(w) for w in weights]), want, 1e-14)


def peaks(n: int, side: int) -> int:
    """The peak of forward and backward in numbers of 8 bytes, with every sphere on every tile; on one thread."""
    s = scenes.spheres(n, size=(4.0, 5.0), depth=(7.0, 8.0), spread=0.0)
    K = torch.tensor([[side, 0, side / 2], [0, side, side / 2], [0, 0, 1]], dtype=torch.float64)
    rest = (s.positions[None], s.radii[None], s.opacities[None], s.features[None], torch.ones(1, 3, dtype=torch.float64),
            torch.tensor(0.1, dtype=torch.float64), K[None])
    outline = reference.outlines(rest[0], rest[1], K[None], side, side, "pinhole", NEAR, FAR)
    bins = reference.bin_splats(outline.means2d, outline.radii, outline.conics, outline.opacities, outline.depths, side, side, 8)
    assert len(bins.ids) == n * (side // 8) ** 2
    with torch.no_grad(), Peak() as peak:
        images = reference.blend_sphere_blocks(*rest, *bins, side, side, 8, "pinhole", NEAR, FAR, 1e-6, False, False, 0.0)
        reference.blend_sphere_blocks_backward(*rest, *bins, None, images, images.image, None, None, side, side, 8, "pinhole", NEAR, FAR, 1e-6,
                                               False, True)
    return peak.peak // 8


def test_working_memory_does_not_grow_with_the_pairs_of_pixels_and_spheres(monkeypatch: pytest.MonkeyPatch) -> None:
    """Some numbers for each sphere, for each pixel and channel, and constants; here with small constants, and every sphere on every pixel."""
    by_default = peaks(100, 24)
    for name, value in SMALL_BLOCKS.items():
        monkeypatch.setattr(walk, name, value)
    for n, side in ((100, 24), (400, 24), (100, 48)):  # of which each but the first has four times the pairs
        allowed = 30 * n + 32 * side * side + 10 * SMALL_BLOCKS["BLOCK"] + 150 * SMALL_BLOCKS["GROUP"]
        assert peaks(n, side) < allowed
        assert by_default > 4 * allowed                                               # the measure does see the working memory


def test_threads_change_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    """With workers."""
    for name, value in (("GROUP", 512), ("ALONE", 512), ("PLANES", 0), ("WORTH_WORKERS", 0)):
        monkeypatch.setattr(walk, name, value)
    s, camera = scenes.spheres(3000, size=(0.05, 0.3)), scenes.camera(2, 130, 90)
    results = []
    for count in (1, 3):
        with threads(count):
            mine = leaves(*s)
            p, f, R, o = mine
            r = tsplat.render_spheres(p, f, R, camera, opacities=o, gamma=0.05, near=NEAR, far=FAR)
            results.append([r.image, r.alpha, *gradients([r.image, r.alpha], mine)])
    assert_same_bits(*results)


@pytest.mark.parametrize("dynamic", [False, True])
def test_compiles_without_graph_breaks(backend: Backend, dynamic: bool) -> None:
    s, camera = backend.put(scenes.spheres(12)), backend.put(scenes.camera(2, 9, 7))

    def step(p: Tensor, f: Tensor, R: Tensor, o: Tensor, g: Tensor, viewmats: Tensor, Ks: Tensor) -> tuple[Tensor, ...]:
        r = tsplat.render_spheres(p, f, R, dataclasses.replace(camera, viewmats=viewmats, Ks=Ks), opacities=o, gamma=g, depth="expected",
                                  n_track=2, fade_below=2.0, **options())
        assert r.depth is not None
        assert r.hits is not None
        return r.image, r.alpha, r.depth, r.hits.weights

    compiled = torch.compile(step, fullgraph=True, dynamic=dynamic, backend="aot_eager")
    for n in (12, 7):
        inputs = (*(x[:n] for x in s), backend.put(torch.tensor(0.1)), camera.viewmats, camera.Ks)
        mine, others = leaves(*inputs), leaves(*inputs)
        want, got = step(*mine), compiled(*others)
        assert_close(got, want, 1e-14)
        assert_close(gradients(got, others), gradients(want, mine), 1e-12)
