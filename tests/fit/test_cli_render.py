"""`tsplat render`: views, modes, and what is written."""

from pathlib import Path

import pytest
import torch

from tsplat.cli import main
from tsplat.scene import Gaussians, Spheres, read_image


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Opaque grey splats in a cube around (0, -0.5, 0)."""
    splats = Gaussians.random(400, [-0.5, -1.0, -0.5], [0.5, 0.0, 0.5], 0, generator=torch.Generator().manual_seed(0))
    torch.nn.init.constant_(splats.opacity_logits, 3.0)
    torch.nn.init.constant_(splats.log_scales, -2.8)
    path = tmp_path_factory.mktemp("scene") / "cloud.ply"
    splats.save(path)
    return path


def run(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


@pytest.mark.parametrize("kind", ["gaussians", "spheres"])
def test_modes(scene: Path, tmp_path: Path, kind: str) -> None:
    if kind == "spheres":
        ball = Spheres(torch.tensor([[0.0, -0.5, 0.0]]), torch.zeros(1), torch.full((1,), 9.0), torch.full((1, 3), 0.5), gamma=1e-3, far=9.0)
        ball.save(tmp_path / "ball.ply")
        scene = tmp_path / "ball.ply"
    pictures = {}
    for mode in ("color", "depth", "alpha", "normals"):
        assert run("render", scene, "--size", "40x30", "--mode", mode, "-o", tmp_path / f"{mode}.png") == 0
        pictures[mode] = read_image(tmp_path / f"{mode}.png").float() / 255
        assert not pictures[mode][0, 0].any()                                              # nothing there
    assert pictures["alpha"][15, 20, 0] > 0.9
    red, green, blue = pictures["normals"][15, 20]
    assert blue > 0.7                                                                      # towards the camera
    assert (pictures["depth"][15, 20, 2] < pictures["depth"][15, 20, 1]) or kind == "gaussians"      # near: yellow or green, not violet
    assert len({tuple(p.flatten().tolist()) for p in pictures.values()}) == 4


def test_depth_range_and_transparent(scene: Path, tmp_path: Path) -> None:
    arguments = ("render", scene, "--size", "40x30", "--mode", "depth")
    assert run(*arguments, "--depth-range", 100, 200, "-o", tmp_path / "near.png") == 0
    assert read_image(tmp_path / "near.png")[15, 20].tolist() == pytest.approx([253, 231, 37], abs=25)       # yellow, at 0.95 of opacity
    assert run(*arguments, "--background", "transparent", "-o", tmp_path / "clear.png") == 0
    clear = read_image(tmp_path / "clear.png")
    assert clear.shape == (30, 40, 4)
    assert clear[0, 0, 3] == 0
    assert clear[15, 20, 3] > 200


def test_one_range_for_all_pictures(scene: Path, tmp_path: Path) -> None:
    """What is near from the one side and far from the other is so in both pictures: the first is not as it is alone, with a range of its own."""
    splats = Gaussians.load(scene)
    with torch.no_grad():
        splats.means[:40, 2] += 3.0
    splats.save(tmp_path / "deep.ply")
    assert run("render", tmp_path / "deep.ply", "--orbit", 2, "--size", "40x30", "--mode", "depth", "-o", tmp_path / "d.png") == 0
    assert run("render", tmp_path / "deep.ply", "--size", "40x30", "--mode", "depth", "-o", tmp_path / "alone.png") == 0
    assert sorted(path.name for path in tmp_path.glob("d_*")) == ["d_000.png", "d_001.png"]
    assert not torch.equal(read_image(tmp_path / "d_000.png"), read_image(tmp_path / "alone.png"))


def test_clips_along_a_path(scene: Path, capture_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = ("--path", capture_folder, "--frames", 5)
    assert run("render", scene, *path, "--closed", "-o", tmp_path / "new" / "a.gif", "--fps", 10, "--background", "white") == 0
    data = (tmp_path / "new" / "a.gif").read_bytes()
    assert data.count(b"\x21\xF9\x04") == 5
    assert data[6:10] == bytes([32, 0, 24, 0])
    captured = capsys.readouterr()
    assert captured.out == f"{tmp_path / 'new' / 'a.gif'}\n"
    assert captured.err == ""                                                              # no progress bar where there is no terminal
    assert run("render", scene, *path, "--size", "16x12", "--mode", "normals", "-o", tmp_path / "p.png") == 0
    assert sorted(p.name for p in tmp_path.glob("p_*")) == [f"p_{i:03d}.png" for i in range(5)]
    assert read_image(tmp_path / "p_004.png").shape == (12, 16, 3)
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="an MP4 needs imageio-ffmpeg: pip install 'tsplat[video]'")
    assert run("render", scene, "--orbit", 3, "--size", "41x31", "-o", tmp_path / "a.mp4") == 0
    reader = ffmpeg.read_frames(str(tmp_path / "a.mp4"))
    assert next(reader)["size"] == (40, 30)
    assert len(list(reader)) == 3


@pytest.mark.parametrize(("arguments", "message"), [
    (["-o", "{tmp}/a.avi"], "a.avi: expected a file name that ends in .png, .gif or .mp4; got '.avi'"),
    (["-o", "{tmp}/a.png", "--index", "1"], "--index: expected only with --camera"), (["-o", "{tmp}/a.png", "--frames", "9"], "--frames: expected"),
    (["-o", "{tmp}/a.png", "--closed"], "--closed: expected only with --path"), (["-o", "{tmp}/a.png", "--fps", "9"], "--fps: expected only"),
    (["-o", "{tmp}/a.gif", "--background", "transparent"], "--background transparent: expected only with PNG"),
    (["-o", "{tmp}/a.png", "--depth-range", "1", "2"], "--depth-range: expected only with --mode depth"),
    (["-o", "{tmp}/a.png", "--mode", "depth", "--depth-range", "2", "1"], "--depth-range: expected 0 <= NEAR < FAR; got [2.0, 1.0]"),
    (["-o", "{tmp}/a.png", "--path", "{capture}", "--frames", "0"], "--frames: expected at least 1; got 0"),
    (["-o", "{tmp}/a.gif", "--fps", "1000"], "fps: expected above 0 and up to 100"),
])
def test_errors(scene: Path, capture_folder: Path, tmp_path: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("render", scene, *(argument.format(tmp=tmp_path, capture=capture_folder) for argument in arguments)) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())
