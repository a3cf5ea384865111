"""What gsplat's training loops use besides rendering: density control. (`SelectiveAdam`: test_compat_gsplat_adam.py.)"""

from __future__ import annotations

import math
import re
from typing import Any

import pytest
import torch
from compare import assert_close
from torch import Tensor

from tsplat import Camera
from tsplat.compat.gsplat import DefaultStrategy, MCMCStrategy, edits, rasterization

WIDTH, HEIGHT = 32, 24
ROWS = 8


def parameters(n: int = ROWS, opacity_dim: bool = False) -> torch.nn.ParameterDict:
    """Trainable parameters, and one that is not trained."""
    g = torch.Generator().manual_seed(n)
    tensors = {"means": torch.randn(n, 3, generator=g) * 0.4, "scales": torch.rand(n, 3, generator=g) - 3, "quats": torch.randn(n, 4, generator=g),
               "opacities": torch.randn(n, *[1] * opacity_dim, generator=g), "colors": torch.rand(n, 3, generator=g)}
    params = torch.nn.ParameterDict({k: torch.nn.Parameter(v) for k, v in tensors.items()})
    params["labels"] = torch.nn.Parameter(torch.arange(float(n)), requires_grad=False)
    return params


def adam(params: Any, lr: float = 0.01) -> dict[str, torch.optim.Optimizer]:
    return {name: torch.optim.Adam([{"params": p, "lr": lr, "name": name}]) for name, p in params.items() if p.requires_grad}


def with_moments(params: Any) -> dict[str, torch.optim.Optimizer]:
    """Optimisers that have made a step with gradients 1, 2, 3, ... in the rows."""
    optimizers = adam(params)
    for name, optimizer in optimizers.items():
        params[name].grad = torch.arange(1.0, len(params[name]) + 1).view(-1, *[1] * (params[name].ndim - 1)).expand_as(params[name]).clone()
        optimizer.step()
    return optimizers


def moments(optimizers: dict[str, torch.optim.Optimizer], params: Any, name: str = "means") -> Tensor:
    """First moments, in units of those of the first row (so 1, 2, 3, ... at first)."""
    optimizer = optimizers[name]
    assert optimizer.param_groups[0]["params"] == [params[name]]
    state = optimizer.state[params[name]]
    assert state["exp_avg_sq"].shape == params[name].shape
    assert state["step"] == 1
    return state["exp_avg"].flatten(1)[:, 0] / 0.1


def copies(params: Any) -> dict[str, Tensor]:
    return {k: v.detach().clone() for k, v in params.items()}


MASK = torch.tensor([False, True, False, False, True, False, False, False])


# Edits


def test_duplicate() -> None:
    params = parameters()
    optimizers, before, state = with_moments(params), copies(params), {"count": torch.arange(8.0), "scene_scale": 2.0}
    before = copies(params)
    edits.duplicate(params, optimizers, state, MASK)
    source = [*range(8), 1, 4]
    for name, old in before.items():
        assert torch.equal(params[name], old[source]), name
        assert params[name].requires_grad == (name != "labels")
    assert_close(moments(optimizers, params), torch.tensor([1.0, 2, 3, 4, 5, 6, 7, 8, 0, 0]), 1e-6)
    assert torch.equal(state["count"], torch.tensor(source).float())
    assert state["scene_scale"] == 2.0


