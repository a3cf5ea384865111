"""Shared by all tests: where the data is, where the ops run, and what every test starts from."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")           # arrays are small, and several processes of pytest-xdist share the cores

import torch

if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")      # read when Triton is imported, which torch.compile does, too

import pytest
from backends import BACKENDS, KERNELS, Backend

from tsplat.rasterize import TILE
from tsplat.scene import Capture, load_capture, write_synthetic_capture

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:           # as in the background of a shell; programs that tests start would ignore it, too
    signal.signal(signal.SIGINT, signal.default_int_handler)

HERE = Path(__file__).resolve().parent


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """A test that takes `backend` runs on all of them, or without the interpreter where its module says that this takes too long."""
    if "backend" in metafunc.fixturenames:
        slow = getattr(metafunc.module, "WITHOUT_INTERPRETER", False)
        metafunc.parametrize("backend", [name for name in BACKENDS if not (slow and name == "interpreter")], indirect=True)


@pytest.fixture
def backend(request: pytest.FixtureRequest) -> Iterator[Backend]:
    """Where the ops run in this test. Of a test with tiles of several sizes, the kernels run the one with theirs."""
    tile = request.node.callspec.params.get("tile", TILE)
    if request.param == KERNELS.name and tile != TILE:
        pytest.skip(f"the kernels have tiles of {TILE} pixels; got {tile}")
    with BACKENDS[request.param].active() as backend:
        yield backend


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of recorded results and real inputs; skips the test where it is absent."""
    root = Path(os.environ.get("TSPLAT_DATA", HERE.parent.parent / "shared"))
    if not (root / "golden").is_dir():
        pytest.skip(f"no test data in {root}: set TSPLAT_DATA to the folder that holds golden/ and data/")
    return root


@pytest.fixture(autouse=True)
def _same_start() -> None:
    """The same seed for every test, whatever ran before. (`test_parallel.py` and tests of chunks take more threads than one explicitly.)"""
    torch.manual_seed(0)


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
