"""Pulsar's weights over gamma: from a softmax that lets everything through to one that takes the nearest sphere (Pulsar, equation 1).

python bench/figures/gamma.py [OUT.png]
"""

from __future__ import annotations

import torch
from matplotlib.figure import Figure
from style import BLUE, GREEN, GREY, ORANGE, RED, figure, save

import tsplat

SIDE, NEAR, FAR = 160, 1.0, 9.0
DEPTHS = (3.0, 4.0, 5.5, 7.0)
COLORS = (RED, ORANGE, GREEN, BLUE)
GAMMAS = (1.0, 0.1, 0.02, 1e-3)


def draw() -> Figure:
    positions = torch.tensor([[0.25 * (i - 1.5), 0.12 * (-1) ** i, z] for i, z in enumerate(DEPTHS)])
    features = torch.tensor([[int(c[k:k + 2], 16) / 255 for k in (1, 3, 5)] for c in COLORS])
    radii = torch.tensor([0.5, 0.65, 0.9, 1.1])
    K = torch.tensor([[2.4 * SIDE, 0, SIDE / 2], [0, 2.4 * SIDE, SIDE / 2], [0, 0, 1]])
    camera = tsplat.Camera(torch.eye(4), K, SIDE, SIDE)

    def render(gamma: float, n_track: int = 0) -> tsplat.spheres.SphereRendering:
        return tsplat.render_spheres(positions, features, radii, camera, gamma=gamma, near=NEAR, far=FAR, n_track=n_track)

    fig = figure(9.6, 2.9)
    left, right = fig.subfigures(1, 2, width_ratios=(1.0, 1.15))
    axes = left.subplots()
    grid = torch.logspace(0, -3.2, 60)
    rows = []
    for gamma in grid.tolist():
        hits = render(gamma, len(DEPTHS)).hits
        ids, weights = (x[SIDE // 2, SIDE // 2] for x in (hits.ids, hits.weights))
        rows.append([float(weights[ids == i].sum()) for i in range(len(DEPTHS))])
    shares = torch.tensor(rows).T
    axes.stackplot(grid, *shares, 1 - shares.sum(0), colors=[*COLORS, "#e6e6e6"], labels=[*(f"sphere at z = {z:g}" for z in DEPTHS), "background"])
    axes.set_xscale("log")
    axes.invert_xaxis()
    axes.margins(0)
    axes.set_xlabel(r"$\gamma$")
    axes.set_ylabel("weight in the middle pixel")
    for gamma in GAMMAS:
        axes.axvline(gamma, color="white", linewidth=0.8, linestyle=":")
    axes.legend(loc="lower right", fontsize=7, frameon=True, facecolor="white", framealpha=0.85, edgecolor=GREY)
    for panel, gamma in zip(right.subplots(2, 2).flat, GAMMAS, strict=True):
        panel.imshow(render(gamma).image.clamp(0, 1))
        panel.plot(SIDE / 2, SIDE / 2, "+", color="black")
        panel.set_axis_off()
        panel.set_title(rf"$\gamma$ = {gamma:g}")
    return fig


if __name__ == "__main__":
    save(draw, __file__, __doc__)
