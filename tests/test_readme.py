"""The README's code and that in `help(tsplat.rasterize)` run, and do what the text beside them says; what README links to is there."""

from __future__ import annotations

import doctest
import inspect
import json
import math
import os
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import tsplat
from tsplat.cli import main
from tsplat.compat.pulsar import Renderer
from tsplat.scene import read_image, write_synthetic_capture

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
SIZE = {"width": 64, "height": 48}
POINT = torch.tensor([0.3, -0.2, 0.1])              # of the world, seen by all cameras below


def section(title: str, language: str = "python") -> list[str]:
    """The code of a section in one language."""
    text = README.split(f"\n## {title}\n")
    assert len(text) == 2, title
    return re.findall(rf"```{language}\n(.*?)```", text[1].split("\n## ")[0], re.DOTALL)


def run(code: str, **names: Any) -> dict[str, Any]:
    space = {"torch": torch, "math": math, "tsplat": tsplat, **SIZE, **names}
    exec(code, space)
    return space


def pixel(camera: tsplat.Camera) -> Tensor:
    p = camera.viewmats[:3, :3] @ POINT + camera.viewmats[:3, 3]
    assert p[2] > 0
    return (camera.Ks @ p)[:2] / p[2]


def camera_to_world() -> Tensor:
    """Of a camera at (1, 0.5, 3), turned, with OpenGL's axes: right, up, back."""
    eye = torch.tensor([1.0, 0.5, 3.0])
    back = torch.nn.functional.normalize(eye, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.1, 1.0, 0.0]), back), dim=0)
    c2w = torch.eye(4)
    c2w[:3, :3], c2w[:3, 3] = torch.stack([right, torch.linalg.cross(back, right), back], 1), eye
    return c2w


def opengl_pixel(c2w: Tensor, focal: float, point: Tensor = POINT) -> Tensor:
    """Where a point is on the image, by the definition: along the axes right, up and back."""
    right, up, back = c2w[:3, :3].T @ (point - c2w[:3, 3])
    return torch.stack([SIZE["width"] / 2 + focal * right / -back, SIZE["height"] / 2 - focal * up / -back])


def test_rendering_a_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out").mkdir()
    tsplat.Gaussians.from_points(torch.randn(50, 3) * 0.3, torch.rand(50, 3), 0).save(tmp_path / "out" / "scene.ply")
    [code] = section("Render a scene")
    names = run(code)
    assert (names["scene"].means.grad != 0).any()
    assert read_image(tmp_path / "picture.png").shape == (600, 800, 3)


def test_commands_of_a_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """With a small scene and few photos in place of the fit's."""
    monkeypatch.chdir(tmp_path)
    write_synthetic_capture("out/capture", views=4, size=(32, 24))
    tsplat.Gaussians.from_points(torch.randn(50, 3) * 0.3, torch.rand(50, 3), 0).save("out/scene.ply")
    [code] = section("Render a scene", "sh")
    lines = code.splitlines()
    assert len(lines) == 5
    for line in lines:
        assert main(shlex.split(line, comments=True)[1:]) == 0, line
    for name in ("orbit_000.png", "orbit_011.png", "flight.gif", "difference.png", "out/scene.spz"):
        assert Path(name).exists(), name
    assert json.loads(re.findall(r"^\{\n.*?^\}", capsys.readouterr().out, re.DOTALL | re.MULTILINE)[0])["count"] == 50


