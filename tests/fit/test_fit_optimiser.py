"""Schedules are functions of the step; Adam moves each parameter at its own rate."""

import math
from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tsplat.fit import FitConfig
from tsplat.fit.optimiser import learning_rates, make_adam, set_rates
from tsplat.fit.schedules import divisor_at, sh_degree_at
from tsplat.fit.visible_adam import VisibleAdam
from tsplat.scene import Gaussians

Make = Callable[..., FitConfig]


def test_rate_of_the_means_falls_log_linearly(config: Make) -> None:
    c = config(steps=1001, lr_means=1e-3, lr_means_decay=0.01)
    rates = [learning_rates(c, 2.0, step)["means"] for step in (0, 500, 1000)]
    factor = math.sqrt(30_000 / 1001)
    assert rates == pytest.approx([2e-3 * factor, 2e-4 * factor, 2e-5 * factor])
    assert learning_rates(config(steps=1), 1.0, 0)["quats"] == pytest.approx(6 * config(steps=1).lr_quats)      # raised no further


def test_rates_rise_with_the_square_root_of_the_photos_of_a_step(config: Make) -> None:
    c = config(steps=30_000)
    twice = {name: 2 * rate for name, rate in learning_rates(c, 1.0, 0).items()}
    assert learning_rates(c, 1.0, 0, photos=4) == pytest.approx(twice)


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


@settings(max_examples=20, deadline=None)
@given(seen=st.lists(st.tuples(st.booleans(), st.booleans(), st.booleans()), max_size=8), beta1=st.sampled_from([0.0, 0.9]))
def test_a_row_moves_as_if_it_were_alone_with_adam(seen: list[tuple[bool, bool, bool]], beta1: float) -> None:
    """Bias correction included: k is how often the row was seen, not how many steps there were."""
    start = torch.randn(3, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    together = torch.nn.Parameter(start.clone())
    alone = [torch.nn.Parameter(row.clone()) for row in start]
    visible_adam = VisibleAdam([together], lr=0.1, betas=(beta1, 0.99))
    adams = [torch.optim.Adam([row], lr=0.1, betas=(beta1, 0.99), eps=1e-15) for row in alone]
    generator = torch.Generator().manual_seed(1)
    for visible in seen:
        together.grad = torch.randn(3, 2, generator=generator, dtype=torch.float64)
        for row, adam, gradient, moves in zip(alone, adams, together.grad, visible, strict=True):
            row.grad = gradient.clone()
            if moves:
                adam.step()
        visible_adam.step(torch.tensor(visible))
    torch.testing.assert_close(together.detach(), torch.stack(alone).detach(), atol=1e-13, rtol=1e-13)
    if seen:
        assert visible_adam.state[together]["steps"].tolist() == [sum(column) for column in zip(*seen, strict=True)]


def test_rows_that_are_not_seen_rest() -> None:
    row = torch.nn.Parameter(torch.ones(2, 3))
    adam = VisibleAdam([row], lr=0.1)
    row.grad = torch.ones(2, 3)
    adam.step(torch.tensor([True, True]))
    before, moment = row.detach().clone(), adam.state[row]["exp_avg"].clone()
    adam.step(torch.tensor([False, True]))
    assert torch.equal(row[0], before[0])
    assert torch.equal(adam.state[row]["exp_avg"][0], moment[0])
    assert not torch.equal(row[1], before[1])


@pytest.mark.parametrize("visible", [torch.ones(3, dtype=torch.bool), torch.ones(2)])
def test_visible_that_does_not_fit(visible: torch.Tensor) -> None:
    row = torch.nn.Parameter(torch.ones(2, 3))
    row.grad = torch.ones(2, 3)
    with pytest.raises(ValueError, match=r"^visible: expected bool \[2\], for a parameter \[2, 3\]; got"):
        VisibleAdam([row]).step(visible)


def test_adam_rows_is_an_op() -> None:
    """Schema, fake kernel and what it writes to, as `torch.compile` relies on them."""
    moments = [torch.rand(4, 3) for _ in range(2)]
    inputs = (torch.rand(4, 3), torch.rand(4, 3), *moments, torch.arange(4.0), torch.tensor([True, False, True, True]), 0.1, 0.9, 0.999, 1e-15)
    torch.library.opcheck(torch.ops.tsplat.adam_rows.default, inputs)


def test_photos_start_small(config: Make) -> None:
    c = config(steps=100, resolution_warmup=0.2)
    assert [divisor_at(c, step) for step in (0, 9, 10, 19, 20, 99)] == [4, 4, 2, 2, 1, 1]
    assert divisor_at(config(steps=0), 0) == 1