@pytest.mark.parametrize("revised", [True, False])
def test_split(revised: bool) -> None:
    """The halves are drawn from the Gaussian: over many, their offsets have its covariance."""
    n = 4000
    params = parameters(2)
    params = torch.nn.ParameterDict({k: torch.nn.Parameter(v[[0] + [1] * n].detach(), requires_grad=v.requires_grad) for k, v in params.items()})
    optimizers = with_moments(params)
    before, mask = copies(params), torch.arange(n + 1) > 0
    edits.split(params, optimizers, {}, mask, revised_opacity=revised)
    assert len(params["means"]) == 2 * n + 1
    for name in ("quats", "colors", "labels"):
        assert_close(params[name][1:], before[name][1:].repeat(2, *[1] * (before[name].ndim - 1)), 1e-6)
    assert_close(params["scales"][1:].exp() * 1.6, before["scales"][1:2].exp().expand(2 * n, 3), 1e-6)
    o, new = before["opacities"][1].sigmoid(), params["opacities"][1:].sigmoid()
    assert_close(1 - (1 - new) ** 2 if revised else new, o.expand(2 * n), 1e-5)
    offsets = (params["means"] - before["means"][1])[1:].detach()
    covar, _ = edits.quat_scale_to_covar_preci(before["quats"][1], before["scales"][1].exp())
    whitened = torch.linalg.solve_triangular(torch.linalg.cholesky(covar), offsets.mT, upper=False)
    assert (whitened @ whitened.mT / (2 * n) - torch.eye(3)).abs().max() < 0.06        # 4 standard errors, sqrt(2 / 8000) each
    assert (moments(optimizers, params)[1:] == 0).all()
    assert_close(moments(optimizers, params)[0], torch.tensor(1.0), 1e-6)


def test_remove() -> None:
    params = parameters()
    optimizers, state = with_moments(params), {"count": torch.arange(8.0)}
    before = copies(params)
    edits.remove(params, optimizers, state, MASK)
    for name, old in before.items():
        assert torch.equal(params[name], old[~MASK])
    assert_close(moments(optimizers, params), torch.tensor([1.0, 3, 4, 6, 7, 8]), 1e-6)
    assert state["count"].tolist() == [0, 2, 3, 5, 6, 7]


def test_reset_opacities() -> None:
    params = parameters()
    optimizers = with_moments(params)
    before = copies(params)
    edits.reset_opacities(params, optimizers, 0.4)
    assert_close(params["opacities"].sigmoid(), before["opacities"].sigmoid().clamp_max(0.4), 1e-6)
    assert (optimizers["opacities"].state[params["opacities"]]["exp_avg"] == 0).all()
    assert_close(moments(optimizers, params), torch.arange(1.0, 9.0), 1e-6)
    assert torch.equal(params["means"], before["means"])


@pytest.mark.parametrize("opacity_dim", [True, False])
def test_relocate(opacity_dim: bool) -> None:
    """The dead are copies of living ones; each group of copies is as opaque at its centre as the one was."""
    params = parameters(opacity_dim=opacity_dim)
    optimizers = with_moments(params)
    before = copies(params)
    edits.relocate(params, optimizers, MASK, edits.binomials(), 0.005)
    source = params["labels"].long()
    assert torch.equal(source[~MASK], torch.arange(8)[~MASK])
    assert (~MASK[source]).all()
    for name in ("means", "quats", "colors"):
        assert torch.equal(params[name], before[name][source])
    assert params["opacities"].shape == before["opacities"].shape
    count = torch.bincount(source, minlength=8)[source]
    o, new = before["opacities"].flatten().sigmoid()[source], params["opacities"].flatten().sigmoid()
    assert_close(1 - (1 - new) ** count, o, 1e-5)
    chosen = (count > 1) & ~MASK
    assert (params["scales"][chosen] < before["scales"][chosen]).all()
    want = torch.arange(1.0, 9.0).masked_fill(chosen, 0.0)
    assert_close(moments(optimizers, params), want, 1e-6)


def test_add_copies() -> None:
    params = parameters()
    optimizers = with_moments(params)
    before = copies(params)
    edits.add_copies(params, optimizers, 3, edits.binomials(), 0.005)
    source = params["labels"].long()
    assert source[:8].tolist() == list(range(8))
    assert_close(1 - (1 - params["opacities"].sigmoid()) ** torch.bincount(source)[source], before["opacities"].sigmoid()[source], 1e-5)
    assert_close(moments(optimizers, params), torch.tensor([1.0, 2, 3, 4, 5, 6, 7, 8, 0, 0, 0]), 1e-6)


