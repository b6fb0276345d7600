"""Records from files: every format gives back what went in, and so does a list of records."""

import time as clock

import h5py
import numpy as np
import pytest
import scipy.io
from files_helpers import (
    DT,
    MAPPED,
    MODEL,
    assert_holds,
    csv_text,
    message,
    model_of,
    signals,
    table_of,
    write_csv,
    write_list,
    write_text,
    write_uff,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsid.checks import InputError
from jaxsid.files.csv_out import write_record
from jaxsid.files.csv_table import exact_floats
from jaxsid.files.model_toml import read_model
from jaxsid.files.record_file import read_record, read_records
from jaxsid.records import Record


def test_csv_in_the_models_order_with_its_holds(tmp_path):
    data = signals()
    shuffled = {name: data[name] for name in ("acc2", "time", "force", "acc1")}
    record = read_record(write_csv(tmp_path, {**shuffled, "unused": data["force"]}), MODEL)
    assert_holds(record)
    assert float(record.dt) == DT
    assert (record.hold, record.name) == (("first",), "run.csv")


@pytest.mark.parametrize("separator", [",", ";", "\t", " , ", "; "])
def test_csv_separators(tmp_path, separator):
    assert_holds(read_record(write_text(tmp_path, csv_text(signals(), separator)), MODEL))


def test_csv_names_that_hold_separators(tmp_path):
    model = model_of(["f;;;;;;"], ["a,b,c", 'd"\te'])
    values = np.random.default_rng(0).standard_normal((20, 3))
    record = Record(values[:, :1], values[:, 1:], DT, inputs=["f;;;;;;"], outputs=["a,b,c", 'd"\te'])
    write_record(record, tmp_path / "run.csv")
    np.testing.assert_array_equal(read_record(tmp_path / "run.csv", model).y, values[:, 1:])


def test_csv_decimal_commas(tmp_path):
    text = csv_text(signals(), ";").replace(".", ",")
    assert_holds(read_record(write_text(tmp_path, text), MODEL))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "cp1252"])
def test_csv_encodings(tmp_path, encoding):
    text = csv_text({**signals(), "größe µ": signals()["force"]})
    (tmp_path / "run.csv").write_bytes(text.replace("\n", "\r\n").encode(encoding))
    assert_holds(read_record(tmp_path / "run.csv", MODEL))


def test_every_pandas_rounds_numbers_correctly():
    assert exact_floats("3.1.1") == {}
    assert exact_floats("2.2.3") == exact_floats("3.0.0rc1") == {"float_precision": "round_trip"}


def test_csv_comments_quotes_and_trailing_separators(tmp_path):
    lines = csv_text(signals()).splitlines()
    lines[0] = ",".join(f'"{name}"' for name in lines[0].split(","))
    lines = [line + "," for line in lines]
    text = "# rig 3\n\n" + "\n".join([*lines[:5], "# paused", *lines[5:]]) + "\n"
    assert_holds(read_record(write_text(tmp_path, text), MODEL))


def test_npz(tmp_path):
    np.savez(tmp_path / "run.npz", **signals(), notes=np.array("text"))
    assert_holds(read_record(tmp_path / "run.npz", MODEL))


@pytest.mark.parametrize("shape", [(-1, 1), (1, -1)])
@pytest.mark.parametrize("compressed", [True, False])
def test_mat5(tmp_path, shape, compressed):
    data = {name: column.reshape(shape) for name, column in signals().items()}
    scipy.io.savemat(tmp_path / "run.mat", {**data, "info": {"a": 1}}, do_compression=compressed)
    assert_holds(read_record(tmp_path / "run.mat", MODEL))


def test_mat4(tmp_path):
    scipy.io.savemat(tmp_path / "run.mat", signals(), format="4")
    assert_holds(read_record(tmp_path / "run.mat", MODEL))


