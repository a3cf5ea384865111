"""`RenderLoop`: the one thread that draws for all visitors."""

from __future__ import annotations

import contextlib
import threading
import time
import traceback
from collections.abc import Callable
from types import TracebackType

import torch
from tsplat_reference.parallel import single_threaded

from tsplat.pictures.modes import Scene
from tsplat.viewer.schedule import Frame, Job, Schedule, Visitor, Wish
from tsplat.viewer.view import Pixels, draw_view


class RenderLoop:
    """Draws a scene for any number of visitors, as `Schedule` says.

    The methods may be called from any thread. A context manager: at the end of the block the thread ends.

    Args:
        one_core: whether the rest of a CPU is for something else, a fit (see `tsplat_reference.parallel.single_threaded`).
    """

    def __init__(self, *, one_core: bool = False) -> None:
        self._schedule = Schedule()
        self._scene: Scene | None = None
        self._changed = threading.Condition()
        self._closed = False
        self._looked = threading.Event()
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        with single_threaded() if one_core else contextlib.nullcontext():
            self._thread.start()
            self._looked.wait()

    def enter(self, show: Callable[[Frame], None]) -> Visitor:
        """A page was opened. Its `show` is called in the thread that draws."""
        visitor = Visitor(show)
        with self._changed:
            self._schedule.visitors.append(visitor)
            self._changed.notify_all()
        return visitor

    def leave(self, visitor: Visitor) -> None:
        """The page was closed."""
        with self._changed:
            self._schedule.visitors.remove(visitor)
            self._changed.notify_all()

    def wish(self, visitor: Visitor, wish: Wish) -> None:
        """A visitor wants to see this from now on."""
        with self._changed:
            self._schedule.wish(visitor, wish, time.perf_counter())
            self._changed.notify_all()

    def show(self, scene: Scene) -> None:
        """Draw this scene from now on. Nobody may change it any more."""
        with self._changed:
            self._scene = scene
            self._schedule.scene_changed()
            self._changed.notify_all()

    def take(self, share: float) -> None:
        """How much of the time is for pictures that are no answer to a visitor's change (see `Schedule`)."""
        with self._changed:
            self._schedule.take(share)
            self._changed.notify_all()

    @property
    def visitors(self) -> int:
        """How many pages are open."""
        with self._changed:
            return len(self._schedule.visitors)

    @property
    def settled(self) -> bool:
        """Whether all visitors who do not move see a sharp picture of the scene."""
        with self._changed:
            return self._scene is None or self._schedule.settled(time.perf_counter())

    def sharp(self, wish: Wish) -> Pixels | None:
        """The picture of a wish at its full resolution, drawn by the calling thread; None as long as there is no scene."""
        with single_threaded():                       # beside the thread of the loop
            return None if self._scene is None else draw_view(self._scene, wish.viewpoint.camera(), wish.settings)

    def close(self) -> None:
        """End the thread, after the picture at which it is."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join()

    def __enter__(self) -> RenderLoop:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _run(self) -> None:
        torch.get_num_threads()                       # now, that of this moment is this thread's
        self._looked.set()
        while (work := self._next()) is not None:
            job, scene = work
            begin = time.perf_counter()
            try:
                pixels = draw_view(scene, job.wish.viewpoint.camera(job.divisor), job.wish.settings)
                if job.visitor in self._schedule.visitors:             # still
                    job.visitor.show(Frame(pixels, job.wish, job.divisor, time.perf_counter() - begin))
            except Exception:                         # one picture that fails (memory, say) must not end those of all visitors
                traceback.print_exc()
            with self._changed:
                now = time.perf_counter()
                self._schedule.done(job, now - begin, now)

    def _next(self) -> tuple[Job, Scene] | None:
        """What to draw, as soon as there is something; None at the end."""
        with self._changed:
            while not self._closed:
                job = None if self._scene is None else self._schedule.next(time.perf_counter())
                if isinstance(job, Job) and self._scene is not None:
                    return job, self._scene
                self._changed.wait(None if isinstance(job, Job) else job)
        return None