def test_relocated_is_equation_9_of_the_paper() -> None:
    """As printed, a double sum, for 1 to 51 copies, in exact binomials; more are taken for 51."""
    n = torch.arange(1, 52)
    o = torch.linspace(0.02, 0.98, 51, dtype=torch.float64)
    got, scales = edits.relocated(o, torch.ones(51, 3, dtype=torch.float64), n, edits.binomials())
    for copies_, opacity, new, scale in zip(n.tolist(), o.tolist(), got.tolist(), scales[:, 0].tolist(), strict=True):
        o_new = 1 - (1 - opacity) ** (1 / copies_)
        total = sum(math.comb(i - 1, k) * (-1) ** k * o_new ** (k + 1) / math.sqrt(k + 1) for i in range(1, copies_ + 1) for k in range(i))
        assert new == pytest.approx(o_new, rel=1e-12)
        assert scale == pytest.approx(opacity / total, rel=1e-9)
    many, _ = edits.relocated(o[:1], torch.ones(1, 3, dtype=torch.float64), torch.tensor([80]), edits.binomials())
    assert many.item() == pytest.approx(1 - 0.98 ** (1 / 51))


def test_noise_moves_the_transparent_along_their_axes() -> None:
    params = parameters(2000)
    params["quats"].data[:] = torch.tensor([1.0, 0, 0, 0])
    params["scales"].data[:] = torch.tensor([0.1, 0.2, 0.4]).log()
    params["opacities"].data[:1000], params["opacities"].data[1000:] = -8.0, 3.0
    before = copies(params)["means"]
    edits.add_noise(params, 2.0)
    moved = (params["means"] - before).detach()
    assert moved[1000:].abs().max() < 1e-6
    weight = 1 / (1 + math.exp(-100 * (1 - 1 / (1 + math.exp(8)) - 0.995)))
    assert_close(moved[:1000].std(0) / weight / 2, torch.tensor([0.01, 0.04, 0.16]), 0.1)                # variances times the noise's deviation


# Strategies


def target_and_camera() -> tuple[Tensor, Camera]:
    """A picture of 12 coloured Gaussians."""
    cam = Camera.look_at((0, 0, -3), (0, 0, 0), width=WIDTH, height=HEIGHT, fov=40)
    g = torch.Generator().manual_seed(3)
    image, _, _ = rasterization(torch.randn(12, 3, generator=g) * 0.4, torch.randn(12, 4, generator=g), torch.rand(12, 3, generator=g) * 0.3,
                                torch.full((12,), 0.9), torch.rand(12, 3, generator=g), cam.viewmats[None], cam.Ks[None], WIDTH, HEIGHT)
    return image, cam


def render(params: Any, cam: Camera, **options: Any) -> tuple[Tensor, Tensor, Any]:
    return rasterization(params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(), params["colors"],
                         cam.viewmats[None], cam.Ks[None], WIDTH, HEIGHT, **options)


@pytest.mark.parametrize(("packed", "absgrad"), [(True, False), (False, True)])
def test_a_loop_with_the_default_strategy(packed: bool, absgrad: bool, capsys: pytest.CaptureFixture[str]) -> None:
    """The loop of gsplat's docstring: Gaussians come and go, opacities are reset, and the loss falls."""
    target, cam = target_and_camera()
    params = parameters(40)
    del params["labels"]
    optimizers = adam(params)
    strategy = DefaultStrategy(refine_start_iter=5, refine_every=10, reset_every=60, refine_stop_iter=70, grow_grad2d=1e-3, prune_opa=0.2,
                               refine_scale2d_stop_iter=70, absgrad=absgrad, verbose=True)
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state(scene_scale=1.0)
    losses, sizes = [], []
    for step in range(90):
        image, _, info = render(params, cam, packed=packed, absgrad=absgrad)
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss = (image - target).square().mean()
        loss.backward()
        strategy.step_post_backward(params, optimizers, state, step, info, packed=packed)
        if step == 60:
            assert params["opacities"].sigmoid().max() <= 0.4 + 1e-6
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        losses.append(loss.item())
        sizes.append(len(params["means"]))
    assert all(len(p) == sizes[-1] for p in params.values())
    assert sizes[10] > 40
    assert sizes[-1] == sizes[69]
    assert sum(int(count) for count in re.findall(r"(\d+) removed", capsys.readouterr().out)) > 0
    assert losses[-1] < 0.5 * losses[0]


