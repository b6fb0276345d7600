"""What the messages of this layer share: near misses, lists of names, files that are not there."""

import difflib
from collections.abc import Iterable
from pathlib import Path

from jaxsid.checks import bad_input, require

LISTED = 20


def listing(names: Iterable[str]) -> str:
    """The names in quotes, cut where there are too many to read."""
    names = list(names)
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return ", ".join(f"'{name}'" for name in names[:LISTED]) + more


def nearest(name: str, known: Iterable[str]) -> str | None:
    """The known name that is most like this one, whatever the case; None if none is close."""
    folded = {other.casefold(): other for other in known}
    found = difflib.get_close_matches(name.casefold(), list(folded), n=1, cutoff=0.6)
    return folded[found[0]] if found else None


def suggestion(name: str, known: Iterable[str]) -> str:
    """A sentence that offers the nearest known name, or nothing."""
    found = nearest(name, known)
    return f" Did you mean '{found}'?" if found else ""


def require_file(path: Path) -> None:
    """Raise InputError unless the path is a file that is there and holds something."""
    if not path.exists():
        folder = path.parent
        others = [other.name for other in folder.iterdir()] if folder.is_dir() else []
        where = "" if folder.is_dir() else f" (nor is there a folder '{folder}')"
        bad_input(f"{path}: there is no such file{where}.{suggestion(path.name, others)}")
    require(path.is_file(), f"{path}: is a folder, not a file.")
    require(path.stat().st_size > 0, f"{path}: the file is empty.")
