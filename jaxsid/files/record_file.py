"""Records from files: which columns are the model's inputs and sensors, scaled, on a uniform time."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxsid.checks import InputError, bad_input, check_record, require
from jaxsid.files.naming import listing, nearest, require_file, suggestion
from jaxsid.files.table import Table, held, read_columns, require_column, split_name
from jaxsid.files.time_axis import SHORTEST, check_finite, require_length, rounded, sampling_interval
from jaxsid.files.toml_file import checked, load_toml
from jaxsid.mechanics.lumped import LumpedModel
from jaxsid.records import Record

TIME = "time"
TIME_LIKE = ("t", "tm", "times", "timestamp", "seconds", "sec", "zeit", "temps")
RATE_AGREEMENT = 1e-3


class Entry(NamedTuple):
    """One record as a list of records describes it.

    Attributes:
        path: the file.
        columns: for a name of the model or "time", its name in the file.
        scale: factors on columns, by the model's names.
        rate: sampling rate in Hz, where the file has no time.
        time_unit: "s", "ms" or "us", None if nobody said.
        listed: the TOML list this stands in, for messages.
    """

    path: Path
    columns: Mapping[str, str] = {}
    scale: Mapping[str, float] = {}
    rate: float | None = None
    time_unit: str | None = None
    listed: str = ""


def read_record(path: Path | str, model: LumpedModel) -> Record:
    """One experiment from a CSV, NPZ, MAT or UFF 58 file, or from a TOML list of one record.

    The inputs are those of the model, in its order and with its holds; the outputs those sensors of the
    model that the file holds, at least one. Units are SI after scaling; time in s unless told otherwise.

    Args:
        path: of the file or list.
        model: gives the names to look for.

    Raises:
        InputError: naming file, column and row of what is missing or cannot be used.
    """
    entries = entries_of(Path(path), model)
    require(
        len(entries) == 1,
        f"{path}: holds {len(entries)} records where one is wanted. Read it by `read_records`.",
    )
    return record_of(entries[0], model)


def read_records(paths: Path | str | Sequence[Path | str], model: LumpedModel) -> list[Record]:
    """All experiments of some files, each a record or a TOML list of records; see `read_record`.

    Args:
        paths: one file, or several.
        model: gives the names to look for.
    """
    paths = [paths] if isinstance(paths, (str, Path)) else list(paths)
    require(len(paths) > 0, "No record was given.")
    return [record_of(entry, model) for path in paths for entry in entries_of(Path(path), model)]


def entries_of(path: Path, model: LumpedModel) -> list[Entry]:
    """The records that a path stands for."""
    if path.suffix.lower() != ".toml":
        return [Entry(path)]
    from jaxsid.files.schema import RECORD_TABLES, RecordsFile

    data = load_toml(path)
    require(
        "bodies" not in data or "records" in data,
        f"{path}: is a model, not a list of records. The model comes first, then the records.",
    )
    file = checked(RecordsFile, data, path, RECORD_TABLES)
    require(len(file.records) > 0, f"{path}: lists no record.")
    entries = []
    for number, table in enumerate(file.records, 1):
        where = f"{path}: [[records]] number {number} ('{table.file}')"
        columns = {name: str(column) for name, column in table.columns.items()}
        entry = Entry(path.parent / table.file, columns, table.scale, table.rate, table.time_unit, where)
        check_entry(entry, model)
        entries.append(entry)
    return entries


def check_entry(entry: Entry, model: LumpedModel) -> None:
    """Raise InputError where an entry of the list speaks of a channel that the model does not have."""
    known = [*channels(model), TIME]
    for key, given in (("columns", entry.columns), ("scale", entry.scale)):
        for name in given:
            require(
                name in known,
                f"{entry.listed}, key '{key}': '{name}' is neither time nor an input or sensor of the model."
                f"{suggestion(name, known)} Known: {listing(known)}.",
            )


def channels(model: LumpedModel) -> list[str]:
    """Names of the model's inputs and sensors."""
    return [channel.name for channel in (*model.inputs, *model.sensors)]


def record_of(entry: Entry, model: LumpedModel) -> Record:
    """Read one record."""
    try:
        return unlabelled_record(entry, model)
    except InputError as error:
        if entry.listed:
            raise InputError(f"{error}\n(Listed in {entry.listed}.)") from None
        raise


