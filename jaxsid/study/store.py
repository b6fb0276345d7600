"""The folder of a study: what is to be done, what is done, and a lock, so that it can stop and go on at any moment.

    plan.json                            the study, to know it again
    parts/case-00012/case.json           the case: quantities, units, truth, Cramer-Rao bound
    parts/case-00012/000256-000512.parquet   realizations 256 to 511
    lock                                 held by the process at work; the system frees it however that ends

What is missing follows from the parts that are there; nothing else remembers progress.
"""

import fcntl
import functools
import hashlib
import json
import os
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np
from jaxtyping import Float

from jaxsid.checks import InputError, bad_input, require
from jaxsid.study.configuration import Study
from jaxsid.study.parts import put

SCHEMA = 1
DECIDING = (
    "records",
    "modes",
    "least_squares",
    "mechanics",
    "examples",
    "impulse",
    "realization",
    "physical",
    "uncertainty",
    "study",
)
SHOWN = 5  # differences named in a message
ABSENT = "absent"


class Facts(NamedTuple):
    """What of a case does not depend on the noise."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    truth: Float[np.ndarray, " q"]
    bound: Float[np.ndarray, " q"]


@functools.cache
def versions() -> dict[str, str]:
    """What the results depend on besides the study: versions, and the sources of what computes the numbers."""
    package, digest = Path(__file__).parents[1], hashlib.sha256()
    for part in DECIDING:
        for source in sorted((package / part).rglob("*.py")) or [package / f"{part}.py"]:
            digest.update(source.read_bytes())
    return {"jaxsid": f"{version('jaxsid')} ({digest.hexdigest()[:8]})", "jax": version("jax")}


@contextmanager
def open_store(folder: Path, study: Study) -> Iterator[Path]:
    """The folder, made if need be, for this process alone as long as the block lasts.

    Args:
        folder: of the study's results.
        study: what is to be run; one begun there before must be the same, but for its name, the chunk and the
            number of realizations.

    Raises:
        InputError: the folder holds another study, or one begun with other versions; another process is at work
            there; it cannot be written to.
    """
    lock = _claimed(folder)
    try:
        _clean(folder)
        _check_plan(folder, study)
        yield folder
    finally:
        lock.close()


def _claimed(folder: Path) -> TextIO:
    """The lock file of the folder, locked for this process, which it names."""
    require(not folder.exists() or folder.is_dir(), f"{folder}: is a file; name a folder for the results.")
    try:
        (folder / "parts").mkdir(parents=True, exist_ok=True)
        lock = (folder / "lock").open("a+")
    except OSError as error:
        raise InputError(f"{folder}: cannot be written to: {error.strerror}.") from error
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        with lock:
            lock.seek(0)
            holder = lock.read().strip() or error.strerror
        bad_input(
            f"{folder}: another jaxsid is at work there ({holder}). Let it finish, stop it, or name another folder."
        )
    lock.truncate(0)
    lock.write(f"process {os.getpid()} on {socket.gethostname()}\n")
    lock.flush()
    return lock


def _clean(folder: Path) -> None:
    """Remove drafts that a killed process left."""
    for draft in [*folder.glob(".*.tmp"), *folder.glob("parts/*/.*.tmp")]:
        draft.unlink()


def _check_plan(folder: Path, study: Study) -> None:
    """Write down what is to be done here, or make sure that it is what was begun."""
    path = folder / "plan.json"
    built = versions()
    plan = {"schema": SCHEMA, "name": study.name, "built_with": built, "study": json.loads(study.source)}
    if not path.exists():
        require(
            not any((folder / "parts").iterdir()),
            f"{folder}: holds parts of a study but no plan.json that says of which. Name another folder.",
        )
        put(path, json.dumps(plan, indent=1).encode())
        return
    begun = _read_json(path)
    _same(
        folder,
        begun.get("study"),
        plan["study"],
        "another study",
        "Name another folder, or change the study back",
    )
    _same(
        folder,
        begun.get("built_with"),
        built,
        "a study begun with other versions",
        "Install them, or start anew",
    )


def _same(folder: Path, begun: Any, now: Any, what: str, remedy: str) -> None:
    old, new = _flat(begun), _flat(now)
    differ = [key for key in sorted({*old, *new}) if old.get(key) != new.get(key)]
    if differ:
        told = [
            f"{key or 'all'} was {old.get(key, ABSENT)}, is {new.get(key, ABSENT)}" for key in differ[:SHOWN]
        ]
        more = f"; and {len(differ) - SHOWN} more" if len(differ) > SHOWN else ""
        bad_input(f"{folder}: holds {what}: {'; '.join(told)}{more}. {remedy}.")


def _flat(value: Any, prefix: str = "") -> dict[str, str]:
    """Every entry of nested tables by its dotted name."""
    if not isinstance(value, Mapping):
        return {prefix: ABSENT if value is None else json.dumps(value)}
    return {
        name: text
        for key, item in value.items()
        for name, text in _flat(item, f"{prefix}.{key}" if prefix else key).items()
    }


def _read_json(path: Path) -> dict:
    try:
        return json.loads(path.read_text())
    except ValueError:
        bad_input(f"{path}: is damaged. Remove the folder and start anew.")


def case_folder(folder: Path, case: int) -> Path:
    """Folder of the parts of a case."""
    return folder / "parts" / f"case-{case:05d}"


def write_facts(folder: Path, case: int, facts: Facts) -> None:
    """Keep what is known of a case before any realization."""
    case_folder(folder, case).mkdir(exist_ok=True)
    columns = {"truth": facts.truth, "bound": facts.bound}
    plain = {name: [float(x) if np.isfinite(x) else None for x in column] for name, column in columns.items()}
    content = {"schema": SCHEMA, "names": facts.names, "units": facts.units, **plain}
    put(case_folder(folder, case) / "case.json", json.dumps(content, indent=1).encode())


def read_facts(folder: Path, case: int) -> Facts | None:
    """What was kept of a case; None where there is nothing yet."""
    path = case_folder(folder, case) / "case.json"
    if not path.exists():
        return None
    content = _read_json(path)
    truth, bound = (np.array(content[name], dtype=float) for name in ("truth", "bound"))
    return Facts(tuple(content["names"]), tuple(content["units"]), truth, bound)