@pytest.mark.parametrize("block", [0, 512])
def test_mat73(tmp_path, block):
    with h5py.File(tmp_path / "run.mat", "w", userblock_size=block) as file:
        for name, column in signals().items():
            file.create_dataset(name, data=column.reshape(1, -1)).attrs["MATLAB_class"] = np.bytes_("double")
        file.create_group("info")
    assert_holds(read_record(tmp_path / "run.mat", MODEL))


def test_columns_of_a_two_dimensional_variable(tmp_path):
    data = signals()
    scipy.io.savemat(tmp_path / "run.mat", {"t": data["time"], "data": table_of(data)})
    assert_holds(read_record(write_list(tmp_path, MAPPED), MODEL))


@pytest.mark.parametrize("matlab", [True, False])
def test_columns_of_a_two_dimensional_variable_of_mat73(tmp_path, matlab):
    data = signals()
    with h5py.File(tmp_path / "run.mat", "w") as file:
        for name, values in {"t": data["time"][:, None], "data": table_of(data)}.items():
            stored = file.create_dataset(name, data=values.T if matlab else values)
            if matlab:
                stored.attrs["MATLAB_class"] = np.bytes_("double")
    assert_holds(read_record(write_list(tmp_path, MAPPED), MODEL))


@pytest.mark.parametrize("binary", [0, 1])
@pytest.mark.parametrize("even", [0, 1])
def test_uff58_by_the_first_id_line(tmp_path, binary, even):
    write_uff(tmp_path / "run.uff", signals(), binary=binary, even=even)
    assert_holds(read_record(tmp_path / "run.uff", MODEL), rtol=1e-11)


@pytest.mark.parametrize(
    "columns", ['force = "1:+Z", acc1 = "2:+Z", acc2 = "3:+Z"', "force = 0, acc1 = 1, acc2 = 2"]
)
def test_uff58_by_node_and_direction_or_by_index(tmp_path, columns):
    write_uff(tmp_path / "run.uff", signals(), names=False)
    path = write_list(tmp_path, f'file = "run.uff"\ncolumns = {{ {columns} }}')
    assert_holds(read_record(path, MODEL), rtol=1e-11)


def test_uff58_of_another_kind_or_damaged(tmp_path):
    path = tmp_path / "run.uff"
    write_uff(path, signals(), func_type=4)
    assert "no time history" in message(path)
    write_uff(path, signals())
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:20] + lines[25:]))
    assert all(part in message(path) for part in ("run.uff", "column 'force'", "cut off or damaged"))
    path.write_text("not a universal file\n")
    assert all(part in message(path) for part in ("run.uff", "no dataset 58"))


def test_uff58_channels_that_do_not_share_their_time(tmp_path):
    data = signals()
    write_uff(tmp_path / "run.uff", data)
    other = tmp_path / "other.uff"
    write_uff(other, {name: column[:-5] for name, column in data.items()})
    head, tail = (tmp_path / "run.uff").read_text(), other.read_text()
    count = head.count("    -1\n") // 3
    sets = head.split("    -1\n")
    late = tail.split("    -1\n")
    assert count == 2
    sets[-2] = late[-2]
    (tmp_path / "run.uff").write_text("    -1\n".join(sets))
    assert all(part in message(tmp_path / "run.uff") for part in ("'force' and 'acc2'", "60 samples", "55"))


