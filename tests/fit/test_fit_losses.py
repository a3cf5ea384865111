"""Losses and metrics against their formulas; masks, alpha, and images smaller than the window."""

import math

import pytest
import torch
from torch import Tensor
from torch.nn.functional import conv2d

from tsplat.fit.losses import Target, depth_loss, photo_loss, psnr, scene_regulariser, ssim, ssim_map, target_of
from tsplat.rasterize import Meta


def images(height: int, width: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    a = torch.rand(height, width, 3, generator=generator)
    return a, (a + 0.2 * torch.randn(height, width, 3, generator=generator)).clamp(0, 1)


def plain_ssim(a: Tensor, b: Tensor) -> Tensor:
    """By the formula of Wang et al., zero padding, in float64."""
    g = torch.exp(-torch.arange(-5, 6, dtype=torch.float64).square() / (2 * 1.5**2))
    window = torch.outer(g, g)[None, None] / g.sum() ** 2

    def blur(x: Tensor) -> Tensor:
        return conv2d(x.double().permute(2, 0, 1)[:, None], window, padding=5)[:, 0].permute(1, 2, 0)

    mean_a, mean_b = blur(a), blur(b)
    var_a, var_b, cov = blur(a * a) - mean_a**2, blur(b * b) - mean_b**2, blur(a * b) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    return (2 * mean_a * mean_b + c1) * (2 * cov + c2) / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))


@pytest.mark.parametrize("size", [(20, 30), (1, 1), (3, 40), (11, 11)])
def test_ssim_is_the_formula(size: tuple[int, int]) -> None:
    a, b = images(*size)
    # a variance is a difference of means of squares, off by an eps (6e-8) or two, over c2 = 9e-4 where it is small: 1e-4
    torch.testing.assert_close(ssim_map(a, b).double(), plain_ssim(a, b), atol=1e-4, rtol=0)
    torch.testing.assert_close(ssim_map(a, a), torch.ones(*size, 3), atol=1e-4, rtol=0)


