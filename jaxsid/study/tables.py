"""The tables of a study: every realization, and a summary with a row for each case and quantity.

`results.parquet` is tidy: case, its factors, number of the realization, quantity, value (NaN where it failed). It is
written case by case, so that memory does not grow with the study. Equal studies give equal bytes.
"""

import csv
import io
import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float

from jaxsid.checks import InputError
from jaxsid.files.atomic import draft_beside, write_bytes_atomically
from jaxsid.study.configuration import Case, Study
from jaxsid.study.parts import read_realizations
from jaxsid.study.store import Facts, case_folder, read_facts
from jaxsid.study.summary import Row, summarize

LINES = 2**17  # rows of results.parquet that are in memory at once, unless a case has more realizations
OWN = [name for name in Row._fields if name not in ("case", "factors", "quantity", "unit")]


def write_tables(study: Study, store: Path) -> list[Row]:
    """Write results.parquet, summary.parquet and summary.csv of a study that is complete, and give the summary.

    Raises:
        InputError: realizations are missing or damaged; the folder cannot be written to.
    """
    types = factor_types(study.cases)
    rows: list[Row] = []
    with draft_beside(store / "results.parquet") as draft, draft.open("wb") as stream:
        with pq.ParquetWriter(
            stream,
            _schema(types),
            compression="zstd",
            use_dictionary=[*types, "quantity"],  # pyright: ignore[reportArgumentType]
        ) as writer:
            for case in study.cases:
                facts, values = _case(study, store, case)
                for table in _long(case, facts.names, values, _schema(types)):
                    writer.write_table(table)
                rows += summarize(case, facts, values)
        stream.flush()
        os.fsync(stream.fileno())
    write_summary(rows, types, store)
    return rows


def _case(study: Study, store: Path, case: Case) -> tuple[Facts, Float[np.ndarray, "count quantities"]]:
    facts = read_facts(store, case.index)
    if facts is None:
        raise InputError(f"{store}: case {case.index} was not begun. Run the study first.")
    return facts, read_realizations(case_folder(store, case.index), facts.names, study.realizations)


def factor_types(cases: Sequence[Case]) -> dict[str, pa.DataType]:
    """Type of each factor's column: that of its values, a number where they are integers and reals, else text."""
    return {name: _type({type(case.values[name]) for case in cases}) for name in cases[0].values}


def _type(kinds: set[type]) -> pa.DataType:
    if kinds == {bool}:
        return pa.bool_()
    if kinds == {int}:
        return pa.int64()
    return pa.float64() if kinds <= {int, float} else pa.string()


def _plain(value: str | int | float | bool, kind: pa.DataType) -> str | int | float | bool:
    """The value as its column wants it."""
    return str(value) if kind == pa.string() else float(value) if kind == pa.float64() else value


def _schema(types: dict[str, pa.DataType]) -> pa.Schema:
    tail = {"number": pa.int64(), "quantity": pa.string(), "value": pa.float64()}
    return pa.schema({"case": pa.int64(), **types, **tail})


def _long(
    case: Case, names: tuple[str, ...], values: Float[np.ndarray, "count quantities"], schema: pa.Schema
):
    """The case as long tables, some quantities at a time."""
    count = len(values)
    step = max(LINES // count, 1)
    for first in range(0, len(names), step):
        some = names[first : first + step]
        size = count * len(some)
        constant = {"case": case.index, **case.values}
        columns = [
            pa.repeat(
                pa.scalar(_plain(constant[name], schema.field(name).type), schema.field(name).type), size
            )
            for name in constant
        ]
        numbers = np.tile(np.arange(count), len(some))
        quantity = pa.array(np.repeat(np.array(some, dtype=object), count), pa.string())
        value = np.ascontiguousarray(values[:, first : first + step].T).ravel()
        yield pa.Table.from_arrays([*columns, pa.array(numbers), quantity, pa.array(value)], schema=schema)


def write_summary(rows: Sequence[Row], types: dict[str, pa.DataType], store: Path) -> None:
    """Write summary.parquet and summary.csv; NaN is NaN in the one and an empty field in the other."""
    columns = {"case": pa.array([row.case for row in rows])}
    for name, kind in types.items():
        columns[name] = pa.array([_plain(row.factors[name], kind) for row in rows], kind)
    columns |= {name: pa.array([getattr(row, name) for row in rows]) for name in ("quantity", "unit", *OWN)}
    stream = io.BytesIO()
    pq.write_table(pa.table(columns), stream, compression="zstd")
    write_bytes_atomically(store / "summary.parquet", stream.getvalue())
    write_bytes_atomically(store / "summary.csv", _csv(columns).encode())


def _csv(columns: dict[str, pa.Array]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for line in zip(*(column.to_pylist() for column in columns.values()), strict=True):
        writer.writerow(["" if isinstance(x, float) and math.isnan(x) else x for x in line])
    return text.getvalue()
