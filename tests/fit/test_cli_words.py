"""What the command line says: help, suggestions, JSON, and how it ends."""

import json
import re
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
import torch

import tsplat.cli.render
from tsplat.cli import COMMANDS, main
from tsplat.fit import FitConfig
from tsplat.scene import Gaussians, Spheres


@pytest.mark.parametrize(("arguments", "message"), [
    ("fit a -o b --stepz 4", "tsplat fit: error: unknown option --stepz; did you mean --steps?"),
    ("fit a --ouput b", "unknown option --ouput; did you mean --out?"),                            # not: -o is missing
    ("fit a -o b --no-antialised", "unknown option --no-antialised; did you mean --no-antialiased?"),
    ("fit a -o b --down 4", "unknown option --down; did you mean --downscale?"),                   # abbreviations are not taken
    ("fit a -o b --downscal=4", "unknown option --downscal; did you mean --downscale?"),
    ("render a -o b --orbitt 3", "tsplat render: error: unknown option --orbitt; did you mean --orbit?"),
    ("info a --qqqqqq", "unknown option --qqqqqq\n"), ("--versoin", "unknown option --versoin; did you mean --version?"),
    ("rendr a -o b", "did you mean render?"), ("compair a b", "did you mean compare?"), ("xyzzy", "invalid choice: 'xyzzy' (choose from"),
    ("fit a -o b --density budgt", "did you mean budget?"), ("render a -o b --mode colour", "did you mean color?"),
])
def test_suggestions(arguments: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(arguments.split())
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.startswith("usage: tsplat ")
    assert len(error.splitlines()) == 2


def test_what_looks_like_an_option_after_two_dashes_is_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", "--", "--odd.ply"]) == 2
    assert "--odd.ply: No such file" in capsys.readouterr().err


def test_help(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    for name, command in COMMANDS.items():
        assert f"    {name:9} {command.HELP}\n" in text                       # one line each
    ends = text.partition("exit status:\n")[2]
    assert re.findall(r"^  (\d+)  ", ends, re.MULTILINE) == ["0", "2", "130", "141"]
    assert max(map(len, text.splitlines())) <= 80


@pytest.mark.parametrize("name", list(COMMANDS))
def test_help_of_commands(name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as stop:
        main([name, "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert text.startswith(f"usage: tsplat {name} ")
    assert f"examples:\n  tsplat {name} " in text
    assert max(map(len, text.splitlines())) <= 80
    if name == "fit":
        topics = list(dict.fromkeys(item.metadata["topic"] for item in fields(FitConfig)))
        assert [line[:-1] for line in text.splitlines() if line[:-1] in topics] == topics
        for item in fields(FitConfig):
            option = "  --" + item.name.replace("_", "-")
            assert text.count(f"\n{option} ") + text.count(f"\n{option},") == 1


def printed(capsys: pytest.CaptureFixture[str], *arguments: object) -> Any:
    assert main([str(argument) for argument in arguments]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    return json.loads(captured.out)                                            # one document, and nothing else


def test_json_of_info(capture_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    splats = Gaussians.random(10, sh_degree=1)
    with torch.no_grad():
        splats.means[0] = float("nan")
        splats.means[1:, 0] = torch.arange(9.0)
    splats.save(tmp_path / "a.ply")
    facts = printed(capsys, "info", tmp_path / "a.ply", "--json")
    assert {key: facts[key] for key in ("kind", "count", "sh_degree", "not_finite")} == {
        "kind": "gaussians", "count": 10, "sh_degree": 1, "not_finite": 1}
    assert facts["quantiles"]["at"] == [0, 0.05, 0.5, 0.95, 1]
    assert facts["quantiles"]["x"] == [0, 0, 4, 8, 8]
    Gaussians.random(0).save(tmp_path / "none.ply")
    assert printed(capsys, "info", tmp_path / "none.ply", "--json")["quantiles"] is None
    Spheres.from_points(torch.rand(5, 3)).save(tmp_path / "s.ply")
    facts = printed(capsys, "info", tmp_path / "s.ply", "--json")
    assert (facts["kind"], facts["count"], facts["channels"], facts["gamma"]) == ("spheres", 5, 3, 0.01)
    facts = printed(capsys, "info", capture_folder, "--json")
    assert (facts["kind"], facts["count"], facts["train"], facts["test"], facts["sizes"]) == ("capture", 8, 7, 1, [[32, 24]])
    assert (facts["points"], facts["masked"]) == (3000, False)


def test_json_of_eval_is_what_the_fit_wrote(capture_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fit", str(capture_folder), "-o", str(tmp_path), "--steps", "2", "--splats", "200", "--test-every", "4"]) == 0
    capsys.readouterr()
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert printed(capsys, "eval", tmp_path / "scene.ply", capture_folder, "--json") == {key: metrics[key] for key in ("ssim", "mean", "images")}


def test_ctrl_c_between_frames_leaves_no_half_a_clip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    Gaussians.random(5).save(tmp_path / "a.ply")
    drawn = []

    def interrupted(*arguments: Any, **options: Any) -> torch.Tensor:
        drawn.append(0)
        if len(drawn) == 3:
            raise KeyboardInterrupt
        return torch.zeros(6, 8, 3)

    monkeypatch.setattr(tsplat.cli.render, "picture", interrupted)
    assert main(["render", str(tmp_path / "a.ply"), "-o", str(tmp_path / "a.gif"), "--orbit", "9", "--size", "8x6"]) == 130
    assert capsys.readouterr().err == "tsplat: interrupted\n"
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


def test_ctrl_c_in_the_evaluation_names_the_checkpoint(capture_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                                       capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    arguments = ["fit", str(capture_folder), "-o", str(tmp_path), "--steps", "2", "--splats", "200"]
    with monkeypatch.context() as patch:
        patch.setattr("tsplat.fit.trainer.scores", interrupted)
        assert main(arguments) == 130
    assert capsys.readouterr().err == f"tsplat: interrupted; the same command goes on from {tmp_path / 'checkpoint.pt'}\n"
    assert main(arguments) == 0
    assert (tmp_path / "scene.ply").exists()
