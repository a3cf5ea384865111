"""Shared by the tests of `tsplat.fit` and of the command line: a tiny capture, and a config that goes with it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tsplat.fit import FitConfig
from tsplat.scene import Capture, load_capture, write_synthetic_capture


@pytest.fixture(scope="session")
def capture_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """8 photos of 32x24 with 3000 points."""
    return write_synthetic_capture(tmp_path_factory.mktemp("capture"), views=8, size=(32, 24))


@pytest.fixture
def capture(capture_folder: Path) -> Capture:
    """The same, loaded, with 200 of the points; photos 0 and 4 are held out."""
    capture = load_capture(capture_folder, test_every=4)
    assert capture.points is not None
    assert capture.point_colors is not None
    capture.points, capture.point_colors = capture.points[:200], capture.point_colors[:200]
    return capture


@pytest.fixture(scope="session")
def config() -> Callable[..., FitConfig]:
    """A function that makes a config for a short fit."""

    def make(**changes: Any) -> FitConfig:
        return FitConfig(**{"steps": 20, "splats": 200, "test_every": 4, "checkpoint_every": 5, **changes})

    return make
