"""Columns that cannot be used are named by file, column and row."""

import numpy as np
import pytest
import scipy.io
from files_helpers import (
    DT,
    MAPPED,
    MODEL,
    SAMPLES,
    assert_holds,
    csv_text,
    message,
    signals,
    table_of,
    write_csv,
    write_list,
    write_text,
    write_uff,
)

from jaxsid.files import table as table_file
from jaxsid.files.record_file import read_record


def test_a_missing_input_is_named_with_what_the_file_holds(tmp_path):
    data = signals()
    text = message(write_csv(tmp_path, {n if n != "force" else "Force": x for n, x in data.items()}))
    assert all(part in text for part in ("run.csv", "no column 'force'", "Did you mean 'Force'", "'acc1'")), (
        text
    )


def test_a_record_without_any_sensor_is_refused(tmp_path):
    data = signals()
    text = message(write_csv(tmp_path, {"time": data["time"], "force": data["force"], "accl1": data["acc1"]}))
    assert all(part in text for part in ("run.csv", "'acc1', 'acc2'", "Did you mean 'accl1' for 'acc1'")), (
        text
    )


@pytest.mark.parametrize(
    ("name", "like"), [("Time", "Time"), ("t", "t"), ("TIMESTAMP", "TIMESTAMP"), ("seconds", "seconds")]
)
def test_a_time_by_another_name_is_suggested_not_taken(tmp_path, name, like):
    data = signals()
    text = message(write_csv(tmp_path, {name: data["time"], "force": data["force"], "acc1": data["acc1"]}))
    assert all(part in text for part in ("run.csv", "no column 'time'", f'time = "{like}"', "rate")), text


def test_neither_time_nor_rate(tmp_path):
    data = signals()
    text = message(write_csv(tmp_path, {"force": data["force"], "acc1": data["acc1"]}))
    assert all(part in text for part in ("run.csv", "no column 'time'", "no rate", "rate = ...")), text


@pytest.mark.parametrize("column", ["force", "acc2", "time"])
@pytest.mark.parametrize(
    ("cell", "part"),
    [
        ("", "empty"),
        ("nan", "empty or not a number"),
        ("inf", "infinite"),
        ("volt", "'volt' is not a number"),
    ],
)
def test_bad_cells_of_a_csv_are_named_by_row(tmp_path, column, cell, part):
    lines = csv_text(signals()).splitlines()
    cells = lines[41].split(",")
    cells[["time", "force", "acc1", "acc2"].index(column)] = cell
    lines[41] = ",".join(cells)
    text = message(write_text(tmp_path, "\n".join(lines) + "\n"))
    assert all(p in text for p in ("run.csv", f"column '{column}', row 42", part)), text


def test_a_short_or_long_row_is_named(tmp_path):
    lines = csv_text(signals()).splitlines()
    text = message(write_text(tmp_path, "\n".join([*lines[:20], "0.038,1.0", *lines[21:]])))
    assert all(part in text for part in ("run.csv", "column 'acc1', row 21")), text
    text = message(write_text(tmp_path, "\n".join([lines[0], lines[1].replace(".", ","), *lines[2:]])))
    assert all(part in text for part in ("run.csv", "row 2", "decimal sign")), text


def test_columns_cut_by_spaces_are_refused(tmp_path):
    text = message(write_text(tmp_path, csv_text(signals(), " ")))
    assert all(part in text for part in ("run.csv", "row 1", "comma, semicolon or tab")), text


def test_a_bad_value_of_a_mat_file_is_named_by_sample(tmp_path):
    data = signals()
    data["acc2"][6] = np.nan
    scipy.io.savemat(tmp_path / "run.mat", data)
    assert "run.mat: column 'acc2', row 7: is empty or not a number" in message(tmp_path / "run.mat")


@pytest.mark.parametrize(
    ("values", "part"),
    [
        (np.zeros((SAMPLES, 3)), f"column 'force': is {SAMPLES} x 3, not one column"),
        (np.zeros(SAMPLES, complex), "column 'force': holds complex numbers"),
        (np.array(["a"] * SAMPLES), "column 'force': holds text"),
        (np.zeros(SAMPLES - 1), "differ in length"),
    ],
)
def test_wrong_variables_are_named(tmp_path, values, part):
    np.savez(tmp_path / "run.npz", **{**signals(), "force": values})
    assert part in message(tmp_path / "run.npz")


def test_an_index_beyond_the_columns_is_named(tmp_path):
    data = signals()
    scipy.io.savemat(tmp_path / "run.mat", {"t": data["time"], "data": table_of(data)})
    text = message(write_list(tmp_path, MAPPED.replace("data:2", "data:3")))
    assert "column 'data': has 3 columns, so 'data:3' is not there" in text


def test_pickled_objects_are_not_loaded(tmp_path):
    np.savez(tmp_path / "run.npz", **{**signals(), "force": np.array([{}] * SAMPLES, dtype=object)})
    assert all(part in message(tmp_path / "run.npz") for part in ("run.npz", "allow_pickle=False"))


def test_a_header_is_needed_and_its_names_must_differ(tmp_path):
    lines = csv_text(signals()).splitlines()
    assert "row 1 holds numbers only" in message(write_text(tmp_path, "\n".join(lines[1:])))
    assert "2 columns are called 'acc1'" in message(
        write_text(tmp_path, "\n".join([lines[0].replace("acc2", "acc1"), *lines[1:]]))
    )
    assert "no rows of data" in message(write_text(tmp_path, lines[0] + "\n"))
    assert "no header" in message(write_text(tmp_path, "# nothing\n"))


def test_too_large_a_file_is_refused_before_it_is_read(tmp_path, monkeypatch):
    paths = [write_csv(tmp_path, signals()), tmp_path / "run.npz", tmp_path / "run.mat", tmp_path / "run.uff"]
    np.savez(paths[1], **signals())
    scipy.io.savemat(paths[2], signals())
    write_uff(paths[3], signals())
    monkeypatch.setattr(table_file, "available_memory", lambda: 1000.0)
    for path in paths:
        assert all(part in message(path) for part in (path.name, "GiB", "Cut the record"))
    monkeypatch.setattr(table_file, "available_memory", lambda: None)
    assert_holds(read_record(paths[0], MODEL))


def test_the_size_of_a_large_csv_is_estimated_from_its_head(tmp_path, monkeypatch):
    big = {name: np.resize(column, 20_000) for name, column in signals().items()}
    path = write_csv(tmp_path, {**big, "time": np.arange(20_000) * DT})
    needed = 3 * 8 * 4 * 20_000
    monkeypatch.setattr(table_file, "available_memory", lambda: 2 * 0.8 * needed)
    assert "GiB" in message(path)
    monkeypatch.setattr(table_file, "available_memory", lambda: 2 * 1.2 * needed)
    assert read_record(path, MODEL).u.shape == (20_000, 1)


def test_available_memory_is_told_on_linux():
    free = table_file.available_memory()
    assert free is None or free > 1e6
