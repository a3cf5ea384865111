"""Density control on scenes of a few splats: who comes, who goes, what the optimiser remembers of whom."""

import math
from collections.abc import Callable

import pytest
import torch
from few_splats import ALWAYS, assert_follows, marked, scene_of, see, seeded
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn
from torch.optim import Adam

from tsplat import Camera, rasterize
from tsplat.fit import FitConfig, Step, fit
from tsplat.fit.density import MCMC, AdaptiveControl, Budget, Control, NoControl, Schedule
from tsplat.fit.density.mcmc import shared_opacity
from tsplat.fit.density.rows import grow, take_rows, turned
from tsplat.fit.visible_adam import VisibleAdam
from tsplat.scene import Capture, Gaussians

Make = Callable[..., FitConfig]


@settings(max_examples=25, deadline=None)
@given(n=st.integers(0, 6), rows=st.lists(st.integers(0, 5), max_size=12), visible_only=st.booleans(), data=st.data())
def test_taken_rows_keep_their_state(n: int, rows: list[int], visible_only: bool, data: st.DataObject) -> None:
    rows = [row for row in rows if row < n]
    fresh = torch.tensor(data.draw(st.lists(st.booleans(), min_size=len(rows), max_size=len(rows))), dtype=torch.bool)
    scene = scene_of(n)
    before = {name: p.detach().clone() for name, p in scene.named_parameters()}
    adam = marked(scene, visible_only)
    take_rows(scene, adam, torch.tensor(rows, dtype=torch.int64), fresh)
    assert_follows(scene, adam, fresh)
    for name, parameter in scene.named_parameters():
        assert torch.equal(parameter.detach(), before[name][rows])
        if visible_only:
            assert torch.equal(adam.state[parameter]["steps"], (~fresh).float())
    for parameter in scene.parameters():                               # and it goes on
        parameter.grad = torch.ones_like(parameter)
    adam.step(torch.ones(len(rows), dtype=torch.bool)) if isinstance(adam, VisibleAdam) else adam.step()


def test_clones_and_halves() -> None:
    scene = scene_of(5)
    before = {name: p.detach().clone() for name, p in scene.named_parameters()}
    adam = marked(scene)
    rows = grow(scene, adam, torch.tensor([1, 3]), torch.tensor([False, True]), seeded())
    assert rows.tolist() == [0, 1, 2, 3, 4, 1, 3]
    fresh = torch.tensor([0, 0, 0, 1, 0, 1, 1]).bool()
    assert_follows(scene, adam, fresh)
    for name, parameter in scene.named_parameters():
        assert torch.equal(parameter.detach()[[0, 1, 2, 4, 5]], before[name][[0, 1, 2, 4, 1]])      # a clone is a copy
    torch.testing.assert_close(scene.scales[[3, 6]], before["log_scales"][[3, 3]].exp() / 1.6)
    assert not torch.equal(scene.means[3], scene.means[6])


def test_halves_are_drawn_from_their_parent() -> None:
    """Mean and covariance of 4000 samples; their standard errors are 1/sqrt(4000) = 1.6 % of a deviation and 2.2 % of a variance."""
    n = 2000
    scales, quat = torch.tensor([1.0, 0.2, 0.05]), torch.tensor([0.8, 0.3, -0.5, 0.2])
    scene = Gaussians(torch.ones(n, 3), quat.repeat(n, 1), scales.log().repeat(n, 1), torch.zeros(n), torch.zeros(n, 1, 3), torch.zeros(n, 0, 3))
    grow(scene, marked(scene), torch.arange(n), torch.ones(n, dtype=torch.bool), seeded())
    axes = turned((quat * torch.tensor([1.0, -1, -1, -1])).repeat(2 * n, 1), (scene.means - 1).detach())      # in the parent's axes
    assert ((axes.mean(0) / scales).abs() < 0.08).all()
    torch.testing.assert_close((axes / scales).T @ (axes / scales) / (2 * n), torch.eye(3), atol=0.11, rtol=0)


def test_turned_is_the_rotation_matrix() -> None:
    from kornia.geometry.conversions import quaternion_to_rotation_matrix

    quats, vectors = torch.randn(9, 4, generator=seeded(), dtype=torch.float64), torch.randn(9, 3, generator=seeded(1), dtype=torch.float64)
    matrices = quaternion_to_rotation_matrix(torch.nn.functional.normalize(quats, dim=1))
    torch.testing.assert_close(turned(quats, vectors), (matrices @ vectors[..., None])[..., 0], atol=1e-12, rtol=0)


