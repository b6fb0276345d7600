"""Steps whose results outlive a run that was cut off."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from gap_helpers import JOINT, chain, drive, with_effect

from jaxsid.files.model_toml import write_model
from jaxsid.gap.resume import resumable, step
from jaxsid.records import Record

CALLS = []


@step
def doubled(x, *, by=2.0):
    CALLS.append(by)
    return {"value": by * x, "record": Record(x[:, None], x[:, None], 0.1, inputs=("a",), outputs=("b",))}


@pytest.fixture(autouse=True)
def forgotten():
    CALLS.clear()


def cut_off(folder, *steps, resume=False):
    with suppress(KeyboardInterrupt), resumable(folder, resume=resume):
        for x, by in steps:
            doubled(x, by=by)
        raise KeyboardInterrupt


X = jnp.arange(4.0)


def test_what_was_computed_is_not_computed_again(tmp_path):
    folder = tmp_path / "parts"
    cut_off(folder, (X, 2.0), (X, 3.0))
    assert CALLS == [2.0, 3.0]
    with resumable(folder, resume=True):
        found = [doubled(jnp.asarray(np.asarray(X)), by=by) for by in (2.0, 3.0, 4.0)]
    assert CALLS == [2.0, 3.0, 4.0]
    for by, one in zip((2.0, 3.0, 4.0), found, strict=True):
        np.testing.assert_array_equal(one["value"], by * X)
        np.testing.assert_array_equal(one["record"].u[:, 0], X)
        assert one["record"].outputs == ("b",)
    assert not folder.exists()


def test_another_argument_is_another_step(tmp_path):
    cut_off(tmp_path / "parts", (X, 2.0))
    with resumable(tmp_path / "parts", resume=True):
        np.testing.assert_array_equal(doubled(X + 1e-12, by=2.0)["value"], 2 * (X + 1e-12))
    assert CALLS == [2.0, 2.0]


def test_a_fresh_run_takes_up_nothing(tmp_path):
    cut_off(tmp_path / "parts", (X, 2.0))
    cut_off(tmp_path / "parts", (X, 2.0))
    assert CALLS == [2.0, 2.0]


def test_a_damaged_part_is_computed_anew(tmp_path):
    folder = tmp_path / "parts"
    cut_off(folder, (X, 2.0))
    (part,) = folder.iterdir()
    part.write_bytes(part.read_bytes()[:-3])
    with resumable(folder, resume=True):
        np.testing.assert_array_equal(doubled(X, by=2.0)["value"], 2 * X)
    assert CALLS == [2.0, 2.0]


def test_results_of_results_are_found_again(tmp_path):
    """A step fed with what another left on disk has the same name as one fed with what it returned."""
    folder = tmp_path / "parts"
    with suppress(KeyboardInterrupt), resumable(folder, resume=False):
        doubled(doubled(X, by=2.0)["record"].u[:, 0], by=5.0)
        raise KeyboardInterrupt
    with resumable(folder, resume=True):
        doubled(doubled(X, by=2.0)["record"].u[:, 0], by=5.0)
    assert CALLS == [2.0, 5.0]


def test_nothing_is_written_outside(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    doubled(X)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_killed_diagnosis_goes_on(tmp_path):
    """Killed between two stages, it comes to the same result as one that was left alone, and leaves nothing behind."""
    u = drive(2048)
    y = with_effect(u, "cubic_stiffness", JOINT, {"coefficient": 1e6})
    y = y + 0.01 * y.std(axis=0) * np.random.default_rng(0).standard_normal(y.shape)
    model, data = tmp_path / "model.toml", tmp_path / "run.csv"
    write_model(chain(), model)
    rows = np.column_stack([np.arange(len(u)) * 0.01, u, y])
    np.savetxt(data, rows, delimiter=",", header="time,drive,s0,s1,s2", comments="")
    call = [str(Path(sys.executable).with_name("jaxsid")), "diagnose", str(model), str(data), "--out"]
    subprocess.run([*call, str(tmp_path / "whole")], check=True)
    parts = tmp_path / ".cut.unfinished"
    with subprocess.Popen([*call, str(tmp_path / "cut")]) as running:
        while running.poll() is None and len(list(parts.glob("*"))) < 8:
            time.sleep(0.1)
        running.send_signal(signal.SIGKILL)
    assert not (tmp_path / "cut").exists()
    assert len(list(parts.glob("*"))) >= 8
    subprocess.run([*call, str(tmp_path / "cut"), "--resume"], check=True)
    assert not parts.exists()
    found = [json.loads((tmp_path / x / "diagnosis.json").read_text()) for x in ("whole", "cut")]
    assert found[0] == found[1]
    assert sorted(os.listdir(tmp_path / "cut")) == sorted(os.listdir(tmp_path / "whole"))