@pytest.mark.parametrize("name", ["run.npz", "run.mat"])
@pytest.mark.parametrize(
    "content", [b"PK\x03\x04 broken", b"time,force\n0,1\n", b"MATLAB 7.3 \x89HDF", b"\x89HDF\r\n\x1a\n123"]
)
def test_unreadable_files_are_named(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    assert name in message(tmp_path / name)


def test_unreadable_csv_and_unknown_endings(tmp_path):
    (tmp_path / "run.csv").write_bytes(b"\x00\x01\x02\x00" * 10)
    assert "binary" in message(tmp_path / "run.csv")
    (tmp_path / "run.xlsx").write_bytes(b"x")
    assert all(part in message(tmp_path / "run.xlsx") for part in ("run.xlsx", "'.xlsx'", ".csv"))
    assert "no such file" in message(tmp_path / "gone.csv")
    assert "empty" in message(write_text(tmp_path, "", "none.csv"))


# --- the list of records ---------------------------------------------------------------------------------


def test_a_list_scales_maps_and_gives_the_rate(tmp_path):
    data = signals()
    np.savez(tmp_path / "run.npz", volts=data["force"], a=data["acc1"], acc2=data["acc2"])
    body = 'file = "run.npz"\ncolumns = { force = "volts", acc1 = "a" }\n'
    body += "scale = { force = 35.15, acc2 = -2 }\nrate = 500.0"
    expected = {**data, "force": 35.15 * data["force"], "acc2": -2 * data["acc2"]}
    assert_holds(read_record(write_list(tmp_path, body), MODEL), expected)


@pytest.mark.parametrize(("unit", "factor"), [("s", 1), ("ms", 1e3), ("us", 1e6)])
def test_time_units(tmp_path, unit, factor):
    write_csv(tmp_path, {**signals(), "time": np.round(signals()["time"] * factor, 9)})
    path = write_list(tmp_path, f'file = "run.csv"\ntime_unit = "{unit}"')
    assert_holds(read_record(path, MODEL))


def test_time_can_be_scaled_like_any_column(tmp_path):
    write_csv(tmp_path, {**signals(), "time": np.round(signals()["time"] * 1e3, 9)})
    assert_holds(read_record(write_list(tmp_path, 'file = "run.csv"\nscale = { time = 1e-3 }'), MODEL))


def test_roving_sensors_and_several_rates(tmp_path):
    data = signals()
    write_csv(tmp_path, {n: data[n] for n in ("time", "force", "acc1")}, "a.csv")
    write_csv(
        tmp_path, {**{n: data[n][:30] for n in ("force", "acc2")}, "time": data["time"][:30] * 2}, "b.csv"
    )
    listed = write_text(
        tmp_path, '[[records]]\nfile = "a.csv"\n[[records]]\nfile = "b.csv"\n', "records.toml"
    )
    records = read_records([listed, tmp_path / "a.csv"], MODEL)
    assert [r.outputs for r in records] == [("acc1",), ("acc2",), ("acc1",)]
    assert [r.u.shape for r in records] == [(60, 1), (30, 1), (60, 1)]
    assert [float(r.dt) for r in records] == [0.002, 0.004, 0.002]
    assert [r.name for r in records] == ["a.csv", "b.csv", "a.csv"]
    with pytest.raises(InputError, match="holds 2 records where one is wanted"):
        read_record(listed, MODEL)


@pytest.mark.parametrize(
    ("body", "parts"),
    [
        (
            'file = "run.csv"\ncolums = { time = "t" }',
            ["[[records]] number 1 ('run.csv')", "'colums'", "'columns'"],
        ),
        (
            'file = "run.csv"\nscale = { forse = 2.0 }',
            ["number 1", "key 'scale'", "'forse'", "Did you mean 'force'"],
        ),
        (
            'file = "run.csv"\ncolumns = { acc3 = "acc1" }',
            ["key 'columns'", "'acc3'", "Known: 'force', 'acc1', 'acc2', 'time'"],
        ),
        (
            'file = "run.csv"\ncolumns = { acc1 = "ac1" }',
            ["run.csv: there is no column 'ac1'", "Did you mean 'acc1'", "records.toml"],
        ),
        ('file = "run.csv"\nrate = -3.0', ["key 'rate'", "greater than 0"]),
        ('file = "run.csv"\nrate = 1000.0', ["column 'time' says 500 Hz", "rate = 1000"]),
        ('file = "run.csv"\ntime_unit = "h"', ["key 'time_unit'", "'ms'", "'h'"]),
        ("rate = 3.0", ["number 1", "key 'file' is missing"]),
        ('file = "rum.csv"', ["rum.csv: there is no such file", "Did you mean 'run.csv'"]),
        ("file = ", ["records.toml", "line 2"]),
    ],
)
def test_mistakes_in_a_list_are_named(tmp_path, body, parts):
    write_csv(tmp_path, signals())
    text = message(write_list(tmp_path, body))
    assert all(part in text for part in ["records.toml", *parts]), text


def test_a_model_or_an_empty_list_is_no_record(tmp_path):
    assert "is a model" in message(write_text(tmp_path, "[bodies]\na = 1.0\n", "model.toml"))
    assert "lists no record" in message(write_text(tmp_path, "records = []\n", "records.toml"))
    with pytest.raises(InputError, match="No record"):
        read_records([], MODEL)


column_names = st.text(
    st.characters(blacklist_categories=("Cs", "Cc", "Z"), blacklist_characters="\\"), min_size=1, max_size=8
).filter(lambda n: n != "time" and n.strip() == n and not n.isspace())


@settings(max_examples=25, deadline=None)
@given(
    names=st.lists(column_names, min_size=3, max_size=3, unique=True),
    rows=st.lists(st.lists(st.floats(-1e300, 1e300), min_size=3, max_size=3), min_size=16, max_size=20),
    dt=st.floats(1e-5, 0.5),
    ending=st.sampled_from([".csv", ".npz"]),
)
def test_what_is_written_reads_back_equal(names, rows, dt, ending, tmp_path_factory):
    values = np.array(rows)
    record = Record(values[:, :1], values[:, 1:], float(f"{dt:.9g}"), inputs=names[:1], outputs=names[1:])
    path = tmp_path_factory.mktemp("records") / f"run{ending}"
    write_record(record, path)
    back = read_record(path, model_of(names[:1], names[1:], "zero"))
    np.testing.assert_array_equal(back.u, record.u)
    np.testing.assert_array_equal(back.y, record.y)
    assert float(back.dt) == pytest.approx(float(record.dt), rel=1e-11)
    assert (back.inputs, back.outputs, back.hold) == (record.inputs, record.outputs, record.hold)


@pytest.mark.usefixtures("single_precision")
def test_single_precision(tmp_path):
    data = signals()
    record = Record(
        data["force"],
        np.stack([data["acc1"], data["acc2"]], 1),
        DT,
        inputs=["force"],
        outputs=["acc1", "acc2"],
    )
    write_record(record, tmp_path / "run.csv")
    back = read_record(tmp_path / "run.csv", MODEL)
    assert back.u.dtype == np.float32
    np.testing.assert_array_equal(back.y, record.y)
    assert back.dt == record.dt


def test_reading_is_quick(tmp_path):
    names = [f"y{i}" for i in range(6)]
    record = Record(
        np.random.default_rng(0).standard_normal((20_000, 1)),
        np.ones((20_000, 6)) / 3,
        DT,
        inputs=["u"],
        outputs=names,
    )
    write_record(record, tmp_path / "run.csv")
    model = model_of(["u"], names)
    read_record(tmp_path / "run.csv", model)
    took = []
    for _ in range(5):
        start = clock.process_time()  # others may keep the machine busy
        read_record(tmp_path / "run.csv", model)
        took.append(clock.process_time() - start)
    assert min(took) < 0.1


def measured(data, name):
    folder = data / name
    if not folder.is_dir():
        pytest.skip(f"the measured records of {name} are not there")
    return read_records(folder / "records.toml", read_model(folder / "model.toml"))


def test_the_measured_frame(data):
    records = measured(data, "cambridge_frame")
    assert [r.outputs for r in records] == [("acc1",), ("acc2",), ("acc3",)]
    assert [float(r.dt) for r in records] == [0.002] * 3
    assert {r.u.shape for r in records} == {(15_000, 1)}
    assert {r.hold for r in records} == {("first",)}


def test_the_measured_axis(data):
    (record,) = measured(data, "emps")
    raw = scipy.io.loadmat(data / "emps" / "DATA_EMPS.mat")
    assert float(record.dt) == pytest.approx(1e-3, rel=1e-6)
    np.testing.assert_allclose(record.u, 35.1507 * raw["vir"], rtol=1e-15)
    np.testing.assert_array_equal(record.y, raw["qm"])
