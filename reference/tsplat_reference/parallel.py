"""Independent pieces of work on all cores: a thread for each, in which torch's operations are single-threaded.

Operations on arrays that fit in a cache take 10 to 100 us, short for torch to split each of them over the cores: that gains less than whole
pieces of work on either core, if there are many of these and they are large. Results come in the order of the pieces, so that sums over them have
the same bits in every run and with any number of threads.
"""

from __future__ import annotations

import contextlib
import functools
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Protocol, TypeVar

import torch

T = TypeVar("T")
R = TypeVar("R")


class OrderedMap(Protocol):
    """`function` of each item, in the order of the items. With `repeat` an item comes again after all others that are left, until its
    result is None, which is not given: work in steps that depend on each other, as a function `next` of iterators, beside other such work.
    """

    def __call__(self, function: Callable[[T], R], items: Iterable[T], repeat: bool = False) -> Iterator[R]: ...


_pools: dict[int, ThreadPoolExecutor] = {}
_lock = threading.Lock()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pools.clear)    # threads do not survive a fork


@contextlib.contextmanager
def workers(worth: bool = True) -> Iterator[OrderedMap]:
    """Gives a map over independent pieces, without autograd, on `torch.get_num_threads()` threads.

    Meanwhile the calling thread's own operations are single-threaded, too: after a parallel one, OpenMP's threads would spin for a
    while and take the cores away from the workers. With `worth` False there are no workers: where there is little to do, handing it over
    costs more than it gains. Then the calling thread does all, and its operations are as parallel as torch makes them.
    """
    threads = torch.get_num_threads()
    if threads == 1 or not worth:
        yield _plain_map
        return
    pool = _pool(threads)
    with single_threaded():
        yield functools.partial(_pool_map, pool, threads)


def map_chunks(function: Callable[[slice], R], n: int, size: int) -> list[R]:
    """`function` of the slices of `size` rows that make up n rows."""
    with workers(n > size) as ordered_map:
        return list(ordered_map(function, [slice(i, i + size) for i in range(0, n, size)]))


def _plain_map(function: Callable[[T], R], items: Iterable[T], repeat: bool = False) -> Iterator[R]:
    queue = deque(items)
    while queue:
        item = queue.popleft()
        result = _call(function, item)
        if not repeat:
            yield result
        elif result is not None:
            queue.append(item)
            yield result


def _pool_map(pool: ThreadPoolExecutor, threads: int, function: Callable[[T], R], items: Iterable[T], repeat: bool = False) -> Iterator[R]:
    queue = deque(items)
    pending: deque[tuple[T, Future[R]]] = deque()
    while queue or pending:
        while queue and len(pending) < threads + 2:     # bounds the results that wait
            item = queue.popleft()
            pending.append((item, pool.submit(_call, function, item)))
        item, future = pending.popleft()
        result = future.result()
        if not repeat:
            yield result
        elif result is not None:
            queue.append(item)                          # the order of pending and queue together is that of `_plain_map`
            yield result


def _call(function: Callable[[T], R], item: T) -> R:
    with torch.no_grad():
        return function(item)


@contextlib.contextmanager
def single_threaded() -> Iterator[None]:
    """The calling thread's operations are single-threaded: where another thread has the work that all cores are for.

    Each thread with parallel operations has OpenMP threads of its own, as long as it lives. If there are more of these than cores, OpenMP (GNU's)
    no longer lets them spin while they wait for each other, but sleep: everything in the process takes up to twice as long.

    Threads that look at their setting (`torch.get_num_threads`) in the block for the first time are so for good.
    """
    before = torch.get_num_threads()    # a thread's first look takes over the process's setting, so it comes before its own setting
    torch.set_num_threads(1)            # each thread's own, but for threads that have not looked yet
    try:
        yield
    finally:
        torch.set_num_threads(before)


def single_threaded_pool(threads: int, name: str) -> ThreadPoolExecutor:
    """Threads whose operations are single-threaded (see `single_threaded`); the setting of all others, and of those yet to come, stays."""
    pool = ThreadPoolExecutor(threads, name, initializer=torch.get_num_threads)
    started = threading.Barrier(threads)
    with single_threaded():
        for future in [pool.submit(started.wait) for _ in range(threads)]:
            future.result()
    return pool


def _pool(threads: int) -> ThreadPoolExecutor:
    with _lock:
        if threads not in _pools:
            _pools[threads] = single_threaded_pool(threads, "tsplat")
        return _pools[threads]
