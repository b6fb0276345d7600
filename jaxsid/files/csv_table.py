"""CSV: a header row, then numbers; separator and decimal sign are found out, '#' starts a comment."""

import codecs
import csv
import re
import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxsid.checks import InputError, bad_input, require
from jaxsid.files.table import Columns, Table

SEPARATORS = (",", ";", "\t")
SAMPLE = 65536  # bytes from which the layout is found out
PARSING_COPIES = 3  # of the numbers held at once while pandas parses
DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")


class Layout(NamedTuple):
    """How a CSV file is written."""

    encoding: str
    separator: str
    decimal: str
    header: tuple[str, ...]
    skipped: int  # lines up to and including the header
    rows: float  # estimated


def open_csv(path: Path) -> Table:
    """The table of a CSV file; its header row names the columns."""
    layout = find_layout(path)
    return Table(
        path=path,
        names=tuple(dict.fromkeys(name for name in layout.header if name)),
        aliases={},
        size=lambda names: PARSING_COPIES * 8.0 * layout.rows * len(names),
        read=lambda names: read_csv(path, layout, names),
        first_row=2,
    )


def find_layout(path: Path) -> Layout:
    """Encoding, separator, decimal sign, header and length, from the head of the file."""
    with path.open("rb") as stream:
        head = stream.read(SAMPLE)
    encoding = find_encoding(head)
    text = head.decode(encoding, errors="ignore")
    require("\0" not in text, f"{path}: holds binary data. Is it a CSV file?")
    lines = text.splitlines()
    data = [i for i, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")]
    require(len(data) > 0, f"{path}: holds no header and no data.")
    separator = find_separator(lines[data[0]], lines[data[1]] if len(data) > 1 else "")
    header = cells(lines[data[0]], separator)
    require(
        not all(is_number(cell) for cell in header),
        f"{path}: row 1 holds numbers only, {header[:3]}. The first row, comments apart, must name the "
        "columns, 'time' among them.",
    )
    require(
        len(header) > 1,
        f"{path}: row 1 is not cut into columns: {header[0]!r}. Separate them by comma, semicolon or tab.",
    )
    require(len(data) > 1, f"{path}: holds no rows of data below the header.")
    first = cells(lines[data[1]], separator)
    extra = [cell for cell in first[len(header) :] if cell]
    require(
        not extra,
        f"{path}: row 2 holds {len(first)} cells but the header {len(header)}. Is the comma both separator "
        "and "
        "decimal sign? Then separate by semicolons.",
    )
    decimal = "," if separator != "," and any(DECIMAL_COMMA.fullmatch(cell) for cell in first) else "."
    rows = len(data) * max(path.stat().st_size / len(head), 1.0)
    return Layout(encoding, separator, decimal, tuple(header), data[0] + 1, rows)


def is_number(cell: str) -> bool:
    """Whether a cell reads as a number."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def find_encoding(head: bytes) -> str:
    """UTF-8 unless the bytes say otherwise; spreadsheets also write UTF-16 and the Windows code page."""
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    try:
        codecs.getincrementaldecoder("utf-8-sig")().decode(head)  # which forgives a character cut at the end
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig"


def find_separator(header: str, row: str) -> str:
    """The separator that cuts the header into most cells, and a row into as many: names may hold others."""

    def rank(separator: str) -> tuple[bool, int]:
        count = len(cells(header, separator))
        return count > 1 and count == len(cells(row, separator)), count

    return max(SEPARATORS, key=rank)


def cells(line: str, separator: str) -> list[str]:
    """The cells of one line, without the space around them."""
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])]


def read_csv(path: Path, layout: Layout, names: Sequence[str]) -> Columns:
    """The named columns."""
    counts = Counter(layout.header)
    for name in names:
        require(
            counts[name] == 1,
            f"{path}: {counts[name]} columns are called '{name}' in the header. Rename all but one.",
        )
    places = [layout.header.index(name) for name in names]
    try:
        frame = parse(path, layout, places, dtype=np.float64, decimal=layout.decimal)
    except (ValueError, OverflowError) as error:
        blame_cell(path, layout, places)
        raise InputError(f"{path}: cannot be read as CSV: {str(error).strip()}.") from None
    return {name: frame[place].to_numpy() for name, place in zip(names, places, strict=True)}


def parse(path: Path, layout: Layout, places: Sequence[int], **options: Any) -> Any:
    """The columns at the given places as a data frame; columns are labelled by place."""
    import pandas as pd

    with warnings.catch_warnings(action="ignore"):  # of rows that end with a separator
        return pd.read_csv(
            path,
            sep=layout.separator,
            header=None,
            skiprows=layout.skipped,
            usecols=list(places),
            index_col=False,
            names=range(len(layout.header)),
            comment="#",
            skipinitialspace=True,
            encoding=layout.encoding,
            **exact_floats(pd.__version__),
            **options,
        )


def exact_floats(version: str) -> dict[str, str]:
    """The option with which pandas rounds every number correctly; since 3.1 it always does."""
    major, minor = (int(part) for part in version.split(".")[:2])
    return {} if (major, minor) >= (3, 1) else {"float_precision": "round_trip"}


def blame_cell(path: Path, layout: Layout, places: Sequence[int]) -> None:
    """Raise InputError for the first cell that is not a number, if one can be found."""
    try:
        frame = parse(path, layout, places, dtype=str)
    except ValueError:
        return  # the rows themselves are broken: pandas has said where
    for place in places:
        # An empty cell is NaN here, and no text to blame.
        text = [cell.strip() if isinstance(cell, str) else "0" for cell in frame[place]]
        bad = [i for i, cell in enumerate(text) if not is_number(cell.replace(layout.decimal, "."))]
        if bad:
            bad_input(
                f"{path}: column '{layout.header[place]}', row {bad[0] + 2}: '{text[bad[0]]}' is not "
                f"a number ({len(bad)} such cells in this column). The header is row 1."
            )
