"""Adam over the parameters of a scene, and its rates, which are functions of the step alone."""

from __future__ import annotations

from torch import Tensor, nn
from torch.optim import Adam, Optimizer

from tsplat.fit.config import FitConfig
from tsplat.fit.schedules import progress, rate_factor
from tsplat.fit.visible_adam import VisibleAdam

EPS = 1e-15                # as in 3DGS: gradients of single splats are tiny
BETAS = 0.9, 0.999         # for one photo at a time


def learning_rates(config: FitConfig, extent: float, step: int, photos: int = 1) -> dict[str, float]:
    """The learning rate of each parameter of `Gaussians` at `step`, counted from 0.

    That of the means falls log-linearly from `lr_means * extent` to that times `lr_means_decay` at the last step
    (3DGS, section 7.1); the others stay. All are the config's times `rate_factor`, which knows how many `photos` a step has.
    """
    rates = {
        "means": config.lr_means * extent * config.lr_means_decay ** progress(config, step),
        "quats": config.lr_quats,
        "log_scales": config.lr_scales,
        "opacity_logits": config.lr_opacities,
        "sh0": config.lr_sh0,
        "sh_rest": config.lr_sh_rest,
    }
    factor = rate_factor(config, photos)
    return {name: factor * rate for name, rate in rates.items()}


def make_adam(scene: nn.Module, *, visible_only: bool = False) -> Adam | VisibleAdam:
    """One parameter group per parameter, with its name; the rates are set at each step by `set_rates`."""
    groups = [{"params": [parameter], "name": name} for name, parameter in scene.named_parameters()]
    return VisibleAdam(groups, lr=0.0, eps=EPS) if visible_only else Adam(groups, lr=0.0, eps=EPS, fused=True)


def set_rates(adam: Optimizer, rates: dict[str, float], photos: int = 1) -> None:
    """Give each group the rate of its name, and betas to the power of `photos`, those of a step: moments then remember as many photos
    as with one at a time (Grendel, Zhao et al. 2024).
    """
    for group in adam.param_groups:
        group["lr"], group["betas"] = rates[group["name"]], (BETAS[0]**photos, BETAS[1]**photos)


def adam_step(adam: Adam | VisibleAdam, visible: Tensor) -> None:
    """Move what has a gradient, with `VisibleAdam` only the rows where `visible`, bool `[N]`."""
    if isinstance(adam, VisibleAdam):
        adam.step(visible)
    else:
        adam.step()
