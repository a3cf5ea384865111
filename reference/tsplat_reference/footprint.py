"""The footprint of a splat: how its alpha falls off over the image. Blending knows a footprint only through these functions.

The Gaussian: log alpha = log o - (a dx^2 + c dy^2)/2 - b dx dy. With s = b/a, u = dx + s dy and the second derivatives p = -a along u
and r = b^2/a - c along y it is log o + (p u^2 + r dy^2)/2, which keeps its precision when a long thin splat is centred far from the pixel.
Within a tile that is a polynomial in the pixel's position (x, y) about the tile's centre: six coefficients per tile and splat turn
the evaluation at all pixels into a matrix product, and so are the sums that the backward needs.
"""

from __future__ import annotations

import torch
from torch import Tensor

RECORD = 9
"""Numbers of a record."""

NOTHING = -1e4
"""The log opacity of padding: exp of it is 0 in every dtype."""


def log_alpha(dx: Tensor, dy: Tensor, conics: Tensor, opacities: Tensor) -> Tensor:
    """log(o exp(-sigma)) at offsets dx, dy from the mean, before the clamp: the definition."""
    a, b, c = conics.unbind(-1)
    return torch.log(opacities) - 0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy


def monomials(tile: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """`[6, P]`: 1, x, y, x^2, xy, y^2 at the pixels of a tile, row by row, about its centre."""
    p = torch.arange(tile, dtype=dtype, device=device) - (tile - 1) / 2
    y, x = (v.flatten() for v in torch.meshgrid(p, p, indexing="ij"))
    return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y])


def records(means2d: Tensor, conics: Tensor, opacities: Tensor) -> Tensor:
    """`[R, RECORD]`: mean x, mean y, s, p, r and log opacity of splats `[R, 2]`, `[R, 3]`, `[R]`, and their coefficients of x^2, xy and y^2, which
    are those of any tile; finite for culled ones (conic 0)."""
    a, b, c = conics.unbind(-1)
    s = torch.where(a > 0, b / a, 0.0)
    p, r = -a, (b * s - c).clamp_max(0.0)
    log_opacity = torch.log(opacities.clamp_min(torch.finfo(opacities.dtype).tiny))
    return torch.stack([*means2d.unbind(-1), s, p, r, log_opacity, 0.5 * p, p * s, 0.5 * torch.addcmul(r, p * s, s)], -1)


def records_backward(records: Tensor, opacities: Tensor, sums: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients with respect to means2d, conics and opacities, from the `sums` `[6, R]` of `moments_about_mean` over all tiles."""
    s, p, r = records[:, 2:5].unbind(-1)
    v, vu, vy, vuu, vuy, vyy = sums
    along_x = -p * vu                                                                       # du/dmx = -1, du/dmy = -s, ddy/dmy = -1
    half = -0.5 * vyy
    v_conics = torch.stack([torch.addcmul(-0.5 * vuu, s, torch.addcmul(vuy, s, half)), s * vyy - vuy, half], -1)    # dx = u - s dy
    v_opacities = torch.where(opacities > 0, v / opacities, 0.0)
    return torch.stack([along_x, s * along_x - r * vy], -1), v_conics, v_opacities


def coefficients(record: Tensor, qx: Tensor, qy: Tensor) -> Tensor:
    """Polynomial coefficients `[B, 6, K]` of log alpha, from records `[RECORD, B, K]` and tile centre minus mean, `[B, K]` each."""
    _, _, s, p, r, log_opacity = record[:6]
    result = record.new_empty(len(qx), 6, qx.shape[1])
    value, along_x, along_y = result[:, :3].unbind(1)
    u, ry = torch.addcmul(qx, s, qy), r * qy
    torch.mul(p, u, out=along_x)
    torch.addcmul(ry, along_x, s, out=along_y)
    torch.addcmul(log_opacity, along_x, u, value=0.5, out=value).addcmul_(ry, qy, value=0.5)
    result[:, 3:] = record[6:].transpose(0, 1)
    return result


def moments_about_mean(record: Tensor, qx: Tensor, qy: Tensor, moments: Tensor, out: Tensor) -> None:
    """Fill in `out` `[6, B, K]`: sums over the pixels of v, v u, v dy, v u^2, v u dy and v dy^2, where v is dL/dlog alpha, from the
    `moments` `[B, 6, K]`, its sums times the monomials."""
    s = record[2]
    v, vx, vy, vxx, vxy, vyy = moments.unbind(1)
    u = torch.addcmul(qx, s, qy)                                                            # at the tile's centre; u - that = x + s y
    out[0] = v
    sum_x = torch.addcmul(vx, u, v)                                                         # of v (u - s y)
    torch.addcmul(sum_x, s, vy, out=out[1])
    torch.addcmul(vy, qy, v, out=out[2])
    cross = torch.addcmul(vxy, u, vy)                                                       # of v (u - s y) y
    torch.addcmul(vxx, u, sum_x.add_(vx), out=out[3]).addcmul_(s, torch.addcmul(cross, s, vyy, value=0.5), value=2)
    torch.addcmul(cross.addcmul_(s, vyy), qy, out[1], out=out[4])
    torch.addcmul(vyy, qy, out[2] + vy, out=out[5])


def mean_slopes(coefficients: Tensor) -> tuple[Tensor, Tensor]:
    """Coefficients `[B, 3, K]` on (1, x, y) of minus dlog alpha/dmean, for x and for y: what the absolute gradient needs per pixel."""
    _, x, y, xx, xy, yy = coefficients.unbind(1)
    return torch.stack([x, 2 * xx, xy], 1), torch.stack([y, xy, 2 * yy], 1)
