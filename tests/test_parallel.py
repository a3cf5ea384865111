"""Work on several threads: the same bits, the caller's settings, and no deadlock."""

from __future__ import annotations

import importlib
import os
import platform
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import scenes
import torch
from compare import assert_same_bits, gradients, leaves, threads
from torch import Tensor
from tsplat_reference import parallel

from tsplat import rasterize

ROOT = Path(__file__).resolve().parents[1]


def results() -> list[Tensor]:
    """Image and gradients of a scene with several groups of blocks."""
    s, cam = scenes.splats(500, seed=4), scenes.camera(2, 64, 56)
    inputs = leaves(*s[:4], scenes.sh_coefficients(500, 2))
    r = rasterize(*inputs, cam, sh_degree=2, depth="expected", antialiased=True)
    outputs = [r.image, r.alpha, r.depth]
    return [*outputs, *gradients(outputs, inputs)]


@pytest.fixture
def many_pieces(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Small pieces of work, and workers even for little of it; the names of the threads that did some."""
    names: set[str] = set()
    call = parallel._call

    def named(function: Callable[[Any], Any], item: Any) -> Any:
        names.add(threading.current_thread().name)
        return call(function, item)

    monkeypatch.setattr(parallel, "_call", named)
    small = {"walk.GROUP": 512, "walk.ALONE": 512, "walk.WORTH_WORKERS": 0, "projection.CHUNK": 64, "harmonics.CHUNK": 64}
    for name, value in small.items():
        module, constant = name.split(".")
        monkeypatch.setattr(importlib.import_module(f"tsplat_reference.{module}"), constant, value)
    return names


def test_results_have_the_same_bits_with_any_number_of_threads(many_pieces: set[str]) -> None:
    with threads(1):
        want = results()
    assert many_pieces == {threading.current_thread().name}
    for count in (2, 3):
        many_pieces.clear()
        with threads(count):
            assert_same_bits(results(), want)
            assert_same_bits(results(), want)
        assert len(many_pieces) > 1
        assert all("tsplat" in name for name in many_pieces)


def test_little_work_is_not_handed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes longer with workers; the bits are the same."""
    with threads(1):
        want = results()
    monkeypatch.setattr(parallel, "_pool", lambda count: pytest.fail("workers for 500 splats"))
    with threads(2):
        assert_same_bits(results(), want)


def test_pieces_run_on_the_workers_and_come_in_order() -> None:
    names: set[str] = set()

    def work(rows: slice) -> int:
        names.add(threading.current_thread().name)
        assert torch.get_num_threads() == 1  # torch's own threads would take the cores away
        assert not torch.is_grad_enabled()
        return rows.start

    with threads(2):
        assert parallel.map_chunks(work, 50, 3) == list(range(0, 50, 3))
        assert all("tsplat" in name for name in names)
        names.clear()
    with threads(1):
        assert parallel.map_chunks(work, 50, 3) == list(range(0, 50, 3))
        assert names == {threading.current_thread().name}


def test_the_caller_computes_on_one_thread_meanwhile() -> None:
    """Else OpenMP's threads, which spin for a while after each operation, would take the cores away from the workers."""
    with threads(2):
        with parallel.workers():
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 2


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.usefixtures("many_pieces")
def test_the_number_of_threads_is_as_before(count: int) -> None:
    with threads(count):
        results()
        assert torch.get_num_threads() == count
        seen: list[int] = []
        other = threading.Thread(target=lambda: seen.append(torch.get_num_threads()))
        other.start()
        other.join()
        assert seen == [count]                                                    # for threads yet to come, too


def fail(rows: slice) -> int:
    if rows.start == 4:
        raise RuntimeError("piece 4")
    return rows.start


@pytest.mark.parametrize("count", [1, 2])
def test_an_error_in_a_piece_reaches_the_caller_and_leaves_things_in_order(count: int) -> None:
    with threads(count):
        with pytest.raises(RuntimeError, match="piece 4"):
            parallel.map_chunks(fail, 10, 1)
        assert torch.get_num_threads() == count
        assert parallel.map_chunks(lambda rows: rows.start, 4, 1) == [0, 1, 2, 3]


def test_few_results_wait() -> None:
    """A producer far ahead of its consumer would hold them all in memory."""
    done: list[int] = []
    with threads(2), parallel.workers() as ordered_map:
        for i, _ in enumerate(ordered_map(done.append, range(40))):
            assert len(done) <= i + 1 + 4


def test_threads_of_the_caller_may_render_at_the_same_time(many_pieces: set[str]) -> None:
    want = results()
    found: dict[int, list[Tensor]] = {}

    def work(i: int) -> None:
        found[i] = results()

    running = [threading.Thread(target=work, args=(i,), daemon=True) for i in range(3)]
    with threads(2):
        for t in running:
            t.start()
        for t in running:
            t.join(60)
        assert torch.get_num_threads() == 2
    assert any("tsplat" in name for name in many_pieces)
    assert sorted(found) == [0, 1, 2]
    for mine in found.values():
        assert_same_bits(mine, want)


FORK = """
import os, sys, torch
from tsplat_reference import parallel
torch.set_num_threads(2)
work = lambda: parallel.map_chunks(lambda rows: rows.start, 6, 1)
assert work() == [0, 1, 2, 3, 4, 5]
child = os.fork()
if child == 0:
    os._exit(0 if work() == [0, 1, 2, 3, 4, 5] else 1)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_forked_process_starts_workers_of_its_own() -> None:
    """Threads do not survive a fork. (Torch's own hang after one, so a child renders with one thread, as DataLoader sets
    it.)
    """
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "reference")])}
    subprocess.run([sys.executable, "-W", "ignore", "-c", FORK], env=environment, timeout=60, check=True)


FAULTS = """
import resource, torch, tsplat_reference
torch.set_num_threads(1)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for mb in range(4, 31, 2):
    torch.ones(mb << 18)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="it is glibc whose freed memory goes back to the system")
def test_freed_memory_stays_with_the_process() -> None:
    """Arrays of 4 to 30 MB, each larger than what glibc has learnt of, are 60,900 pages, and so many faults were freed memory given back; else 8,600
    to 30,800, by what else is on the heap.
    """
    environment = {**{k: v for k, v in os.environ.items() if not k.startswith(("MALLOC_", "GLIBC_"))},
                   "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "reference")])}
    run = subprocess.run([sys.executable, "-W", "ignore", "-c", FAULTS], env=environment, timeout=60, check=True, capture_output=True, text=True)
    assert int(run.stdout) < 45_000