def test_adaptive_clones_the_small_splits_the_large_prunes_the_faint() -> None:
    scene = scene_of(6)
    with torch.no_grad():
        scene.opacity_logits.fill_(0.0)
        scene.opacity_logits[5] = -6                                   # below 0.005
        scene.log_scales.fill_(math.log(0.005))
        scene.log_scales[1] = math.log(0.05)                           # more than 0.01 of the extent
    before = scene.means.detach().clone()
    adam = marked(scene)
    control = AdaptiveControl(1.0, ALWAYS)
    see(control, scene, torch.tensor([3e-4, 3e-4, 1e-4, 0, 0, 0]))
    assert control.growth(scene, 1) == 2
    control.update(scene, adam, 1, seeded())
    assert len(scene) == 7                                             # 6, a clone, a split, less one
    assert torch.equal(scene.means[[0, 2, 3, 4, 5]], before[[0, 2, 3, 4, 0]])
    torch.testing.assert_close(scene.scales[[1, 6]], torch.full((2, 3), 0.05 / 1.6))
    assert_follows(scene, adam, torch.tensor([0, 1, 0, 0, 0, 1, 1]).bool())
    control.update(scene, adam, 2, seeded())                           # nothing seen since
    assert len(scene) == 7


def test_gradients_are_means_over_the_views_that_see() -> None:
    scene = scene_of(2)
    with torch.no_grad():
        scene.means[1, 2] = -50.0                                      # behind the camera
        scene.opacity_logits.fill_(0.0)
    control = AdaptiveControl(100.0, ALWAYS)
    for pull in (2e-4, 3e-4):
        see(control, scene, torch.tensor([pull, 0.0]))
    assert control.gradients.mean(2, scene.means.detach()).tolist() == pytest.approx([2.5e-4, 0.0])
    assert control.growth(scene, 1) == 1


def test_adaptive_never_exceeds_its_cap_and_takes_the_largest_gradients() -> None:
    scene = scene_of(6)
    with torch.no_grad():
        scene.opacity_logits.fill_(0.0)
    control = AdaptiveControl(1e6, ALWAYS, max_splats=8)             # all are small: clones
    see(control, scene, torch.tensor([3, 4, 5, 6, 7, 8]) * 1e-4)
    before = scene.means.detach().clone()
    control.update(scene, marked(scene), 1, seeded())
    assert len(scene) == 8
    assert torch.equal(scene.means[6:], before[4:])


def test_absgrad_asks_the_renderer_for_it() -> None:
    scene = scene_of(3)
    assert list(AdaptiveControl(1.0, ALWAYS, absgrad=True).probes(scene, 1)) == ["absgrad"]
    assert list(AdaptiveControl(1.0, ALWAYS).probes(scene, 1)) == ["screen_offset"]
    for control in (AdaptiveControl(1.0, Schedule(1, 9, 1)), Budget(1.0, Schedule(1, 9, 1), 3)):
        assert control.probes(scene, 8)
        assert not control.probes(scene, 9)                            # of no use any more, and not free
    assert AdaptiveControl(1.0, ALWAYS, absgrad=True).threshold == 4 * AdaptiveControl(1.0, ALWAYS).threshold


@settings(max_examples=20, deadline=None)
@given(first=st.integers(0, 9), most=st.integers(0, 40), faint=st.integers(0, 9))
def test_budget_is_met_exactly_and_never_exceeded(first: int, most: int, faint: int) -> None:
    scene, schedule = scene_of(first), Schedule(2, 12, 2)
    with torch.no_grad():
        scene.opacity_logits.fill_(0.0)
        scene.opacity_logits[:faint] = -7
    alive = max(0, first - faint)
    adam, control = marked(scene), Budget(1.0, schedule, most)
    for step in range(1, 15):
        n = len(scene)
        see(control, scene, torch.rand(n, generator=seeded(step)))
        allowed = control.growth(scene, step)
        control.update(scene, adam, step, seeded(step))
        assert len(scene) <= n + allowed
        assert len(scene) <= max(first, most)
        assert schedule.due(step) or len(scene) == n
        assert [p for group in adam.param_groups for p in group["params"]] == list(scene.parameters())
    assert len(scene) == (most if alive else 0)


def test_budget_is_spent_on_the_highest_scores() -> None:
    scene = scene_of(5)
    with torch.no_grad():
        scene.opacity_logits.fill_(0.0)
        scene.opacity_logits[0] = -7
    before = scene.means.detach().clone()
    adam, control = marked(scene), Budget(1e6, Schedule(1, 2, 1), 6, recycled=0.4)      # all are small: clones
    see(control, scene, torch.tensor([9.0, 1, 4, 3, 2]))
    control.update(scene, adam, 1, seeded())
    assert torch.equal(scene.means.detach(), before[[2, 3, 4, 2, 3, 4]])                # neither the faint nor the lowest
    assert_follows(scene, adam, torch.arange(6) >= 3)


