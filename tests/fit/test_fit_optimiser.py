"""Schedules are functions of the step; Adam moves each parameter at its own rate."""

import math
from collections.abc import Callable

import pytest
import torch

from tsplat.fit import FitConfig
from tsplat.fit.optimiser import learning_rates, make_adam, set_rates
from tsplat.fit.schedules import sh_degree_at
from tsplat.scene import Gaussians

Make = Callable[..., FitConfig]


def test_rate_of_the_means_falls_log_linearly(config: Make) -> None:
    c = config(steps=1001, lr_means=1e-3, lr_means_decay=0.01)
    rates = [learning_rates(c, 2.0, step)["means"] for step in (0, 500, 1000)]
    factor = math.sqrt(30_000 / 1001)
    assert rates == pytest.approx([2e-3 * factor, 2e-4 * factor, 2e-5 * factor])
    assert learning_rates(config(steps=1), 1.0, 0)["quats"] == pytest.approx(6 * config(steps=1).lr_quats)      # raised no further


def test_schedules_stretch_over_the_steps(config: Make) -> None:
    short, long = config(steps=1001), config(steps=4001)               # 4 times the steps, half the rates
    for part in range(5):
        rates = learning_rates(short, 1.0, 250 * part)
        assert {name: rate / 2 for name, rate in rates.items()} == pytest.approx(learning_rates(long, 1.0, 1000 * part), rel=1e-3)
        assert sh_degree_at(config(steps=100), 10 * part) == sh_degree_at(config(steps=1000), 100 * part)


def test_other_rates_are_the_configs(config: Make) -> None:
    c = config(steps=30_000)
    rates = learning_rates(c, 5.0, 7)
    assert set(rates) == set(Gaussians.NAMES)
    assert (rates["quats"], rates["log_scales"], rates["opacity_logits"], rates["sh0"], rates["sh_rest"]) == (
        c.lr_quats, c.lr_scales, c.lr_opacities, c.lr_sh0, c.lr_sh_rest)


def test_sh_degree_rises_to_the_full_one(config: Make) -> None:
    c = config(steps=100, sh_degree=3, sh_warmup=0.3)
    assert [sh_degree_at(c, step) for step in (0, 9, 10, 19, 20, 29, 30, 99)] == [0, 0, 1, 1, 2, 2, 3, 3]
    assert sh_degree_at(config(sh_warmup=0.0), 0) == 3
    assert sh_degree_at(config(sh_degree=0), 0) == 0


def test_adam_moves_by_the_rates() -> None:
    splats = Gaussians.random(4, generator=torch.Generator().manual_seed(0))
    before = {name: p.detach().clone() for name, p in splats.named_parameters()}
    adam = make_adam(splats)
    rates = {name: 10.0**-i for i, name in enumerate(Gaussians.NAMES)}
    set_rates(adam, rates)
    for parameter in splats.parameters():
        parameter.grad = torch.ones_like(parameter)
    adam.step()
    for name, parameter in splats.named_parameters():
        expected = torch.full_like(parameter, -rates[name])              # the first step of Adam is its rate
        torch.testing.assert_close(parameter.detach() - before[name], expected, atol=2e-6, rtol=1e-5)     # parameters of up to 16, rounded twice


def test_adam_of_no_splats() -> None:
    splats = Gaussians.random(0)
    adam = make_adam(splats)
    for parameter in splats.parameters():
        parameter.grad = torch.zeros_like(parameter)
    adam.step()
