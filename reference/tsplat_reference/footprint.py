"""The footprint of a splat: how its alpha falls off over the image. Blending knows a footprint only through these functions.

The Gaussian: log alpha = log o - (a dx^2 + c dy^2)/2 - b dx dy. With h = a/2, s = b/a and w = (c - b^2/a)/2 it is
log o - h u^2 - w dy^2, u = dx + s dy, which keeps its precision when a long thin splat is centred far from the pixel.
Within a tile that is a polynomial in the pixel's position (x, y) about the tile's centre: six coefficients per tile and splat turn
the evaluation at all pixels into a matrix product, and so are the sums that the backward needs.
"""

from __future__ import annotations

import torch
from torch import Tensor

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
    """`[6, R]`: mean x, mean y, h, s, w and log opacity of splats `[R, 2]`, `[R, 3]`, `[R]`; finite for culled ones (conic 0)."""
    a, b, c = conics.unbind(-1)
    s = torch.where(a > 0, b / torch.where(a > 0, a, 1.0), 0.0)
    return torch.stack([*means2d.unbind(-1), 0.5 * a, s, (0.5 * (c - b * s)).clamp_min(0.0),
                        torch.log(opacities.clamp_min(torch.finfo(opacities.dtype).tiny))])


def records_backward(conics: Tensor, opacities: Tensor, v_records: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients with respect to means2d, conics and opacities."""
    v_mx, v_my, v_h, v_s, v_w, v_log = v_records
    a, b, _ = conics.unbind(-1)
    inverse = torch.where(a > 0, 1 / torch.where(a > 0, a, 1.0), 0.0)
    s = b * inverse
    v_conics = torch.stack([0.5 * v_h - s * inverse * v_s + 0.5 * s * s * v_w, inverse * v_s - s * v_w, 0.5 * v_w], -1)
    v_opacities = torch.where(opacities > 0, v_log / torch.where(opacities > 0, opacities, 1.0), 0.0)
    return torch.stack([v_mx, v_my], -1), v_conics, v_opacities


def coefficients(record: Tensor, qx: Tensor, qy: Tensor) -> Tensor:
    """Polynomial coefficients `[B, 6, K]` of log alpha, from records `[6, B, K]` and tile centre minus mean, `[B, K]` each."""
    _, _, h, s, w, log_opacity = record
    u = torch.addcmul(qx, s, qy)
    hu, wq, hs = h * u, w * qy, h * s
    planes = [log_opacity - hu * u - wq * qy, -2 * hu, -2 * torch.addcmul(wq, hu, s), -h, -2 * hs, -torch.addcmul(w, hs, s)]
    return torch.stack(planes).movedim(0, 1)


def coefficients_backward(record: Tensor, qx: Tensor, qy: Tensor, moments: Tensor) -> Tensor:
    """Gradients `[6, B, K]` of the records from the `moments` `[B, 6, K]`: sums of dL/dlog alpha times monomial."""
    _, _, h, s, w, _ = record
    m0, mx, my, mxx, mxy, myy = moments.unbind(1)
    u = torch.addcmul(qx, s, qy)
    uy = u * my
    sum_u = u * m0 + mx + s * my                                     # sum of v u over the pixels, and so on
    sum_y = qy * m0 + my
    sum_uu = u * (u * m0 + 2 * mx) + 2 * s * (uy + mxy) + mxx + s * s * myy
    sum_uy = qy * sum_u + uy + mxy + s * myy
    sum_yy = qy * (qy * m0 + 2 * my) + myy
    v_mx = 2 * h * sum_u                                             # du/dmx = -1, du/dmy = -s, du/ds = dy, ddy/dmy = -1
    return torch.stack([v_mx, s * v_mx + 2 * w * sum_y, -sum_uu, -2 * h * sum_uy, -sum_yy, m0])


def mean_slopes(record: Tensor, qx: Tensor, qy: Tensor) -> tuple[Tensor, Tensor]:
    """Coefficients `[B, 3, K]` on (1, x, y) of dlog alpha/dmean, for x and for y: what the absolute gradient needs per pixel."""
    _, _, h, s, w, _ = record
    u = torch.addcmul(qx, s, qy)
    along_x = torch.stack([u, torch.ones_like(u), s], 1) * (2 * h)[:, None]
    along_y = along_x * s[:, None]
    along_y[:, 0] += 2 * w * qy
    along_y[:, 2] += 2 * w
    return along_x, along_y
