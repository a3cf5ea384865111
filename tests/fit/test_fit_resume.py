"""Checkpoints: a fit that was killed goes on as if it had not been, and nothing is lost or written over."""

import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from compare import saved_state

import tsplat.fit.trainer
from tsplat.fit import FitConfig, Step, fit
from tsplat.fit.photos import PhotoParameters
from tsplat.scene import Capture

Make = Callable[..., FitConfig]

KILLED = """
import os, signal, sys
from tsplat.fit import FitConfig, fit

def kill(*_):
    os.kill(os.getpid(), signal.SIGKILL)

def at_step_13(step):
    if step.number == 13:
        kill()

if sys.argv[3] == "while it writes":
    import tsplat.scene.files
    replace, calls = os.replace, []
    tsplat.scene.files.os.replace = lambda *paths: kill() if len(calls) == 2 else (calls.append(1), replace(*paths))
fit(sys.argv[1], FitConfig(steps=20, splats=200, test_every=4, checkpoint_every=5, background="random"), sys.argv[2],
    progress=False, callbacks=[at_step_13] if sys.argv[3] == "between checkpoints" else [])
"""


@pytest.mark.parametrize("moment", ["between checkpoints", "while it writes"])
def test_killed_and_resumed_is_bit_equal(capture_folder: Path, config: Make, tmp_path: Path, moment: str) -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    status = subprocess.run([sys.executable, "-c", KILLED, capture_folder, killed, moment], env=environment, check=False).returncode
    assert status == -9
    assert not (killed / "scene.ply").exists()
    c = config(background="random")
    steps: list[Step] = []
    resumed = fit(capture_folder, c, killed, progress=False, callbacks=[steps.append])
    assert steps[0].number == 11                                       # the checkpoint after step 10 was the last whole one
    straight = fit(capture_folder, c, whole, progress=False)
    assert (killed / "scene.ply").read_bytes() == (whole / "scene.ply").read_bytes()
    assert resumed.qualities == straight.qualities


def test_failing_write_leaves_the_last_checkpoint(capture: Capture, config: Make, tmp_path: Path) -> None:
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill_disk(step: Step) -> None:
        if step.number == 8:
            resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limit[1]))

    try:
        with pytest.raises(OSError, match=r"checkpoint|File too large"):
            fit(capture, config(), tmp_path, progress=False, callbacks=[fill_disk])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint.pt"]
    steps: list[Step] = []
    fit(capture, config(), tmp_path, progress=False, callbacks=[steps.append])
    assert steps[0].number == 6


def test_other_config_is_refused(capture: Capture, config: Make, tmp_path: Path) -> None:
    fit(capture, config(steps=5), tmp_path, progress=False)
    before = (tmp_path / "scene.ply").read_bytes()
    with pytest.raises(ValueError, match=r"checkpoint\.pt: made with ssim_weight = 0\.2; expected 0\.5"):
        fit(capture, config(steps=5, ssim_weight=0.5), tmp_path, progress=False)
    assert (tmp_path / "scene.ply").read_bytes() == before
    fit(capture, config(steps=5, checkpoint_every=3), tmp_path, progress=False)          # decides nothing
    fit(capture, config(steps=5, ssim_weight=0.5), tmp_path, progress=False, resume=False)
    assert (tmp_path / "scene.ply").read_bytes() != before


def test_other_photos_are_refused(capture: Capture, config: Make, tmp_path: Path) -> None:
    fit(capture, config(steps=2), tmp_path, progress=False)
    capture.names[3] = "another.png"
    with pytest.raises(ValueError, match=r"checkpoint\.pt: made from other photos"):
        fit(capture, config(steps=2), tmp_path, progress=False)


@pytest.mark.parametrize("content", [b"", b"no checkpoint", "cut", "other"])
@pytest.mark.parametrize("resume", [True, False])
def test_what_is_no_checkpoint_stays(capture: Capture, config: Make, tmp_path: Path, content: bytes | str, resume: bool) -> None:
    path = tmp_path / "checkpoint.pt"
    if content == "cut":
        fit(capture, config(steps=2), tmp_path, progress=False)
        path.write_bytes(path.read_bytes()[:5000])
    elif content == "other":
        torch.save({"weights": torch.ones(3)}, path)
    else:
        path.write_bytes(content)                                      # type: ignore[arg-type]
    before = path.read_bytes()
    with pytest.raises(ValueError, match=r"checkpoint\.pt: expected a checkpoint of `tsplat fit`"):
        fit(capture, config(steps=2), tmp_path, progress=False, resume=resume)
    assert path.read_bytes() == before


