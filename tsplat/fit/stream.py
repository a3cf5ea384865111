"""Photos read ahead by a worker thread: a step does not wait for the file of the next."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType

from torch import Tensor
from tsplat_reference.parallel import single_threaded_pool

from tsplat.scene.images import ImageStore


class PhotoStream:
    """`images[i]`, of which the next can be asked for beforehand.

    A context manager: at the end of the block the thread ends.

    Args:
        images: to read from.
        one_core: whether the rest is for something else, a fit on a CPU (see `single_threaded_pool`).
    """

    def __init__(self, images: ImageStore, *, one_core: bool = False) -> None:
        self._images = images
        self._worker = single_threaded_pool(1, "photos") if one_core else ThreadPoolExecutor(1, "photos")
        self._next: tuple[int, Future[Tensor]] | None = None

    def __getitem__(self, index: int) -> Tensor:
        if self._next is None or self._next[0] != index:
            self.prepare(index)
        assert self._next is not None
        return self._next[1].result()

    def prepare(self, index: int) -> None:
        """Begin to read photo `index`."""
        self._next = index, self._worker.submit(self._images.__getitem__, index)

    def __enter__(self) -> PhotoStream:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._worker.shutdown(cancel_futures=True)
