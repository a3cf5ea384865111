"""The commands, as a user types them."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from tsplat.cli import main
from tsplat.fit import FitConfig
from tsplat.fit.checkpoint import read_checkpoint
from tsplat.scene import Gaussians, Spheres, read_image, write_synthetic_capture

SHORT = ["--steps", "4", "--splats", "200", "--quiet"]


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A file with a grey cloud of 300 splats around (1, 2, 3)."""
    splats = Gaussians.random(300, [0.0, 1.0, 2.0], [2.0, 3.0, 4.0], generator=torch.Generator().manual_seed(0))
    torch.nn.init.constant_(splats.sh0, 0.0)
    torch.nn.init.constant_(splats.opacity_logits, 3.0)
    torch.nn.init.constant_(splats.log_scales, -2.3)
    splats.save(tmp_path / "cloud.ply")
    return tmp_path / "cloud.ply"


def run(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


def test_fit(capture_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("fit", capture_folder, "-o", tmp_path, "--downscale", 2, "--antialiased", *SHORT) == 0
    out = capsys.readouterr().out
    assert "1 held-out photos: PSNR" in out
    assert str(tmp_path / "scene.ply") in out
    config = FitConfig(**json.loads((tmp_path / "metrics.json").read_text())["config"])
    assert config == FitConfig(steps=4, splats=200, downscale=2, antialiased=True)
    assert read_image(tmp_path / "test" / "view_000.png").shape == (12, 32, 3)


def test_fit_synthetic(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    written = []

    def small(folder: Path) -> Path:
        written.append(folder)
        return write_synthetic_capture(folder, views=4, size=(32, 24))

    monkeypatch.setattr("tsplat.cli.fit.write_synthetic_capture", small)
    for _ in range(2):
        assert run("fit", "--synthetic", "-o", tmp_path, *SHORT) == 0
    assert written == [tmp_path / "capture"]                           # once
    assert "made-up scene" in capsys.readouterr().out
    assert (tmp_path / "scene.ply").exists()


def test_fit_from_the_outside_is_interrupted_and_goes_on(capture_folder: Path, tmp_path: Path) -> None:
    """The real program, stopped by a real Ctrl-C."""
    command = [sys.executable, "-m", "tsplat", "fit", capture_folder, "-o", tmp_path, "--steps", "100000", "--splats", "200",
               "--checkpoint-every", "1"]
    with subprocess.Popen(command, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}, text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        while not (tmp_path / "checkpoint.pt").exists() and process.poll() is None:
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        error = process.communicate(timeout=120)[1]
    assert process.returncode == 130
    found = re.fullmatch(r"tsplat: stopped after step (\d+) of 100000; the same call goes on from (.*)\n", error)
    assert found, error                                                    # one line: no traceback, and no progress bar in a pipe
    assert read_checkpoint(Path(found[2]))["state"]["step"] == int(found[1])


def test_config_of_a_fit_makes_it_again_and_eval_measures_it(capture_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("fit", capture_folder, "-o", tmp_path / "a", "--test-every", 4, "--background", "white", "--no-antialiased", *SHORT) == 0
    first = json.loads((tmp_path / "a" / "metrics.json").read_text())
    assert run("fit", capture_folder, "-o", tmp_path / "b", "--config", tmp_path / "a" / "config.json", "--quiet") == 0
    assert (tmp_path / "a" / "scene.ply").read_bytes() == (tmp_path / "b" / "scene.ply").read_bytes()
    assert run("fit", capture_folder, "-o", tmp_path / "c", "--config", tmp_path / "a" / "config.json", "--quiet", "--steps", 2) == 0
    again = json.loads((tmp_path / "c" / "config.json").read_text())["config"]
    assert again == {**first["config"], "steps": 2}
    capsys.readouterr()
    assert run("eval", tmp_path / "a" / "scene.ply", capture_folder, "-o", tmp_path / "again.json") == 0
    measured = json.loads((tmp_path / "again.json").read_text())
    assert measured == {key: first[key] for key in ("ssim", "mean", "images")}
    assert f"2 held-out photos: PSNR {first['mean']['psnr']:.2f} dB" in capsys.readouterr().out
    assert run("eval", tmp_path / "a" / "scene.ply", capture_folder, "--test-every", 2) == 0
    assert "4 held-out photos" in capsys.readouterr().out


def test_eval_gives_both_scores_of_a_fit_that_refined_poses(capture_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """To the last digit, from scene.ply, config.json and the photos; and the plain one alone, if that is asked for."""
    assert run("fit", capture_folder, "-o", tmp_path, "--refine-poses", "--pose-steps", 9, "--lr-poses", 3e-4, "--ssim-weight", 0.4, *SHORT) == 0
    first, said = json.loads((tmp_path / "metrics.json").read_text()), capsys.readouterr().out
    assert first["mean_with_refined_poses"]["psnr"] > first["mean"]["psnr"] + 0.01
    assert f"1 held-out photos with their poses refined: PSNR {first['mean_with_refined_poses']['psnr']:.2f} dB" in said
    (tmp_path / "checkpoint.pt").unlink()
    assert run("eval", tmp_path / "scene.ply", capture_folder, "-o", tmp_path / "again.json") == 0
    assert set(said.splitlines()[:2]) < set(capsys.readouterr().out.splitlines())
    wanted = {key: value for key, value in first.items() if key not in ("splats", "seconds", "config")}
    assert json.loads((tmp_path / "again.json").read_text()) == wanted
    assert run("eval", tmp_path / "scene.ply", capture_folder, "--no-refine-poses", "--json") == 0
    assert json.loads(capsys.readouterr().out) == {key: first[key] for key in ("ssim", "mean", "images")}


def test_render_camera(scene: Path, capture_folder: Path, tmp_path: Path) -> None:
    picture = tmp_path / "new" / "view.png"
    assert run("render", scene, "--camera", capture_folder, "--index", 3, "-o", picture) == 0
    assert read_image(picture).shape == (24, 32, 3)
    assert run("render", scene, "--camera", capture_folder, "--size", "64x48", "-o", picture) == 0
    assert read_image(picture).shape == (48, 64, 3)


@pytest.mark.parametrize("up", ["-y", "y", "z", "-x"])
def test_render_frames_the_scene(scene: Path, tmp_path: Path, up: str) -> None:
    assert run("render", scene, "--orbit", 3, "--size", "60x40", f"--up={up}", "-o", tmp_path / "turn.png") == 0
    assert sorted(path.name for path in tmp_path.glob("turn*")) == ["turn_000.png", "turn_001.png", "turn_002.png"]
    assert run("render", scene, "--size", "60x40", f"--up={up}", "-o", tmp_path / "one.png") == 0
    image = read_image(tmp_path / "one.png").float()
    assert torch.equal(image, read_image(tmp_path / "turn_000.png").float())
    assert image[15:25, 25:35].mean() > 100                            # the grey cloud is in the middle
    assert image[:, :3].mean() < 10                                    # with air around it


def test_render_background(scene: Path, tmp_path: Path) -> None:
    assert run("render", scene, "--size", "60x40", "--background", "white", "-o", tmp_path / "a.png") == 0
    assert (read_image(tmp_path / "a.png")[0, 0] == 255).all()


def test_render_no_splats(tmp_path: Path) -> None:
    Gaussians.random(0).save(tmp_path / "none.ply")
    assert run("render", tmp_path / "none.ply", "--size", "8x6", "-o", tmp_path / "none.png") == 0
    assert (read_image(tmp_path / "none.png") == 0).all()
    assert run("info", tmp_path / "none.ply") == 0


def test_info_scene(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    splats = Gaussians.load(scene)
    with torch.no_grad():
        splats.means[0] = float("nan")
    splats.save(scene)
    assert run("info", scene) == 0
    out = capsys.readouterr().out
    assert "splats   300, spherical harmonics of degree 3" in out
    assert "1 of them with NaN" in out
    opacity = next(line for line in out.splitlines() if line.startswith("opacity"))
    assert float(opacity.split()[3]) == pytest.approx(0.9526, abs=1e-4)


def test_info_capture(capture_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("info", capture_folder) == 0
    out = capsys.readouterr().out
    assert "8: 7 to train on, 1 held out" in out
    assert "32x24" in out
    assert "3000" in out


@pytest.mark.parametrize(("arguments", "message"), [
    (["fit", "{tmp}/nowhere", "-o", "{tmp}/out"], "nowhere: expected a folder"),
    (["fit", "{tmp}/empty", "-o", "{tmp}/out"], "found no capture"),
    (["fit", "{tmp}/bare", "-o", "{tmp}/out"], "a COLMAP model needs its photos"),
    (["fit", "{tmp}/spoilt", "-o", "{tmp}/out", *SHORT], ".png: expected an image"),
    (["fit", "{capture}", "-o", "{scene}"], "cloud.ply: expected a folder to write to"),
    (["fit", "{capture}", "-o", "{tmp}/out", "--steps", "-5"], "steps: expected"),
    (["fit", "{capture}", "-o", "{tmp}/out", "--device", "toaster"], "--device: expected"),
    (["fit", "{capture}", "-o", "{tmp}/out", "--primitive", "spheres", "--density", "mcmc"], "density: expected 'budget'"),
    (["fit", "{capture}", "-o", "{tmp}/out", "--config", "{scene}"], "cloud.ply: expected a config.json"),
    (["render", "{scene}", "-o", "{tmp}/a.png", "--device", "xla"], "--device: xla cannot be used here: "),
    (["convert", "{tmp}/spheres.ply", "{tmp}/a.spz"], "spheres.ply: expected Gaussians, for which these formats are; got spheres"),
    (["eval", "{scene}", "{capture}", "--test-every", "0"], "expected held-out photos; there are none with test_every = 0"),
    (["render", "{tmp}/none.ply", "-o", "{tmp}/a.png"], "none.ply: No such file"),
    (["render", "{tmp}/cut.ply", "-o", "{tmp}/a.png"], "cut.ply: truncated"),
    (["render", "{scene}", "-o", "{tmp}/a.jpg", "--size", "8x6"], "ends in .png"),
    (["render", "{scene}", "-o", "{tmp}/a.png", "--camera", "{capture}", "--index", "8"], "--index: expected 0 to 7"),
    (["render", "{scene}", "-o", "{tmp}/a.png", "--orbit", "0"], "--orbit: expected at least 1"),
    (["render", "{scene}", "-o", "{tmp}/a.png", "--fov", "180"], "--fov: expected"),
    (["info", "{tmp}/photo.jpg"], "expected a file name that ends in .ply"),
    (["info", "{tmp}/empty"], "found no capture"),
])
def test_errors_are_one_line(arguments: list[str], message: str, scene: Path, capture_folder: Path, tmp_path: Path,
                             capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    for name in ("bare", "spoilt"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "sparse").symlink_to(capture_folder / "sparse")
    photos = tmp_path / "spoilt" / "images"
    photos.mkdir()
    for photo in (capture_folder / "images").iterdir():
        (photos / photo.name).write_bytes(photo.read_bytes()[:200])    # the header only
    (tmp_path / "cut.ply").write_bytes(scene.read_bytes()[:-100])
    (tmp_path / "photo.jpg").write_bytes(b"")
    Spheres.from_points(torch.zeros(3, 3)).save(tmp_path / "spheres.ply")
    status = run(*(argument.format(tmp=tmp_path, scene=scene, capture=capture_folder) for argument in arguments))
    captured = capsys.readouterr()
    assert status == 2
    assert captured.err.startswith("tsplat: error: ")
    assert captured.err.count("\n") == 1
    assert message in captured.err


def test_too_little_memory_is_one_line(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("tsplat.cli.render.draw_layers", lambda *_, **__: torch.empty(1 << 60))
    assert run("render", scene, "-o", tmp_path / "a.png") == 2
    error = capsys.readouterr().err
    assert error.startswith("tsplat: error: not enough memory: ")
    assert error.count("\n") == 1


def test_debug_shows_where(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FileNotFoundError):
        run("info", "--debug", tmp_path / "none.ply")
    monkeypatch.setenv("TSPLAT_DEBUG", "1")
    with pytest.raises(FileNotFoundError):
        run("info", tmp_path / "none.ply")


@pytest.mark.parametrize("arguments", [[], ["fit"], ["fit", "-o", "x"], ["fit", "x", "--synthetic", "-o", "x"],
                                       ["render", "x", "-o", "x.png", "--size", "8"],
                                       ["render", "x", "-o", "x.png", "--size", "100000x8"], ["fit", "x", "-o", "x", "--sh-degree", "a"]])
def test_usage(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    assert "usage: tsplat" in capsys.readouterr().err


def test_warnings_are_one_line(capture_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "sparse").symlink_to(capture_folder / "sparse")
    (tmp_path / "images").mkdir()
    for photo in sorted((capture_folder / "images").iterdir())[1:]:
        (tmp_path / "images" / photo.name).symlink_to(photo)
    assert run("info", tmp_path) == 0
    error = capsys.readouterr().err
    assert error.startswith("tsplat: warning: ")
    assert error.count("\n") == 1
