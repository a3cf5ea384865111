"""`FitConfig` refuses what makes no sense, by name."""

import dataclasses
import re
from typing import Any

import pytest

from tsplat.fit import FitConfig


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
