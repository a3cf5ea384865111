"""The rules of `diff_gaussian_rasterization` a second time, to judge the drop-in: every splat at every pixel, gradients by autograd.

Written from the 3DGS paper (Kerbl et al. 2023, sections 4 to 6) and slides on the program: no code is shared with tsplat or its other tests.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

C0, C1 = 0.5 / math.sqrt(math.pi), math.sqrt(3 / (4 * math.pi))


def covariance(scale: Tensor, q: Tensor) -> Tensor:
    w, x, y, z = q
    R = torch.stack([torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
                     torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
                     torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])])
    return R @ torch.diag(scale**2) @ R.T


def render(s: Any, means3D: Tensor, ndc_offset: Tensor, opacities: Tensor, shs: Tensor | None, colors: Tensor | None, scales: Tensor | None,
           rotations: Tensor | None, covs: Tensor | None, *, cut: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Image, radii and inverse depths; with `cut`, splats end with the tiles of 16 pixels that their radius touches.

    `s` are the settings. `ndc_offset` `[N, 2]` is added to the projected means. SH of degree 0 and 1 only.
    """
    W, H = s.image_width, s.image_height
    fx, fy = W / (2 * s.tanfovx), H / (2 * s.tanfovy)
    splats, radii = [], []
    for i in range(len(means3D)):
        homogeneous = torch.cat([means3D[i], means3D.new_ones(1)])
        view, clip = homogeneous @ s.viewmatrix, homogeneous @ s.projmatrix
        radii.append(0)
        if view[2] <= 0.2:
            continue
        u, v = (((clip[:2] / clip[3] + ndc_offset[i] + 1) * torch.tensor([W, H]) - 1) / 2).unbind()        # pixel centres at integers
        if covs is None:
            sigma = covariance(s.scale_modifier * scales[i], rotations[i])  # type: ignore[index]
        else:
            a, b, c, d, e, f = covs[i]
            sigma = torch.stack([torch.stack([a, b, c]), torch.stack([b, d, e]), torch.stack([c, e, f])])
        tz = view[2]
        tx = (view[0] / tz).clamp(-1.3 * s.tanfovx, 1.3 * s.tanfovx) * tz
        ty = (view[1] / tz).clamp(-1.3 * s.tanfovy, 1.3 * s.tanfovy) * tz
        zero = torch.zeros_like(tz)
        J = torch.stack([torch.stack([fx / tz, zero, -fx * tx / tz**2]), torch.stack([zero, fy / tz, -fy * ty / tz**2])])
        T = J @ s.viewmatrix[:3, :3].T
        sharp = T @ sigma @ T.T
        cov = sharp + 0.3 * torch.eye(2, dtype=sharp.dtype)
        det = torch.linalg.det(cov)
        opacity = opacities[i]
        if s.antialiasing:
            opacity = opacity * (torch.linalg.det(sharp) / det).clamp_min(0.000025).sqrt()
        mid = cov.trace() / 2
        radius = math.ceil(3 * math.sqrt(mid.item() + math.sqrt(max(0.1, (mid**2 - det).item()))))
        grid_x, grid_y = math.ceil(W / 16), math.ceil(H / 16)
        x0, x1 = (min(grid_x, max(0, int(k))) for k in ((u.item() - radius) / 16, (u.item() + radius + 15) / 16))
        y0, y1 = (min(grid_y, max(0, int(k))) for k in ((v.item() - radius) / 16, (v.item() + radius + 15) / 16))
        if (x1 - x0) * (y1 - y0) <= 0:
            continue
        radii[-1] = radius
        if shs is None:
            color = colors[i]  # type: ignore[index]
        else:
            x, y, z = (means3D[i] - s.campos) / (means3D[i] - s.campos).norm()
            color = C0 * shs[i, 0]
            if s.sh_degree == 1:
                color = color - C1 * y * shs[i, 1] + C1 * z * shs[i, 2] - C1 * x * shs[i, 3]
            color = (color + 0.5).clamp_min(0)
        splats.append((tz, u, v, torch.linalg.inv(cov), opacity, color, (16 * x0, 16 * x1, 16 * y0, 16 * y1)))

    splats.sort(key=lambda splat: splat[0].item())
    ys, xs = torch.meshgrid(torch.arange(H, dtype=torch.float64), torch.arange(W, dtype=torch.float64), indexing="ij")
    T, done = torch.ones(H, W, dtype=torch.float64), torch.zeros(H, W, dtype=torch.bool)
    image, inverse = torch.zeros(len(s.bg), H, W, dtype=torch.float64), torch.zeros(H, W, dtype=torch.float64)
    for z, u, v, conic, opacity, color, (x0, x1, y0, y1) in splats:
        dx, dy = xs - u, ys - v
        power = -0.5 * (conic[0, 0] * dx * dx + conic[1, 1] * dy * dy) - conic[0, 1] * dx * dy
        alpha = (opacity * power.exp()).clamp_max(0.99)
        alpha = torch.where(alpha < 1 / 255, 0.0, alpha)
        if cut:
            alpha = torch.where((xs >= x0) & (xs < x1) & (ys >= y0) & (ys < y1), alpha, 0.0)
        done = done | (T * (1 - alpha) < 0.0001)
        weight = torch.where(done, 0.0, alpha * T)
        image, inverse = image + weight * color[:, None, None], inverse + weight / z
        T = T - weight
    return image + T * s.bg[:, None, None], torch.tensor(radii, dtype=torch.int32), inverse[None]
