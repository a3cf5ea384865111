"""What is drawn when, for whom and how finely, with a clock of our own."""

from collections.abc import Callable
from typing import NamedTuple

import pytest

from tsplat.viewer.schedule import DIVISORS, PROMPT, REST, Job, Schedule, Visitor, Wish
from tsplat.viewer.view import Settings
from tsplat.viewer.viewpoint import Viewpoint


def wish(x: float = 0.0) -> Wish:
    return Wish(Viewpoint((1.0, 0.0, 0.0, 0.0), (x, 0.0, 0.0), 1.0, 640, 480), Settings())


class Drawn(NamedTuple):
    """A picture that ended at `time`."""

    time: float
    visitor: Visitor
    divisor: int


class World:
    """A schedule with a clock, and pictures that take `cost(divisor)` seconds."""

    def __init__(self, cost: Callable[[int], float], visitors: int = 1) -> None:
        self.schedule, self.cost, self.now = Schedule(), cost, 0.0
        self.schedule.visitors += [Visitor(lambda frame: None) for _ in range(visitors)]

    def run(self, until: float, moves: Callable[[float], float] | None = None, who: int = 0) -> list[Drawn]:
        """Draw up to a time, while visitor `who` is at the place `moves(now)`."""
        drawn = []
        while self.now < until:
            if moves is not None:
                self.schedule.wish(self.schedule.visitors[who], wish(moves(self.now)), self.now)
            job = self.schedule.next(self.now)
            if isinstance(job, Job):
                seconds = self.cost(job.divisor)
                self.now += seconds
                self.schedule.done(job, seconds, self.now)
                drawn.append(Drawn(self.now, job.visitor, job.divisor))
            elif job is None:
                self.now = until
            else:
                assert job > 0
                self.now += job
        return drawn


def per_pixel(full: float, splats: float = 0.0) -> Callable[[int], float]:
    """The cost of pictures of which the sharp one takes `full` seconds, and all of them `splats` seconds for the splats."""
    return lambda divisor: splats + (full - splats) / divisor**2


def test_nothing_to_do_before_there_is_a_wish_and_after_the_sharp_picture() -> None:
    world = World(per_pixel(1.0))
    assert world.schedule.next(0.0) is None
    world.schedule.wish(world.schedule.visitors[0], wish(), 0.0)
    drawn = world.run(5.0)
    assert [d.divisor for d in drawn] == [8, 4, 2, 1]
    assert drawn[0].time < REST < drawn[1].time                                        # refined at rest only
    assert world.schedule.next(5.0) is None
    assert world.schedule.settled(5.0)
    world.schedule.wish(world.schedule.visitors[0], wish(), 5.0)                       # the same again
    assert world.schedule.next(5.0) is None


def test_pictures_stay_coarse_while_the_camera_moves_and_end_sharp() -> None:
    world = World(per_pixel(1.0))
    moving = world.run(3.0, moves=lambda now: now)
    assert len(moving) > 3.0 / PROMPT                                                  # each was prompt
    assert {d.divisor for d in moving[3:]} == {4}                                      # 1/16 s; at 1/2 of the resolution it would be 1/4
    rest = world.run(9.0)
    assert [d.divisor for d in rest] == [4, 2, 1] or [d.divisor for d in rest] == [2, 1]
    assert world.schedule.next(9.0) is None


def test_a_fast_renderer_draws_all_pictures_sharp() -> None:
    drawn = World(per_pixel(0.01)).run(1.0, moves=lambda now: now)
    assert [d.divisor for d in drawn[:2]] == [8, 1]
    assert {d.divisor for d in drawn[1:]} == {1}


def test_a_coarser_picture_that_gains_nothing_is_not_drawn() -> None:
    world = World(per_pixel(0.6, splats=0.5))
    world.schedule.wish(world.schedule.visitors[0], wish(-1.0), 0.0)
    world.run(10.0)
    assert {d.divisor for d in world.run(20.0, moves=lambda now: now)} == {1}


