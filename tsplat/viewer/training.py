"""`TrainingView`: a fit that can be looked at, and paused, while it goes on."""

from __future__ import annotations

import copy
import sys
import threading
import time
import warnings
from collections.abc import Callable
from typing import NamedTuple

from tsplat.fit.interrupt import interrupt_requested
from tsplat.fit.trainer import Step
from tsplat.viewer.loop import RenderLoop

SHARE = 0.25
"""Part of the time in which pictures may be drawn while the fit goes on, which needs the same processor."""
SNAPSHOT_SECONDS = 0.5
"""Least time between two copies of the scene."""
TELL_SECONDS = 0.25
POLL_SECONDS = 0.1
ABSENCE = 5.0
"""Seconds without any page after which a paused fit goes on. A page that is loaded again is away for less."""


class Report(NamedTuple):
    """How a fit is getting on: after step `step` of `steps`; loss and PSNR in dB of that step."""

    step: int
    steps: int
    loss: float
    psnr: float
    splats: int
    paused: bool


class TrainingView:
    """A callback of `tsplat.fit.fit` that shows the scene as it grows.

    What is drawn are copies of the scene, made between two steps and only if somebody looks: the fit ends with the same bits with and
    without visitors. Spheres are drawn with the gamma of the end. A paused fit holds still in the callback. It goes on if it is told to, on
    Ctrl-C (to save and stop), or if no page has been open for 5 seconds: a fit that nobody looks at must not stand still unnoticed.

    Args:
        loop: which draws.
        steps: of the fit.
    """

    def __init__(self, loop: RenderLoop, steps: int) -> None:
        self.tell: Callable[[Report], None] = lambda report: None
        """Is told how it is getting on, a few times per second."""
        self._loop, self._steps = loop, steps
        self._going = threading.Event()
        self._going.set()
        self._next_snapshot = self._next_report = 0.0
        loop.take(SHARE)

    def toggle(self) -> None:
        """Pause after this step, or go on."""
        if self._going.is_set():
            self._going.clear()
        else:
            self._going.set()

    def __call__(self, step: Step) -> None:
        """Called after each step."""
        now, last = time.monotonic(), step.number >= self._steps
        if last or (self._loop.visitors and self._loop.settled and now >= self._next_snapshot):
            self._snapshot(step)
        if last or now >= self._next_report:
            self._report(step)
        if last:
            self._loop.take(1.0)
        elif not self._going.is_set():
            self._hold(step)

    def _hold(self, step: Step) -> None:
        """Until something says that it goes on."""
        self._snapshot(step)
        self._report(step)
        self._loop.take(1.0)
        seen = time.monotonic()
        while not self._going.wait(POLL_SECONDS) and not interrupt_requested():
            now = time.monotonic()
            if self._loop.visitors:
                seen = now
            elif now - seen > ABSENCE:
                print("tsplat: the page was closed: the paused fit goes on", file=sys.stderr)
                self._going.set()
        self._loop.take(SHARE)
        self._report(step)

    def _snapshot(self, step: Step) -> None:
        try:
            self._loop.show(copy.deepcopy(step.gaussians))
        except (MemoryError, RuntimeError) as error:           # torch has RuntimeErrors for it
            warnings.warn(f"no copy of the scene to look at: {error}", stacklevel=2)
        self._next_snapshot = time.monotonic() + SNAPSHOT_SECONDS

    def _report(self, step: Step) -> None:
        self.tell(Report(step.number, self._steps, step.loss, step.psnr, len(step.gaussians), not self._going.is_set()))
        self._next_report = time.monotonic() + TELL_SECONDS
