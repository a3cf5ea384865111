"""Pulsar's spheres by their formula (Pulsar, section 3.2, equation 1): what the op means, differentiable by autograd, twice if need be.

Along the ray of a pixel, from the camera's centre (orthographic: from the camera's plane), sphere i with opacity o_i has weight

    w_i = o_i d_i exp(o_i z_i / gamma) / (exp(eps / gamma) + sum_k o_k d_k exp(o_k z_k / gamma)),

where D_i is the distance at which the ray enters the sphere, z_i = 1 - (D_i - near)/(far - near), and d_i = max(0, 1 - delta_i/R_i), which
falls from 1 for a ray through the centre to 0 at the outline. (The paper prints min(1, delta/R), the complement.) delta is the distance of
the ray from the centre, or with `chord` that of the centre from the ray's point at the centre's own distance, as the authors' program has it.

`sphere_blocks.py` computes the same, and the gradient in closed form, fast and in little memory.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from tsplat_reference.binning import tile_counts
from tsplat_reference.blending import pixel_centers, to_image, to_tiles
from tsplat_reference.camera import split_intrinsics
from tsplat_reference.constants import EVERYWHERE, ON_OUTLINE

PAIRS = 1 << 20
"""Pixel-sphere pairs of a group of tiles evaluated at a time."""


class Outlines(NamedTuple):
    """What binning takes. radii: int32 `[C, N, 2]`, 1, or 0 if culled. means2d, conics: `[C, N, 2]`, `[C, N, 3]` of the ellipse
    (dx, dy) conic (dx, dy) <= 1 in pixels. opacities: `[C, N]`, all `ON_OUTLINE`. depths: `[C, N]`, the distance of the nearest point.
    """

    radii: Tensor
    means2d: Tensor
    conics: Tensor
    opacities: Tensor
    depths: Tensor


class SphereImages(NamedTuple):
    """image: `[C, H, W, D]`. depth: `[C, H, W]`, sum of w_i D_i (`[C, 0, 0]` unless asked for). logsumexp: `[C, H, W]`, log of the
    denominator of w over the background's term: 0 where nothing is hit, exactly, whatever gamma. used: int32 `[tiles]`, so many hits of each
    tile's list count.
    """

    image: Tensor
    depth: Tensor
    logsumexp: Tensor
    used: Tensor


def outlines(centers: Tensor, radii: Tensor, Ks: Tensor, width: int, height: int, model: str, near: float, far: float) -> Outlines:
    """The outline of each sphere in the image, and its distance; no gradients.

    A ray m = (x, y, 1) touches the sphere where |c x m|^2 = R^2 |m|^2, an ellipse if the sphere is in front of the camera's plane. One that
    reaches through that plane may be seen anywhere. Culled: what is not finite, R <= 0, behind the camera, beyond `far`, before `near`, and
    the sphere that the camera is in, which no ray enters.

    Args:
        centers: `[C, N, 3]` in camera space. radii: `[C, N]` or `[1, N]`.
        Ks: `[C, 3, 3]`. width, height: in pixels.
        model: "pinhole" or "orthographic".
        near, far: range of the distances D that count.
    """
    x, y, z = centers.detach().unbind(-1)
    R = radii.detach().expand_as(x)
    fx, fy, cx, cy = split_intrinsics(Ks.detach())
    finite = torch.isfinite(x + y + z + R) & (R > 0)
    x, y, z, R = (torch.where(finite, v, 1.0) for v in (x, y, z, R))
    if model == "orthographic":
        visible = finite & (z > near) & (z - R < far)
        means2d = torch.stack([fx * x + cx, fy * y + cy], -1)
        conics = torch.stack([(fx * R) ** -2, torch.zeros_like(R), (fy * R) ** -2], -1)
        nearest = z - R
    else:
        distance = (x * x + y * y + z * z).sqrt()
        nearest = distance - R
        tangent2 = nearest * (distance + R)                                                 # squared length of a tangent
        visible = finite & (nearest > 0) & (tangent2.clamp_min(0.0).sqrt() > near) & (nearest < far) & (z > -R)
        ellipse = visible & (z > R)
        before = torch.where(ellipse, (z - R) * (z + R), 1.0)
        scale = before / (R * R * torch.where(ellipse, tangent2, 1.0))
        mean = [fx * (x * z / before) + cx, fy * (y * z / before) + cy]
        conic = [scale * (y * y + before) / (fx * fx), -scale * x * y / (fx * fy), scale * (x * x + before) / (fy * fy)]
        means2d = torch.where(ellipse[..., None], torch.stack(mean, -1), torch.tensor([width / 2, height / 2]).to(x))
        conics = torch.where(ellipse[..., None], torch.stack(conic, -1), torch.tensor([EVERYWHERE, 0.0, EVERYWHERE]).to(x))
    return Outlines(visible[..., None].expand(-1, -1, 2).to(torch.int32, memory_format=torch.contiguous_format), means2d, conics,
                    torch.full_like(x, ON_OUTLINE), nearest)


def blend_spheres(centers: Tensor, radii: Tensor, opacities: Tensor, features: Tensor, backgrounds: Tensor, gamma: Tensor, Ks: Tensor, ids: Tensor,
            offsets: Tensor, cutoff: Tensor | None, width: int, height: int, tile: int, model: str, near: float, far: float,
            background_depth: float, chord: bool, depth: bool, used: Tensor | None = None) -> SphereImages:
    """Blend spheres over each pixel.

    Args:
        centers: `[C, N, 3]` in camera space.
        radii, opacities: `[C, N]`, or `[1, N]` for all cameras alike.
        features: `[C, N, D]` or `[1, N, D]`.
        backgrounds: `[C, D]`.
        gamma: `[]`, in [1e-5, 1]: how soft the spheres are along the ray.
        Ks: `[C, 3, 3]`.
        ids, offsets: of `bin_splats` of the `outlines`, with the same width, height and tile.
        cutoff: `[C, H, W]` or None: hits at larger D have no gradient.
        model: "pinhole" or "orthographic".
        near, far: hits with D outside [near, far] do not count.
        background_depth: eps.
        chord: which delta.
        depth: whether to render depth.
        used: so many of the hits of each tile count; default all.
    """
    C, N, D = *centers.shape[:2], features.shape[-1]
    tiles_x, tiles_y = tile_counts(width, height, tile)
    shape = C, tiles_y, tiles_x
    counts = offsets.diff() if used is None else used.long()
    rows = torch.arange(N, device=centers.device).expand(C, N)
    # one row of (x, y, z, R, o, features) per camera and sphere
    table = torch.cat([centers, *(v.expand(C, -1)[..., None] for v in (radii, opacities)), features.expand(C, -1, -1)], -1).flatten(0, 1)
    fx, fy, cx, cy = (v.squeeze(1) for v in split_intrinsics(Ks))
    cut = None if cutoff is None else to_tiles(cutoff[..., None], tile)[:, 0, :, None]
    parts = []
    longest = int(counts.max()) if len(ids) and rows.numel() else 0
    for tiles in torch.split(torch.arange(len(counts), device=ids.device), max(1, PAIRS // (tile * tile * max(longest, 1)))):
        k = torch.arange(int(counts[tiles].max()) if longest else 0, device=ids.device)
        valid = k < counts[tiles, None]                                                     # [T, K]
        row = table[ids[torch.where(valid, offsets[tiles, None] + k, 0)].long()] if longest else table.new_zeros(len(tiles), 0, 5 + D)
        view = tiles // (tiles_y * tiles_x)
        u, v = pixel_centers(tiles, shape, tile, centers.dtype)                             # [T, P, 1]
        mx, my = (u - cx[view, None, None]) / fx[view, None, None], (v - cy[view, None, None]) / fy[view, None, None]
        x, y, z, R, o = row[..., :5].unsqueeze(1).unbind(-1)                                # [T, 1, K]
        hit, d, D_hit = ray_hits(mx, my, x, y, z, torch.where(valid[:, None], R, 0.0), model, near, far, chord)         # [T, P, K]
        logit = o * (1 - (D_hit - near) / (far - near)) / gamma
        background = background_depth / gamma
        keep = None if cut is None else D_hit <= cut[tiles]
        logit, d, o, D_hit = (_only(keep, t) for t in (logit, d, o.expand_as(logit), D_hit))
        peak = torch.where(hit, logit, -torch.inf).detach()
        peak = torch.cat([peak, background.detach().expand_as(mx)], -1).amax(-1, keepdim=True)
        e = o * d * torch.where(hit, logit - peak, 0.0).exp()
        rest = (background - peak).exp()
        total = e.sum(-1, keepdim=True) + rest
        w = e / total
        F = row[..., 5:]
        image = w @ F if keep is None else (w * keep) @ F + (w * ~keep) @ F.detach()
        image = image + rest / total * backgrounds[view, None]
        parts.append(torch.cat([image, (w * D_hit).sum(-1, keepdim=True), total.log() + (peak - background)], -1))
    full = to_image(torch.cat(parts).mT, shape, width, height)
    return SphereImages(full[..., :D], full[..., D] if depth else full.new_zeros(C, 0, 0), full[..., D + 1], counts.to(torch.int32))


def ray_hits(mx: Tensor, my: Tensor, x: Tensor, y: Tensor, z: Tensor, R: Tensor, model: str, near: float, far: float, chord: bool
             ) -> tuple[Tensor, Tensor, Tensor]:
    """Which rays (mx, my, 1) hit which spheres, d, and the distance D; d = 0 and D = far where missed. The arguments broadcast."""
    if model == "orthographic":                         # a: along the ray to the point closest to the centre, q: from there to the centre
        q2, a = (mx - x) ** 2 + (my - y) ** 2, z + 0 * mx
        delta2, ahead = q2, R > 0
    else:
        norm2 = mx * mx + my * my + 1
        px, py, pz = z * mx - x, z * my - y, x * my - y * mx                                # the vector product of centre and ray
        q2, a = (px * px + py * py + pz * pz) / norm2, (x * mx + y * my + z) / norm2.sqrt()
        distance = (x * x + y * y + z * z).sqrt()
        delta2, ahead = q2 * 2 * distance / (distance + a) if chord else q2, (R > 0) & (a > 0)
    inside = ahead & (delta2 < R * R)
    D = torch.where(inside, a - torch.where(inside, R * R - q2, 1.0).sqrt(), far)
    hit = inside & (D >= near) & (D <= far)
    tiny = torch.finfo(q2.dtype).tiny                                                       # a ray through a centre: derivative 0
    delta = torch.where(hit & (delta2 > tiny), delta2, tiny).sqrt()
    return hit, torch.where(hit, 1 - delta / torch.where(hit, R, 1.0), 0.0), D


def _only(keep: Tensor | None, value: Tensor) -> Tensor:
    """The value, with a gradient only where `keep`."""
    return value if keep is None else torch.where(keep, value, value.detach())
