"""A fit that is looked at ends as one that is not, and can be paused."""

import dataclasses
import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from compare import assert_same_bits, threads

import tsplat.viewer.training
from tsplat.fit import FitConfig, FitResult, Step, fit
from tsplat.fit.interrupt import interrupt_requested
from tsplat.scene import Capture
from tsplat.viewer import RenderLoop, Settings, TrainingView, draw_view
from tsplat.viewer.schedule import Frame, Wish
from tsplat.viewer.training import Report
from tsplat.viewer.viewpoint import Viewpoint

Wait = Callable[..., None]

# density control replaces the parameters in this many steps, and the order in which random numbers are drawn matters
CONFIG = FitConfig(steps=60, splats=200, max_splats=300, test_every=4, density="mcmc", background="random", sh_degree=1)
WISH = Wish(Viewpoint((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -3.0), 0.8, 40, 30), Settings())


def parameters(result: FitResult) -> list[torch.Tensor]:
    return [p.detach() for p in result.gaussians.parameters()]


@pytest.mark.parametrize(("count", "changes"), [(1, {}), (1, {"primitive": "spheres", "density": "budget"}), (2, {"steps": 10})])
def test_a_fit_with_a_restless_visitor_ends_with_the_same_bits(capture: Capture, count: int, changes: dict[str, Any],
                                                               monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tsplat.viewer.training, "SNAPSHOT_SECONDS", 0.0)
    config = dataclasses.replace(CONFIG, **changes)
    frames: list[Frame] = []
    with threads(count):
        torch.manual_seed(1)
        alone = parameters(fit(capture, config, progress=False))
        with RenderLoop() as loop:
            visitor = loop.enter(frames.append)
            look = [0.0]

            def move(step: Step) -> None:
                look[0] += 0.01
                loop.wish(visitor, WISH._replace(viewpoint=WISH.viewpoint._replace(position=(look[0], 0.0, -3.0))))

            torch.manual_seed(1)
            watched = parameters(fit(capture, config, progress=False, callbacks=[TrainingView(loop, config.steps), move]))
    assert len(frames) > 3
    assert len({frame.pixels.tobytes() for frame in frames}) > 3
    assert_same_bits(watched, alone)


def test_visitors_see_the_scene_grow_and_its_end(capture: Capture, wait: Wait) -> None:
    frames, reports = list[Frame](), list[Report]()
    with RenderLoop() as loop:
        visitor = loop.enter(frames.append)
        loop.wish(visitor, WISH)
        training = TrainingView(loop, CONFIG.steps)
        training.tell = reports.append
        result = fit(capture, CONFIG, progress=False, callbacks=[training, lambda step: wait(lambda: frames, "a picture of the first step")])
        want = draw_view(result.gaussians, WISH.viewpoint.camera(), WISH.settings)
        wait(lambda: frames[-1].divisor == 1 and (frames[-1].pixels == want).all(), "the picture of the last step")
        assert loop.settled
    first, last = reports[0], reports[-1]
    assert (first.step, last.step, last.steps, last.splats) == (1, CONFIG.steps, CONFIG.steps, len(result.gaussians))
    assert last.psnr > first.psnr


def test_nothing_is_copied_for_nobody(capture: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    shown = []
    with RenderLoop() as loop:
        monkeypatch.setattr(loop, "show", shown.append)
        fit(capture, dataclasses.replace(CONFIG, steps=10), progress=False, callbacks=[TrainingView(loop, 10)])
    assert len(shown) == 1                                             # the end, for those who come then


def test_a_fit_goes_on_without_memory_for_visitors(capture: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(scene: object) -> None:
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory")

    monkeypatch.setattr(tsplat.viewer.training.copy, "deepcopy", fails)
    with RenderLoop() as loop:
        loop.wish(loop.enter(lambda frame: None), WISH)
        training = TrainingView(loop, 3)
        with pytest.warns(UserWarning, match="no copy of the scene to look at: DefaultCPUAllocator"):
            training(Step(1, "a.png", 0.1, 20.0, [None] * 5))


class Paused:
    """A fit in a thread, with a visitor, that pauses after its third step."""

    def __init__(self, capture: Capture, loop: RenderLoop, config: FitConfig = CONFIG) -> None:
        self.steps: list[int] = []
        self.reports: list[Report] = []
        self.frames: list[Frame] = []
        self.result: FitResult | None = None
        self.visitor = loop.enter(self.frames.append)
        loop.wish(self.visitor, WISH)
        self.training = TrainingView(loop, config.steps)
        self.training.tell = self.reports.append

        def count(step: Step) -> None:
            self.steps.append(step.number)
            if step.number == 3:
                self.training.toggle()

        def run() -> None:
            self.result = fit(capture, config, progress=False, callbacks=[count, self.training])

        self.thread = threading.Thread(target=run)
        self.thread.start()

    def held(self) -> bool:
        return bool(self.reports) and self.reports[-1].paused


def test_a_paused_fit_holds_still_is_drawn_sharp_and_goes_on(capture: Capture, wait: Wait) -> None:
    with RenderLoop() as loop:
        paused = Paused(capture, loop)
        wait(paused.held, "the pause")
        wait(lambda: loop.settled and paused.frames and paused.frames[-1].divisor == 1, "the sharp picture")
        time.sleep(0.1)                                                # a few steps, if it went on
        assert paused.steps == [1, 2, 3]
        paused.training.toggle()
        paused.thread.join()
        assert paused.steps == list(range(1, CONFIG.steps + 1))
        assert not paused.reports[-1].paused
    assert paused.result is not None
    assert_same_bits(parameters(paused.result), parameters(fit(capture, CONFIG, progress=False)))


def test_a_paused_fit_that_nobody_sees_goes_on_and_says_so(capture: Capture, wait: Wait, monkeypatch: pytest.MonkeyPatch,
                                                           capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(tsplat.viewer.training, "ABSENCE", 0.3)
    with RenderLoop() as loop:
        paused = Paused(capture, loop)
        wait(paused.held, "the pause")
        loop.leave(paused.visitor)
        paused.thread.join()
    assert paused.steps[-1] == CONFIG.steps
    assert "the paused fit goes on" in capsys.readouterr().err


def test_ctrl_c_ends_a_pause_with_a_checkpoint(capture: Capture, tmp_path: Path) -> None:
    with RenderLoop() as loop:
        loop.enter(lambda frame: None)
        training = TrainingView(loop, CONFIG.steps)
        training.toggle()

        def interrupt(report: Report) -> None:
            if report.paused:
                threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
                training.tell = lambda report: None

        training.tell = interrupt
        with pytest.raises(KeyboardInterrupt, match="stopped after step 1 of 60; the same call goes on"):
            fit(capture, CONFIG, tmp_path, progress=False, callbacks=[training])
    assert (tmp_path / "checkpoint.pt").exists()
    assert not interrupt_requested()                                   # any more
    result = fit(capture, CONFIG, tmp_path, progress=False)
    assert_same_bits(parameters(result), parameters(fit(capture, CONFIG, progress=False)))
