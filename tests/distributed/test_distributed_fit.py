"""`tsplat fit` over several processes: `check_fit.py`, and real runs of torchrun."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from launch import ROOT, run_ranks

from tsplat.cli import main, torchrun
from tsplat.fit.checkpoint import read_checkpoint
from tsplat.fit.density import Schedule
from tsplat.fit.report import History
from tsplat.fit.shards import moves
from tsplat.scene import write_synthetic_capture

SECONDS = 120
"""How long torchrun may take for anything; on a quiet machine it is 5 to 10."""


@pytest.fixture(scope="session")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_synthetic_capture(tmp_path_factory.mktemp("capture"), views=8, size=(32, 24))


@pytest.mark.parametrize("ranks", [2, 3])
def test_ranks(ranks: int, capture: Path, tmp_path: Path) -> None:
    shutil.copytree(capture, tmp_path / "capture")
    run_ranks(Path(__file__).parent / "ranks.py", ranks, tmp_path, "check_fit")


def arguments(capture: Path, out: Path, *options: str) -> list[str]:
    return ["fit", str(capture), "-o", str(out), "--splats", "200", "--test-every", "4", "--checkpoint-every", "10", *options]


@contextmanager
def started(log: Path, ranks: int, command: list[str], *options: str) -> Iterator[subprocess.Popen[bytes]]:
    """`torchrun -m tsplat command`; at the end of the block torchrun and its processes are gone, whatever happened."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "reference")]), "OMP_NUM_THREADS": "1"}
    line = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={ranks}", *options, "-m", "tsplat", *command]
    with log.open("wb") as out:
        process = subprocess.Popen(line, env=environment, stdout=out, stderr=subprocess.STDOUT)
    try:
        yield process
    finally:
        if process.poll() is None:
            for worker in children(process):
                os.kill(worker, signal.SIGKILL)
            process.kill()
            process.wait()


def children(process: subprocess.Popen[bytes]) -> list[int]:
    return [int(pid) for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]


def wait_for(what: Callable[[], bool], process: subprocess.Popen[bytes], log: Path) -> None:
    end = time.monotonic() + SECONDS
    while not what():
        assert process.poll() is None, log.read_text()
        assert time.monotonic() < end, log.read_text()
        time.sleep(0.05)


def step_of(out: Path) -> int:
    """Of the last checkpoint; 0 without."""
    path = out / "checkpoint.pt"
    return int(read_checkpoint(path)["state"]["step"]) if path.exists() else 0


def test_one_process_of_torchrun_is_as_none(capture: Path, tmp_path: Path) -> None:
    """To the last bit of scene and checkpoint, which has no folder."""
    options = ["--steps", "30", "--max-splats", "250", "--background", "random"]
    assert main(arguments(capture, tmp_path / "none", *options)) == 0
    with started(tmp_path / "log", 1, arguments(capture, tmp_path / "one", *options)) as process:
        assert process.wait(SECONDS) == 0, (tmp_path / "log").read_text()
    assert (tmp_path / "one" / "scene.ply").read_bytes() == (tmp_path / "none" / "scene.ply").read_bytes()
    assert {path.name for path in (tmp_path / "one").iterdir()} == {path.name for path in (tmp_path / "none").iterdir()}
    assert not (tmp_path / "one" / "checkpoint.pt.0").exists()


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds torchrun's processes in /proc")
def test_a_rank_that_is_killed(capture: Path, tmp_path: Path) -> None:
    """The other one says what happened and where it goes on; torchrun starts both anew, and they go on there. Ctrl-C ends them as it ends one."""
    out, log = tmp_path / "out", tmp_path / "log"
    with started(log, 2, arguments(capture, out, "--steps", "1000000", "--quiet"), "--max-restarts=1") as process:
        wait_for(lambda: step_of(out) >= 20, process, log)
        workers = children(process)
        victim = next(pid for pid in workers if b"\0RANK=1\0" in Path(f"/proc/{pid}/environ").read_bytes())
        os.kill(victim, signal.SIGKILL)
        wait_for(lambda: len(children(process)) == 2 and not set(workers) & set(children(process)), process, log)
        kept = step_of(out)
        assert kept >= 20
        steps = [kept]

        def goes_on() -> bool:
            steps.append(step_of(out))
            return steps[-1] > kept

        wait_for(goes_on, process, log)
        assert steps == sorted(steps)                      # one that began anew would write its step 10
        process.send_signal(signal.SIGINT)
        assert process.wait(SECONDS) != 0
    text = log.read_text()
    path = out / "checkpoint.pt"
    said = f"tsplat: error: process 0: (ended by torchrun, as where )?another process of this fit has ended; the same command goes on from {path}, "
    assert re.search(f"{said}after step {kept}", text), text
    assert f"tsplat: stopped after step {step_of(out)} of 1000000; the same call goes on from {path}" in text
    saved = read_checkpoint(out / "checkpoint.pt")["shards"]
    assert [path.name for path in out.iterdir() if path.is_dir()] == [saved["folder"]]