def test_the_gradient_that_grows_is_that_of_half_an_image() -> None:
    """grad2d: the norm of the gradient by u in units of half the width, and by v of half the height, times the cameras; summed over views."""
    target, cam = target_and_camera()
    for packed in (True, False):
        params = parameters(30)
        del params["labels"]
        strategy = DefaultStrategy(refine_scale2d_stop_iter=5)
        state = strategy.initialize_state()
        assert state == {"grad2d": None, "count": None, "scene_scale": 1.0, "radii": None}
        args = [params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(), params["colors"]]
        image, _, info = rasterization(*args, cam.viewmats.expand(2, 4, 4), cam.Ks.expand(2, 3, 3), WIDTH, HEIGHT, packed=packed)
        strategy.step_pre_backward(params, adam(params), state, 0, info)
        (image - target).square().sum().backward()
        strategy.step_post_backward(params, adam(params), state, 0, info, packed=packed)
        gradient, radii = info["means2d"].grad, info["radii"].amax(-1)
        if packed:
            gradient, radii = (torch.zeros(2, 30, *v.shape[1:], dtype=v.dtype).index_put((info["camera_ids"], info["gaussian_ids"]), v)
                               for v in (gradient, radii))
        assert_close(state["grad2d"], (gradient * torch.tensor([WIDTH, HEIGHT])).norm(dim=-1).sum(0), 1e-6)
        assert torch.equal(state["count"], (radii > 0).sum(0).float())
        assert_close(state["radii"], radii.amax(0) / WIDTH, 1e-6)


@pytest.mark.parametrize("packed", [True, False])
def test_packed_is_that_of_the_rendering(packed: bool) -> None:
    """Or gradients would be taken for those of other Gaussians."""
    _, cam = target_and_camera()
    params, strategy = parameters(), DefaultStrategy()
    image, _, info = render(params, cam, packed=not packed)
    strategy.step_pre_backward(params, {}, {}, 0, info)
    image.sum().backward()
    with pytest.raises(ValueError, match=f"packed: expected {not packed}"):
        strategy.step_post_backward(params, {}, strategy.initialize_state(), 0, info, packed=packed)


def test_what_grows_and_what_goes() -> None:
    """Small and large with a high gradient, a transparent one, and a huge one, each of which has its fate."""
    params = parameters(5)
    params["scales"].data[:] = torch.tensor([0.005, 0.05, 0.005, 0.005, 0.5]).log()[:, None]
    params["opacities"].data[:] = torch.tensor([1.0, 1.0, -6.0, 1.0, 1.0])
    optimizers = with_moments(params)
    params["scales"].data[:] = torch.tensor([0.005, 0.05, 0.005, 0.005, 0.5]).log()[:, None]
    strategy = DefaultStrategy(reset_every=100)
    state = {"grad2d": torch.tensor([6e-4, 6e-4, 0, 3e-4, 0]), "count": torch.tensor([2.0, 2.0, 0.0, 2.0, 1.0]), "scene_scale": 1.0}
    assert strategy._grow(params, optimizers, state, 200) == (1, 1)
    assert params["labels"].tolist() == [0, 2, 3, 4, 0, 1, 1]
    assert strategy._prune(params, optimizers, state, 50) == 1
    assert params["labels"].tolist() == [0, 3, 4, 0, 1, 1]
    assert strategy._prune(params, optimizers, state, 200) == 1
    assert params["labels"].tolist() == [0, 3, 0, 1, 1]


def info_of(gradient: Tensor, radius: int) -> dict[str, Any]:
    """What a strategy reads of a rendering of 40 x 20 pixels, with this gradient `[1, N, 2]`."""
    means2d = torch.zeros_like(gradient, requires_grad=True)
    means2d.grad = gradient
    return {"width": 40, "height": 20, "n_cameras": 1, "radii": torch.full(gradient.shape, radius, dtype=torch.int32), "gaussian_ids": None,
            "means2d": means2d}


def test_absolute_gradients_are_those_that_count() -> None:
    strategy, info = DefaultStrategy(absgrad=True), info_of(torch.zeros(1, ROWS, 2), 1)
    info["means2d"].absgrad = torch.tensor([0.3, 0.8]).expand(1, ROWS, 2)
    state = strategy.initialize_state()
    strategy.step_post_backward(parameters(), {}, state, 0, info)
    assert_close(state["grad2d"], torch.full((ROWS,), 10.0), 1e-6)          # (0.3 40 / 2, 0.8 20 / 2)


