"""Output that is there whole or not at all: written beside its place, moved in when it is complete."""

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from jaxsid.checks import InputError, require


def write_atomically(path: Path | str, write: Callable[[TextIO], object]) -> None:
    """Let `write` fill a new text file beside `path`, then put it in its place; on failure nothing is left.

    Raises InputError where the folder is missing or cannot be written to.
    """
    with draft_beside(Path(path)) as draft, draft.open("w", encoding="utf-8", newline="\n") as stream:
        write(stream)


def write_bytes_atomically(path: Path | str, content: bytes) -> None:
    """Put the content in the place of `path`, whole or not at all; errors as for `write_atomically`."""
    with draft_beside(Path(path)) as draft:
        draft.write_bytes(content)


@contextmanager
def draft_beside(path: Path) -> Iterator[Path]:
    """A name beside `path` to write to, moved to `path` when the block ends well."""
    require(not path.is_dir(), f"{path}: is a folder; name a file to write to.")
    require(path.parent.is_dir(), f"{path}: there is no folder '{path.parent}' to write into. Make it first.")
    draft = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        yield draft
        os.replace(draft, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}.") from error
    finally:
        draft.unlink(missing_ok=True)


@contextmanager
def atomic_directory(directory: Path | str) -> Iterator[Path]:
    """A fresh folder to write into, whose files move into `directory` when the block ends well.

    Where the block fails nothing of it is left, and `directory` is as it was. Files of an older run with
    other names stay. The draft lies on the same disk, so that each move is one step.

        with atomic_directory(out) as draft:
            write_json(draft / "identification.json", result)
    """
    directory = Path(directory)
    require(
        not directory.exists() or directory.is_dir(), f"{directory}: is a file; name a folder for the output."
    )
    anchor = nearest_folder(directory)
    try:
        draft = Path(tempfile.mkdtemp(prefix=f".{directory.name}.", suffix=".tmp", dir=anchor))
    except OSError as error:
        raise InputError(f"{directory}: cannot be written to '{anchor}': {error.strerror}.") from error
    try:
        yield draft
        move_files(draft, directory)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def nearest_folder(directory: Path) -> Path:
    """The closest folder at or above the parent that is there already."""
    folder = next(parent for parent in directory.absolute().parents if parent.exists())
    require(folder.is_dir(), f"{directory}: '{folder}' is a file, so no folder can be made in it.")
    return folder


def move_files(source: Path, target: Path) -> None:
    """Move every file below `source` to the same place below `target`, replacing what is there."""
    try:
        target.mkdir(parents=True, exist_ok=True)
        for file in sorted(item for item in source.rglob("*") if item.is_file()):
            place = target / file.relative_to(source)
            place.parent.mkdir(parents=True, exist_ok=True)
            os.replace(file, place)
    except OSError as error:
        raise InputError(f"{target}: cannot be written: {error.strerror}.") from error
