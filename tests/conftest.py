"""Shared by all tests: where the data is, where the ops run, and what every test starts from."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import torch

if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")      # read when Triton is imported, which torch.compile does, too

import pytest
from backends import BACKENDS, Backend

HERE = Path(__file__).resolve().parent


@pytest.fixture(params=BACKENDS)
def backend(request: pytest.FixtureRequest) -> Backend:
    """Each backend in turn: a test that takes this runs on all of them."""
    return BACKENDS[request.param]


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of recorded results and real inputs; skips the test where it is absent."""
    root = Path(os.environ.get("TSPLAT_DATA", HERE.parent.parent / "shared"))
    if not (root / "golden").is_dir():
        pytest.skip(f"no test data in {root}: set TSPLAT_DATA to the folder that holds golden/ and data/")
    return root


@pytest.fixture(autouse=True)
def _same_start(request: pytest.FixtureRequest) -> Iterator[None]:
    """The same seed for every test, whatever ran before, and one thread for those of this folder.

    Their arrays are small, and a second thread would wait in loops; `test_parallel.py` and tests of chunks take more
    explicitly.
    """
    torch.manual_seed(0)
    threads = torch.get_num_threads()
    if request.path.parent == HERE:
        torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
