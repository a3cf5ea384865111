"""`fit` end to end on a tiny capture: it learns, it writes what it says, and it survives odd input."""

import json
import os
import re
import signal
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

import tsplat.fit.trainer
from tsplat.fit import FitConfig, Step, fit
from tsplat.fit.losses import SSIM_NAME
from tsplat.fit.output import read_config
from tsplat.fit.trainer import start, train_step
from tsplat.scene import Capture, Gaussians, load_capture, read_image, write_image, write_synthetic_capture

Make = Callable[..., FitConfig]


def test_loss_falls_and_held_out_views_improve(capture: Capture, config: Make) -> None:
    steps: list[Step] = []
    result = fit(capture, config(steps=30), progress=False, callbacks=[steps.append])
    assert [step.number for step in steps] == list(range(1, 31))
    assert sum(s.loss for s in steps[-6:]) < 0.8 * sum(s.loss for s in steps[:6])
    before = fit(capture, config(steps=0), progress=False).mean
    assert before is not None
    assert result.mean is not None
    assert result.mean.psnr > before.psnr + 1
    assert result.mean.ssim > before.ssim
    assert result.seconds > 0


def test_every_photo_once_per_round(capture: Capture, config: Make) -> None:
    photos: list[str] = []
    fit(capture, config(steps=12), progress=False, callbacks=[lambda step: photos.append(step.photo)])
    train = sorted(capture.names[i] for i in capture.train)
    assert len(train) == 6
    assert sorted(photos[:6]) == sorted(photos[6:]) == train
    assert photos[:6] != photos[6:]


def test_what_is_written(capture_folder: Path, config: Make, tmp_path: Path) -> None:
    out = tmp_path / "new" / "out"
    c = config(steps=6)
    result = fit(capture_folder, c, out, progress=False)
    assert sorted(path.name for path in out.iterdir()) == [
        "checkpoint.pt", "config.json", "contact.png", "curves.png", "metrics.json", "scene.ply", "test"]
    assert torch.equal(Gaussians.load(out / "scene.ply").means, result.gaussians.means)
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["ssim"] == SSIM_NAME
    assert FitConfig(**metrics["config"]) == read_config(out / "config.json") == c
    assert set(metrics["images"]) == {"view_000.png", "view_004.png"}
    for measure in ("psnr", "ssim"):
        values = [image[measure] for image in metrics["images"].values()]
        assert metrics["mean"][measure] == pytest.approx(sum(values) / 2)
    assert result.mean is not None
    assert metrics["mean"]["psnr"] == result.mean.psnr
    beside = read_image(out / "test" / "view_004.png")
    assert beside.shape == (24, 64, 3)
    assert torch.equal(beside[:, :32], read_image(capture_folder / "images" / "view_004.png"))


