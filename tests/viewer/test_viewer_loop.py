"""The thread that draws for all."""

import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch

import tsplat.viewer.loop
from tsplat.scene import Gaussians, Spheres
from tsplat.viewer import RenderLoop, Settings, draw_view
from tsplat.viewer.schedule import Frame, Visitor, Wish
from tsplat.viewer.viewpoint import Viewpoint

Wait = Callable[..., None]


def wish(x: float = 0.0, **settings: float) -> Wish:
    return Wish(Viewpoint((1.0, 0.0, 0.0, 0.0), (x, 0.0, -4.0), 0.8, 32, 24), Settings(**settings))     # type: ignore[arg-type]


class Eye:
    """A visitor without a page."""

    def __init__(self, loop: RenderLoop) -> None:
        self.frames: list[Frame] = []
        self.visitor: Visitor = loop.enter(self.frames.append)

    def sharp(self, wish: Wish) -> Callable[[], bool]:
        """Whether the last frame is the sharp one of this wish."""
        return lambda: bool(self.frames) and self.frames[-1].wish == wish and self.frames[-1].divisor == 1


@pytest.fixture
def loop() -> Iterator[RenderLoop]:
    with RenderLoop() as loop:
        yield loop


def test_two_visitors_at_once_see_what_they_look_at(loop: RenderLoop, gaussians: Gaussians, wait: Wait) -> None:
    a, b = Eye(loop), Eye(loop)
    wishes = wish(-0.5), wish(0.5, splat_size=0.5)
    for eye, w in zip((a, b), wishes, strict=True):
        loop.wish(eye.visitor, w)
    assert loop.settled                                      # there is no scene yet
    assert loop.sharp(wishes[0]) is None
    loop.show(gaussians)
    for eye, w in zip((a, b), wishes, strict=True):
        wait(eye.sharp(w), "the sharp picture")
        want = draw_view(gaussians, w.viewpoint.camera(), w.settings)
        assert (eye.frames[-1].pixels == want).all()
        assert (loop.sharp(w) == want).all()
        assert [frame.divisor for frame in eye.frames] == sorted((f.divisor for f in eye.frames), reverse=True)
    assert (a.frames[-1].pixels != b.frames[-1].pixels).any()
    assert loop.visitors == 2


def test_a_new_scene_is_drawn_for_all_who_are_there(loop: RenderLoop, gaussians: Gaussians, spheres: Spheres, wait: Wait) -> None:
    stays, leaves = Eye(loop), Eye(loop)
    for eye in (stays, leaves):
        loop.wish(eye.visitor, wish())
    loop.show(gaussians)
    wait(lambda: loop.settled and stays.sharp(wish())() and leaves.sharp(wish())(), "both pictures")
    loop.leave(leaves.visitor)
    count = len(leaves.frames)
    loop.show(spheres)
    want = draw_view(spheres, wish().viewpoint.camera(), Settings())
    wait(lambda: stays.frames[-1].divisor == 1 and (stays.frames[-1].pixels == want).all(), "the picture of the spheres")
    assert len(leaves.frames) == count
    assert loop.visitors == 1


def test_a_picture_that_fails_does_not_end_the_others(loop: RenderLoop, gaussians: Gaussians, wait: Wait, monkeypatch: pytest.MonkeyPatch,
                                                      capsys: pytest.CaptureFixture[str]) -> None:
    def fails(*arguments: object) -> None:
        raise MemoryError("no room for this picture")

    eye = Eye(loop)
    with monkeypatch.context() as patch:
        patch.setattr(tsplat.viewer.loop, "draw_view", fails)
        loop.show(gaussians)
        loop.wish(eye.visitor, wish())
        wait(lambda: eye.visitor.shown == 1, "the failures")
    assert "no room for this picture" in capsys.readouterr().err
    assert not eye.frames
    loop.wish(eye.visitor, wish(1.0))
    wait(eye.sharp(wish(1.0)), "a picture after the failures")


@pytest.mark.parametrize("one_core", [False, True])
def test_only_one_thread_draws_on_all_cores(one_core: bool, gaussians: Gaussians, wait: Wait, monkeypatch: pytest.MonkeyPatch) -> None:
    """A second one would make both slower: each takes OpenMP threads of its own. None does beside a fit."""
    cores, drawn, others = 2, [], list[int]()

    def draw(*args: Any) -> Any:
        drawn.append((threading.current_thread().name, torch.get_num_threads()))
        return draw_view(*args)

    monkeypatch.setattr(tsplat.viewer.loop, "draw_view", draw)
    before = torch.get_num_threads()
    torch.set_num_threads(cores)
    try:
        with RenderLoop(one_core=one_core) as loop:
            loop.show(gaussians)
            eye = Eye(loop)
            loop.wish(eye.visitor, wish())
            wait(eye.sharp(wish()), "the sharp picture")
            loop.sharp(wish())
            other = threading.Thread(target=lambda: others.append(torch.get_num_threads()))
            other.start()
            other.join()
        assert torch.get_num_threads() == cores
    finally:
        torch.set_num_threads(before)
    assert set(drawn) == {("viewer", 1 if one_core else cores), (threading.current_thread().name, 1)}
    assert others == [cores]                                 # of a fit in a thread that has not computed yet, too


def test_the_thread_ends(gaussians: Gaussians) -> None:
    before = threading.active_count()
    with RenderLoop() as loop:
        loop.show(gaussians)
        assert threading.active_count() == before + 1
    assert threading.active_count() == before
