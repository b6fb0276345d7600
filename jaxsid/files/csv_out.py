"""Responses and records as CSV or NPZ, in full precision."""

import csv
import io
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TextIO

import numpy as np
from jaxtyping import ArrayLike

from jaxsid.checks import bad_input, require
from jaxsid.files.atomic import write_atomically, write_bytes_atomically
from jaxsid.records import Record

TIME_DIGITS = 15  # enough for any time, and 0.3 s is written 0.3


def write_response(path: Path | str, y: ArrayLike, dt: ArrayLike, names: Sequence[str]) -> None:
    """Write a response as CSV: `time`, t_k = k dt in s, and a column for each sensor, SI units.

    Args:
        path: the file; it is there whole or not at all.
        y: (samples, outputs).
        dt: sampling interval, s.
        names: of the outputs.

    Raises:
        InputError: names and columns differ in number, or the file cannot be written.
    """
    y = np.asarray(y)
    require(
        y.ndim == 2 and len(names) == y.shape[1],
        f"{path}: a response of shape {y.shape} does not go with {len(names)} names of outputs.",
    )
    write_columns(Path(path), ["time", *names], [times(len(y), dt), *y.T])


def write_record(record: Record, path: Path | str) -> None:
    """Write a record as CSV or NPZ, by the ending of the path, so that `read_record` gives it back.

    Raises:
        InputError: any other ending, names used twice, or the file cannot be written.
    """
    path = Path(path)
    names = ["time", *record.inputs, *record.outputs]
    require(
        len(set(names)) == len(names), f"{path}: time, inputs and outputs need different names to be columns."
    )
    columns = [times(len(record.u), record.dt), *np.asarray(record.u).T, *np.asarray(record.y).T]
    if path.suffix.lower() == ".csv":
        write_columns(path, names, columns)
    elif path.suffix.lower() == ".npz":
        write_bytes_atomically(path, npz_bytes(dict(zip(names, columns, strict=True))))
    else:
        bad_input(f"{path}: records are written as .csv or .npz, not '{path.suffix}'.")


def times(samples: int, dt: ArrayLike) -> np.ndarray:
    """(samples,) t_k = k dt, without the last digits that only show the rounding of the product."""
    interval = float(str(np.asarray(dt)))  # 0.002 in single precision is 0.002 here
    return np.array([float(f"{k * interval:.{TIME_DIGITS}g}") for k in range(samples)])


def write_columns(path: Path, names: Sequence[str], columns: Sequence[np.ndarray]) -> None:
    """Write a header row and the columns, each number with the fewest digits that give it back."""

    def write(stream: TextIO) -> None:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(names)
        writer.writerows(zip(*map(shortest, columns), strict=True))

    write_atomically(path, write)


def shortest(column: np.ndarray) -> list[float]:
    """Python numbers that print in the column's own precision."""
    return column.tolist() if column.dtype == np.float64 else [float(str(x)) for x in column]


def npz_bytes(columns: Mapping[str, np.ndarray]) -> bytes:
    """The content of an NPZ file; `np.savez` itself cannot hold a column called "file"."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, column in columns.items():
            with archive.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, np.ascontiguousarray(column), allow_pickle=False)
    return stream.getvalue()
