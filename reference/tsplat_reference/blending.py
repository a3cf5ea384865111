"""Blending: C = sum_i c_i alpha_i T_i + T_final background, front to back (3DGS, equations 2 and 3), by its formula.

This is the definition, written to be read and to be differentiated by autograd, twice if need be. `blocks.py` computes the same, and
the gradient in closed form, fast and in little memory: it is what the op runs on a CPU.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tsplat_reference import footprint
from tsplat_reference.binning import tile_counts
from tsplat_reference.constants import ALPHA_MIN, TRANSMITTANCE_MIN

PAIRS = 1 << 22
"""Pixel-splat pairs of a group of tiles evaluated at a time."""


def blend(means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, backgrounds: Tensor | None, ids: Tensor, offsets: Tensor,
          width: int, height: int, tile: int, alpha_max: float, drop_last: bool = False) -> tuple[Tensor, Tensor]:
    """Composite splats over each pixel: alpha_i = min(alpha_max, o_i exp(-sigma_i)), 0 below 1/255.

    A splat contributes while the transmittance T_i in front of it is above 1e-4, so what is left out weighs at most 1e-4. Peers (3DGS, gsplat)
    also drop the splat that takes T to 1e-4 or below, which can weigh 1e-2: so do we with `drop_last`.

    Args:
        means2d, conics, opacities: `[C, N, 2]`, `[C, N, 3]`, `[C, N]`.
        colors: `[C, N, D]`, or `[1, N, D]` for all cameras alike.
        backgrounds: `[C, D]`, or None for zeros.
        ids, offsets: of `bin_splats`, with the same width, height and tile.
        alpha_max: in (0, 1); alpha has zero gradient where it is clamped.
        drop_last: the peers' rule for the end of a pixel.

    Returns:
        image `[C, H, W, D]` and alpha `[C, H, W]`, 1 - T_final.
    """
    C, N, D = *opacities.shape, colors.shape[-1]
    tiles_x, tiles_y = tile_counts(width, height, tile)
    shape = C, tiles_y, tiles_x
    counts = offsets.diff()
    parts = []
    longest = int(counts.max()) if len(ids) else 0
    for tiles in torch.split(torch.arange(len(counts), device=ids.device), max(1, PAIRS // (tile * tile * max(longest, 1)))):
        k = torch.arange(int(counts[tiles].max()), device=ids.device)
        valid = k < counts[tiles, None]                                                     # [T, K]
        splat = ids[torch.where(valid, offsets[tiles, None] + k, 0)].long() if len(ids) else valid.long()
        px, py = pixel_centers(tiles, shape, tile, means2d.dtype)                          # [T, P, 1]
        mx, my = means2d.reshape(-1, 2)[splat][:, None].unbind(-1)                          # [T, 1, K]
        alpha = footprint.log_alpha(px - mx, py - my, conics.reshape(-1, 3)[splat][:, None], opacities.reshape(-1)[splat][:, None])
        alpha = alpha.exp().clamp_max(alpha_max)
        alpha = torch.where((alpha >= ALPHA_MIN) & valid[:, None], alpha, 0.0)              # [T, P, K]
        T = torch.cumprod(torch.cat([torch.ones_like(px), 1 - alpha], -1), -1)
        front, behind = T[..., :-1], T[..., 1:]
        weights = alpha * torch.where((behind if drop_last else front) > TRANSMITTANCE_MIN, front, 0.0)
        rgb = weights @ colors.reshape(-1, D)[splat % N if len(colors) < C else splat]      # [T, P, D]
        parts.append(torch.cat([rgb, weights.sum(-1, keepdim=True)], -1))
    image = to_image(torch.cat(parts).mT, shape, width, height)
    image, alphas = image[..., :D], image[..., D]
    if backgrounds is not None:
        image = image + (1 - alphas)[..., None] * backgrounds[:, None, None]
    return image, alphas


def to_image(tiles: Tensor, shape: tuple[int, int, int], width: int, height: int) -> Tensor:
    """Tiles `[C tiles_y tiles_x, D, P]` to images `[C, H, W, D]`, contiguous and in memory of their own."""
    side = round(tiles.shape[-1] ** 0.5)
    tiles = tiles.view(*shape, -1, side, side).permute(0, 1, 4, 2, 5, 3)                    # C, ty, y, tx, x, D
    # a copy whose innermost loop has 3 numbers takes 2 to 3 times as long as one per channel
    image = torch.stack(tiles.unbind(-1), -1) if tiles.shape[-1] <= 8 else tiles.clone(memory_format=torch.contiguous_format)
    return image.view(shape[0], shape[1] * side, shape[2] * side, -1)[:, :height, :width].contiguous()


def to_tiles(image: Tensor, tile: int) -> Tensor:
    """Images `[C, H, W, D]` to tiles `[C tiles_y tiles_x, D, P]`, zero beyond the border."""
    C, H, W, D = image.shape
    tiles_x, tiles_y = tile_counts(W, H, tile)
    image = torch.nn.functional.pad(image, (0, 0, 0, tiles_x * tile - W, 0, tiles_y * tile - H))
    return image.view(C, tiles_y, tile, tiles_x, tile, D).permute(0, 1, 3, 5, 2, 4).reshape(-1, D, tile * tile)


def pixel_centers(tiles: Tensor, shape: tuple[int, int, int], tile: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """X and y `[T, P, 1]` of the pixel centres of tiles `[T]`."""
    p = torch.arange(tile * tile, device=tiles.device)
    x = (tiles % shape[2] * tile)[:, None] + p % tile
    y = (tiles // shape[2] % shape[1] * tile)[:, None] + p // tile
    return x[..., None].to(dtype) + 0.5, y[..., None].to(dtype) + 0.5