def test_wrong_command_lines_under_torchrun(capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                            capsys: pytest.CaptureFixture[str]) -> None:
    for name, value in (("RANK", "0"), ("WORLD_SIZE", "2"), ("LOCAL_RANK", "0"), ("LOCAL_WORLD_SIZE", "2")):
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    for options, text in ((["--view"], "--view: expected only with one process"), (["--device", "cuda:0"], "--device: expected cpu or cuda"),
                          (["--device", "cuda"], "--device: expected a GPU for each process; got 0 for 2 here"),
                          (["--device", "meta"], "--device: expected cpu or cuda")):
        assert main(arguments(capture, tmp_path, *options)) == 2
        assert f"tsplat: error: {text}" in capsys.readouterr().err
    for command in (["view", "scene.ply"], ["info", "scene.ply"], ["render", "scene.ply", "-o", "turn.gif"]):
        assert main(command) == 2
        assert f"tsplat: error: tsplat {command[0]}: expected one process; got 2 of torchrun" in capsys.readouterr().err


def test_what_torchrun_says(monkeypatch: pytest.MonkeyPatch) -> None:
    assert (torchrun.ranks(), torchrun.rank(), torchrun.restarted()) == (1, 0, False)
    for name, value in (("RANK", "2"), ("WORLD_SIZE", "3"), ("TORCHELASTIC_RESTART_COUNT", "1")):
        monkeypatch.setenv(name, value)
    assert (torchrun.ranks(), torchrun.rank(), torchrun.restarted()) == (3, 2, True)


def test_the_backend_is_that_of_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """NCCL on GPUs, each process on its own: what can be told without one."""
    called: list[object] = []
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "set_device", called.append)
    monkeypatch.setattr(torch.distributed, "rendezvous", lambda url: iter([(torch.distributed.HashStore(), 3, 4)]))
    monkeypatch.setattr(torch.distributed, "init_process_group", lambda backend, store, rank, world_size: called.append((backend, rank, world_size)))
    monkeypatch.setattr(torch.distributed, "destroy_process_group", lambda: called.append("destroyed"))
    for name, value in (("RANK", "3"), ("WORLD_SIZE", "4"), ("LOCAL_RANK", "1")):
        monkeypatch.setenv(name, value)
    with torchrun.joined(torch.device("cuda")) as (_, device):
        assert device == torch.device("cuda", 1)
    assert called == [torch.device("cuda", 1), ("nccl", 3, 4), "destroyed"]
    called.clear()
    with torchrun.joined(torch.device("cpu")) as (_, device):
        assert device == torch.device("cpu")
    assert called == [("gloo", 3, 4), "destroyed"]


def test_when_splats_move() -> None:
    """Where the largest is 1.1 times the mean, and moving makes a difference."""
    assert [moves(sizes) for sizes in ([100], [110, 90], [0, 0, 0], [0, 0, 1])] == [False] * 4
    assert [moves(sizes) for sizes in ([111, 89], [1, 0, 0], [0, 300, 0])] == [True] * 3


def test_curves_of_several_photos_a_step() -> None:
    """A point for each interval of 2 photos that is passed, and the last."""
    history = History()
    for step in range(3, 1003, 3):
        history.add(step, 1000, 1.0, float(step), 7)
    assert [row[0] for row in history.rows[:4]] == [3, 6, 9, 12]
    assert history.rows[-1] == [1002, 1.0, 1002.0, 7]


@pytest.mark.parametrize("batch", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("others", [1, 3, 5])
@pytest.mark.parametrize("stop", [48, 49, 51, 60])
def test_every_action_is_due_once(batch: int, others: int, stop: int) -> None:
    """In a fit of 60 photos that went on with another number of ranks in between: none is left out, and the last is that of all splats."""
    step, due, parts = 0, 0, []
    while step < 60:
        count = batch if step < 25 else others
        step += count
        schedule = Schedule(7, stop, 6, count)
        due += schedule.due(step)
        parts += [schedule.part(step)] * schedule.due(step)
    assert due == len(range(12, stop, 6))
    assert parts == sorted(set(parts))
    assert parts[-1] == 1