def test_commands_that_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As printed, but for two steps of few splats."""
    monkeypatch.chdir(tmp_path)
    write_synthetic_capture("path/to/capture", views=8, size=(32, 24))
    commands = [line.split("tsplat ", 1)[1] for code in section("Two commands", "sh") for line in code.splitlines() if "tsplat fit" in line]
    assert len(commands) == 2
    for command in commands:
        assert main([*shlex.split(command), "--steps", "2", "--splats", "100"]) == 0, command
    assert Path("out/contact.png").exists()
    assert Path("fitted/contact.png").exists()


def test_spheres() -> None:
    """The image is that of Pulsar's own call, but for which distance is meant in a sphere's d."""
    [code] = section("Spheres: Pulsar")
    names = run(code)
    assert float(names["rendering"].alpha.detach().max()) > 0.5
    assert (names["colors"].grad != 0).any()
    camera = torch.tensor([0.0, 0, 0, 0, 0, 0, 5, 2])
    theirs = Renderer(1024, 1024, 10)(names["positions"], names["colors"], names["radii"], camera, gamma=0.1, max_depth=45.0, min_depth=5.0)
    assert float((names["rendering"].image - theirs).abs().max()) < 0.01


def test_conventions() -> None:
    """Each conversion puts a point on the pixel that the other's own rules give."""
    opengl, colmap, nerfstudio, pytorch3d = section("Conventions")
    c2w, angle = camera_to_world(), 0.9
    focal = SIZE["width"] / (2 * math.tan(angle / 2))
    K = torch.tensor([[focal, 0, 32.0], [0, focal, 24.0], [0, 0, 1]])
    expected = opengl_pixel(c2w, focal)
    torch.testing.assert_close(pixel(run(opengl, c2w=c2w, camera_angle_x=angle)["camera"]), expected)

    half_turn = math.radians(35)                                                # about y, with COLMAP's rule: x' = R x + t
    R = torch.tensor([[math.cos(2 * half_turn), 0, math.sin(2 * half_turn)], [0, 1, 0], [-math.sin(2 * half_turn), 0, math.cos(2 * half_turn)]])
    tx, ty, tz = (shift := torch.tensor([0.1, 0.2, 3.0])).tolist()
    seen = R @ POINT + shift
    quaternion = {"qw": math.cos(half_turn), "qx": 0.0, "qy": math.sin(half_turn), "qz": 0.0}
    camera = run(colmap, **quaternion, tx=tx, ty=ty, tz=tz, fx=50.0, fy=60.0, cx=31.0, cy=25.0)["camera"]
    torch.testing.assert_close(pixel(camera), torch.stack([31 + 50 * seen[0] / seen[2], 25 + 60 * seen[1] / seen[2]]))

    turned = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    transform, scale = torch.cat([turned, torch.tensor([[0.3], [-0.1], [0.2]])], 1), 0.4
    camera = run(nerfstudio, transform=transform, scale=scale, c2w=c2w, K=K)["camera"]
    moved = scale * (transform[:, :3] @ POINT + transform[:, 3])                 # the point in nerfstudio's world: on the same pixel
    p = camera.viewmats[:3, :3] @ moved + camera.viewmats[:3, 3]
    torch.testing.assert_close((camera.Ks @ p)[:2] / p[2], expected)
    torch.testing.assert_close(camera.viewmats[:3, :3] @ camera.viewmats[:3, :3].T, torch.eye(3), atol=1e-6, rtol=0)

    R, T, f, px, py = camera_to_world()[:3, :3], torch.tensor([0.1, -0.2, 4.0]), 1.7, 0.1, -0.2      # any rotation
    x, y, z = POINT @ R + T
    ndc = torch.stack([f * x / z + px, f * y / z + py])                          # x to the left, y up, in half the shorter side
    camera = run(pytorch3d, R=R, T=T, focal_length=f, px=px, py=py)["camera"]
    torch.testing.assert_close(pixel(camera), torch.tensor([32.0, 24.0]) - 24 * ndc)


def test_many_gpus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a CPU, as one process: what it says, with gloo for nccl."""
    if not torch.distributed.is_available():
        pytest.skip("torch was built without torch.distributed")
    begin = torch.distributed.init_process_group
    store = torch.distributed.FileStore(str(tmp_path / "store"), 1)
    monkeypatch.setenv("LOCAL_RANK", "0")
    monkeypatch.setattr(torch.cuda, "set_device", lambda device: None)
    monkeypatch.setattr(torch.distributed, "init_process_group", lambda backend: begin("gloo", store=store, rank=0, world_size=1))
    scene = tsplat.Gaussians.from_points(torch.randn(20, 3) * 0.3, torch.rand(20, 3), 3)
    camera = tsplat.Camera.look_at((0, -1, -3), (0, 0, 0), fov=50, **SIZE)
    [code] = section("Many GPUs")
    try:
        run(code, os=os, means=scene.means, quats=scene.quats, scales=scene.scales, opacities=scene.opacities, sh=scene.sh, camera=camera,
            loss=torch.mean)
    finally:
        torch.distributed.destroy_process_group()
    assert scene.means.grad is not None
    assert (scene.means.grad != 0).any()


def test_help_of_rasterize() -> None:
    """Its example runs, and each argument is explained."""
    help_text = tsplat.rasterize.__doc__ or ""
    [example] = doctest.DocTestFinder().find(tsplat.rasterize, "rasterize", globs={"torch": torch, "tsplat": tsplat})
    assert doctest.DocTestRunner().run(example, clear_globs=False) == doctest.TestResults(failed=0, attempted=7)
    assert (example.globs["means"].grad != 0).any()
    for name in inspect.signature(tsplat.rasterize).parameters:
        assert f"\n        {name}: " in help_text, name
    for name in ("image", "alpha", "depth", "meta"):
        assert f"`{name}`" in help_text.partition("Returns:")[2].partition("Raises:")[0], name


def test_no_code_is_left_out() -> None:
    """The sections above, and that of the peers, whose code tests/compat runs."""
    tested = ["Render a scene", "Spheres: Pulsar", "Many GPUs", "Conventions", "Coming from gsplat, Inria or Pulsar"]
    assert sum(len(section(title)) for title in tested) == README.count("```python")


def test_commands_are_known(capsys: pytest.CaptureFixture[str]) -> None:
    """Every option of a `tsplat` command in the README is one that its help lists."""
    commands = re.findall(r"`?(?:\.venv/bin/)?\btsplat (fit|eval|render|convert|info|compare|view)\b([^`\n]*)", README)
    assert {"fit", "render", "info", "convert"} <= {name for name, _ in commands}
    for name in {name for name, _ in commands}:
        with pytest.raises(SystemExit):
            main([name, "--help"])
        text = capsys.readouterr().out
        for option in {option for other, rest in commands if other == name for option in re.findall(r"(?<!\S)--?[a-z][\w-]*", rest)}:
            assert re.search(rf"(?<![\w-]){re.escape(option)}(?![\w-])", text), (name, option)


def test_links_lead_somewhere() -> None:
    links = re.findall(r"\]\(([^)#]+)\)", README)
    assert len(links) > 5
    for link in links:
        assert link.startswith("https://") or (ROOT / link).exists(), link
