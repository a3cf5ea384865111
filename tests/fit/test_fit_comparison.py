"""Images beside images, and the command that compares them."""

import json
from pathlib import Path

import pytest
import torch

from tsplat.cli import main
from tsplat.fit import FitConfig, fit
from tsplat.fit.comparison import compare
from tsplat.scene import Capture, read_image, write_image


def grey(path: Path, level: float, size: tuple[int, int] = (12, 16)) -> Path:
    path.parent.mkdir(exist_ok=True)
    write_image(path, torch.full((*size, 3), level / 255))
    return path


def test_two_images(tmp_path: Path) -> None:
    """A difference of 51/255 = 0.2 everywhere: -20 log10(0.2) dB; four times that is shown."""
    a, b, out = grey(tmp_path / "a.png", 51), grey(tmp_path / "b.png", 102), tmp_path / "new" / "out.png"
    (quality,) = compare(a, b, out).values()
    assert quality.psnr == pytest.approx(13.9794, abs=1e-4)
    assert quality.ssim < 0.9
    assert compare(a, a) == {"a.png": (100.0, pytest.approx(1.0, abs=1e-6))}
    shown = read_image(out)
    assert shown.shape == (12, 48, 3)
    assert [int(shown[5, column, 1]) for column in (3, 20, 40)] == [51, 102, 204]


def test_folders_by_name(tmp_path: Path) -> None:
    for name, level in (("x", 10), ("y", 20)):
        grey(tmp_path / "a" / f"{name}.png", level)
        grey(tmp_path / "b" / f"{name}.png", level)
    (tmp_path / "a" / "notes.txt").write_text("not an image")
    qualities = compare(tmp_path / "a", tmp_path / "b", tmp_path / "out")
    assert list(qualities) == ["x", "y"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["x.png", "y.png"]


def test_alpha_is_over_black(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", torch.tensor([1.0, 1.0, 1.0, 0.2]).expand(12, 16, 4))
    assert compare(tmp_path / "a.png", grey(tmp_path / "b.png", 51))["a.png"].psnr == 100


def test_renders_of_a_fit(capture: Capture, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Against the photos, they have the figures of the fit's own metrics, but for the 8 bits of the pictures; of two fits only the renders count."""
    for name in ("a", "b"):
        fit(capture, FitConfig(steps=8, splats=200, test_every=4), tmp_path / name, progress=False)
    for picture in (tmp_path / "a" / "test").iterdir():
        (tmp_path / "photos").mkdir(exist_ok=True)
        image = read_image(picture).float() / 255
        write_image(tmp_path / "photos" / picture.name, image[:, :image.shape[1] // 2])
    assert main(["compare", str(tmp_path / "a"), str(tmp_path / "photos"), "--json"]) == 0
    measured, metrics = json.loads(capsys.readouterr().out), json.loads((tmp_path / "a" / "metrics.json").read_text())
    assert measured["ssim"] == metrics["ssim"]
    assert measured["images"].keys() == {name.removesuffix(".png") for name in metrics["images"]}
    assert measured["mean"]["psnr"] == pytest.approx(metrics["mean"]["psnr"], abs=0.01)
    assert measured["mean"]["ssim"] == pytest.approx(metrics["mean"]["ssim"], abs=1e-3)
    for a, b in (("a", "b"), ("a/test", "b"), ("a/test/view_000.png", "b/test/view_000.png")):
        out = tmp_path / f"out{len(a)}{'.png' if a.endswith('png') else ''}"
        assert main(["compare", str(tmp_path / a), str(tmp_path / b), "-o", str(out)]) == 0
        printed = capsys.readouterr().out
        assert "PSNR 100.00 dB, SSIM 1.0000" in printed
        assert printed.splitlines()[-1] == f"{out}: A, B, and their difference, of which 0.25 is white"
        assert read_image(out if out.is_file() else out / "view_000.png").shape == (24, 96, 3)


@pytest.mark.parametrize(("a", "b", "message"), [
    ("none.png", "x.png", "none.png: expected an image or a folder of images; it does not exist"),
    ("a", "x.png", "expected two images or two folders; got one of each"),
    ("x.png", "small.png", "small.png: expected two images of one size; got 16x12 and 8x6"), ("empty", "a", "empty: expected images"),
    ("a", "less", "less: expected an image for each in the other folder; 1 missing: y"), ("less", "a", "less: expected an image for each"),
    ("twice", "a", "twice: expected one image of a name; got x.jpg and x.png"), ("notes.txt", "x.png", "notes.txt: expected an image that can be"),
])
def test_errors(tmp_path: Path, a: str, b: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("a/x.png", "a/y.png", "less/x.png", "twice/x.png", "x.png"):
        grey(tmp_path / name, 3)
    grey(tmp_path / "small.png", 3, (6, 8))
    (tmp_path / "twice" / "x.jpg").write_bytes(b"")
    (tmp_path / "notes.txt").write_bytes(b"abc")
    (tmp_path / "empty").mkdir()
    assert main(["compare", str(tmp_path / a), str(tmp_path / b)]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