def test_one_slow_picture_is_forgotten() -> None:
    """The first ones compile and load, which takes long, and says nothing about those that follow."""
    costs = iter([5.0, 3.0])
    world = World(lambda divisor: next(costs, per_pixel(1.0)(divisor)))
    drawn = world.run(12.0, moves=lambda now: now)
    assert {d.divisor for d in drawn[6:]} == {4}


def test_two_visitors_have_turns() -> None:
    world = World(per_pixel(1.0), visitors=2)
    a, b = world.schedule.visitors
    world.schedule.wish(b, wish(7.0), 0.0)
    drawn = world.run(3.0, moves=lambda now: now, who=0)
    assert drawn[0].visitor is not drawn[1].visitor                                    # both at once
    assert [d.divisor for d in drawn if d.visitor is b] == [8]                         # a moves: its pictures come before finer ones for b
    later = world.run(9.0)
    for visitor in (a, b):
        assert [d.divisor for d in later if d.visitor is visitor][-1] == 1
    both = World(per_pixel(1.0), visitors=2)
    for visitor, job in zip(both.schedule.visitors, (wish(1.0), wish(2.0)), strict=True):
        both.schedule.wish(visitor, job, 0.0)
    turns = [both.schedule.visitors.index(d.visitor) for d in both.run(9.0)]
    assert turns == [0, 1] * len(DIVISORS)


def test_a_wish_that_changes_while_it_is_drawn_is_drawn_again() -> None:
    world = World(per_pixel(1.0))
    visitor, schedule = world.schedule.visitors[0], world.schedule
    schedule.wish(visitor, wish(1.0), 0.0)
    job = schedule.next(0.0)
    assert isinstance(job, Job)
    schedule.wish(visitor, wish(2.0), 0.01)
    schedule.done(job, 0.02, 0.02)
    again = schedule.next(0.02)
    assert isinstance(again, Job)
    assert again.wish == wish(2.0)


def test_a_scene_that_changes_while_it_is_drawn_is_drawn_again() -> None:
    world = World(per_pixel(1.0))
    visitor, schedule = world.schedule.visitors[0], world.schedule
    schedule.wish(visitor, wish(), 0.0)
    world.run(5.0)
    schedule.scene_changed()
    job = schedule.next(world.now)
    assert isinstance(job, Job)
    schedule.scene_changed()
    schedule.done(job, 0.1, world.now)
    assert visitor.shown is None
    assert not schedule.settled(world.now)
    world.run(15.0)
    assert schedule.settled(15.0)


def test_others_get_their_share() -> None:
    """While a fit goes on, pictures of its new scenes take a quarter of the time; the answers to a visitor do not wait."""
    world = World(per_pixel(0.4))
    schedule, visitor = world.schedule, world.schedule.visitors[0]
    schedule.wish(visitor, wish(), 0.0)
    world.run(5.0)
    schedule.take(0.25)
    busy, begin = 0.0, world.now
    while world.now < begin + 40.0:
        if schedule.settled(world.now):
            schedule.scene_changed()
        busy += sum(world.cost(d.divisor) for d in world.run(world.now + 0.1))
    assert busy / (world.now - begin) == pytest.approx(0.25, rel=0.05)                 # but for the last picture
    schedule.scene_changed()
    job = schedule.next(world.now + 2.0)
    assert isinstance(job, Job)
    schedule.done(job, 0.1, world.now)
    assert schedule.next(world.now) == pytest.approx(0.3)
    schedule.wish(visitor, wish(1.0), world.now)
    assert isinstance(schedule.next(world.now), Job)                                   # at once
    schedule.take(1.0)
    world.run(world.now + 3.0)
    assert schedule.settled(world.now)


def test_settled_does_not_wait_for_those_who_move() -> None:
    world = World(per_pixel(1.0))
    visitor = world.schedule.visitors[0]
    assert world.schedule.settled(0.0)
    world.schedule.wish(visitor, wish(1.0), 0.0)
    assert world.schedule.settled(0.5 * REST)
    assert not world.schedule.settled(1.5 * REST)
