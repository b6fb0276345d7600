"""Results of long steps, kept while a run lasts, so that one that was killed goes on where it was.

Steps are pure functions: a result is named by the function, its arguments and this library's sources, and nothing else
need be known of a run to take it up again. What has changed meanwhile is computed anew.
"""

import functools
import hashlib
import io
import pickle
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import ParamSpec, TypeVar

from jaxsid.compilation import source_stamp
from jaxsid.files.atomic import write_bytes_atomically

P = ParamSpec("P")
T = TypeVar("T")
_folder: ContextVar[Path | None] = ContextVar("folder", default=None)


@contextmanager
def resumable(folder: Path, *, resume: bool) -> Iterator[None]:
    """Keep the results of steps in a folder, which goes when the block ends well and stays when it is cut off.

    Args:
        folder: made when the first result is written; like every store of pickles one that nobody else can write to.
        resume: take up what an earlier run left there; else that is removed.
    """
    if not resume:
        shutil.rmtree(folder, ignore_errors=True)
    before = _folder.set(folder)
    try:
        yield
    finally:
        _folder.reset(before)
    shutil.rmtree(folder, ignore_errors=True)


def step(function: Callable[P, T]) -> Callable[P, T]:
    """A pure function whose results are kept inside `resumable`."""

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        folder = _folder.get()
        if folder is None:
            return function(*args, **kwargs)
        path = folder / _name(function, args, kwargs)
        if (known := _read(path)) is not None:
            return known[0]
        result = function(*args, **kwargs)
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        write_bytes_atomically(path, _signed(pickle.dumps((result,))))
        return result

    return call


def _name(function: Callable, args: tuple, kwargs: dict) -> str:
    stream = io.BytesIO()
    pickler = pickle.Pickler(stream)
    pickler.fast = True  # without a memo, so that equal values give equal bytes
    pickler.dump((function.__module__, function.__qualname__, args, kwargs))
    return hashlib.sha256(source_stamp() + stream.getvalue()).hexdigest()


def _signed(body: bytes) -> bytes:
    return hashlib.sha256(body).digest() + body


def _read(path: Path) -> tuple | None:
    """A kept result; None where there is none, or a damaged one."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    return pickle.loads(content[32:]) if _signed(content[32:]) == content else None
