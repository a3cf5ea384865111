"""The renderer a second time, to judge the first: every splat at every pixel, in matrix form, with gradients by autograd.

Written from the 3DGS paper (Kerbl et al. 2023, equations 2 to 6) and the conventions alone. No tiles, chunks, blocks, tables or
closed-form derivatives. Expects sane splats; small sizes only, in float64.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

ALPHA_MIN = 1 / 255
STOP = 1e-4


class Splats(NamedTuple):
    """`[C, N, ...]`, zero where culled."""

    radii: Tensor
    means2d: Tensor
    depths: Tensor
    conics: Tensor
    compensations: Tensor


def rotation(quats: Tensor) -> Tensor:
    """`[..., 3, 3]`: column i is the vector part of q e_i q*, with Hamilton's product from i j = k and so on."""
    product = torch.zeros(4, 4, 4, dtype=quats.dtype)                               # (p q)_c = sum p_a q_b product[a, b, c]
    for a in range(4):
        product[0, a, a] = product[a, 0, a] = 1
    for a, b, c in ((1, 2, 3), (2, 3, 1), (3, 1, 2)):
        product[a, a, 0], product[a, b, c], product[b, a, c] = -1, 1, -1
    unit = quats / torch.linalg.vector_norm(quats, dim=-1, keepdim=True)
    conjugate = unit * torch.tensor([1, -1, -1, -1], dtype=quats.dtype)
    return torch.einsum("...a,abc,...d,cde->...eb", unit, product, conjugate, product)[..., 1:, 1:]


def covariances(quats: Tensor, scales: Tensor) -> Tensor:
    """Sigma = R S S^T R^T (equation 6)."""
    RS = rotation(quats) @ torch.diag_embed(scales)
    return RS @ RS.mT


def pixel(point: Tensor, K: Tensor, model: str) -> Tensor:
    """Where a camera-space point `[3]` is seen, `[2]`."""
    x, y, z = point
    if model == "pinhole":
        x, y = x / z, y / z
    elif model == "fisheye":  # the angle to the axis is the distance from the centre
        r = torch.sqrt(x * x + y * y)
        x, y = x * torch.atan2(r, z) / r, y * torch.atan2(r, z) / r
    return torch.stack([K[0, 0] * x + K[0, 2], K[1, 1] * y + K[1, 2]])


def jacobian_point(point: Tensor, K: Tensor, width: int, height: int, model: str) -> Tensor:
    """Where the Jacobian is taken: for a pinhole with x/z and y/z clamped to the frustum, widened by 0.3 tan(fov/2) on each
    side.
    """
    if model != "pinhole":
        return point
    size, f, c = K.new_tensor([width, height]), torch.stack([K[0, 0], K[1, 1]]), torch.stack([K[0, 2], K[1, 2]])
    margin = 0.3 * 0.5 * size / f
    ratio = torch.maximum(torch.minimum(point[:2] / point[2], (size - c) / f + margin), -c / f - margin)
    return torch.cat([ratio * point[2], point[2:]])


def project(means: Tensor, quats: Tensor | None, scales: Tensor | None, covars: Tensor | None, opacities: Tensor,
            viewmats: Tensor, Ks: Tensor, width: int, height: int, model: str, near: float, far: float, eps2d: float,
            antialiased: bool) -> Splats:
    """Sigma' = J W Sigma W^T J^T + eps2d I (equation 5) with J by autograd, camera by camera."""
    covars = covariances(quats, scales) if covars is None else covars
    views = [_view(means, covars, opacities, viewmat, K, width, height, model, near, far, eps2d, antialiased)
             for viewmat, K in zip(viewmats, Ks, strict=True)]
    return Splats(*map(torch.stack, zip(*views, strict=True)))


