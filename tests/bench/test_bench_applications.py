"""Pulsar's applications, a few steps of each on small images: they run, improve on their start, and draw."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
import torch

from tsplat.scene.image_files import image_size

FOLDER = Path(__file__).resolve().parents[2] / "bench" / "applications"


@pytest.fixture
def application(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The script that the test is parametrised with, imported as if it ran from its folder."""
    names = [path.stem for path in FOLDER.glob("*.py")]
    monkeypatch.syspath_prepend(FOLDER)
    yield importlib.import_module(request.param)
    for name in names:
        sys.modules.pop(name, None)


def options(shared: Path, tmp_path: Path, text: str) -> list[str]:
    return ["--data", str(shared / "data"), "--picture", str(tmp_path / "picture.png"), *text.split()]


@pytest.mark.parametrize("application", ["silhouettes"], indirect=True)
def test_silhouettes(application: ModuleType, shared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert application.main(options(shared, tmp_path, "--steps 45 --rounds 3 --segments 6")) > 0.2         # 0.13 at first, 0.29 then
    assert "218 spheres, 45 steps, held-out IoU" in capsys.readouterr().out
    assert image_size(tmp_path / "picture.png") == (6 * 128, 2 * 128)


@pytest.mark.parametrize("application", ["silhouettes"], indirect=True)
def test_document(application: ModuleType, shared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It is all of stdout, has what its figures hold for, and says that a goal is missed."""
    score = application.main(options(shared, tmp_path, "--steps 4 --rounds 2 --segments 3 --json"))
    out, err = capsys.readouterr()
    document = json.loads(out)
    assert document.keys() == {"application", "measure", "figures", "spheres", "steps", "relocated", "note", "goal", "met", "wall_s", "cpu_s",
                               "device", "machine", "torch", "threads", "command", "commit", "date"}
    assert (document["application"], document["spheres"], document["steps"]) == ("silhouettes", 56, 4)
    assert document["figures"]["end"] == score
    assert (document["goal"], document["met"]) == (0.9, False)
    assert document["cpu_s"] > 0
    assert "silhouettes: goal 0.9 missed" in err


@pytest.mark.parametrize("application", ["silhouettes"], indirect=True)
def test_the_cube_that_is_a_sphere(application: ModuleType) -> None:
    vertices = application.cube_sphere(15)
    assert vertices.shape == (1352, 3)
    torch.testing.assert_close(vertices.norm(dim=1), torch.ones(1352))
    assert len(vertices.unique(dim=0)) == 1352


@pytest.mark.parametrize("application", ["illumination"], indirect=True)
def test_illumination(application: ModuleType, shared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before, after = application.main(options(shared, tmp_path, "--steps 20 --rounds 2 --spheres 150 --samples 1000 --cameras 12 --size 32 --json"))
    assert after < before
    document = json.loads(capsys.readouterr().out)
    assert document["figures"] == {"before": before, "after": after}
    assert 0 < document["counts"]["after"] <= document["spheres"] == 150
    assert "goal" not in document
    assert image_size(tmp_path / "picture.png") == (5 * 32, 4 * 32)


@pytest.mark.parametrize("application", ["illumination"], indirect=True)
def test_chamfer_distance(application: ModuleType) -> None:
    """Half of (mean of 0, 3) and half of (mean of 0, 4)."""
    a, b = torch.tensor([[0.0, 0, 0], [3, 0, 0]]), torch.tensor([[0.0, 0, 0], [0, 4, 0]])
    assert application.chamfer(a, b) == pytest.approx((1.5 + 2) / 2, rel=1e-6)


@pytest.mark.parametrize("application", ["head"], indirect=True)
def test_head_and_its_neural_shading(application: ModuleType, shared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spheres = tmp_path / "made" / "head.ply"
    result = application.main(options(shared, tmp_path, f"--steps 8 --volume 200 --refinements 1 --downscale 8 --spheres {spheres} --json"))
    names, counts, quality = zip(*result.history, strict=True)
    assert names == ("volume", "volume, pruned", "refinement 1, before", "refinement 1", "refinement 1, pruned")
    assert counts[2] == 12 * counts[1]
    assert quality[3] > quality[2]
    assert len(result.spheres) == counts[4]
    assert json.loads(capsys.readouterr().out)["figures"] == dict(zip(names, quality, strict=True))
    assert image_size(tmp_path / "picture.png") == (4 * 32, 32)
    shading = importlib.import_module("neural_shading")
    figures = shading.main(options(shared, tmp_path, f"--steps 20 --downscale 8 --spheres {spheres} --json"))
    assert json.loads(capsys.readouterr().out)["figures"] == figures
    before, *after = figures.values()
    assert before == pytest.approx(quality[4], abs=1e-3)                                # where the head ended
    assert all(figure > before for figure in after)
    assert image_size(tmp_path / "picture.png") == (4 * 32, 3 * 32)


@pytest.mark.parametrize("application", ["view_dependent"], indirect=True)
def test_view_dependent_shading(application: ModuleType, shared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    qualities = application.main(options(shared, tmp_path, "--steps 5 --volume 200 --refinements 0 --downscale 16 --targets"))
    assert all(quality > 5 for quality in qualities)
    assert "with a network of the viewing direction" in capsys.readouterr().out
    assert image_size(tmp_path / "picture.png") == (5 * 25, 3 * 25)


@pytest.mark.parametrize("application", ["view_dependent"], indirect=True)
def test_viewing_directions(application: ModuleType) -> None:
    """From the eye through a point to where the camera sees that point."""
    import tsplat

    eye, point = torch.tensor([1.0, -2, 3]), torch.tensor([0.3, 0.1, -0.2])
    camera = tsplat.Camera.look_at(eye, (0, 0, 0), (0, 1, 0), width=64, height=48)
    seen = camera.Ks @ (camera.viewmats[:3, :3] @ point + camera.viewmats[:3, 3])
    column, row = (seen[:2] / seen[2]).floor().long().tolist()
    expected = torch.nn.functional.normalize(point - eye, dim=0)
    angles = torch.linalg.cross(application.directions(camera), expected.expand(48, 64, 3)).norm(dim=-1)
    assert angles.argmin() == row * 64 + column
    assert angles[row, column] < 0.01                                                   # less than a pixel, fov/64 = 0.0136
    torch.testing.assert_close(application.directions(camera).norm(dim=-1), torch.ones(48, 64))
