"""The program where little is as usual: no home, no locale, no terminal, odd names, nobody who reads."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tsplat.cli import main
from tsplat.scene import Gaussians

BARE = {"PATH": os.defpath, "PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path)), "LC_ALL": "C", "OMP_NUM_THREADS": "1"}
ALL = """
import json, sys
from tsplat.cli import main
for arguments in json.loads(sys.argv[1]):
    print("$", *arguments)
    assert main(arguments) == 0, arguments
"""


def listing(folder: Path) -> dict[str, tuple[int, int]]:
    """Size and time of each file and folder."""
    return {str(path.relative_to(folder)): (path.stat().st_size, path.stat().st_mtime_ns) for path in sorted(folder.rglob("*"))}


@pytest.fixture
def capture(capture_folder: Path, tmp_path: Path) -> Path:
    """A copy under a name with spaces and letters that are not ASCII."""
    return Path(shutil.copytree(capture_folder, tmp_path / "Füchse und Gänse, 2. Teil" / "пример"))


def test_every_command_without_home_or_locale(capture: Path, tmp_path: Path) -> None:
    """As `env -i` with LC_ALL=C leaves it, from a folder of its own, on odd names. Nothing is written but what is asked for."""
    pytest.importorskip("imageio_ffmpeg", reason="an MP4 needs imageio-ffmpeg: pip install 'tsplat[video]'")
    here, out = tmp_path / "here", capture.parent / "größer 1"
    here.mkdir()
    before = listing(capture)
    scene = out / "scene.ply"
    commands = [["fit", capture, "-o", out, "--steps", 3, "--splats", 200, "--video", 2], ["eval", scene, capture], ["info", scene],
                ["info", capture, "--json"], ["convert", scene, out / "ä b.spz"], ["compare", out, out, "-o", out / "différence"]]
    commands += [["render", scene, "--path", capture, "--frames", 2, "-o", out / f"ö 1{suffix}"] for suffix in (".png", ".gif", ".mp4")]
    done = subprocess.run([sys.executable, "-c", ALL, json.dumps([[str(word) for word in command] for command in commands])], cwd=here, env=BARE,
                          capture_output=True, timeout=120)
    assert done.returncode == 0, done.stderr.decode()
    assert done.stderr == b""                                          # no warning, and no progress bar where there is no terminal
    assert listing(capture) == before
    assert not list(here.iterdir())
    assert {path.name for path in tmp_path.iterdir()} == {"here", capture.parent.name}
    for name in ("ä b.spz", "ö 1_000.png", "ö 1_001.png", "ö 1.gif", "ö 1.mp4", "différence/view_000.png", "turntable.gif", "checkpoint.pt"):
        assert (out / name).stat().st_size > 0
    assert str(out / "ö 1.gif").encode() in done.stdout


@pytest.mark.parametrize("arguments", [["info", "{capture}"], ["--help"]])
def test_nobody_reads(arguments: list[str], capture: Path, tmp_path: Path) -> None:
    """As `| head` may leave it; with a home that cannot be written to."""
    home = tmp_path / "home"
    home.write_text("a file")
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "wb") as pipe:
        done = subprocess.run([sys.executable, "-m", "tsplat", *(a.format(capture=capture) for a in arguments)], env={**BARE, "HOME": str(home)},
                              stdout=pipe, stderr=subprocess.PIPE, timeout=120)
    assert (done.returncode, done.stderr) == (141, b"")


def test_a_terminal_gets_a_progress_line(capture_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                         capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["fit", str(capture_folder), "--steps", "2", "--splats", "200"]
    assert main([*arguments, "-o", str(tmp_path / "a")]) == 0
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert main([*arguments, "-o", str(tmp_path / "b"), "--quiet"]) == 0
    assert capsys.readouterr().err == ""
    assert main([*arguments, "-o", str(tmp_path / "c")]) == 0
    assert "PSNR" in capsys.readouterr().err


def test_names_that_the_terminal_cannot_show(tmp_path: Path) -> None:
    """A stdout of ASCII only, which raises an error for any other letter, is written to all the same."""
    Gaussians.random(5).save(tmp_path / "ä.ply")
    code = "import io, sys; sys.stdout = io.TextIOWrapper(sys.stdout.buffer, 'ascii'); from tsplat.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "convert", tmp_path / "ä.ply", tmp_path / "ö.splat"]
    done = subprocess.run(command, env=BARE, capture_output=True, timeout=120)
    assert done.returncode == 0, done.stderr.decode()
    assert rb"\xf6.splat" in done.stdout
    assert (tmp_path / "ö.splat").exists()
