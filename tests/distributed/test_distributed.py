"""Several processes on a CPU, over gloo: `check_*.py`. And what can be told from one."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import scenes
import torch
import torch.distributed as dist
from launch import run_ranks

from tsplat import rasterize
from tsplat.compat.gsplat import rasterization
from tsplat.distributed.collectives import check_device

WAITS = "import sys, time\nif sys.argv[1] == '1': sys.exit('this is the end')\ntime.sleep(100)"


@pytest.mark.parametrize(("ranks", "modules"), [(2, ["images", "agreement", "gsplat", "compile"]), (3, ["images", "agreement", "gsplat"])])
def test_ranks(ranks: int, modules: list[str], tmp_path: Path) -> None:
    run_ranks(Path(__file__).parent / "ranks.py", ranks, tmp_path, *(f"check_{m}" for m in modules))


def test_a_process_that_dies_ends_the_others(tmp_path: Path) -> None:
    (tmp_path / "waits.py").write_text(WAITS)
    with pytest.raises(AssertionError, match=r"exit codes \[None, 1\](.|\n)*rank 1: this is the end"):
        run_ranks(tmp_path / "waits.py", 2, tmp_path)


def test_a_process_that_hangs_is_ended(tmp_path: Path) -> None:
    (tmp_path / "waits.py").write_text(WAITS)
    with pytest.raises(AssertionError, match=r"exit codes \[None\]"):
        run_ranks(tmp_path / "waits.py", 1, tmp_path, seconds=0.5)


@pytest.fixture
def world(tmp_path: Path) -> Iterator[Any]:
    """A default group of this process alone."""
    dist.init_process_group("gloo", init_method=f"file://{tmp_path / 'store'}", rank=0, world_size=1)
    yield dist.group.WORLD
    dist.destroy_process_group()


def test_a_backend_that_does_not_move_tensors_of_the_device(world: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    for config, device, good in (("cpu:gloo,cuda:gloo", "cpu", True), ("cpu:gloo,cuda:gloo", "cuda", False), ("cuda:nccl", "cuda", True),
                                 ("cuda:nccl", "cpu", False), ("cpu:gloo,cuda:nccl", "cuda", True), ("cpu:gloo,cuda:nccl", "cpu", True)):
        monkeypatch.setattr(dist, "get_backend_config", lambda _, config=config: config)
        if good:
            check_device(world, torch.device(device))
        else:
            with pytest.raises(ValueError, match=f"^group: expected a backend for tensors on '{device}'.*got '{config}'$"):
                check_device(world, torch.device(device))


def test_what_is_not_a_group() -> None:
    splats, camera = scenes.splats(3), scenes.camera()
    for wrong in ("nccl", 0, dist.group.WORLD or object()):                 # WORLD is None before init_process_group
        with pytest.raises(TypeError, match=r"^group: expected a torch.distributed.ProcessGroup"):
            rasterize(*splats, camera, group=wrong)                         # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"^group: expected .*after init_process_group.*got NoneType$"):
        rasterization(*splats, camera.viewmats[None], camera.Ks[None], camera.width, camera.height, distributed=True)


def test_the_drop_in_for_gsplat_on_one_rank(world: Any) -> None:
    """To the bit, and with lists of tiles."""
    camera = scenes.camera(2)
    args = *scenes.splats(12), camera.viewmats, camera.Ks, camera.width, camera.height
    (want, _, _), (got, _, meta) = rasterization(*args), rasterization(*args, distributed=True)
    assert torch.equal(got, want)
    assert len(meta["isect_ids"])
