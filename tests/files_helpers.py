"""Synthetic records on disk, shared by the tests of reading."""

import warnings

import numpy as np
import pytest
import pyuff

from jaxsid.checks import InputError
from jaxsid.files.record_file import read_records
from jaxsid.mechanics.lumped import Input, Sensor, lumped_model

DT = 0.002
SAMPLES = 60


def model_of(inputs=("force",), sensors=("acc1", "acc2"), hold="first"):
    return lumped_model(
        ["a"],
        [1.0],
        inputs=[Input(name, "a", hold) for name in inputs],
        sensors=[Sensor(name, "a", "velocity") for name in sensors],
    )


MODEL = model_of()


def signals(samples=SAMPLES):
    rng = np.random.default_rng(0)
    time = np.round(np.arange(samples) * DT, 9)
    return {"time": time, **{name: rng.standard_normal(samples) for name in ("force", "acc1", "acc2")}}


def csv_text(columns, separator=","):
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    lines = [separator.join(columns), *(separator.join(map(repr, row)) for row in rows)]
    return "\n".join(lines) + "\n"


def write_text(tmp_path, text, name="run.csv"):
    (tmp_path / name).write_text(text, encoding="utf-8")
    return tmp_path / name


def write_csv(tmp_path, columns, name="run.csv"):
    return write_text(tmp_path, csv_text(columns), name)


def write_list(tmp_path, body, name="records.toml"):
    return write_text(tmp_path, f"[[records]]\n{body}\n", name)


def message(path, model=MODEL):
    with pytest.raises(InputError) as caught:
        read_records([path], model)
    return str(caught.value)


def assert_holds(record, data=None, inputs=("force",), outputs=("acc1", "acc2"), rtol=0.0):
    data = signals() if data is None else data
    assert (record.inputs, record.outputs) == (tuple(inputs), tuple(outputs))
    np.testing.assert_allclose(record.u, np.stack([data[n] for n in inputs], 1), rtol=rtol)
    np.testing.assert_allclose(record.y, np.stack([data[n] for n in outputs], 1), rtol=rtol)
    assert float(record.dt) == pytest.approx(DT, rel=1e-9)


def table_of(data):
    return np.stack([data["force"], data["acc2"], data["acc1"]], axis=1)


def write_uff(path, data, *, binary=0, even=1, names=True, func_type=1):
    sets = [
        {
            "type": 58,
            "binary": binary,
            "func_type": func_type,
            "rsp_node": node,
            "rsp_dir": 3,
            "ref_dir": 0,
            "ref_node": 0,
            "id1": name if names else "Time capture",
            "abscissa_spacing": even,
            "data": data[name],
            "x": data["time"],
            "orddenom_spec_data_type": 0,
        }
        for node, name in enumerate(("force", "acc1", "acc2"), 1)
    ]
    path.unlink(missing_ok=True)  # pyuff loses the header of a binary set when it overwrites
    with warnings.catch_warnings(action="ignore"):  # and leaves files open
        pyuff.UFF(str(path)).write_sets(sets)


MAPPED = 'file = "run.mat"\ncolumns = { time = "t", force = "data:0", acc1 = "data:2", acc2 = "data:1" }'
