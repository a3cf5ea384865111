"""One splat from 3D to pixels: the ellipsoid, its projection, its alpha (3DGS, sections 4 and 6).

python bench/figures/one_splat.py [OUT.png]
"""

from __future__ import annotations

import math

import torch
import tsplat_reference as reference
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Rectangle
from style import BLUE, GREY, ORANGE, RED, figure, save
from tsplat_reference.constants import ALPHA_MIN

import tsplat

WIDTH, HEIGHT, TILE, EPS2D = 48, 40, 8, 0.3
OPACITY = 0.8


def draw() -> Figure:
    camera = tsplat.Camera.look_at((0.0, 0.0, -4.4), (0.0, 0.0, 0.0), width=WIDTH, height=HEIGHT, fov=40)
    mean, quat = torch.tensor([[0.25, -0.1, 0.0]]), torch.tensor([[0.8, 0.3, -0.4, 0.35]])
    scale, opacity = torch.tensor([[0.55, 0.22, 0.12]]), torch.tensor([OPACITY])
    p = reference.project(mean, quat, scale, None, opacity, camera.viewmats[None], camera.Ks[None], WIDTH, HEIGHT, camera.model, camera.near,
                          camera.far, EPS2D, False)
    fig = figure(9.6, 3.3)
    _ellipsoid(fig, camera, mean, reference.covariances(quat, scale)[0])
    _ellipse(fig.add_subplot(1, 3, 2), camera, p, mean, reference.covariances(quat, scale)[0])
    _pixels(fig, mean, quat, scale, opacity, camera)
    return fig


def _ellipsoid(fig: Figure, camera: tsplat.Camera, mean: torch.Tensor, covariance: torch.Tensor) -> None:
    axes = fig.add_subplot(1, 3, 1, projection="3d")
    u, v = torch.meshgrid(torch.linspace(0, 2 * math.pi, 40), torch.linspace(0, math.pi, 20), indexing="ij")
    sphere = torch.stack([u.cos() * v.sin(), u.sin() * v.sin(), v.cos()], -1)
    surface = mean[0] + 2 * sphere @ torch.linalg.cholesky(covariance).T
    x, y, z = surface.unbind(-1)
    axes.plot_surface(x, z, -y, color=BLUE, alpha=0.75, linewidth=0)
    eye = torch.tensor([0.0, 0.0, -4.4])
    K = camera.Ks
    corners = [torch.tensor([(cx - K[0, 2]) / K[0, 0], (cy - K[1, 2]) / K[1, 1], 1.0]) * 2.4 + eye
               for cx, cy in ((0, 0), (WIDTH, 0), (WIDTH, HEIGHT), (0, HEIGHT), (0, 0))]
    loop = torch.stack(corners)
    axes.plot(loop[:, 0], loop[:, 2], -loop[:, 1], color=ORANGE)
    for corner in corners[:4]:
        axes.plot(*zip((eye[0], eye[2], -eye[1]), (corner[0], corner[2], -corner[1]), strict=True), color=ORANGE, linewidth=0.8)
    axes.set_box_aspect((1.6, 3.2, 1.4))
    axes.view_init(22, -48)
    axes.set_axis_off()
    axes.set_title(r"in space: $\Sigma = R S S^\top R^\top$, at 2 sigma")


def _ellipse(axes, camera: tsplat.Camera, p: reference.Projection, mean: torch.Tensor, covariance: torch.Tensor) -> None:
    points = mean + torch.randn(1500, 3, generator=torch.Generator().manual_seed(0)) @ torch.linalg.cholesky(covariance).T
    view = points @ camera.viewmats[:3, :3].T + camera.viewmats[:3, 3]
    pixel = view @ camera.Ks.T
    axes.scatter(pixel[:, 0] / pixel[:, 2], pixel[:, 1] / pixel[:, 2], s=1.5, color=GREY, alpha=0.5, linewidths=0, label="points of it, projected")
    a, b, c = p.conics[0, 0].tolist()
    variances, directions = torch.linalg.eigh(torch.linalg.inv(torch.tensor([[a, b], [b, c]])))
    angle = math.degrees(math.atan2(float(directions[1, 1]), float(directions[0, 1])))
    center = p.means2d[0, 0].tolist()
    cut = math.sqrt(2 * math.log(OPACITY / ALPHA_MIN))
    for sigmas, style, label in ((2.0, "-", "2 sigma"), (cut, "--", "alpha = 1/255")):
        width, height = (2 * sigmas * variances.sqrt()).tolist()
        axes.add_patch(Ellipse(center, height, width, angle=angle, fill=False, color=BLUE, linestyle=style, label=label))
    rx, ry = p.radii[0, 0].tolist()
    axes.add_patch(Rectangle((center[0] - rx, center[1] - ry), 2 * rx, 2 * ry, fill=False, color=RED, linewidth=0.8, label="its box (radii)"))
    axes.legend(loc="lower left", fontsize=7, ncols=2)
    _frame(axes)
    axes.set_title(r"on the image: $\Sigma' = J W \Sigma W^\top J^\top + 0.3\,I$")


def _pixels(fig: Figure, mean: torch.Tensor, quat: torch.Tensor, scale: torch.Tensor, opacity: torch.Tensor, camera: tsplat.Camera) -> None:
    axes = fig.add_subplot(1, 3, 3)
    rendering = tsplat.rasterize(mean, quat, scale, opacity, torch.ones(1, 3), camera)
    picture = axes.imshow(rendering.alpha.where(rendering.alpha > 0, torch.nan), extent=(0, WIDTH, HEIGHT, 0), cmap="viridis", vmin=0, vmax=OPACITY)
    fig.colorbar(picture, ax=axes, shrink=0.8, label="alpha")
    hits = rendering.meta.hits[0]
    for y, x in hits.nonzero().tolist():
        axes.add_patch(Rectangle((x * TILE, y * TILE), TILE, TILE, fill=False, color=ORANGE, linewidth=1.2))
    _frame(axes)
    axes.set_title(f"in pixels: alpha, and the {int(hits.sum())} tiles that it hits")


def _frame(axes) -> None:
    axes.set_xlim(0, WIDTH)
    axes.set_ylim(HEIGHT, 0)
    axes.set_aspect("equal")
    axes.set_xticks(range(0, WIDTH + 1, TILE))
    axes.set_yticks(range(0, HEIGHT + 1, TILE))
    axes.grid(color=GREY, alpha=0.25, linewidth=0.6)


if __name__ == "__main__":
    save(draw, __file__, __doc__)
