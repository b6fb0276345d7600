"""Realizations on disk: a small Parquet file for each chunk of a case, there whole or not at all."""

import io
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float

from jaxsid.checks import bad_input, require
from jaxsid.files.atomic import draft_beside

NAME = re.compile(r"(\d+)-(\d+)\.parquet")
NUMBER = "number"  # of a realization; "realization" is a factor


class Span(NamedTuple):
    """Realizations `first` to `end - 1`."""

    first: int
    end: int


def part_path(folder: Path, span: Span) -> Path:
    return folder / f"{span.first:06d}-{span.end:06d}.parquet"


def write_part(
    folder: Path, first: int, names: tuple[str, ...], values: Float[np.ndarray, "count quantities"]
) -> None:
    """Keep realizations from `first` on, one column a quantity, so that not even a power cut leaves half of them."""
    span = Span(first, first + len(values))
    columns = {NUMBER: np.arange(*span), **dict(zip(names, values.T, strict=True))}
    stream = io.BytesIO()
    options = {"compression": "none", "use_dictionary": False, "write_statistics": False}
    pq.write_table(pa.table(columns), stream, write_page_checksum=True, **options)
    put(part_path(folder, span), stream.getvalue())


def put(path: Path, content: bytes) -> None:
    """Put the content in the place of `path`, on the disk itself before it gets that name."""
    with draft_beside(path) as draft, draft.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())


def read_part(path: Path, names: tuple[str, ...]) -> Float[np.ndarray, "count quantities"] | None:
    """The values of a part; None where the file is damaged or not what its name says."""
    try:
        source = pa.BufferReader(path.read_bytes())
        table = pq.ParquetFile(source, page_checksum_verification=True).read()
    except (OSError, pa.ArrowException):
        return None
    span = _span(path)
    if table.column_names != [NUMBER, *names] or not np.array_equal(table[NUMBER], np.arange(*span)):
        return None
    return np.column_stack([table[name].to_numpy() for name in names])


def sound_parts(folder: Path, names: tuple[str, ...]) -> list[Span]:
    """What is there, in order; a damaged part is removed, so that it is computed anew."""
    spans, end = [], 0
    for path in _paths(folder):
        if read_part(path, names) is None:
            path.unlink()
        elif _span(path).first >= end:
            spans.append(_span(path))
            end = spans[-1].end
    return spans


def missing(spans: list[Span], count: int, chunk: int) -> Iterator[Span]:
    """Spans that are not there of realizations 0 to count - 1, cut at the multiples of `chunk`."""
    begin = 0
    for span in [*spans, Span(count, count)]:
        while begin < min(span.first, count):
            end = min(span.first, count, begin - begin % chunk + chunk)
            yield Span(begin, end)
            begin = end
        begin = max(begin, span.end)


def read_realizations(
    folder: Path, names: tuple[str, ...], count: int
) -> Float[np.ndarray, "count quantities"]:
    """Realizations 0 to count - 1 of a case, from all its parts."""
    values, end = np.empty((count, len(names))), 0
    for path in _paths(folder):
        first, last = _span(path)
        part = read_part(path, names) if first == end < count else None
        if part is not None:
            values[first:last] = part[: count - first]
            end = last
    require(
        end >= count, f"{folder}: realizations from {end} on are damaged or gone. Run the same command again."
    )
    return values


def _paths(folder: Path) -> list[Path]:
    """Files of parts, in the order of what they hold."""
    return sorted((path for path in folder.iterdir() if NAME.fullmatch(path.name)), key=_span)


def _span(path: Path) -> Span:
    match = NAME.fullmatch(path.name)
    if match is None:
        bad_input(f"{path}: is no part of a study.")
    return Span(int(match[1]), int(match[2]))