def test_same_seed_same_scene(capture: Capture, config: Make) -> None:
    first, again, other = (fit(capture, config(steps=5, seed=s), progress=False).gaussians.means for s in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_finished_fit_is_only_evaluated_again(capture: Capture, config: Make, tmp_path: Path) -> None:
    c = config(steps=5)
    first = fit(capture, c, tmp_path, progress=False)
    scene = (tmp_path / "scene.ply").read_bytes()
    (tmp_path / "scene.ply").unlink()
    steps: list[Step] = []
    again = fit(capture, c, tmp_path, progress=False, callbacks=[steps.append])
    assert not steps
    assert again.qualities == first.qualities
    assert (tmp_path / "scene.ply").read_bytes() == scene
    fit(capture, c, tmp_path, progress=False, callbacks=[steps.append], resume=False)
    assert len(steps) == 5


def test_no_splats(capture: Capture, config: Make, tmp_path: Path) -> None:
    capture.points = None
    result = fit(capture, config(splats=0), tmp_path, progress=False)
    assert len(result.gaussians) == 0
    assert result.mean is not None
    assert result.mean.psnr < 20                                      # a black picture
    again = fit(capture, config(splats=0), tmp_path, progress=False)
    assert again.qualities == result.qualities


def test_one_pixel(config: Make, tmp_path: Path) -> None:
    folder = write_synthetic_capture(tmp_path / "capture", views=4, size=(1, 1))
    result = fit(folder, config(steps=10), tmp_path / "out", progress=False)
    assert len(result.qualities) == 1
    assert read_image(tmp_path / "out" / "test" / "view_000.png").shape == (1, 2, 3)


def test_nothing_held_out_and_everything_held_out(capture_folder: Path, config: Make, tmp_path: Path) -> None:
    result = fit(capture_folder, config(steps=2, test_every=0), tmp_path, progress=False)
    assert result.mean is None
    assert json.loads((tmp_path / "metrics.json").read_text())["mean"] is None
    with pytest.raises(ValueError, match=r"data: expected photos to train on; all 8 are held out"):
        fit(capture_folder, config(test_every=1), progress=False)


@pytest.mark.parametrize("background", ["black", "white", "random"])
def test_photos_with_alpha(capture: Capture, capture_folder: Path, config: Make, tmp_path: Path, background: str) -> None:
    images = tmp_path / "images"
    images.mkdir()
    for name in capture.names:
        photo = read_image(capture_folder / "images" / name) / 255
        write_image(images / name, torch.cat([photo, (photo.amax(2, keepdim=True) > 0).float()], dim=2))
    (tmp_path / "sparse").symlink_to(capture_folder / "sparse")
    rgba = load_capture(tmp_path, test_every=4)
    assert rgba.images[0].shape[2] == 4
    first, last = (fit(rgba, config(steps=n, background=background), tmp_path / f"out{n}", progress=False).mean for n in (0, 20))
    assert first is not None
    assert last is not None
    assert last.psnr > first.psnr
    corner = read_image(tmp_path / "out20" / "test" / "view_000.png")[0, 0]             # sky: transparent
    assert (corner == (0 if background == "black" else 255)).all()


def test_masks_are_left_out(capture: Capture, capture_folder: Path, config: Make, tmp_path: Path) -> None:
    """Photos spoilt where they are masked give the same fit."""
    results = []
    for spoil in (False, True):
        folder = tmp_path / str(spoil)
        for name in ("images", "masks"):
            (folder / name).mkdir(parents=True)
        for name in capture.names:
            photo, mask = read_image(capture_folder / "images" / name) / 255, torch.ones(24, 32, 1)
            mask[:, 20:] = 0
            write_image(folder / "images" / name, torch.where(mask == 0, 1.0, photo) if spoil else photo)
            write_image(folder / "masks" / name, mask)
        (folder / "sparse").symlink_to(capture_folder / "sparse")
        masked = load_capture(folder, test_every=4)
        assert masked.masked
        results.append(fit(masked, config(), progress=False))
    assert torch.equal(results[0].gaussians.means, results[1].gaussians.means)
    assert results[0].qualities == results[1].qualities


def test_loss_that_is_not_finite(capture: Capture, config: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loss = tsplat.fit.trainer.photo_loss
    calls = []

    def spoilt(*args: object) -> torch.Tensor:
        calls.append(1)
        return loss(*args) * (float("nan") if len(calls) == 9 else 1.0)             # type: ignore[arg-type]

    monkeypatch.setattr(tsplat.fit.trainer, "photo_loss", spoilt)
    with pytest.raises(FloatingPointError, match=r"step 9, photo view_00\d\.png: the loss is nan; expected"):
        fit(capture, config(), tmp_path, progress=False)
    monkeypatch.undo()
    steps: list[Step] = []
    fit(capture, config(), tmp_path, progress=False, callbacks=[steps.append])
    assert steps[0].number == 6                                        # from the checkpoint after step 5


def test_gradient_that_is_not_finite(capture: Capture, config: Make) -> None:
    def spoil(step: Step) -> None:
        if step.number == 3:
            step.gaussians.log_scales.register_hook(lambda gradient: gradient * float("inf"))

    with pytest.raises(FloatingPointError, match=r"step 4, photo view_00\d\.png: the gradient of log_scales is not finite"):
        fit(capture, config(), progress=False, callbacks=[spoil])


def test_photo_that_cannot_be_read_takes_no_turn(capture: Capture, config: Make) -> None:
    """The same photo, and the same random background, are next."""
    class Broken:
        def __getitem__(self, view: int) -> torch.Tensor:
            raise OSError("view_001.png: no such file")

        def prepare(self, view: int) -> None: ...

    c = config(background="random")
    state = start(capture, c, torch.device("cpu"))
    for _ in range(3):
        before = list(state.queue), state.generator.get_state(), state.step
        with pytest.raises(OSError, match="no such file"):
            train_step(state, capture, c, Broken())             # type: ignore[arg-type]
        assert (state.queue, state.step) == (before[0], before[2])
        assert torch.equal(state.generator.get_state(), before[1])
        train_step(state, capture, c)


def test_interrupt_saves_and_says_how_to_go_on(capture: Capture, config: Make, tmp_path: Path) -> None:
    def press(step: Step) -> None:
        if step.number == 7:
            os.kill(os.getpid(), signal.SIGINT)

    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt, match=r"stopped after step 7 of 20; .* goes on from .*checkpoint\.pt"):
        fit(capture, config(), tmp_path / "stopped", progress=False, callbacks=[press])
    assert signal.getsignal(signal.SIGINT) is handler
    assert not (tmp_path / "stopped" / "scene.ply").exists()
    steps: list[Step] = []
    fit(capture, config(), tmp_path / "stopped", progress=False, callbacks=[steps.append])
    assert steps[0].number == 8
    fit(capture, config(), tmp_path / "whole", progress=False)
    assert (tmp_path / "stopped" / "scene.ply").read_bytes() == (tmp_path / "whole" / "scene.ply").read_bytes()


def test_second_interrupt_stops_at_once(capture: Capture, config: Make) -> None:
    def press_twice(_step: Step) -> None:
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt, match=r"^$"):
        fit(capture, config(), progress=False, callbacks=[press_twice])


def test_in_another_thread(capture: Capture, config: Make) -> None:
    results = []
    thread = threading.Thread(target=lambda: results.append(fit(capture, config(steps=2), progress=False)))
    thread.start()
    thread.join()
    assert len(results) == 1


def test_progress_line(capture: Capture, config: Make, capsys: pytest.CaptureFixture[str]) -> None:
    fit(capture, config(steps=3))
    last = capsys.readouterr().err.rpartition("\r")[2]
    assert re.search(r"3/3 \[\d\d:\d\d<\d\d:\d\d, .*loss 0\.\d+, PSNR [\d.]+ dB, 200 splats", last)       # < the time that is left
    fit(capture, config(steps=3), progress=False)
    assert capsys.readouterr().err == ""
