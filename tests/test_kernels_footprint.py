"""Another footprint in the kernels of blending, by the seam that is there for it: no kernel knows that splats are Gaussians."""

from __future__ import annotations

import math

import pytest
import scenes
import torch
import tsplat_reference as reference
from compare import assert_close, leaves
from torch import Tensor

pytest.importorskip("triton", reason="Triton is not installed here")

import triton
import triton.language as tl

from tsplat.kernels import blending, footprint

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


@triton.jit
def flat_form(mx, my, l00, l10, l11, x, y):
    """dx, dy, u and v of the Gaussian's -log2, u^2 + v^2."""
    dx = x - mx
    dy = y - my
    return dx, dy, l00 * dx + l10 * dy, l11 * dy


@triton.jit
def flat_log2_alpha(mx, my, l00, l10, l11, log2_opacity, x, y):
    """Flat about the mean, and steep at the border: o 2^-q^2, where the Gaussian is o 2^-q."""
    _, _, u, v = flat_form(mx, my, l00, l10, l11, x, y)
    q = u * u + v * v
    return log2_opacity - q * q


@triton.jit
def flat_moments(v, mx, my, l00, l10, l11, x, y, AXIS: tl.constexpr):
    """The opacity's sum, and the Gaussian's five, of v times dq^2/dq."""
    dx, dy, u, w = flat_form(mx, my, l00, l10, l11, x, y)
    f = 2 * v * (u * u + w * w)
    dy = dx * 0.0 + dy
    return (tl.sum(v, AXIS, keep_dims=True), tl.sum(f * dx, AXIS, keep_dims=True), tl.sum(f * dy, AXIS, keep_dims=True),
            tl.sum(f * dx * dx, AXIS, keep_dims=True), tl.sum(f * dx * dy, AXIS, keep_dims=True), tl.sum(f * dy * dy, AXIS, keep_dims=True))


@triton.jit
def flat_lane_moments(v, mx, my, l00, l10, l11, x, y):
    """Over a lane's pixels."""
    return flat_moments(v, mx, my, l00, l10, l11, x, y, 1)


@triton.jit
def flat_block_moments(v, mx, my, l00, l10, l11, x, y):
    """Over the pixels of a block."""
    return flat_moments(v, mx, my, l00, l10, l11, x, y, 0)


@triton.jit
def flat_mean_slopes(mx, my, l00, l10, l11, x, y):
    """The Gaussian's, times dq^2/dq."""
    _, _, u, v = flat_form(mx, my, l00, l10, l11, x, y)
    f = 2 * (u * u + v * v)
    return f * (l00 * u), f * (l10 * u + l11 * v)


def flat_log_alpha(dx: Tensor, dy: Tensor, conics: Tensor, opacities: Tensor) -> Tensor:
    """The same, by its definition."""
    a, b, c = conics.unbind(-1)
    q = (0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy) / math.log(2)
    return torch.log(opacities) - math.log(2) * q * q


@pytest.mark.parametrize("channels", [3, 6])
def test_another_footprint_needs_no_other_kernel(channels: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Images and gradients are those of the definition, by autograd."""
    s = scenes.splats2d(1, 14, 21, 17, channels=channels)
    bins = reference.bin_splats(s.means2d, s.radii, s.conics, s.opacities, s.depths, 21, 17, 8)     # reaches farther than is needed
    options = 21, 17, 8, 0.99, False
    gaussian = reference.blend(*s[:5], *bins, *options)
    monkeypatch.setattr(reference.footprint, "log_alpha", flat_log_alpha)
    inputs = leaves(*s[:4])
    want = reference.blend(*inputs, s.backgrounds, *bins, *options)
    assert float((want[0].detach() - gaussian[0]).abs().max()) > 0.05
    v = [torch.randn_like(w) for w in want]
    v_want = torch.autograd.grad(want, inputs, v)

    for name, function in (("log2_alpha", flat_log2_alpha), ("lane_moments", flat_lane_moments), ("block_moments", flat_block_moments),
                           ("mean_slopes", flat_mean_slopes)):
        monkeypatch.setattr(footprint, name, function)
    splats, lists, upstream = ([None if x is None else x.to(DEVICE) for x in some] for some in (s[:5], bins, v))
    got = blending.blend(*splats, *lists, *options)
    assert_close([g.cpu() for g in got], [w.detach() for w in want], 1e-12)
    *v_got, v_abs = blending.blend_backward(*splats, *lists, *got, *upstream, *options, True)
    assert_close([g.cpu() for g in v_got], v_want, 1e-11)
    assert bool((v_abs.cpu() >= v_got[0].cpu().abs() * (1 - 1e-12)).all())
