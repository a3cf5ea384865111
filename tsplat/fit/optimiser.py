"""Adam over the parameters of `Gaussians`, and its schedules, which are functions of the step alone."""

from __future__ import annotations

import math

from torch.optim import Adam

from tsplat.fit.config import FitConfig
from tsplat.scene import Gaussians

EPS = 1e-15                # as in 3DGS: gradients of single splats are tiny
REFERENCE_STEPS = 30_000   # the length of a fit that the rates of 3DGS, and those of the config, are made for
MAX_FACTOR = 6.0     # by which fits of fewer steps raise the rates


def learning_rates(config: FitConfig, extent: float, step: int) -> dict[str, float]:
    """The learning rate of each parameter of `Gaussians` at `step`, counted from 0.

    That of the means falls log-linearly from `lr_means * extent` to that times `lr_means_decay` at the last step
    (3DGS, section 7.1); the others stay. All are the config's times sqrt(30,000 / steps): Adam moves a parameter by about
    its rate per step, to and fro, so by about rate times sqrt(steps) in all, which stays the same for any number of steps
    (down to 830: the factor is 6 at the most, as at 10 fits diverge).
    """
    done = step / max(1, config.steps - 1)
    rates = {
        "means": config.lr_means * extent * config.lr_means_decay**done,
        "quats": config.lr_quats,
        "log_scales": config.lr_scales,
        "opacity_logits": config.lr_opacities,
        "sh0": config.lr_sh0,
        "sh_rest": config.lr_sh_rest,
    }
    factor = min(math.sqrt(REFERENCE_STEPS / max(1, config.steps)), MAX_FACTOR)
    return {name: factor * rate for name, rate in rates.items()}


def sh_degree_at(config: FitConfig, step: int) -> int:
    """The degree of the spherical harmonics in use at `step`: from 0 up to `sh_degree` in equal intervals of the warm-up."""
    warmup = config.sh_warmup * config.steps
    return config.sh_degree if step >= warmup else int(step / warmup * config.sh_degree)


def make_adam(gaussians: Gaussians) -> Adam:
    """One parameter group per parameter, with its name; the rates are set at each step by `set_rates`."""
    groups = [{"params": [gaussians.get_parameter(name)], "name": name} for name in gaussians.NAMES]
    return Adam(groups, lr=0.0, eps=EPS, fused=True)


def set_rates(adam: Adam, rates: dict[str, float]) -> None:
    """Give each group the rate of its name."""
    for group in adam.param_groups:
        group["lr"] = rates[group["name"]]
