"""`tsplat view` and `tsplat fit --view`, as a user types them."""

import errno
import os
import re
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from tsplat.cli import main
from tsplat.scene import Gaussians, Spheres

needs_viser = pytest.mark.skipif(find_spec("viser") is None, reason="the viewer's page needs viser: pip install 'tsplat[viewer]'")
SHORT = ["--steps", "4", "--splats", "200", "--quiet"]


@pytest.fixture
def scene(gaussians: Gaussians, tmp_path: Path) -> Path:
    gaussians.save(tmp_path / "scene.ply")
    return tmp_path / "scene.ply"


def run(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


@contextmanager
def program(*arguments: object) -> Iterator[subprocess.Popen[str]]:
    """The real one."""
    command = [sys.executable, "-m", "tsplat", *map(str, arguments)]
    with subprocess.Popen(command, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}, text=True, stdout=subprocess.PIPE,
                          stderr=subprocess.PIPE) as process:
        yield process


@needs_viser
@pytest.mark.parametrize("options", [[], ["--up=z", "--background", "white"], ["--data"]])
def test_view_says_where_serves_the_page_and_ends_by_ctrl_c(options: list[str], scene: Path, capture_folder: Path) -> None:
    if options == ["--data"]:
        options = ["--data", str(capture_folder)]
    with program("view", scene, "--port", 0, *options) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        found = re.fullmatch(rf"{re.escape(str(scene))} is at (http://127\.0\.0\.1:(\d+)) \(Ctrl-C to end\)\n", line)
        assert found
        with urllib.request.urlopen(found[1]) as response:
            assert b"<html" in response.read()
        with pytest.raises(OSError):                                   # at this address alone
            socket.create_connection(("127.0.0.2", int(found[2])), timeout=5)
        process.send_signal(signal.SIGINT)
        out, error = process.communicate(timeout=120)
    assert (process.returncode, out, error) == (130, "", "tsplat: interrupted\n")


@needs_viser
def test_the_cores_are_left_to_the_thread_that_draws(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """See `tsplat_reference.parallel.single_threaded`: 100,000 splats took twice as long after the main thread had used both."""
    threads: list[int] = []

    def load(path: str) -> Gaussians:
        threads.append(torch.get_num_threads())
        return Gaussians.load(path)

    def look(*_: object) -> None:
        threads.append(torch.get_num_threads())
        raise ValueError("scene: seen enough")

    monkeypatch.setattr("tsplat.cli.view.load_scene", load)
    monkeypatch.setattr("tsplat.cli.view.draw_view", look)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        assert run("view", scene, "--port", 0) == 2
        assert (threads, torch.get_num_threads()) == ([1, 1], 2)
    finally:
        torch.set_num_threads(before)


@needs_viser
@pytest.mark.parametrize(("options", "message"), [
    (["--port", "65536"], "port: expected 0 (any) to 65535; got 65536"),
    (["--port", "0", "--host", "203.0.113.1"], "host, port: cannot listen at 203.0.113.1, port 0: "),
    (["--data", "nowhere"], "nowhere: expected a folder"),
])
def test_errors_are_one_line(options: list[str], message: str, scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("view", scene, *options) == 2
    error = capsys.readouterr().err
    assert error.startswith("tsplat: error: ")
    assert error.count("\n") == 1
    assert message in error


@needs_viser
def test_a_port_in_use(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        assert run("view", scene, "--port", port) == 2
    assert capsys.readouterr().err == f"tsplat: error: host, port: cannot listen at 127.0.0.1, port {port}: {os.strerror(errno.EADDRINUSE)}\n"


@needs_viser
def test_what_cannot_be_drawn_is_an_error(spheres: Spheres, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Spheres(spheres.positions, spheres.log_radii, spheres.opacity_logits, torch.rand(50, 5)).save(tmp_path / "five.ply")
    assert run("view", tmp_path / "five.ply", "--port", 0) == 2
    assert "expected spheres of 1 or 3 channels" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["view", "fit"])
def test_without_viser_the_error_names_the_extra(command: str, scene: Path, capture_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                                 capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("tsplat.viewer.page", "tsplat.viewer.controls"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setitem(sys.modules, "viser", None)
    arguments = [scene] if command == "view" else [capture_folder, "-o", tmp_path / "out", "--view", *SHORT]
    assert run(command, *arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("tsplat: error: the viewer needs the package viser: pip install 'tsplat[viewer]'")
    assert error.count("\n") == 1


@needs_viser
def test_a_fit_with_a_page_that_nobody_opens_is_a_fit(capture_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("fit", capture_folder, "-o", tmp_path / "a", "--view", "--view-port", 0, *SHORT) == 0
    out = capsys.readouterr().out
    assert "the fit can be watched at http://127.0.0.1:" in out
    assert "the page stays" not in out
    assert run("fit", capture_folder, "-o", tmp_path / "b", *SHORT) == 0
    assert (tmp_path / "a" / "scene.ply").read_bytes() == (tmp_path / "b" / "scene.ply").read_bytes()
    assert run("fit", capture_folder, "-o", tmp_path / "c", "--view-port", 0, *SHORT) == 2
    assert "--view-port: expected only with --view" in capsys.readouterr().err


@needs_viser
@pytest.mark.parametrize("ctrl_c", [False, True])
def test_a_page_that_is_open_stays_after_the_fit(ctrl_c: bool, capture_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                                 capsys: pytest.CaptureFixture[str]) -> None:
    from tsplat.viewer.page import Page

    looks = iter([True, True, False])

    def sleep(seconds: float) -> None:
        if ctrl_c:
            raise KeyboardInterrupt

    monkeypatch.setattr(Page, "visited", property(lambda page: next(looks)))
    monkeypatch.setattr("tsplat.cli.fit.time", SimpleNamespace(sleep=sleep))
    assert run("fit", capture_folder, "-o", tmp_path, "--view", "--view-port", 0, *SHORT) == 0
    assert capsys.readouterr().out.endswith("the page stays until it is closed (or Ctrl-C)\n")
    assert (next(looks, None) is None) is not ctrl_c


@needs_viser
def test_no_page_can_open_a_tunnel(monkeypatch: pytest.MonkeyPatch) -> None:
    """viser would make the page public, through a server of its makers, if any visitor's page asked for it."""
    import viser._viser

    from tsplat.viewer.page import _start

    def tunnel(*arguments: object) -> None:
        raise AssertionError("asked for a tunnel")

    monkeypatch.setattr(viser._viser, "ViserTunnel", tunnel)
    server = _start("127.0.0.1", 0)
    try:
        assert server.request_share_url() is None
    finally:
        server.stop()
