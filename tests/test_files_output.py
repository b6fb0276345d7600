"""Results on disk: whole or not at all, in plain JSON and in CSV of full precision."""

import csv
import json
import os
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsid.checks import InputError
from jaxsid.files.atomic import atomic_directory, write_atomically
from jaxsid.files.csv_out import times, write_record, write_response
from jaxsid.files.results_json import write_json
from jaxsid.records import Record


class Pair(NamedTuple):
    a: float
    b: float


def reread(path):
    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


def test_arrays_become_lists_and_numbers_that_are_none_null(tmp_path):
    data = {
        "order": np.int64(4),
        "ok": np.bool_(True),
        "mass": jnp.eye(2),
        "pole": -114.3 + 1303.0j,
        "poles": np.array([1 + 2j]),
        "bad": [float("nan"), float("inf"), np.nan, 1.0],
        "array": np.array([1.0, np.inf]),
        "scalar": jnp.asarray(0.5),
        "pair": Pair(1.0, 2.0),
        "file": Path("a.csv"),
        "none": None,
        1: "größe",
        "schema": 1,
    }
    write_json(tmp_path / "out.json", data)
    back = reread(tmp_path / "out.json")
    assert next(iter(back)) == "schema"
    assert back == {
        "schema": 1,
        "order": 4,
        "ok": True,
        "mass": [[1.0, 0.0], [0.0, 1.0]],
        "pole": [-114.3, 1303.0],
        "poles": [[1.0, 2.0]],
        "bad": [None, None, None, 1.0],
        "array": [1.0, None],
        "scalar": 0.5,
        "pair": [1.0, 2.0],
        "file": "a.csv",
        "none": None,
        "1": "größe",
    }


def test_the_schema_is_added_where_it_is_not_given(tmp_path):
    write_json(tmp_path / "out.json", {"order": 2})
    assert list(reread(tmp_path / "out.json").items()) == [("schema", 1), ("order", 2)]


@settings(max_examples=30, deadline=None)
@given(values=st.lists(st.floats(allow_nan=False, allow_infinity=False), max_size=5))
def test_numbers_survive_to_the_last_digit(values, tmp_path_factory):
    path = tmp_path_factory.mktemp("json") / "out.json"
    write_json(path, {"x": np.array(values)})
    assert reread(path)["x"] == values


def test_what_json_cannot_hold_is_named_and_nothing_is_written(tmp_path):
    with pytest.raises(TypeError, match=r"data\.modes\[1\]\.x: a set"):
        write_json(tmp_path / "out.json", {"modes": [{}, {"x": {1}}]})
    assert list(tmp_path.iterdir()) == []


def test_a_failing_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "out.txt"
    path.write_text("old")

    def fail(stream):
        stream.write("half of it")
        raise RuntimeError("interrupted")

    with pytest.raises(RuntimeError, match="interrupted"):
        write_atomically(path, fail)
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["out.txt"]


def test_a_new_file_has_the_usual_permissions(tmp_path):
    write_json(tmp_path / "out.json", {})
    (tmp_path / "plain").write_text("")
    assert (tmp_path / "out.json").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_places_that_cannot_be_written_to_are_named(tmp_path):
    with pytest.raises(InputError, match=r"out\.json: there is no folder"):
        write_json(tmp_path / "nowhere" / "out.json", {})
    with pytest.raises(InputError, match="is a folder"):
        write_json(tmp_path, {})
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file"), atomic_directory(tmp_path / "file"):
        pass
    with pytest.raises(InputError, match="is a file"), atomic_directory(tmp_path / "file" / "deeper"):
        pass


def test_a_directory_arrives_whole(tmp_path):
    with atomic_directory(tmp_path / "a" / "out") as draft:
        (draft / "plots").mkdir()
        (draft / "plots" / "one.svg").write_text("1")
        (draft / "model.toml").write_text("2")
        assert not (tmp_path / "a").exists()
    out = tmp_path / "a" / "out"
    assert (out / "plots" / "one.svg").read_text() == "1"
    assert (out / "model.toml").read_text() == "2"
    assert sorted(os.listdir(tmp_path)) == ["a"]
    assert sorted(os.listdir(tmp_path / "a")) == ["out"]


def run_command(out, error):
    """A command that writes part of its results and then, perhaps, fails."""
    with atomic_directory(out) as draft:
        (draft / "model.toml").write_text("new")
        if error is not None:
            raise error("stop")


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, InputError])
def test_a_failing_command_leaves_nothing(tmp_path, error):
    with pytest.raises(error):
        run_command(tmp_path / "a" / "out", error)
    assert list(tmp_path.iterdir()) == []


def test_an_old_directory_keeps_its_files_until_the_new_ones_are_there(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "model.toml").write_text("old")
    (out / "notes.txt").write_text("mine")
    with pytest.raises(RuntimeError):
        run_command(out, RuntimeError)
    assert (out / "model.toml").read_text() == "old"
    run_command(out, None)
    assert (out / "model.toml").read_text() == "new"
    assert (out / "notes.txt").read_text() == "mine"
    assert os.listdir(tmp_path) == ["out"]


def test_a_response_in_full_precision(tmp_path):
    y = np.random.default_rng(0).standard_normal((50, 2)) * [1e-12, 1e9]
    write_response(tmp_path / "out.csv", jnp.asarray(y), 0.1, ["gyro", "acc, raw"])
    with (tmp_path / "out.csv").open(newline="") as stream:
        header, *rows = csv.reader(stream)
    assert header == ["time", "gyro", "acc, raw"]
    back = np.array([[float(cell) for cell in row] for row in rows])
    np.testing.assert_array_equal(back[:, 1:], y)
    assert back[:, 0].tolist() == [k / 10 for k in range(50)]


def test_a_response_needs_a_name_for_each_column(tmp_path):
    with pytest.raises(InputError, match=r"out\.csv: a response of shape \(5, 2\)"):
        write_response(tmp_path / "out.csv", np.zeros((5, 2)), 0.1, ["gyro"])
    assert list(tmp_path.iterdir()) == []


def test_records_are_written_as_csv_or_npz_only(tmp_path):
    with pytest.raises(InputError, match=r"run\.mat: records are written as \.csv or \.npz"):
        write_record(Record(np.zeros(20), np.zeros(20), 0.1), tmp_path / "run.mat")
    same = Record(np.zeros(20), np.zeros(20), 0.1, inputs=["a"], outputs=["a"])
    with pytest.raises(InputError, match="different names"):
        write_record(same, tmp_path / "run.csv")


@given(dt=st.floats(1e-7, 10.0))
def test_times_are_multiples_of_the_interval(dt):
    np.testing.assert_allclose(times(100, dt), np.arange(100) * dt, rtol=1e-14)
