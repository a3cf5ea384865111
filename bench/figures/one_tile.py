"""One tile of a render: its list of splats, and what becomes of the light of one of its pixels (3DGS, section 6).

python bench/figures/one_tile.py [OUT.png]
"""

from __future__ import annotations

import torch
import tsplat_reference as reference
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from style import BLUE, GREEN, GREY, ORANGE, RED, figure, save
from tsplat_reference import footprint
from tsplat_reference.constants import ALPHA_MIN, TRANSMITTANCE_MIN

import tsplat
from tsplat.scene.synthetic import synthetic_scene

WIDTH, HEIGHT, TILE, EPS2D = 240, 180, 8, 0.3
PIXEL = 118, 96                           # (x, y): on the sphere, before the ring
OPACITY = 0.88                            # of all splats here: more than a few count


def draw() -> Figure:
    means, quats, scales, opacities, colors = synthetic_scene()
    opacities = torch.full_like(opacities, OPACITY)
    camera = tsplat.Camera.look_at((1.2, -1.3, -2.8), (0.0, -0.35, 0.0), width=WIDTH, height=HEIGHT, fov=50)
    image = tsplat.rasterize(means, quats, scales, opacities, colors, camera).image
    p = reference.project(means, quats, scales, None, opacities, camera.viewmats[None], camera.Ks[None], WIDTH, HEIGHT, camera.model, camera.near,
                          camera.far, EPS2D, False)
    ids, offsets = reference.bin_splats(p.means2d, p.radii, p.conics, opacities[None], p.depths, WIDTH, HEIGHT, TILE)
    tile = PIXEL[1] // TILE * (-(-WIDTH // TILE)) + PIXEL[0] // TILE
    splats = ids[offsets[tile]:offsets[tile + 1]].long()
    offset = torch.tensor(PIXEL) + 0.5 - p.means2d[0, splats]
    alpha = footprint.log_alpha(offset[:, 0], offset[:, 1], p.conics[0, splats], opacities[splats]).exp()
    alpha = alpha.where(alpha >= ALPHA_MIN, 0.0)
    before = torch.cat([torch.ones(1), (1 - alpha).cumprod(0)[:-1]])
    weight = (alpha * before).where(before > TRANSMITTANCE_MIN, 0.0)

    fig = figure(9.6, 3.1)
    left, middle, right = fig.subplots(1, 3, width_ratios=(1.25, 1, 1.7))
    left.imshow(image.clamp(0, 1), extent=(0, WIDTH, HEIGHT, 0))
    corner = PIXEL[0] // TILE * TILE, PIXEL[1] // TILE * TILE
    left.add_patch(Rectangle(corner, TILE, TILE, fill=False, color=RED, linewidth=1.5))
    left.set_axis_off()
    left.set_title(f"{WIDTH} x {HEIGHT} pixels, tiles of {TILE} x {TILE}")
    _footprints(middle, p, splats, colors, corner)
    _light(right, alpha, before, weight)
    return fig


def _footprints(axes, p: reference.Projection, splats: torch.Tensor, colors: torch.Tensor, corner: tuple[int, int]) -> None:
    angle = torch.linspace(0, 2 * torch.pi, 60)
    circle = torch.stack([angle.cos(), angle.sin()])
    for i in reversed(splats.tolist()):
        a, b, c = p.conics[0, i].tolist()
        outline = torch.linalg.cholesky(torch.linalg.inv(torch.tensor([[a, b], [b, c]]))) @ circle + p.means2d[0, i, :, None]
        axes.plot(outline[0], outline[1], color=colors[i].clamp(0, 1).tolist(), linewidth=1)
    axes.add_patch(Rectangle(corner, TILE, TILE, fill=False, color=RED, linewidth=1.5))
    axes.plot(PIXEL[0] + 0.5, PIXEL[1] + 0.5, "+", color="black", markersize=9)
    axes.set_xlim(corner[0] - 4, corner[0] + TILE + 4)
    axes.set_ylim(corner[1] + TILE + 4, corner[1] - 4)
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set_title(f"the tile's list: {len(splats)} splats, at 1 sigma")


def _light(axes, alpha: torch.Tensor, before: torch.Tensor, weight: torch.Tensor) -> None:
    place = torch.arange(1, len(alpha) + 1)
    axes.bar(place, alpha, width=1.0, color=GREY, alpha=0.35, label=r"$\alpha_i$")
    axes.bar(place, weight, width=1.0, color=BLUE, label=r"weight $w_i = \alpha_i T_i$")
    axes.set_xlabel("place in the list, front to back")
    axes.set_ylabel(r"$\alpha$, $w$")
    axes.set_ylim(0, 0.9)
    light = axes.twinx()
    light.step(place, before, where="mid", color=ORANGE, label=r"transmittance $T_i = \prod_{j<i}(1 - \alpha_j)$")
    light.axhline(TRANSMITTANCE_MIN, color=GREEN, linewidth=0.8, linestyle="--")
    light.set_yscale("log")
    light.set_ylim(TRANSMITTANCE_MIN / 10, 2)
    light.set_ylabel("T")
    lit = int((before > TRANSMITTANCE_MIN).sum())
    if lit < len(alpha):
        light.annotate("the pixel ends", (lit, TRANSMITTANCE_MIN), (lit, 4e-3), arrowprops={"arrowstyle": "->"}, color=GREEN, ha="center")
    handles = [*axes.get_legend_handles_labels()[0], *light.get_legend_handles_labels()[0]]
    axes.legend(handles, [h.get_label() for h in handles], loc="upper center", fontsize=7)
    axes.set_title("the light of the pixel at the cross")


if __name__ == "__main__":
    save(draw, __file__, __doc__)