def _view(means: Tensor, covars: Tensor, opacities: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int, model: str,
          near: float, far: float, eps2d: float, antialiased: bool) -> Splats:
    points = torch.einsum("ij,nj->ni", viewmat[:3, :3], means) + viewmat[:3, 3]
    z = points[:, 2]
    ahead = ((z > near) & (z < far) & ((z > 0) | (model == "orthographic"))).nonzero().squeeze(1)
    points, W = points[ahead], viewmat[:3, :3]
    means2d = torch.func.vmap(lambda p: pixel(p, K, model))(points)
    J = torch.func.vmap(lambda p: torch.func.jacrev(pixel)(jacobian_point(p, K, width, height, model), K, model))(points)
    sharp = torch.einsum("nij,jk,nkl,ml,npm->nip", J, W, covars[ahead], W, J)
    blurred = sharp + eps2d * torch.eye(2, dtype=sharp.dtype)
    ratio = torch.linalg.det(sharp) / torch.linalg.det(blurred)
    compensations = torch.sqrt(torch.clamp(ratio, min=0.005**2)) if antialiased else torch.ones_like(ratio)
    inverse = torch.linalg.inv(blurred)
    conics = torch.stack([inverse[:, 0, 0], (inverse[:, 0, 1] + inverse[:, 1, 0]) / 2, inverse[:, 1, 1]], -1)

    with torch.no_grad():
        seen = opacities[ahead] * compensations
        extent = torch.sqrt(2 * torch.log(torch.clamp(255 * seen, min=1.0)))
        radii = torch.ceil(extent[:, None] * torch.sqrt(torch.diagonal(blurred, dim1=1, dim2=2)))
        size = torch.tensor([width, height])
        kept = ((seen >= ALPHA_MIN) & (radii > 0).all(1) & (means2d + radii > 0).all(1)
                & (means2d - radii < size).all(1)).nonzero().squeeze(1)

    def everywhere(values: Tensor) -> Tensor:
        return values.new_zeros(len(means), *values.shape[1:]).index_copy(0, ahead[kept], values[kept])

    return Splats(everywhere(radii).int(), everywhere(means2d), everywhere(points[:, 2]), everywhere(conics),
                  everywhere(compensations))


