"""What to draw next, for whom and how finely: the decisions of the viewer's one worker, apart from its thread and its clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from tsplat.viewer.view import Pixels, Settings
from tsplat.viewer.viewpoint import Viewpoint

DIVISORS = 8, 4, 2, 1
"""Of the resolution, from the coarsest picture to the sharp one."""
PROMPT = 0.1
"""Seconds that a picture may take while the camera moves."""
HARDLY_LONGER = 1.5
"""A finer picture that takes at most this much longer than the quickest is worth it: in large scenes, most of the time goes into the splats."""
REST = 0.2
"""Seconds without a change after which a picture is refined. Before that, its next camera would have to wait for the finer picture."""


class Wish(NamedTuple):
    """What a visitor wants to see."""

    viewpoint: Viewpoint
    settings: Settings


class Frame(NamedTuple):
    """A picture that was drawn: at `1 / divisor` of the resolution of the wish, in so many seconds."""

    pixels: Pixels
    wish: Wish
    divisor: int
    seconds: float


@dataclass(eq=False)
class Visitor:
    """One open page.

    Args:
        show: takes each frame.
        wish: or None as long as the page has not said what it looks at.
        changed: when it did so last.
        moved: whether there is no picture of that yet.
        shown: divisor of the last picture of this wish and scene, or None.
        turn: when it was served last, as a count.
        seconds: that a picture took, by divisor.
    """

    show: Callable[[Frame], None]
    wish: Wish | None = None
    changed: float = 0.0
    moved: bool = False
    shown: int | None = None
    turn: int = 0
    seconds: dict[int, float] = field(default_factory=dict)

    @property
    def coarse(self) -> int:
        """The smallest divisor with which pictures come quickly. What was not measured is taken to be in proportion to the pixels."""
        coarse = DIVISORS[0]
        if coarse not in self.seconds:
            return coarse
        enough = max(PROMPT, HARDLY_LONGER * min(self.seconds.values()))
        expected = self.seconds[coarse]
        for divisor in DIVISORS[1:]:
            expected = self.seconds.get(divisor, 4 * expected)
            if expected <= enough:
                coarse = divisor
        return coarse


class Job(NamedTuple):
    """A picture to draw, of which edition of the scene."""

    visitor: Visitor
    wish: Wish
    divisor: int
    edition: int


class Schedule:
    """Whose turn it is. First come those whose camera or settings changed, with a coarse picture; then pictures are refined, step by step.

    Times are seconds of any clock.
    """

    def __init__(self) -> None:
        self.visitors: list[Visitor] = []
        self._share = 1.0
        self._turn = self._edition = 0
        self._free = 0.0                             # when such work may be done again

    def wish(self, visitor: Visitor, wish: Wish, now: float) -> None:
        """A visitor wants to see something else."""
        if wish != visitor.wish:
            visitor.wish, visitor.changed, visitor.moved, visitor.shown = wish, now, True, None

    def scene_changed(self) -> None:
        """All pictures are of yesterday."""
        self._edition += 1
        for visitor in self.visitors:
            visitor.shown = None

    def take(self, share: float) -> None:
        """Use this part of the time, in (0, 1], for what is not an answer to a visitor's change: refined pictures, and new ones because the
        scene changed. The rest is left to others who need the processor.
        """
        self._share, self._free = share, 0.0

    def next(self, now: float) -> Job | float | None:
        """A picture to draw, or in how many seconds there may be one, or None if nothing is left to do."""
        jobs, soonest = [], None
        for visitor in self.visitors:
            if visitor.wish is None or visitor.shown == DIVISORS[-1]:
                continue
            divisor, due = visitor.coarse, self._free
            if visitor.moved:
                due = now
            elif visitor.shown is not None:
                divisor, due = visitor.shown // 2, max(self._free, visitor.changed + REST)
            if due <= now:
                rank = not visitor.moved, visitor.shown is not None, visitor.turn
                jobs.append((rank, Job(visitor, visitor.wish, divisor, self._edition)))
            soonest = due if soonest is None else min(due, soonest)
        if jobs:
            return min(jobs, key=lambda ranked: ranked[0])[1]
        return None if soonest is None else soonest - now

    def done(self, job: Job, seconds: float, now: float) -> None:
        """A picture was drawn and shown, which took so long."""
        visitor = job.visitor
        self._turn += 1
        visitor.turn = self._turn
        visitor.seconds[job.divisor] = seconds
        if not visitor.moved:
            self._free = now + seconds * (1 / self._share - 1)
        if visitor.wish is job.wish:
            visitor.moved = False
            visitor.shown = job.divisor if job.edition == self._edition else None

    def settled(self, now: float) -> bool:
        """Whether all who do not move see a sharp picture."""
        return all(visitor.wish is None or visitor.shown == DIVISORS[-1] or now < visitor.changed + REST for visitor in self.visitors)
