"""Spheres through the trainer: what they start from, pruning and refining, resuming, files."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from tsplat import Spheres
from tsplat.cli import main
from tsplat.fit import FitConfig, fit
from tsplat.fit.optimiser import make_adam
from tsplat.fit.sphere_primitive import PruneAndRefine, SpherePrimitive
from tsplat.fit.trainer import start, train_step
from tsplat.scene import Capture, load_scene

CONFIG = FitConfig(primitive="spheres", steps=24, splats=60, max_splats=300, checkpoint_every=5, background="white")


def test_a_fit_improves_and_its_file_renders_the_same(capture: Capture, tmp_path: Path) -> None:
    losses: list[float] = []
    config = dataclasses.replace(CONFIG, steps=60)
    result = fit(capture, config, tmp_path, progress=False, callbacks=[lambda step: losses.append(step.loss)])
    spheres = result.gaussians
    assert isinstance(spheres, Spheres)
    assert spheres.gamma == config.gamma_last
    assert 200 < len(spheres) <= 300
    assert sum(losses[-10:]) < 0.9 * sum(losses[:10])
    loaded = load_scene(tmp_path / "scene.ply")
    assert isinstance(loaded, Spheres)
    camera = capture.camera(0)
    got, want = (s.render(camera, background=torch.ones(3)).image for s in (loaded, spheres))
    assert torch.allclose(got, want, atol=2e-3)         # radii are rounded twice, which the outlines show


def test_an_interrupted_fit_ends_with_the_same_bits(capture: Capture, tmp_path: Path) -> None:
    whole = fit(capture, CONFIG, tmp_path / "whole", progress=False).gaussians

    def stop(step: object) -> None:
        if step.number == 17:  # type: ignore[attr-defined]
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        fit(capture, CONFIG, tmp_path / "broken", progress=False, callbacks=[stop])
    again = fit(capture, CONFIG, tmp_path / "broken", progress=False).gaussians
    assert (again.gamma, again.near, again.far) == (whole.gamma, whole.near, whole.far)
    for name, parameter in whole.named_parameters():
        assert torch.equal(parameter, again.get_parameter(name)), name


def test_near_and_far_hold_the_points(capture: Capture) -> None:
    spheres = SpherePrimitive().start(capture, CONFIG, torch.Generator().manual_seed(0))
    eyes = -(capture.viewmats[:, :3, :3].mT @ capture.viewmats[:, :3, 3:]).squeeze(-1)
    distances = torch.cdist(spheres.positions.detach(), eyes.to(spheres.positions))
    assert float(((distances > spheres.near) & (distances < spheres.far)).float().mean()) > 0.98


def spheres_with_state(n: int) -> tuple[Spheres, torch.optim.Optimizer]:
    g = torch.Generator().manual_seed(0)
    spheres = Spheres(torch.randn(n, 3, generator=g), torch.linspace(-2, 0, n), torch.zeros(n), torch.rand(n, 3, generator=g) * 0.5)
    adam = make_adam(spheres)
    for parameter in spheres.parameters():
        parameter.grad = torch.ones_like(parameter)
    adam.step()
    return spheres, adam


@pytest.mark.parametrize("budget", [10, 31, 43, 1000])
def test_refining_fills_the_budget_with_the_largest(budget: int) -> None:
    spheres, adam = spheres_with_state(20)
    before = spheres.radii.detach().clone()
    control = PruneAndRefine([5], budget, torch.ones(3))
    assert control.growth(spheres, 4) == 0
    allowed = control.growth(spheres, 5)
    control.update(spheres, adam, 5, torch.Generator())
    count = min(20, max(0, budget - 20) // 11)
    assert len(spheres) == 20 + 11 * count <= 20 + allowed
    assert torch.equal(spheres.radii[:20 - count], before[:20 - count])                 # they are in order of size
    for parameter in spheres.parameters():
        assert len(parameter) == len(spheres)
        moments = adam.state[parameter]["exp_avg"]
        assert bool((moments[:20 - count] != 0).any()) or count == 20
        assert bool((moments[20 - count:] == 0).all()) or count == 0


def test_what_is_not_seen_or_looks_like_the_background_goes() -> None:
    spheres, adam = spheres_with_state(6)
    with torch.no_grad():
        spheres.features[1] = 0.97
    spheres.features.grad = torch.ones(6, 3)
    spheres.features.grad[4] = 0
    kept = spheres.positions.detach()[[0, 2, 3, 5]]
    control = PruneAndRefine([2], 6, torch.ones(3))
    control.update(spheres, adam, 1, torch.Generator())
    assert len(spheres) == 6
    control.update(spheres, adam, 2, torch.Generator())
    assert torch.equal(spheres.positions, kept)


def test_everything_may_go(capture: Capture) -> None:
    spheres, adam = spheres_with_state(3)
    spheres.features.grad = torch.zeros(3, 3)
    PruneAndRefine([1], 50, torch.ones(3)).update(spheres, adam, 1, torch.Generator())
    assert len(spheres) == 0
    image = spheres.render(capture.camera(0), background=torch.ones(3)).image
    assert torch.equal(image, torch.ones_like(image))


@pytest.mark.parametrize(("change", "error", "message"), [
    ({"density": "mcmc"}, ValueError, "density: expected 'budget'"), ({"depth_weight": 0.1}, NotImplementedError, "depth_weight")])
def test_what_spheres_do_not_have(capture: Capture, change: dict[str, object], error: type[Exception], message: str) -> None:
    depth = change.get("depth_weight")
    if depth:
        spheres = SpherePrimitive().start(capture, CONFIG, torch.Generator())
        with pytest.raises(error, match=message):
            SpherePrimitive().draw(spheres, capture.camera(0), torch.ones(3), CONFIG, 0, depth=True)
        return
    with pytest.raises(error, match=message):
        fit(capture, dataclasses.replace(CONFIG, **change), progress=False)


def test_commands(capture: Capture, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "s.ply"
    SpherePrimitive().start(capture, CONFIG, torch.Generator().manual_seed(0)).save(path)
    assert main(["info", str(path)]) == 0
    assert "spheres  200, 3 channels, gamma 0.01" in capsys.readouterr().out
    assert main(["render", str(path), "-o", str(tmp_path / "out.png"), "--size", "32x24"]) == 0
    assert (tmp_path / "out.png").is_file()


def test_colours_stay_in_range(capture: Capture) -> None:
    config = dataclasses.replace(CONFIG, density="none")
    state = start(capture, config, torch.device("cpu"))
    with torch.no_grad():
        state.gaussians.features[:3] = torch.tensor([[-1.0, 0.5, 2.0]])
    train_step(state, capture, config)
    features = state.gaussians.features
    assert (features[:3, 0] == 0).all()
    assert (features[:3, 2] == 1).all()
    assert ((features >= 0) & (features <= 1)).all()