def test_files_of_others_stay(capture: Capture, config: Make, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    fit(capture, config(steps=2), tmp_path, progress=False)
    assert (tmp_path / "notes.txt").read_text() == "mine"
    (tmp_path / "checkpoint.pt").unlink()
    scene = (tmp_path / "scene.ply").read_bytes()
    with pytest.raises(FileExistsError, match=r"scene\.ply: would be written over"):
        fit(capture, config(steps=3), tmp_path, progress=False)
    assert (tmp_path / "scene.ply").read_bytes() == scene
    with pytest.raises(FileExistsError, match=r"notes\.txt: expected a folder"):
        fit(capture, config(steps=2), tmp_path / "notes.txt", progress=False)


@pytest.mark.parametrize("changes", [
    {"max_splats": 300},
    {"density": "adaptive", "density_threshold": 1e-5, "reset_every": 10_500, "max_splats": 400},      # the reset is after step 7
    {"density": "mcmc", "max_splats": 250, "optimiser": "visible"},
    {"refine_poses": True, "exposure": True, "resolution_warmup": 0.6, "opacity_depth_reg": 0.01, "background": "random", "pose_steps": 2},
])
def test_everything_resumes_bit_equal(capture: Capture, config: Make, tmp_path: Path, changes: dict[str, Any]) -> None:
    """Stopped after step 7: amid a round of density control, between two checkpoints, and right after a reset."""
    def press(step: Step) -> None:
        if step.number == 7:
            os.kill(os.getpid(), signal.SIGINT)

    c = config(density_start=0.1, density_every=4, **{"density_stop": 0.9, **changes})
    with pytest.raises(KeyboardInterrupt):
        fit(capture, c, tmp_path / "stopped", progress=False, callbacks=[press])
    assert [path.name for path in (tmp_path / "stopped").iterdir()] == ["checkpoint.pt"]
    resumed = fit(capture, c, tmp_path / "stopped", progress=False)
    straight = fit(capture, c, tmp_path / "whole", progress=False)
    assert (tmp_path / "stopped" / "scene.ply").read_bytes() == (tmp_path / "whole" / "scene.ply").read_bytes()
    assert (resumed.qualities, resumed.refined) == (straight.qualities, straight.refined)
    assert saved_state(tmp_path / "stopped") == saved_state(tmp_path / "whole")


def test_parameter_of_a_photo_that_is_not_finite(capture: Capture, config: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    expose = PhotoParameters.expose

    def spoilt(self: PhotoParameters, image: torch.Tensor, photo: int) -> torch.Tensor:
        assert self.exposures is not None
        self.exposures.register_hook(lambda gradient: gradient * float("nan"))
        return expose(self, image, photo)

    monkeypatch.setattr(PhotoParameters, "expose", spoilt)
    with pytest.raises(FloatingPointError, match=r"step 1, photo view_00\d\.png: the gradient of exposures is not finite"):
        fit(capture, config(exposure=True), progress=False)


def test_failing_before_the_first_checkpoint_writes_one(capture: Capture, config: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of before the step that failed, to the last random number: what goes on from it ends as if nothing had been."""
    loss, calls = tsplat.fit.trainer.photo_loss, []

    def spoilt(*args: Any) -> torch.Tensor:
        calls.append(1)
        return loss(*args) * (float("inf") if len(calls) == 4 else 1.0)

    c = config(background="random")
    monkeypatch.setattr(tsplat.fit.trainer, "photo_loss", spoilt)
    with pytest.raises(FloatingPointError, match="step 4, photo"):
        fit(capture, c, tmp_path / "failed", progress=False)
    steps: list[Step] = []
    fit(capture, c, tmp_path / "failed", progress=False, callbacks=[steps.append])
    assert steps[0].number == 4
    fit(capture, c, tmp_path / "whole", progress=False)
    assert (tmp_path / "failed" / "scene.ply").read_bytes() == (tmp_path / "whole" / "scene.ply").read_bytes()
