"""Resets of the opacities: what comes of them, and that nothing is judged, scored or saved until the scene has settled."""

import itertools
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from few_splats import ALWAYS, marked, scene_of, see, seeded
from hypothesis import given
from hypothesis import strategies as st

import tsplat.fit.trainer
from tsplat.fit import FitConfig, fit
from tsplat.fit.density import AdaptiveControl, Schedule
from tsplat.fit.primitive import primitive_of
from tsplat.scene import Capture

Make = Callable[..., FitConfig]


def test_adaptive_prunes_the_huge_after_a_reset() -> None:
    for step, left in ((20, 1), (30, 1), (33, 1), (34, 1), (35, 0)):          # at 34 it has settled, and what step 35 draws is judged
        scene = scene_of(1)
        with torch.no_grad():
            scene.log_scales.fill_(0.0)
        AdaptiveControl(1.0, ALWAYS, reset_every=30).update(scene, marked(scene), step, seeded())
        assert len(scene) == left


def test_reset_of_opacities() -> None:
    scene = scene_of(4)
    with torch.no_grad():
        scene.opacity_logits.copy_(torch.tensor([3.0, 0.0, -5.0, 1.0]))
    adam = marked(scene)
    control = AdaptiveControl(1.0, Schedule(500, 1000, 1000), reset_every=30, settle=5)
    control.update(scene, adam, 30, seeded())
    torch.testing.assert_close(scene.opacities, torch.tensor([0.01, 0.01, torch.tensor(-5.0).sigmoid(), 0.01]))
    assert (adam.state[scene.opacity_logits]["exp_avg"] == 0).all()
    assert torch.equal(adam.state[scene.means]["exp_avg"], 10 * scene.means.detach())
    assert [step for step in range(100) if not control.settled(step)] == [30, 31, 32, 33, 34, 60, 61, 62, 63, 64, 90, 91, 92, 93, 94]
    assert control.settled(1020)                                       # no reset after the schedule


def test_nothing_is_judged_right_after_a_reset() -> None:
    """What is due then is left out, and gradients of what was drawn then do not count: splats that faded stay, and those that are pulled at."""
    scene = scene_of(3)
    adam, control = marked(scene), AdaptiveControl(1e6, ALWAYS, reset_every=10, settle=3)
    sizes = []
    for step in range(9, 16):
        with torch.no_grad():
            scene.opacity_logits.fill_(0.0)
            scene.opacity_logits[0] = -6                               # to be pruned
        if control.probes(scene, step):
            see(control, scene, torch.full((len(scene),), 3e-4))       # to be cloned, if it is seen
        n, allowed = len(scene), control.growth(scene, step)
        control.update(scene, adam, step, seeded(step))
        assert len(scene) <= n + allowed
        assert (scene.opacities.max() < 0.02) == (step == 10)
        sizes.append(len(scene) - n)
    assert [size != 0 for size in sizes] == [True, True, False, False, False, True, True]      # 11, 12 and 13 draw what 10, 11 and 12 left


@given(stop=st.integers(1, 400), every=st.integers(2, 90), part=st.floats(0, 1), batch=st.integers(1, 8))
def test_what_is_reset_settles_before_the_schedule_ends(stop: int, every: int, part: float, batch: int) -> None:
    control = AdaptiveControl(1.0, Schedule(1, stop, 10, batch), reset_every=every, settle=int(part * (every - 1)))
    assert all(control.settled(step) for step in range(stop, stop + 100))
    unsettled = [step for step in range(stop) if not control.settled(step)]
    assert all(step % every < control.settle and step >= every for step in unsettled)
    assert len(unsettled) == max(0, (stop - control.settle) // every) * control.settle


def test_a_scene_that_would_never_settle() -> None:
    with pytest.raises(ValueError, match=r"^reset_every: expected 0, or more than settle = 30 steps, which are at least 0; got 30$"):
        AdaptiveControl(1.0, ALWAYS, reset_every=30, settle=30)
    with pytest.raises(ValueError, match=r"^reset_every: expected 0, or more than settle = 1 steps"):
        AdaptiveControl(1.0, ALWAYS, reset_every=1)
    assert AdaptiveControl(1.0, ALWAYS, reset_every=0).settled(1)
    assert AdaptiveControl(1.0, ALWAYS).settle == 499


@pytest.mark.parametrize(("interval", "steps"), [(1, [*range(1, 19), 22, 23, 24]), (4, [4, 8, 12, 16, 18, 22])])
def test_nothing_is_saved_or_scored_right_after_a_reset(capture: Capture, config: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                                        interval: int, steps: list[int]) -> None:
    """A reset after step 19 of 25, which settles after step 22. What falls due meanwhile is saved before and after: no two are further apart than the
    interval, if that is at least 4."""
    c = config(steps=25, density="adaptive", density_stop=1.0, reset_every=19 * 30_000 // 25, checkpoint_every=interval)
    saved, settled = [], []
    monkeypatch.setattr(tsplat.fit.trainer, "save_checkpoint", lambda path, state, config, capture: saved.append(state.step))
    result = fit(capture, c, tmp_path, progress=False, callbacks=[lambda step: settled.append(step.settled)])
    assert saved == [*steps, 25]
    assert [number for number, is_settled in enumerate(settled, 1) if not is_settled] == [19, 20, 21]
    assert settled[-1]
    assert (result.gaussians.opacities > 0.02).any()                   # 0.01 after the reset


def test_no_reset_that_would_not_settle(capture: Capture, config: Make) -> None:
    """Of 16 steps one would come after the 15th, which the last would draw."""
    c = config(steps=16, density="adaptive", density_stop=1.0, reset_every=15 * 30_000 // 16)
    assert (fit(capture, c, progress=False).gaussians.opacities > 0.1).any()


@pytest.mark.parametrize(("photos", "most"), [(1, 500), (4, 504)])
def test_no_more_is_lost_than_the_interval(photos: int, most: int) -> None:
    """Of a fit of 30,000 steps with the resets of 3DGS, and the default interval of 500; of several ranks, which count `photos`, a step's more."""
    config = FitConfig(steps=30_000, density="adaptive")
    control = primitive_of(config).control(config, 1.0, 100)
    state, saved = SimpleNamespace(step=0, ranks=SimpleNamespace(count=photos), control=control), [0]
    for state.step in range(photos, config.steps, photos):
        if tsplat.fit.trainer._due(state, config, saved[-1]):          # type: ignore[arg-type]
            assert control.settled(state.step)
            saved.append(state.step)
    assert max(b - a for a, b in itertools.pairwise([*saved, config.steps])) == most
    assert len(saved) < 70