def test_when_gaussians_change() -> None:
    """Every so many steps between start and stop, but not right after a reset; the sums begin again each time."""
    params = parameters()
    optimizers = adam(params)
    strategy = DefaultStrategy(refine_start_iter=4, refine_every=2, refine_stop_iter=20, reset_every=10, pause_refine_after_reset=3,
                               refine_scale2d_stop_iter=20)
    state = strategy.initialize_state(scene_scale=100.0)
    changed = []
    for step in range(24):
        n = len(params["means"])
        gradient = torch.zeros(1, n, 2)
        gradient[0, 0] = 1.0
        strategy.step_post_backward(params, optimizers, state, step, info_of(gradient, 1))
        if len(params["means"]) > n:
            changed.append(step)
            assert all(len(state[key]) == n + 1 and (state[key] == 0).all() for key in ("grad2d", "count", "radii"))
    assert changed == [6, 8, 14, 16, 18]


def test_what_is_large_in_the_image() -> None:
    """It is split, and removed once opacities have been reset, until `refine_scale2d_stop_iter`."""
    params = parameters(5)
    optimizers = with_moments(params)
    strategy = DefaultStrategy(refine_scale2d_stop_iter=300, reset_every=100)
    state = {"grad2d": torch.zeros(5), "count": torch.zeros(5), "radii": torch.tensor([0.0, 0.06, 0.04, 0.2, 0.0]), "scene_scale": 100.0}
    assert strategy._grow(params, optimizers, state, 300) == (0, 0)
    assert strategy._grow(params, optimizers, state, 200) == (0, 2)
    assert params["labels"].tolist() == [0, 2, 4, 1, 3, 1, 3]
    assert [strategy._prune(params, optimizers, state, step) for step in (100, 300, 200)] == [0, 0, 2]
    assert params["labels"].tolist() == [0, 2, 4, 1, 1]


def test_a_loop_with_mcmc() -> None:
    target, cam = target_and_camera()
    params = parameters(40)
    del params["labels"]
    params["opacities"].data[:5] = -7.0
    optimizers = adam(params)
    strategy = MCMCStrategy(cap_max=45, refine_start_iter=5, refine_every=10, refine_stop_iter=60, noise_lr=10.0)
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state()
    losses = []
    for step in range(80):
        image, _, info = render(params, cam)
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss = (image - target).square().mean()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        strategy.step_post_backward(params, optimizers, state, step, info, lr=0.01)
        losses.append(loss.item())
        if step == 10:
            assert len(params["means"]) == 42
            assert (params["opacities"].sigmoid() > 0.004).all()
    assert len(params["means"]) == 45
    assert losses[-1] < 0.5 * losses[0]


def test_the_noise_is_relative_to_the_learning_rate() -> None:
    params, want = parameters(), parameters()
    for p in (params, want):
        p["opacities"].data[:] = -8.0
    strategy = MCMCStrategy(noise_lr=3e3)
    torch.manual_seed(1)
    strategy.step_post_backward(params, {}, strategy.initialize_state(), 0, {}, lr=0.02)
    torch.manual_seed(1)
    edits.add_noise(want, 60.0)
    assert not torch.equal(params["means"], parameters()["means"])
    assert torch.equal(params["means"], want["means"])


@pytest.mark.parametrize("strategy", [DefaultStrategy(), MCMCStrategy()])
def test_check_sanity(strategy: Any) -> None:
    params = parameters()
    optimizers = adam(params)
    strategy.check_sanity(params, optimizers)
    with pytest.raises(ValueError, match="expected one for each parameter"):
        strategy.check_sanity(params, {k: v for k, v in optimizers.items() if k != "quats"})
    with pytest.raises(ValueError, match="one param_group"):
        strategy.check_sanity(params, optimizers | {"means": torch.optim.Adam([{"params": params["means"]}, {"params": params["quats"]}])})
    del params["quats"]
    with pytest.raises(ValueError, match="quats missing"):
        strategy.check_sanity(params, {k: v for k, v in optimizers.items() if k != "quats"})
