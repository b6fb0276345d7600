"""Independent pieces of work side by side, on as many cores as the process may use."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar, copy_context
from typing import TypeVar

S = TypeVar("S")
T = TypeVar("T")
_running: ContextVar[int] = ContextVar("running", default=1)  # pieces of work side by side with this one


def side_by_side(function: Callable[[S], T], items: Iterable[S]) -> list[T]:
    """A function of every item, in threads, since compiled programs run without Python's lock.

    Within a piece of such work only the cores that it has to itself are used.

    Args:
        function: of one item; it sees the context of the caller, and leaves it alone.
        items: in whose order the results come.

    Raises:
        Exception: what the function raises for the first item that fails; items not begun by then are left.
    """
    every = list(items)
    workers = min(cores() // _running.get(), len(every))
    if workers < 2:
        return [copy_context().run(function, x) for x in every]
    pool = ThreadPoolExecutor(workers)

    def piece(x: S) -> T:
        _running.set(workers * _running.get())
        return function(x)

    try:
        jobs = [pool.submit(copy_context().run, piece, x) for x in every]
        return [job.result() for job in jobs]
    finally:
        pool.shutdown(cancel_futures=True)


def cores() -> int:
    """How many this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:
        return os.cpu_count() or 1
