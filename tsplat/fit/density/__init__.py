"""Density control: how the number and the places of splats change during a fit, as interchangeable objects.

They know parameters and an optimiser, no trainer, and of splats on several processes what `tsplat.fit.ranks.Ranks` tells them; in a loop of your own,
with any of them:

    control = AdaptiveControl(extent, Schedule(500, 15_000, 100))
    for step in range(1, steps + 1):
        rendering = rasterize(..., **control.probes(scene, step))
        optimiser.zero_grad()
        loss(rendering.image).backward()
        control.observe(rendering.meta, camera)
        optimiser.step()
        control.update(scene, optimiser, step, generator)
        if control.settled(step): ...                    # else it would not be fair to score or save the scene: its opacities were just reset
"""

from tsplat.fit.density.adaptive import AdaptiveControl
from tsplat.fit.density.budget import Budget
from tsplat.fit.density.control import Control, NoControl, Schedule
from tsplat.fit.density.mcmc import MCMC

__all__ = ["MCMC", "AdaptiveControl", "Budget", "Control", "NoControl", "Schedule"]
