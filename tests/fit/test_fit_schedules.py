"""What changes over a fit is what its steps draw with: size of the photos, bands of the colours, background, gamma."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

import tsplat.fit.primitive
from tsplat import Spheres
from tsplat.fit import FitConfig, fit
from tsplat.fit.schedules import sh_degree_at
from tsplat.scene import Capture

Make = Callable[..., FitConfig]


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Arguments of each drawing of Gaussians."""
    calls: list[dict[str, Any]] = []
    draw = tsplat.fit.primitive.draw

    def recorded(scene: Any, **options: Any) -> Any:
        calls.append(options)
        return draw(scene, **options)

    monkeypatch.setattr(tsplat.fit.primitive, "draw", recorded)
    return calls


def test_size_of_the_photos(capture: Capture, config: Make, drawn: list[dict[str, Any]]) -> None:
    """1/4, 1/2, 1 (3DGS, section 7.1), and all of it in the evaluation."""
    width = capture.width[0]
    fit(capture, config(steps=8, resolution_warmup=0.5), progress=False)
    assert [call["camera"].width for call in drawn] == [width / 4] * 2 + [width / 2] * 2 + [width] * (4 + len(capture.test))


def test_bands_of_the_colours(capture: Capture, config: Make, drawn: list[dict[str, Any]]) -> None:
    fit(capture, config(steps=9, sh_degree=3, sh_warmup=2 / 3), progress=False)
    assert [call["sh_degree"] for call in drawn] == [0, 0, 1, 1, 2, 2, 3, 3, 3] + [None] * len(capture.test)


def test_bands_rise_every_1000_steps_of_30000() -> None:
    config = FitConfig(steps=30_000)
    assert [sh_degree_at(config, step) for step in (0, 999, 1000, 1999, 2000, 2999, 3000, 29_999)] == [0, 0, 1, 1, 2, 2, 3, 3]


def test_random_background(capture: Capture, config: Make, drawn: list[dict[str, Any]]) -> None:
    """New at each step, white in the evaluation."""
    fit(capture, config(steps=6, background="random"), progress=False)
    colors = torch.stack([call["background"] for call in drawn])
    assert len(colors[:6].unique(dim=0)) == 6
    assert (colors[6:] == 1).all()


def test_gamma(capture: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    gammas: list[float] = []
    render = Spheres.render

    def recorded(scene: Spheres, *args: Any, **options: Any) -> Any:
        gammas.append(options["gamma"])
        return render(scene, *args, **options)

    monkeypatch.setattr(Spheres, "render", recorded)
    fit(capture, FitConfig(primitive="spheres", steps=5, splats=60, gamma_first=0.1, gamma_last=1e-3), progress=False)
    assert gammas[:5] == pytest.approx([0.1, 0.1**1.5, 0.01, 0.1**2.5, 1e-3])
    assert gammas[5:] == [1e-3] * len(capture.test)