def test_ssim_is_kornias() -> None:
    """Away from the border, where we take zeros to be and kornia mirrors the image. Variances are differences of means of squares, off by some eps,
    over C2 = 9e-4: some 1e-13 at the most."""
    from kornia.metrics import ssim

    a, b = torch.rand(2, 32, 27, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    b = 0.5 * (a + b)
    inside = slice(5, -5)
    theirs = ssim(a.permute(2, 0, 1)[None], b.permute(2, 0, 1)[None], 11, eps=0.0)[0].permute(1, 2, 0)
    torch.testing.assert_close(ssim_map(a, b)[inside, inside], theirs[inside, inside], rtol=0, atol=1e-13)


def test_loss_is_the_weighted_sum() -> None:
    a, b = images(16, 20)
    l1, dissimilarity = float((a - b).abs().mean()), float(1 - plain_ssim(a, b).mean())
    for weight in (0.0, 0.2, 1.0):
        expected = (1 - weight) * l1 + weight * dissimilarity
        assert float(photo_loss(a, Target(b), weight)) == pytest.approx(expected, abs=1e-5)


def test_psnr() -> None:
    a = torch.full((4, 5, 3), 0.5)
    assert float(psnr(a + 0.1, Target(a))) == pytest.approx(20, abs=1e-4)
    assert float(psnr(a, Target(a))) == pytest.approx(100)


def test_masked_pixels_do_not_count() -> None:
    a, b = images(24, 24)
    mask = torch.ones(24, 24, 1)
    mask[:, :12] = 0
    photo = torch.cat([b, mask], dim=2)
    target = target_of(photo, torch.zeros(3), masked=True)
    spoilt = torch.where(mask.bool(), a, 1 - a)
    a.requires_grad_()
    loss = photo_loss(a, target, 0.2)
    loss.backward()
    assert a.grad is not None
    assert (a.grad[:, :12] == 0).all()
    assert (a.grad[:, 12:] != 0).any()
    a = a.detach()
    for measure in (psnr, ssim):
        assert float(measure(a, target)) == pytest.approx(float(measure(spoilt, target)), abs=1e-5)
    assert float(psnr(a, target)) == pytest.approx(float(psnr(a[:, 12:], Target(b[:, 12:]))), abs=1e-4)
    assert float(ssim(a, target)) < float(ssim(b, target)) == pytest.approx(1, abs=1e-4)


def test_photo_that_is_masked_altogether() -> None:
    a, b = images(12, 12)
    target = Target(b, torch.zeros(12, 12, 1))
    a.requires_grad_()
    loss = photo_loss(a, target, 0.2)
    loss.backward()
    assert math.isfinite(float(loss.detach()))
    assert a.grad is not None
    assert (a.grad == 0).all()


def test_alpha_shows_the_background() -> None:
    _, b = images(8, 8)
    alpha = torch.rand(8, 8, 1)
    photo, background = torch.cat([b, alpha], dim=2), torch.tensor([1.0, 0.5, 0.0])
    target = target_of(photo, background, masked=False)
    assert target.mask is None
    torch.testing.assert_close(target.image, b * alpha + background * (1 - alpha))
    assert torch.equal(target_of(b, background, masked=True).image, b)


def test_reduced_target_is_the_mean_of_areas() -> None:
    a, _ = images(8, 12)
    blocks = a.view(4, 2, 6, 2, 3)
    torch.testing.assert_close(Target(a).resized(6, 4).image, blocks.mean((1, 3)))
    mask = (a[..., :1] > 0.5).float()
    small = Target(a, mask).resized(6, 4)
    assert small.mask is not None
    weights = mask.view(4, 2, 6, 2, 1)
    torch.testing.assert_close(small.mask, weights.mean((1, 3)))
    counted = weights.sum((1, 3)).expand(-1, -1, 3) > 0
    expected = (blocks * weights).sum((1, 3)) / weights.sum((1, 3))
    torch.testing.assert_close(small.image[counted], expected[counted])


def test_depth_loss_is_relative_and_skips_the_unknown() -> None:
    truth = torch.tensor([[2.0, 4.0, 0.0], [float("nan"), float("inf"), 8.0]])
    alpha = torch.tensor([[1.0, 0.5, 1.0], [1.0, 1.0, 0.0]])
    depth = torch.tensor([[2.5, 1.0, 7.0], [7.0, 7.0, 0.0]], requires_grad=True)      # z = 2.5, 2, ...: off by 25 % and, half opaque, 50 %
    loss = depth_loss(depth, alpha, truth)
    assert float(loss.detach()) == pytest.approx((0.25 + 0.25 + 0) / 3)
    loss.backward()
    assert depth.grad is not None
    torch.testing.assert_close(depth.grad, torch.tensor([[1 / 6, -1 / 12, 0], [0, 0, 0]]))
    assert float(depth_loss(depth, alpha, torch.zeros(2, 3)).detach()) == 0


def test_regularisers_are_their_formulas() -> None:
    opacities, scales = torch.tensor([0.2, 0.6, 0.9]), torch.tensor([[1.0, 2, 3], [0, 0, 0], [6, 6, 6]])
    radii, depths = torch.tensor([[[1, 1], [2, 2], [0, 0]]]), torch.tensor([[5.0, 10.0, -3.0]])
    meta = Meta(radii, torch.zeros(1, 3, 2), depths, torch.zeros(2, dtype=torch.int64), (1, 1))

    def value(**weights: float) -> Tensor | None:
        return scene_regulariser(opacities, scales, meta, 2.0, **{"opacity": 0.0, "scale": 0.0, "opacity_depth": 0.0, **weights})

    assert value() is None
    assert float(value(opacity=0.1) or 0) == pytest.approx(0.1 * 1.7 / 3)
    assert float(value(scale=0.1) or 0) == pytest.approx(0.1 * 24 / 9)
    assert float(value(opacity_depth=0.1) or 0) == pytest.approx(-0.1 * (1 + 6) / 2 / 2)      # over the visible
    assert float(value(opacity=1.0, scale=1.0) or 0) == pytest.approx(1.7 / 3 + 24 / 9)
    pairs = torch.tensor([[0, 0], [0, 1]])                                                     # as several ranks have them: the drawn alone
    meta = meta._replace(radii=radii[0, :2], depths=depths[0, :2], pairs=pairs, shape=(1, 3))
    assert float(value(opacity_depth=0.1) or 0) == pytest.approx(-0.1 * (1 + 6) / 2 / 2)
