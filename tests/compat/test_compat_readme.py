"""The README's section for those who come from the peers: its code runs, and the names in its tables are there."""

from __future__ import annotations

import functools
import importlib
import math
import re
from pathlib import Path
from typing import Any

import pytest
import torch

import tsplat
from tsplat import Camera

README = Path(__file__).resolve().parents[2] / "README.md"


@functools.cache
def section() -> str:
    text = README.read_text(encoding="utf-8").split("## Coming from gsplat, Inria or Pulsar\n")
    assert len(text) == 2
    return text[1].split("\n## ")[0]


def blocks() -> list[str]:
    return re.findall(r"```python\n(.*?)```", section(), re.DOTALL)


def scene() -> dict[str, Any]:
    """What the code of the section takes for granted."""
    n, width, height = 10, 24, 16
    cam = Camera.look_at((0, 0, -3), (0, 0, 0), width=width, height=height, fov=50)
    tangents = {"tanfovx": math.tan(math.radians(25)), "tanfovy": math.tan(math.radians(25)) * height / width}
    P = torch.tensor([[1 / tangents["tanfovx"], 0, 0, 0], [0, 1 / tangents["tanfovy"], 0, 0], [0, 0, 1, -0.01], [0, 0, 1, 0]])
    means = torch.randn(n, 3) * 0.4
    values = {"means": means, "quats": torch.randn(n, 4), "scales": torch.full((n, 3), -2.0), "opacities": torch.zeros(n), "colors": torch.rand(n, 3)}
    params = torch.nn.ParameterDict({k: torch.nn.Parameter(v) for k, v in values.items()})
    return {
        "torch": torch, "width": width, "height": height, "params": params, "viewmats": cam.viewmats[None], "Ks": cam.Ks[None],
        "optimizers": {k: torch.optim.Adam([p]) for k, p in params.items()}, **tangents, "viewmatrix": cam.viewmats.T,
        "projmatrix": (P @ cam.viewmats).T, "campos": torch.tensor([0.0, 0.0, -3.0]), "means3D": means, "shs": torch.randn(n, 1, 3),
        "opacities": torch.full((n, 1), 0.5), "scales": torch.full((n, 3), 0.2), "rotations": torch.nn.functional.normalize(torch.randn(n, 4)),
        "vert_pos": means + torch.tensor([0.0, 0.0, 10.0]), "vert_col": torch.rand(n, 3, requires_grad=True), "vert_rad": torch.full((n,), 0.5),
        "cam_params": torch.tensor([0.0, 0, 0, 0, 0, 0, 5.0, 2.0])}


@pytest.mark.parametrize("index", range(3))
def test_the_code_runs(index: int) -> None:
    assert len(blocks()) == 3
    names = scene()
    exec(blocks()[index], names)
    if index == 0:
        assert (names["alpha"] > 0.1).any()
        assert names["state"]["count"].sum() > 0
    elif index == 1:
        assert (names["means2D"].grad[:, :2] != 0).any()
        assert (names["invdepths"] > 0.1).any()
    else:
        assert names["nearest"].shape == names["ids"].shape[1:3] == names["hits"].shape[:2] == (16, 24)
        assert (names["vert_col"].grad != 0).any()


def test_the_names_are_there() -> None:
    """Three tables, whose second column names what there is."""
    rows = [line.split(" | ") for line in section().splitlines() if line.startswith("| `")]
    assert all(len(row) == 3 for row in rows)
    names = re.findall(r"`(tsplat\.[\w.]+)`", " ".join(row[1] for row in rows))
    assert len(names) >= len(rows) == 17
    for name in names:
        path = name.split(".")
        found = functools.reduce(getattr, path[3:], importlib.import_module(".".join(path[:3]))) if path[1] == "compat" else getattr(tsplat, path[1])
        assert callable(found), name
        assert name.endswith(found.__name__)