def test_budget_spares_what_no_view_has_seen() -> None:
    scene = scene_of(4)
    with torch.no_grad():
        scene.opacity_logits.fill_(0.0)
        scene.means[:2, 2] = -50.0                                     # behind the camera
    before = scene.means.detach().clone()
    control = Budget(1e6, ALWAYS, 4, recycled=0.75)                    # three, but only two were seen
    see(control, scene, torch.tensor([0.0, 0, 1, 2]))
    control.update(scene, marked(scene), 1, seeded())
    assert torch.equal(scene.means.detach(), before[[0, 1, 0, 1]])


@pytest.mark.parametrize("copies", [1, 2, 3, 7, 51])
@pytest.mark.parametrize("opacity", [0.01, 0.5, 0.99])
def test_copies_look_like_the_one(copies: int, opacity: float) -> None:
    """Equation 9: opacities compose to the old one at the centre, and the integral along a line through it is the old one's."""
    new, shrink = shared_opacity(torch.tensor([opacity], dtype=torch.float64), torch.tensor([copies]))
    assert float(1 - (1 - new) ** copies) == pytest.approx(opacity, rel=1e-9)
    x = torch.linspace(-12, 12, 20_001, dtype=torch.float64)
    together = 1 - (1 - new * torch.exp(-(x / shrink) ** 2 / 2)) ** copies
    # of alternating binomials of up to 1e14 times terms of rounding 1e-16: 1e-3 at the worst, 51 copies of an opaque one
    assert float(torch.trapezoid(together, x)) == pytest.approx(opacity * math.sqrt(2 * math.pi), rel=1e-6 if copies < 51 else 1e-2)


def test_mcmc_relocates_the_dead() -> None:
    scene = scene_of(6)
    with torch.no_grad():
        scene.opacity_logits.copy_(torch.tensor([-6.0, 2.0, 0.0, -9.0, 1.0, -5.31]))     # 0, 3 and 5 are at or below 0.005
    before = scene.means.detach().clone()
    adam = marked(scene)
    MCMC(ALWAYS, 6, noise=0.0).update(scene, adam, 1, seeded())
    assert len(scene) == 6
    for place in (0, 3, 5):
        same = (before == scene.means[place]).all(1).nonzero()[:, 0]
        assert same.item() in (1, 2, 4)
        source = int(same)
        for parameter in scene.parameters():
            assert torch.equal(parameter[place], parameter[source])
            assert (adam.state[parameter]["exp_avg"][[place, source]] == 0).all()
    assert (scene.opacities > 0.005).all()


def test_mcmc_grows_by_5_percent_up_to_the_cap() -> None:
    scene = scene_of(100)
    with torch.no_grad():
        scene.opacity_logits.fill_(0.0)
    adam, control = marked(scene), MCMC(Schedule(2, 100, 2), 107)
    sizes = []
    for step in range(1, 8):
        n, allowed = len(scene), control.growth(scene, step)
        control.update(scene, adam, step, seeded())
        assert len(scene) == n + allowed
        sizes.append(len(scene))
    assert sizes == [100, 105, 105, 107, 107, 107, 107]
    assert set(adam.state) == set(scene.parameters())


def test_mcmc_noise_is_of_the_splats_shape_and_for_the_faint() -> None:
    n = 4000
    quat, scales = torch.tensor([0.8, 0.3, -0.5, 0.2]), torch.tensor([1.0, 0.5, 0.25])
    scene = Gaussians(torch.zeros(2 * n, 3), quat.repeat(2 * n, 1), scales.log().repeat(2 * n, 1), torch.tensor([-9.0, 3.0]).repeat_interleave(n),
                      torch.zeros(2 * n, 1, 3), torch.zeros(2 * n, 0, 3))
    adam = marked(scene)
    MCMC(Schedule(500, 600, 100), 10**6, noise=2.0).update(scene, adam, 1, seeded())
    assert (scene.means[n:].abs() < 1e-30).all()                       # sigmoid(-95)
    axes = turned((quat * torch.tensor([1.0, -1, -1, -1])).repeat(n, 1), scene.means[:n].detach())
    faint = torch.sigmoid(-100 * (torch.tensor(-9.0).sigmoid() - 0.005))
    deviation = axes.std(0) / (2.0 * 1e-3 * faint * scales**2)         # noise times rate times Sigma
    torch.testing.assert_close(deviation, torch.ones(3), atol=0.05, rtol=0)      # standard error 1.1 %


@pytest.mark.parametrize("control", [NoControl(), AdaptiveControl(1.0, ALWAYS, reset_every=2), Budget(1.0, ALWAYS, 10), MCMC(ALWAYS, 10)])
def test_no_splats(control: Control) -> None:
    scene = scene_of(0)
    adam = marked(scene)
    see(control, scene, torch.zeros(0))
    control.update(scene, adam, 1, seeded())
    assert len(scene) == 0


