"""`FitConfig` refuses what makes no sense, by name."""

import dataclasses
import re
from typing import Any

import pytest

from tsplat.fit import FitConfig
from tsplat.fit.schedules import regulariser_weights


@pytest.mark.parametrize(("field", "value"), [
    ("steps", -1), ("downscale", 0.5), ("downscale", float("inf")), ("lr_means", float("nan")), ("lr_scales", -1e-3),
    ("sh_degree", 5), ("sh_warmup", 1.5), ("init_opacity", 0.0), ("background", "green"), ("checkpoint_every", 0),
])
def test_bad_value(field: str, value: Any) -> None:
    with pytest.raises(ValueError, match=rf"^{field}: expected .*; got {re.escape(repr(value))}$"):
        FitConfig(**{field: value})


@pytest.mark.parametrize(("field", "value"), [("steps", 1.5), ("steps", True), ("antialiased", 1), ("lr_means", "1e-3")])
def test_bad_type(field: str, value: Any) -> None:
    with pytest.raises(TypeError, match=rf"^{field}: expected .*; got {re.escape(repr(value))}$"):
        FitConfig(**{field: value})


def test_fields_are_documented_and_fixed() -> None:
    config = FitConfig(downscale=2)
    assert all(item.metadata["help"] for item in dataclasses.fields(config))
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.steps = 3            # type: ignore[misc]


@pytest.mark.parametrize(("config", "random_start", "opacity", "scale"), [
    ({}, True, 0.01, 0.0), ({}, False, 0.0, 0.0), ({"density": "mcmc"}, False, 0.01, 0.01), ({"density": "mcmc"}, True, 0.01, 0.01),
    ({"density": "adaptive"}, True, 0.0, 0.0), ({"primitive": "spheres"}, True, 0.0, 0.0), ({"opacity_reg": 0.0}, True, 0.0, 0.0),
    ({"density": "adaptive", "opacity_reg": 0.3, "scale_reg": 0.2}, False, 0.3, 0.2)])
def test_regularisers_end_with_density_control(config: dict[str, Any], random_start: bool, opacity: float, scale: float) -> None:
    chosen = FitConfig(steps=100, density_stop=0.4, opacity_depth_reg=0.5, **config)
    for step in (0, 39):
        assert regulariser_weights(chosen, step, random_start=random_start) == {"opacity": opacity, "scale": scale, "opacity_depth": 0.5}
    for step in (40, 99):
        assert regulariser_weights(chosen, step, random_start=random_start) == {"opacity": 0.0, "scale": 0.0, "opacity_depth": 0.5}


def test_regularisers_end_at_half_the_steps_where_density_control_goes_on() -> None:
    chosen = FitConfig(steps=100, density="mcmc")
    assert chosen.value("density_stop") == 5 / 6
    assert [regulariser_weights(chosen, step, random_start=False)["opacity"] for step in (0, 49, 50, 99)] == [0.01, 0.01, 0, 0]


def test_regularisers_without_density_control_go_on() -> None:
    assert regulariser_weights(FitConfig(steps=10, density="none", opacity_reg=0.1), 9, random_start=False)["opacity"] == 0.1
