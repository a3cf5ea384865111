"""Shared by the tests of `tsplat.fit` and of the command line: a config for the tiny capture."""

from collections.abc import Callable
from typing import Any

import pytest

from tsplat.fit import FitConfig


@pytest.fixture(scope="session")
def config() -> Callable[..., FitConfig]:
    """A function that makes a config for a short fit."""

    def make(**changes: Any) -> FitConfig:
        return FitConfig(**{"steps": 20, "splats": 200, "test_every": 4, "checkpoint_every": 5, **changes})

    return make