def harmonics_basis(directions: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics `[..., (degree + 1)^2]` of any directions, from their definition.

    Y_lm = sqrt(2) N_lm P_l^m(cos theta) cos(m phi), sin(|m| phi) for m < 0, with the Condon-Shortley phase in P_l^m, whose
    factor sin^m theta goes with the angle: sin^m theta (cos m phi + i sin m phi) = (x + i y)^m.
    """
    x, y, z = (directions / torch.linalg.vector_norm(directions, dim=-1, keepdim=True)).unbind(-1)
    columns: dict[tuple[int, int], Tensor] = {}
    for m in range(degree + 1):
        power = torch.complex(x, y) ** m if m else torch.complex(torch.ones_like(x), torch.zeros_like(x))
        legendre = {m - 1: torch.zeros_like(z), m: torch.full_like(z, (-1.0) ** m * math.prod(range(1, 2 * m, 2)))}
        for l in range(m, degree + 1):
            if l > m:
                legendre[l] = ((2 * l - 1) * z * legendre[l - 1] - (l + m - 1) * legendre[l - 2]) / (l - m)
            norm = math.sqrt((2 * l + 1) / (4 * math.pi) * math.factorial(l - m) / math.factorial(l + m) * (2 if m else 1))
            columns[l, m] = norm * legendre[l] * power.real
            columns[l, -m] = norm * legendre[l] * (power.imag if m else power.real)
    return torch.stack([columns[l, m] for l in range(degree + 1) for m in range(-l, l + 1)], -1)


def harmonics(means: Tensor, centers: Tensor, coeffs: Tensor, degree: int) -> Tensor:
    """`[C, N, D]`: coefficients times basis, seen from the camera centres."""
    return torch.einsum("cnk,nkd->cnd", harmonics_basis(means - centers[:, None], degree), coeffs[:, :(degree + 1) ** 2])


def pixel_centers(width: int, height: int) -> Tensor:
    """`[H, W, 2]`, (x, y)."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack([x, y], -1).double() + 0.5


def alphas_everywhere(means2d: Tensor, conics: Tensor, opacities: Tensor, width: int, height: int, alpha_max: float) -> Tensor:
    """`[H, W, N]` for one camera; 0 where below 1/255. `means2d` is `[N, 2]`, or `[H, W, N, 2]` if each pixel has its own."""
    a, b, c = conics.unbind(-1)
    d = pixel_centers(width, height)[:, :, None] - means2d
    conic = torch.stack([torch.stack([a, b], -1), torch.stack([b, c], -1)], -2)     # [N, 2, 2]
    sigma = (torch.einsum("hwni,nij->hwnj", d, conic) * d).sum(-1) / 2
    alpha = torch.clamp(opacities * torch.exp(-sigma), max=alpha_max)
    return torch.where(alpha >= ALPHA_MIN, alpha, 0.0)


def composite(alpha: Tensor, colors: Tensor, background: Tensor | None, *, drop_last: bool = False) -> tuple[Tensor, Tensor]:
    """Equations 2 and 3 of alphas `[H, W, N]`, front to back. A splat counts while the light in front of it is above 1e-4; with
    `drop_last` (the peers' rule) only if the light behind it is, too.
    """
    behind = torch.cumprod(1 - alpha, -1)
    front = torch.cat([torch.ones_like(behind[..., :1]), behind[..., :-1]], -1)
    weight = alpha * front * ((behind if drop_last else front) > STOP)
    image, total = torch.einsum("hwn,nd->hwd", weight, colors), weight.sum(-1)
    return (image if background is None else image + (1 - total)[..., None] * background), total


def front_to_back(depths: Tensor, radii: Tensor) -> Tensor:
    """The visible splats of one camera in order of depth, equals in order of index."""
    visible = (radii > 0).all(-1).nonzero().squeeze(1)
    return visible[torch.argsort(depths[visible], stable=True)]


def blend(means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, backgrounds: Tensor | None, depths: Tensor,
          radii: Tensor, width: int, height: int, alpha_max: float = 0.99, *, drop_last: bool = False) -> tuple[Tensor, Tensor]:
    """Images `[C, H, W, D]` and alphas `[C, H, W]`; colors `[C or 1, N, D]`."""
    views = []
    for c in range(len(means2d)):
        order = front_to_back(depths[c], radii[c])
        alpha = alphas_everywhere(means2d[c][order], conics[c][order], opacities[c][order], width, height, alpha_max)
        views.append(composite(alpha, colors[c if len(colors) > 1 else 0][order],
                               None if backgrounds is None else backgrounds[c], drop_last=drop_last))
    images, alphas = zip(*views, strict=True)
    return torch.stack(images), torch.stack(alphas)


def absolute_gradient(means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, backgrounds: Tensor | None,
                      depths: Tensor, radii: Tensor, width: int, height: int, v_image: Tensor, v_alpha: Tensor,
                      alpha_max: float = 0.99, *, drop_last: bool = False) -> Tensor:
    """Sum over pixels of |dL/dmeans2d| `[C, N, 2]`: each pixel gets means of its own."""
    result = torch.zeros_like(means2d)
    for c in range(len(means2d)):
        order = front_to_back(depths[c], radii[c])
        own = means2d[c][order].detach().expand(height, width, -1, -1).clone().requires_grad_()
        alpha = alphas_everywhere(own, conics[c][order], opacities[c][order], width, height, alpha_max)
        image, total = composite(alpha, colors[c if len(colors) > 1 else 0][order],
                                 None if backgrounds is None else backgrounds[c], drop_last=drop_last)
        (gradient,) = torch.autograd.grad([image, total], own, [v_image[c], v_alpha[c]])
        result[c, order] = gradient.abs().sum((0, 1))
    return result


def render(means: Tensor, quats: Tensor | None, scales: Tensor | None, opacities: Tensor, colors: Tensor, viewmats: Tensor,
           Ks: Tensor, width: int, height: int, *, covars: Tensor | None = None, model: str = "pinhole", near: float = 0.01,
           far: float = 1e10, sh_degree: int | None = None, background: Tensor | None = None, depth: str | None = None,
           antialiased: bool = False, eps2d: float = 0.3, alpha_max: float = 0.99, screen_offset: Tensor | None = None,
           drop_last: bool = False
           ) -> tuple[Tensor, Tensor, Tensor | None]:
    """Image `[C, H, W, D]`, alpha `[C, H, W]` and depth."""
    splats = project(means, quats, scales, covars, opacities, viewmats, Ks, width, height, model, near, far, eps2d, antialiased)
    means2d = splats.means2d if screen_offset is None else splats.means2d + screen_offset
    if sh_degree is not None:
        centers = -torch.einsum("cji,cj->ci", viewmats[:, :3, :3], viewmats[:, :3, 3])                # W is a rotation: -W^T t
        colors = torch.clamp(harmonics(means, centers, colors, sh_degree) + 0.5, min=0.0)
    colors = (colors if colors.ndim == 3 else colors[None]).expand(len(viewmats), -1, -1)
    backgrounds = None if background is None else background.expand(len(viewmats), -1)
    seen = opacities * splats.compensations
    image, alpha = blend(means2d, splats.conics, seen, torch.cat([colors, splats.depths[..., None]], -1),
                         None if backgrounds is None else torch.cat([backgrounds, torch.zeros_like(backgrounds[:, :1])], -1),
                         splats.depths, splats.radii, width, height, alpha_max, drop_last=drop_last)
    z = None if depth is None else image[..., -1] if depth == "accumulated" else image[..., -1] / alpha.clamp(min=1e-10)
    return image[..., :-1], alpha, z