@pytest.mark.parametrize("kind", ["budget", "adaptive", "mcmc"])
def test_everything_pruned_goes_on(capture: Capture, config: Make, kind: str) -> None:
    def fade(step: Step) -> None:
        with torch.no_grad():
            step.gaussians.opacity_logits.fill_(-20)

    result = fit(capture, config(density=kind), progress=False, callbacks=[fade])
    assert len(result.gaussians) == (210 if kind == "mcmc" else 0)      # grown once before; it moves splats, but only to the living
    assert result.mean is not None


def test_in_a_loop_of_ones_own() -> None:
    """A `ParameterDict` and a plain Adam; the splats that are missing are found."""
    camera = Camera.look_at((0, 0, -4), (0, 0, 0), width=24, height=24)
    truth = scene_of(60, seed=5)
    with torch.no_grad():
        truth.opacity_logits.fill_(3.0)
        truth.log_scales.fill_(-2.0)
        target = rasterize(truth.means, truth.quats, truth.scales, truth.opacities, truth.sh0[:, 0], camera).image
    errors = {}
    for control in (NoControl(), Budget(1.0, Schedule(10, 60, 10), 60), AdaptiveControl(1.0, Schedule(10, 60, 10), reset_every=0),
                    MCMC(Schedule(10, 60, 2), 60, noise=8 / 0.03)):            # noise times rate: a tenth of the published, for so few steps
        start = scene_of(20, seed=6)
        names = ("means", "quats", "log_scales", "opacity_logits", "sh0")
        scene = nn.ParameterDict({name: start.get_parameter(name).detach().clone() for name in names})
        adam = Adam([{"params": [p], "name": name} for name, p in scene.items()], lr=0.03)
        for step in range(1, 81):
            rendering = rasterize(scene["means"], scene["quats"], scene["log_scales"].exp(), scene["opacity_logits"].sigmoid(), scene["sh0"][:, 0],
                                  camera, **control.probes(scene, step))
            loss = (rendering.image - target).abs().mean()
            adam.zero_grad()
            loss.backward()
            control.observe(rendering.meta, camera)
            adam.step()
            control.update(scene, adam, step, seeded(step))
        errors[type(control).__name__] = float(loss.detach())
    assert len(scene["means"]) > 20
    assert errors["Budget"] < 0.8 * errors["NoControl"]
    assert errors["AdaptiveControl"] < 0.8 * errors["NoControl"]
    assert errors["MCMC"] < 0.9 * errors["NoControl"]                  # from 20 splats to 50, 5 % at a time


@pytest.mark.parametrize(("kind", "changes"), [
    ("budget", {"max_splats": 260}), ("adaptive", {"density_threshold": 1e-5, "max_splats": 300, "reset_every": 0}), ("mcmc", {"max_splats": 250})])
def test_fit_with_each_kind(capture: Capture, config: Make, kind: str, changes: dict[str, float]) -> None:
    first, again = (fit(capture, config(density=kind, steps=30, **changes), progress=False) for _ in range(2))
    assert 200 < len(first.gaussians) <= changes["max_splats"]
    assert kind != "budget" or len(first.gaussians) == 260
    for mine, other in zip(first.gaussians.parameters(), again.gaussians.parameters(), strict=True):
        assert torch.equal(mine, other)                                # same seed, same bits
    before = fit(capture, config(density=kind, steps=0), progress=False).mean
    assert first.mean is not None
    assert before is not None
    assert first.mean.psnr > before.psnr + 1


def test_more_points_than_the_budget(capture: Capture, config: Make) -> None:
    sizes = []
    fit(capture, config(max_splats=50), progress=False, callbacks=[lambda step: sizes.append(len(step.gaussians))])
    assert set(sizes) == {50}


@pytest.mark.parametrize("steps", [1, 7, 100, 1000, 30_000])
def test_schedule(config: Make, steps: int) -> None:
    from tsplat.fit.schedules import density_schedule
    schedule = density_schedule(config(steps=steps))
    due = [step for step in range(steps + 1) if schedule.due(step)]
    assert all(steps / 60 - 1 <= step < steps / 2 for step in due)
    if steps == 30_000:
        assert due == list(range(500, 15_000, 100))
        assert density_schedule(config(steps=steps, density="mcmc")) == Schedule(500, 25_000, 100)      # as published
        assert density_schedule(config(steps=steps, density="mcmc", density_stop=0.5)) == schedule
    if steps >= 100:
        assert len(due) >= 9
        assert [schedule.part(step) for step in due] == pytest.approx([(i + 1) / len(due) for i in range(len(due))])
