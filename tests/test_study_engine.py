"""Runs: the same bits for any chunk, whatever stopped them on the way, kill -9 included."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pyarrow.parquet as pq
import pytest
from study_helpers import NAMES, environment, make, numbers, results, run, study

from jaxsid.study.engine import in_process
from jaxsid.uncertainty.ensemble import ensemble

HELPERS = Path(__file__).with_name("study_helpers.py")


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """Bytes of the tables of a run in one piece, by the number of realizations."""
    known = {}

    def tables(count):
        if count not in known:
            folder = tmp_path_factory.mktemp("undisturbed")
            run(study(count, chunk=256), folder)
            known[count] = results(folder)
        return known[count]

    return tables


@pytest.mark.parametrize("chunk", [16, 48, 256])
def test_any_chunk_gives_the_same_bytes(tmp_path, undisturbed, chunk):
    run(study(300, chunk=chunk), tmp_path)
    assert results(tmp_path) == undisturbed(300)


def test_it_is_the_ensemble_of_each_case(tmp_path):
    plan = study(40, chunk=16)
    run(plan, tmp_path)
    frame = pq.read_table(tmp_path / "results.parquet").to_pandas()
    for case in plan.cases:
        key = jax.random.fold_in(jax.random.key(plan.seed), case.index)
        expected = ensemble(make(case), key, 40)
        for i, name in enumerate(NAMES):
            got = frame.value[(frame.case == case.index) & (frame.quantity == name)]
            np.testing.assert_array_equal(got, expected[:, i])


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_what_was_done_before_a_stop_is_not_done_again(tmp_path, undisturbed, error):
    plan, done = study(300, chunk=48), []

    def stopping(jobs):
        for result in in_process(jobs):
            done.append((result.job.case, result.job.first))
            if len(done) in (3, 4, 11):
                raise error
            yield result

    for _ in range(3):
        with pytest.raises(error):
            run(plan, tmp_path, execute=stopping)
    run(plan, tmp_path, execute=stopping)
    assert len(set(done)) == 4 * 7
    assert len(done) == 4 * 7 + 3  # those that were computed, but not handed over
    assert results(tmp_path) == undisturbed(300)


def test_cases_that_share_a_program_are_neighbours(tmp_path):
    order = []

    def noting(jobs):
        for result in in_process(jobs):
            order.append(result.job.case)
            yield result

    run(study(16, noise=(0.5, 0.1)), tmp_path, execute=noting)
    assert order == [0, 1, 2, 3]
    plan = study(16)
    for case, rows in zip(plan.cases, (7, 9, 7, 9), strict=True):
        case.values.update(rows=rows, algorithm="a")
    order.clear()
    run(plan, tmp_path / "other", execute=noting)
    assert order == [0, 2, 1, 3]


def parts(folder):
    return len(list(folder.glob("parts/*/*.parquet")))


def wait_for(condition, process, seconds=60):
    end = time.monotonic() + seconds
    while not condition() and process.poll() is None:
        assert time.monotonic() < end
        time.sleep(0.002)


@pytest.mark.slow
def test_kill_9_loses_and_repeats_nothing(tmp_path, undisturbed):
    """A process is killed while it starts, after the first parts, in the middle, and while it writes the tables."""
    moments = (
        lambda: (tmp_path / "plan.json").exists(),
        lambda: parts(tmp_path) >= 2,
        lambda: parts(tmp_path) >= 100,
        lambda: list(tmp_path.glob(".results.parquet.*")) or (tmp_path / "results.parquet").exists(),
    )
    kept = {}
    for moment in moments:
        process = subprocess.Popen([sys.executable, str(HELPERS), str(tmp_path), "1000"], env=environment())
        wait_for(moment, process)
        process.send_signal(signal.SIGKILL)
        process.wait()
        now = {path: path.stat().st_mtime_ns for path in tmp_path.glob("parts/*/*.parquet")}
        assert kept.items() <= now.items()  # nothing that was there was written again
        kept = now
    run(study(1000), tmp_path)
    assert (
        kept.items() <= {path: path.stat().st_mtime_ns for path in tmp_path.glob("parts/*/*.parquet")}.items()
    )
    for case in range(4):
        np.testing.assert_array_equal(numbers(tmp_path, case), np.arange(1000))
    assert results(tmp_path) == undisturbed(1000)
