"""What is minimised and what is measured: L1, SSIM and PSNR of a render against a photo, depth, and regularisers.

SSIM (Wang et al. 2004) has an 11x11 Gaussian window of sigma 1.5, per channel, as `kornia.metrics.ssim`, by kornia's filters. Images are padded
with zeros, as the 3DGS code does, so that figures compare with its and images of any size have one.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from tsplat.fit.ranks import ALONE, Ranks

WINDOW = 11
SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2       # of SSIM, for images in 0..1
SSIM_NAME = "11x11 Gaussian window, sigma 1.5, zero padding, mean over channels and pixels"


class Target(NamedTuple):
    """What a render is compared with.

    Args:
        image: `[H, W, 3]` in 0..1, the photo over the background.
        mask: `[H, W, 1]` in 0..1, 0 where a pixel does not count, or None if all do.
    """

    image: Tensor
    mask: Tensor | None = None

    def average(self, values: Tensor) -> Tensor:
        """Mean of `[H, W, C]` over channels and the pixels that count; 0 where none does."""
        if self.mask is None:
            return values.mean()
        return (values * self.mask).sum() / (self.mask.sum() * values.shape[-1]).clamp(min=1)

    def resized(self, width: int, height: int) -> Target:
        """Reduced by averaging areas, of what counts in them."""
        if self.mask is None:
            return Target(_reduced(self.image, width, height))
        mask = _reduced(self.mask, width, height)
        return Target(_reduced(self.image * self.mask, width, height) / mask.clamp(min=1e-6), mask)


def target_of(photo: Tensor, background: Tensor, *, masked: bool) -> Target:
    """The target that a photo `[H, W, 3 or 4]` gives; its fourth channel is a mask if `masked`, else its alpha."""
    if photo.shape[-1] == 3:
        return Target(photo)
    image, fourth = photo[..., :3], photo[..., 3:]
    return Target(image, fourth) if masked else Target(image * fourth + (1 - fourth) * background)


def photo_loss(image: Tensor, target: Target, ssim_weight: float) -> Tensor:
    """(1 - w) L1 + w (1 - SSIM) (3DGS, equation 7) of `[H, W, 3]`: a scalar. Pixels that do not count get no gradient."""
    loss = (1 - ssim_weight) * target.average((image - target.image).abs())
    return loss + ssim_weight * (1 - ssim(image, target)) if ssim_weight else loss


def depth_loss(depth: Tensor, alpha: Tensor, truth: Tensor) -> Tensor:
    """Mean over pixels of known depth of |sum of w_i (z_i / z - 1)|, a relative error to which only what is opaque counts.

    Args:
        depth: `[H, W]`, accumulated: the sum of the splats' weights times camera z.
        alpha: `[H, W]`, the sum of the weights.
        truth: `[H, W]` camera z; unknown where not finite or not above 0.
    """
    known = truth.isfinite() & (truth > 0)
    error = depth / truth.where(known, 1.0) - alpha
    return (error.abs() * known).sum() / known.sum().clamp(min=1)


class Seen(Protocol):
    """What is known of a rendering: which splats were visible, bool `[C, N]`, and their camera z, `[C, N]`; or where there are `pairs`, int64
    `[V, 2]` of a camera and a splat that it saw, `[V]`, and (C, N).
    """

    @property
    def visible(self) -> Tensor: ...

    @property
    def depths(self) -> Tensor: ...

    @property
    def pairs(self) -> Tensor | None: ...

    @property
    def shape(self) -> tuple[int, int]: ...


def scene_regulariser(opacities: Tensor, scales: Tensor, meta: Seen, extent: float, *, opacity: float, scale: float,
                      opacity_depth: float, ranks: Ranks = ALONE) -> Tensor | None:
    """The weighted sum of what the loss has besides the photo, or None without any weight. Of several ranks, this one's part of the sum over all.

    Args:
        opacities, scales: `[N]` and `[N, 3]`.
        meta: of the rendering: depths, and what is visible.
        extent: unit of depth.
        opacity, scale: weights of the means of both, as in 3DGS-MCMC (Kheradmand et al. 2024, equation 10).
        opacity_depth: weight of minus the mean of o z over what is visible (Pulsar, Lassner and Zollhoefer 2021): what is near
            and opaque has to be worth it, which keeps floaters from the cameras. The mean over cameras, of which each has such a mean.
        ranks: of which each has some of the splats.
    """
    terms = []
    if opacity or scale:
        n = max(1, ranks.total(len(opacities)))
        terms = [weight * values.sum() / (n * values.shape[1:].numel()) for weight, values in ((opacity, opacities), (scale, scales)) if weight]
    if opacity_depth:
        if meta.pairs is None:
            total, count = (opacities * meta.depths).where(meta.visible, 0.0).sum(1), meta.visible.sum(1)                      # [C]
        else:
            camera, splat = meta.pairs.unbind(1)
            total = opacities.new_zeros(meta.shape[0]).index_add(0, camera, opacities.index_select(0, splat) * meta.depths)
            count = torch.bincount(camera, minlength=meta.shape[0])
        terms.append(-opacity_depth * (total / ranks.add(count).clamp(min=1)).mean() / extent)
    return sum(terms[1:], terms[0]) if terms else None


def psnr(image: Tensor, target: Target) -> Tensor:
    """Peak signal-to-noise ratio in dB, for a peak of 1, over the pixels that count; at most 100."""
    return -10 * target.average((image - target.image).square()).clamp(min=1e-10).log10()


def ssim(image: Tensor, target: Target) -> Tensor:
    """Mean structural similarity over the pixels that count, at most 1. The others are black in both images."""
    if target.mask is None:
        return ssim_map(image, target.image).mean()
    return target.average(ssim_map(image * target.mask, target.image * target.mask))


def ssim_map(a: Tensor, b: Tensor) -> Tensor:
    """Structural similarity `[H, W, 3]` of two images `[H, W, 3]`, of any size, with zeros around them.

    All means at once, in a third to half of the time of `kornia.metrics.ssim`, which takes one after the other.
    """
    from kornia.filters import filter2d_separable, get_gaussian_kernel1d

    window = get_gaussian_kernel1d(WINDOW, SIGMA, device=a.device, dtype=a.dtype)
    a, b = (image.permute(2, 0, 1)[None] for image in (a, b))                                   # [1, 3, H, W]
    mean_a, mean_b, squares, product = filter2d_separable(torch.cat([a, b, a * a + b * b, a * b], 1), window, window, "constant").chunk(4, 1)
    mean_product, mean_squares = mean_a * mean_b, mean_a * mean_a + mean_b * mean_b
    covariance, variances = product - mean_product, squares - mean_squares
    similarity = (2 * mean_product + C1) * (2 * covariance + C2) / ((mean_squares + C1) * (variances + C2))
    return similarity[0].permute(1, 2, 0)


def _reduced(image: Tensor, width: int, height: int) -> Tensor:
    """`[H, W, C]` to `[height, width, C]`, by averaging areas."""
    small: Tensor = interpolate(image.permute(2, 0, 1)[None], size=(height, width), mode="area")[0]
    return small.permute(1, 2, 0)
