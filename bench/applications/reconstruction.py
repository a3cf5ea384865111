"""Pulsar's coarse-to-fine reconstruction (section 5.1): a random volume, pruned, and refined into smaller spheres, several times."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from common import Spheres, Stage, Views, mean_psnr, optimise
from torch import Tensor

from tsplat.fit.spheres import visibility, worth_keeping

GAMMA = 0.5, 1e-2
"""Of the volume. Finer stages start where it ends, but for a little softness with which the new spheres sort themselves."""
FINE_GAMMA = 5e-2, 1e-3
COLOR_DISTANCE = 0.15
LEAST_WEIGHT = 0.5          # pixels of all views together


@dataclass
class Result:
    """The spheres, and what each stage came to: (name, number of spheres, held-out PSNR)."""

    spheres: Spheres
    history: list[tuple[str, int, float]]

    def document(self) -> dict[str, dict[str, float]]:
        """Figures and counts of a report."""
        return {"figures": {name: quality for name, _, quality in self.history}, "counts": {name: count for name, count, _ in self.history}}


def random_volume(count: int, stage: Stage, generator: torch.Generator, overlap: float = 1.0) -> Spheres:
    """Half-transparent grey spheres at random in the stage's ball; `overlap` times as large as if they filled it side by side."""
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    distances = stage.radius * torch.rand(count, 1, generator=generator) ** (1 / 3)
    radii = torch.full((count,), overlap * stage.radius / count ** (1 / 3))
    return Spheres.of(stage.centre + directions * distances, radii, torch.full((count, 3), 0.5), torch.full((count,), 0.5))


def prune(spheres: Spheres, stage: Stage, views: Views, gamma: float) -> Spheres:
    """Without those that no view sees and those of the background's colour. (Opacities tell little: with a small gamma, even o = 0.02 hides
    the background.)"""
    weights = visibility(spheres.positions, spheres.radii, spheres.opacities, (camera for camera, _ in views.each()), gamma=gamma,
                         **stage.planes)
    return spheres.select(worth_keeping(spheres.features.detach(), stage.background, weights, color_distance=COLOR_DISTANCE,
                                        least_weight=LEAST_WEIGHT))


def reconstruct(stage: Stage, train: Views, test: Views, *, volume: int, refinements: int, steps: int, batch: int, reach: float,
                generator: torch.Generator, say: Callable[[str], None] = print) -> Result:
    """Optimise the volume, then prune, refine and optimise `refinements` times; each stage has `steps`."""
    spheres = random_volume(volume, stage, generator)
    history: list[tuple[str, int, float]] = []

    def note(name: str, gamma: float) -> None:
        quality = mean_psnr(lambda camera: stage.render(spheres, camera, gamma), test)
        history.append((name, len(spheres), quality))
        say(f"{name}: {len(spheres)} spheres, held-out PSNR {quality:.2f} dB")

    for level in range(refinements + 1):
        gammas = FINE_GAMMA if level else GAMMA
        if level:
            spheres = spheres.refined(reach)
            note(f"refinement {level}, before", gammas[1])

        def loss(some: Views, gamma: float) -> Tensor:
            return (stage.render(spheres, some.cameras, gamma) - some.images).abs().mean()       # noqa: B023 (called here only)

        name = f"refinement {level}" if level else "volume"
        groups = spheres.groups(stage.radius / 2**level)
        optimise(groups, train, loss, steps=steps, batch=batch, gamma=gammas, generator=generator, name=name)
        note(name, gammas[1])
        spheres = prune(spheres, stage, train, gammas[1])
        note(f"{name}, pruned", gammas[1])
    return Result(spheres, history)
