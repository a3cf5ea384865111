"""What changes over a fit, as functions of the step alone: rates, bands of colours, size of the photos, density control.

All are parts of the length of the fit, so that few steps are a short fit, and not the beginning of a long one.
"""

from __future__ import annotations

import math

from tsplat.fit.config import FitConfig
from tsplat.fit.density import Schedule

REFERENCE_STEPS = 30_000   # the length of a fit that the rates of 3DGS, and those of the config, are made for
MAX_FACTOR = 6.0     # by which fits of fewer steps raise the rates
MIN_ACTIONS = 20     # of density control, if it went on to the end


def rate_factor(config: FitConfig, photos: int = 1) -> float:
    """By which the rates of a fit of 30,000 steps are raised: sqrt(30,000 / steps), and at most 6, as at 10 fits diverge.

    Adam moves a parameter by about its rate per step, to and fro, so by about rate times sqrt(steps) in all, which so stays the
    same for any number of steps down to 830. Of `photos` at a time there are so many times fewer: rates rise by their square root, the
    rule for Adam of Malladi et al. 2022, and for splats of Grendel (Zhao et al. 2024), where gradients of photos are nearly independent.
    """
    return min(math.sqrt(REFERENCE_STEPS * photos / max(1, config.steps)), MAX_FACTOR)


def progress(config: FitConfig, step: int) -> float:
    """0 at step 0, 1 at the last."""
    return step / max(1, config.steps - 1)


def sh_degree_at(config: FitConfig, step: int) -> int:
    """The degree of the spherical harmonics in use at `step`: from 0 up to `sh_degree` in equal intervals of the warm-up."""
    warmup = config.sh_warmup * config.steps
    return config.sh_degree if step >= warmup else int(step / warmup * config.sh_degree)


def divisor_at(config: FitConfig, step: int) -> int:
    """By which the size of the photos is divided at `step`: 4, 2, 1 (3DGS, section 7.1)."""
    warmup = config.resolution_warmup * config.steps
    return 4 if 2 * step < warmup else 2 if step < warmup else 1


def density_schedule(config: FitConfig, photos: int = 1) -> Schedule:
    """When density control acts, with so many photos at a time."""
    every = min(config.density_every, max(1, config.steps // MIN_ACTIONS))
    return Schedule(max(1, round(config.density_start * config.steps)), round(config.value("density_stop") * config.steps), every, photos)


def regulariser_weights(config: FitConfig, step: int, *, random_start: bool) -> dict[str, float]:
    """Of `scene_regulariser`. Those of opacity and scale make splats fade for density control to recycle, and end with it, or at half the steps."""
    acting = config.density == "none" or step < min(density_schedule(config).stop, config.steps / 2)
    opacity, scale = (acting * config.value(name, random_start=random_start) for name in ("opacity_reg", "scale_reg"))
    return {"opacity": opacity, "scale": scale, "opacity_depth": config.opacity_depth_reg}


def reset_interval(config: FitConfig) -> int:
    """Steps between resets of the opacities; 0: none, as where they would come at every step."""
    interval = round(config.reset_every * config.steps / REFERENCE_STEPS)
    return interval if interval > 1 else 0