def unlabelled_record(entry: Entry, model: LumpedModel) -> Record:
    """Read one record; messages name its file but not the list that it stands in."""
    complete = len(model.inputs) > 0 and len(model.sensors) > 0
    require(complete, f"{model.name}: the model needs an input and a sensor before a record can be read.")
    table = open_table(entry.path)
    present = present_channels(table, entry, model)
    timed = has_time(table, entry)
    file_names = {name: entry.columns.get(name, name) for name in ([TIME] if timed else []) + present}
    raw = read_columns(table, file_names.values())
    data = {
        name: scaled(raw[file_name], entry.scale.get(name, 1.0)) for name, file_name in file_names.items()
    }
    dt = interval(data[TIME] if timed else None, table, entry)
    for name in present:
        check_finite(data[name], f"{entry.path}: column '{file_names[name]}'", table.first_row)
    require_length(len(data[present[0]]), str(entry.path))
    inputs = [i.name for i in model.inputs]
    outputs = [name for name in present if name not in inputs]
    record = Record(
        np.stack([data[name] for name in inputs], axis=1),
        np.stack([data[name] for name in outputs], axis=1),
        dt,
        inputs=inputs,
        outputs=outputs,
        hold=[i.hold for i in model.inputs],
        name=entry.path.name,
    )
    check_record(record)
    return record


def scaled(values: np.ndarray, factor: float) -> np.ndarray:
    """The values times a factor, untouched where that is 1."""
    return values if factor == 1.0 else values * factor


def open_table(path: Path) -> Table:
    """The table of a file, by the ending of its name."""
    from jaxsid.files.csv_table import open_csv
    from jaxsid.files.mat_table import open_mat
    from jaxsid.files.npz_table import open_npz
    from jaxsid.files.uff58_table import open_uff58

    openers: dict[str, Callable[[Path], Table]] = {
        **dict.fromkeys((".csv", ".tsv", ".txt", ".dat"), open_csv),
        ".npz": open_npz,
        ".mat": open_mat,
        **dict.fromkeys((".uff", ".unv", ".u58", ".uf"), open_uff58),
    }
    require_file(path)
    opener = openers.get(path.suffix.lower())
    if opener is None:
        bad_input(
            f"{path}: files ending in '{path.suffix}' cannot be read; known are {', '.join(openers)} and "
            ".toml."
        )
    try:
        return opener(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}.") from None


def present_channels(table: Table, entry: Entry, model: LumpedModel) -> list[str]:
    """The model's inputs, all of which must be there, and those of its sensors that are."""
    for name in entry.columns.values():
        require_column(table, name)
    for channel in model.inputs:
        require_column(table, entry.columns.get(channel.name, channel.name))
    names = [name for name in channels(model) if split_name(table, entry.columns.get(name, name)) is not None]
    sensors = [s.name for s in model.sensors]
    if not set(sensors) & set(names):
        close = next(
            (f" Did you mean '{x}' for '{s}'?" for s in sensors if (x := nearest(s, table.names))), ""
        )
        bad_input(
            f"{table.path}: holds none of the model's sensors, which are {listing(sensors)}.{close} "
            f"{held(table)} "
            "Rename the columns, or map them by `columns` in a TOML list of records."
        )
    return names


def has_time(table: Table, entry: Entry) -> bool:
    """Whether the file has a time; InputError where it has neither that nor a rate."""
    if TIME in entry.columns or split_name(table, TIME) is not None:
        return True
    if entry.rate is not None:
        return False
    folded = {name.casefold(): name for name in table.names}
    like = next((folded[name] for name in (TIME, *TIME_LIKE) if name in folded), None) or nearest(
        TIME, table.names
    )
    advice = f'columns = {{ time = "{like}" }}\nif that is the time in seconds, ' if like else ""
    bad_input(
        f"{table.path}: there is no column 'time', and no rate is given. {held(table)} In a TOML list of "
        "records write\n"
        f'[[records]]\nfile = "{table.path.name}"\n{advice}{"or " if like else ""}rate = ... (Hz).'
    )


def interval(time: np.ndarray | None, table: Table, entry: Entry) -> float:
    """The sampling interval in s, from the time or the rate."""
    if time is None:
        dt = 1 / float(entry.rate or np.nan)
        require(dt >= SHORTEST, f"{entry.path}: a rate of {entry.rate:g} Hz is improbable. It is in Hz.")
        return rounded(dt)
    name = entry.columns.get(TIME, TIME)
    unit = "s" if TIME in entry.scale and entry.time_unit is None else entry.time_unit
    dt = sampling_interval(time, entry.path, name, table.first_row, unit)
    if entry.rate is not None:
        require(
            abs(dt * entry.rate - 1) <= RATE_AGREEMENT,
            f"{entry.path}: column '{name}' says {1 / dt:.6g} Hz but the list says rate = {entry.rate:g}. "
            "Drop `rate`, "
            "or give the unit of the time by `time_unit`.",
        )
    return dt
