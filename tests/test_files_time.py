"""The time axis: rounding is forgiven; gaps, jitter and wrong units are named by file and row."""

import numpy as np
import pytest
from files_helpers import (
    DT,
    MODEL,
    message,
    signals,
    write_csv,
    write_list,
)

from jaxsid.files.record_file import read_record


def timed(tmp_path, time):
    data = signals(len(time))
    return write_csv(tmp_path, {**data, "time": np.asarray(time, dtype=float)})


def test_a_gap_is_named(tmp_path):
    time = np.round(np.arange(2000) * 0.001, 9)
    time[1203:] += 0.349
    text = message(timed(tmp_path, time))
    assert "column 'time': a gap of 0.35 after row 1204 (dt is 0.001): split the file there into two" in text


def test_one_missing_sample_is_a_gap(tmp_path):
    text = message(timed(tmp_path, np.delete(np.round(np.arange(500) * 0.001, 9), 100)))
    assert "a gap of 0.002 after row 101" in text
    text = message(timed(tmp_path, np.delete(np.round(np.arange(500) * DT, 9), [100, 250])))
    assert "a gap of 0.004 after row 101" in text
    assert "(2 such gaps)" in text


def test_unsorted_and_repeated_times_are_named(tmp_path):
    time = np.arange(100) * DT
    assert "column 'time', row 52: goes back" in message(timed(tmp_path, np.r_[time[:50], time[:50]]))
    time[30] = time[29]
    assert "column 'time', row 32: repeats 0.058" in message(timed(tmp_path, time))


def test_a_jittery_time_is_not_uniform(tmp_path):
    rng = np.random.default_rng(1)
    time = np.arange(200) * DT + 0.2 * DT * rng.uniform(-1, 1, 200)
    text = message(timed(tmp_path, time))
    assert all(part in text for part in ("run.csv", "column 'time'", "not uniform", "row "))
    fine = np.arange(200) * DT + 0.4e-3 * DT * rng.uniform(-1, 1, 200)
    assert float(read_record(timed(tmp_path, fine), MODEL).dt) == pytest.approx(DT, rel=1e-5)


def test_a_drifting_clock_is_not_uniform(tmp_path):
    k = np.arange(2000)
    assert "not uniform" in message(timed(tmp_path, k * DT + 1e-7 * DT * k**2))


@pytest.mark.parametrize(
    ("rate", "decimals"), [(1024, 6), (1024, 4), (3000, 5), (187.5, 3), (800, 3), (500, 3)]
)
def test_the_rounding_of_a_printed_time_is_no_jitter(tmp_path, rate, decimals):
    record = read_record(timed(tmp_path, np.round(np.arange(4096) / rate, decimals)), MODEL)
    assert float(record.dt) == pytest.approx(1 / rate, rel=1e-5)


def test_a_time_of_six_significant_digits_is_no_jitter(tmp_path):
    time = [float(f"{k / 1000:.6g}") for k in range(20_000, 30_000)]
    assert float(read_record(timed(tmp_path, time), MODEL).dt) == pytest.approx(1e-3, rel=1e-6)


def test_single_precision_and_large_offsets_are_no_jitter(tmp_path):
    data = signals(5000)
    np.savez(tmp_path / "run.npz", **{**data, "time": data["time"].astype(np.float32)})
    assert float(read_record(tmp_path / "run.npz", MODEL).dt) == pytest.approx(DT, rel=1e-6)
    record = read_record(timed(tmp_path, 1.7e9 + np.arange(5000) * DT), MODEL)
    assert float(record.dt) == pytest.approx(DT, rel=1e-6)


@pytest.mark.parametrize("samples", [1, 2, 15])
def test_too_short_a_record(tmp_path, samples):
    assert f"run.csv: {samples} samples are too short" in message(timed(tmp_path, np.arange(samples) * DT))
    data = signals(samples)
    np.savez(tmp_path / "run.npz", force=data["force"], acc1=data["acc1"])
    assert "too short" in message(write_list(tmp_path, 'file = "run.npz"\nrate = 100.0'))


@pytest.mark.parametrize(
    ("step", "unit"), [(2.0, "ms"), (1.0, "ms"), (20.0, "ms"), (12.5, "ms"), (500.0, "us"), (1000.0, "us")]
)
def test_a_time_that_is_probably_not_in_seconds(tmp_path, step, unit):
    path = timed(tmp_path, np.arange(100) * step)
    text = message(path)
    assert all(part in text for part in ("run.csv: column 'time'", f'time_unit = "{unit}"', "Hz")), text
    told = write_list(tmp_path, f'file = "run.csv"\ntime_unit = "{unit}"')
    assert float(read_record(told, MODEL).dt) == pytest.approx(step * {"ms": 1e-3, "us": 1e-6}[unit])
    told = write_list(tmp_path, 'file = "run.csv"\ntime_unit = "s"')
    assert float(read_record(told, MODEL).dt) == pytest.approx(step)


def test_a_time_in_days(tmp_path):
    text = message(timed(tmp_path, np.arange(100) * DT / 86400 / 10))
    assert all(part in text for part in ("run.csv: column 'time'", "hours or days"))
