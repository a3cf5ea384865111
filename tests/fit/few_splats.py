"""Scenes of a few splats, an optimiser that tells whose state is whose, and steps that are made up: for tests of density control."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.optim import Adam

from tsplat import Camera, rasterize
from tsplat.fit.density import Control, Schedule
from tsplat.fit.visible_adam import VisibleAdam
from tsplat.scene import Gaussians

ALWAYS = Schedule(1, 1000, 1)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def scene_of(n: int, seed: int = 0) -> Gaussians:
    scene = Gaussians.random(n, sh_degree=1, generator=seeded(seed))
    with torch.no_grad():
        for parameter in scene.parameters():
            parameter += 0.1 * torch.randn(parameter.shape, generator=seeded(seed))
    return scene


def marked(scene: nn.Module, visible_only: bool = False) -> Adam | VisibleAdam:
    """An optimiser whose moments are 10 and 20 times the parameters, so that they tell whose they are."""
    groups = [{"params": [parameter], "name": name} for name, parameter in scene.named_parameters()]
    adam = VisibleAdam(groups, lr=1e-3) if visible_only else Adam(groups, lr=1e-3)
    for parameter in scene.parameters():
        parameter.grad = torch.zeros_like(parameter)
    adam.step(torch.ones(len(next(scene.parameters())), dtype=torch.bool)) if isinstance(adam, VisibleAdam) else adam.step()
    for parameter in scene.parameters():
        adam.state[parameter]["exp_avg"].copy_(10 * parameter.detach())
        adam.state[parameter]["exp_avg_sq"].copy_(20 * parameter.detach())
    return adam


def assert_follows(scene: nn.Module, adam: Adam | VisibleAdam, fresh: Tensor, but: tuple[str, ...] = ()) -> None:
    """The optimiser has this scene's parameters, and moments that are theirs, or 0 where `fresh`."""
    assert [p for group in adam.param_groups for p in group["params"]] == list(scene.parameters())
    assert set(adam.state) == set(scene.parameters())
    for name, parameter in scene.named_parameters():
        for key, factor in (("exp_avg", 10), ("exp_avg_sq", 20)):
            moment = adam.state[parameter][key]
            assert moment.shape == parameter.shape
            assert (moment[fresh] == 0).all()
            if name not in but:
                assert torch.equal(moment[~fresh], factor * parameter.detach()[~fresh])


def see(control: Control, scene: Gaussians, pull: Tensor) -> None:
    """One step's worth of observations: each splat that is visible is pulled at by `pull` `[N]`, in NDC."""
    camera = Camera.look_at((0, 0, -6), (0, 0, 0), width=20, height=20)
    probes = control.probes(scene, 1)
    rendering = rasterize(scene.means, scene.quats, scene.scales, scene.opacities, scene.sh, camera, sh_degree=1, **probes)
    for probe in probes.values():
        probe.grad = torch.stack([pull / 10, torch.zeros_like(pull)], -1)[None]
    control.observe(rendering.meta, camera)
