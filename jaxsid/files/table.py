"""A file of columns, opened but not yet read: what it holds and how to get some of it."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np

from jaxsid.checks import bad_input, require
from jaxsid.files.naming import listing, suggestion

INDEXED = re.compile(r"(.+):(\d+)")
MEMORY_SHARE = 0.5  # of what is free: the arrays are copied to the device afterwards

Columns: TypeAlias = dict[str, np.ndarray]


class Table(NamedTuple):
    """What a file holds.

    Attributes:
        path: the file.
        names: what its columns or variables are called.
        aliases: other names, each with the name it stands for.
        size: bytes needed to read the given names.
        read: the columns of the given names, 1-D or 2-D (rows, columns).
        first_row: number of the row that holds the first sample, as an editor counts.
    """

    path: Path
    names: tuple[str, ...]
    aliases: Mapping[str, str]
    size: Callable[[Sequence[str]], float]
    read: Callable[[Sequence[str]], Columns]
    first_row: int


def split_name(table: Table, name: str) -> tuple[str, int | None] | None:
    """The column of the file that a name means, with the index of "name:3"; None if there is none."""
    if name in table.names:
        return name, None
    if name in table.aliases:
        return table.aliases[name], None
    indexed = INDEXED.fullmatch(name)
    if indexed and indexed[1] in table.names:
        return indexed[1], int(indexed[2])
    return None


def require_column(table: Table, name: str) -> None:
    """Raise InputError, with what the file holds, unless it holds the column."""
    if split_name(table, name) is None:
        known = [*table.names, *table.aliases]
        bad_input(f"{table.path}: there is no column '{name}'.{suggestion(name, known)} {held(table)}")


def held(table: Table) -> str:
    """What the file holds, as a sentence."""
    return (
        f"The file holds {listing(table.names)}." if table.names else "The file holds no columns of numbers."
    )


def read_columns(table: Table, names: Iterable[str]) -> Columns:
    """One vector for each name, all of the same length; only these are read from the file."""
    wanted = {name: found for name in names if (found := split_name(table, name)) is not None}
    sources = list(dict.fromkeys(source for source, _ in wanted.values()))
    require_memory(table, sources)
    data = table.read(sources)
    columns = {name: vector(table, data[source], source, index) for name, (source, index) in wanted.items()}
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        counts = ", ".join(f"'{name}' {count}" for name, count in lengths.items())
        bad_input(
            f"{table.path}: the columns differ in length: {counts} samples. "
            "They must be read at the same instants."
        )
    return columns


def vector(table: Table, values: np.ndarray, name: str, index: int | None) -> np.ndarray:
    """One column of a variable as floating numbers."""
    where = f"{table.path}: column '{name}'"
    require(values.dtype.kind in "fiub", f"{where}: holds {kind_of(values)}, not real numbers.")
    values = values if values.dtype.kind == "f" else values.astype(float)
    if index is not None:
        width = values.shape[1] if values.ndim == 2 else 1
        require(
            values.ndim == 2 and index < width,
            f"{where}: has {width} columns, so '{name}:{index}' is not there (counting from 0).",
        )
        return np.ascontiguousarray(values[:, index])
    shape = " x ".join(map(str, values.shape))
    require(
        values.ndim == 1 or (values.ndim == 2 and 1 in values.shape),
        f"{where}: is {shape or 'a single number'}, not one column. Choose one by a `columns` map in a TOML "
        f"list of records, such as '{name}:0'.",
    )
    return values.ravel()


def kind_of(values: np.ndarray) -> str:
    """What an array that is not real numbers holds."""
    return {"c": "complex numbers", "U": "text", "S": "text", "M": "dates"}.get(
        values.dtype.kind, "a structure"
    )


def require_memory(table: Table, names: Sequence[str]) -> None:
    """Raise InputError where the named columns would not fit into memory."""
    free = available_memory()
    if free is None:
        return
    needed, limit = table.size(names), MEMORY_SHARE * free
    require(
        needed <= limit,
        f"{table.path}: reading {listing(names)} needs about {needed / 2**30:.3g} GiB, more than the "
        f"{limit / 2**30:.3g} GiB that can be used. Cut the record, or lower its sampling rate.",
    )


def available_memory() -> float | None:
    """Memory in bytes that can still be had, None where the system does not say."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        return next(1024.0 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    except (OSError, ValueError, StopIteration):
        return None
