"""The folder of a study: what is missing follows from what is there, and nothing that is damaged counts."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from study_helpers import environment, make, numbers, rechunked, results, run, study

from jaxsid.checks import InputError
from jaxsid.study.engine import run_study
from jaxsid.study.parts import Span, missing, read_part, read_realizations, sound_parts, write_part
from jaxsid.study.store import Facts, open_store, read_facts, write_facts

NAMES = ("a", "b")


def values(count, first=0):
    return np.random.default_rng(first).normal(size=(count, 2))


@pytest.mark.parametrize("chunk", [16, 48, 256])
@pytest.mark.parametrize("spans", [[], [(0, 16)], [(16, 40), (64, 70)], [(0, 100)], [(0, 130)], [(96, 128)]])
def test_missing_completes_what_is_there(spans, chunk):
    there = [Span(*span) for span in spans]
    new = list(missing(there, 100, chunk))
    held = np.zeros(300, int)
    for first, end in [*there, *new]:
        held[first:end] += 1
    assert (held[:100] == 1).all()
    assert all(first // chunk == (end - 1) // chunk and first < end <= 100 for first, end in new)


def test_parts_come_back_exactly(tmp_path):
    first, second = values(5), values(3, 5)
    first[2, 1], first[0, 0] = np.nan, np.inf
    write_part(tmp_path, 0, NAMES, first)
    write_part(tmp_path, 5, NAMES, second)
    assert sound_parts(tmp_path, NAMES) == [Span(0, 5), Span(5, 8)]
    np.testing.assert_array_equal(read_realizations(tmp_path, NAMES, 8), np.concatenate([first, second]))
    np.testing.assert_array_equal(read_realizations(tmp_path, NAMES, 6), np.concatenate([first, second])[:6])
    with pytest.raises(InputError, match="from 8 on"):
        read_realizations(tmp_path, NAMES, 9)


@pytest.mark.parametrize("damage", ["cut", "empty", "flipped", "longer", "names", "renamed"])
def test_a_damaged_part_does_not_count(tmp_path, damage):
    write_part(tmp_path, 0, NAMES, values(50))
    path = tmp_path / "000000-000050.parquet"
    content = bytearray(path.read_bytes())
    match damage:
        case "cut":
            path.write_bytes(content[: len(content) // 2])
        case "empty":
            path.write_bytes(b"")
        case "flipped":
            content[len(content) // 2] ^= 1
            path.write_bytes(content)
        case "longer":
            path.write_bytes(content + b"x")
        case "names":
            write_part(tmp_path, 0, ("a", "c"), values(50))
        case "renamed":
            path = path.rename(tmp_path / "000016-000066.parquet")
    assert read_part(path, NAMES) is None
    assert sound_parts(tmp_path, NAMES) == []
    assert not path.exists()


def test_a_part_over_another_counts_once(tmp_path):
    write_part(tmp_path, 0, NAMES, values(32))
    write_part(tmp_path, 16, NAMES, values(32))
    assert sound_parts(tmp_path, NAMES) == [Span(0, 32)]
    assert list(missing(sound_parts(tmp_path, NAMES), 48, 16)) == [Span(32, 48)]


def test_facts_come_back_exactly(tmp_path):
    plan = study()
    facts = Facts(NAMES, ("Hz", ""), np.array([1 / 3, -np.pi]), np.array([0.1, np.nan]))
    with open_store(tmp_path / "out", plan) as store:
        assert read_facts(store, 3) is None
        write_facts(store, 3, facts)
        back = read_facts(store, 3)
    assert back is not None
    assert back[:2] == facts[:2]
    np.testing.assert_array_equal(back.truth, facts.truth)
    np.testing.assert_array_equal(back.bound, facts.bound)


def test_damage_of_any_part_is_repaired(tmp_path):
    plan = study(100)
    run(plan, tmp_path)
    before = results(tmp_path)
    parts = sorted(tmp_path.glob("parts/*/*.parquet"))
    parts[0].write_bytes(parts[0].read_bytes()[:100])
    parts[5].unlink()
    (tmp_path / ".results.parquet.99.tmp").write_bytes(b"half")
    (parts[0].parent / ".000000-000016.parquet.99.tmp").write_bytes(b"half")
    told = []
    run(plan, tmp_path, progress=told.append)
    assert told[0].done == 400 - 32
    assert results(tmp_path) == before
    assert not list(tmp_path.rglob("*.tmp"))


def test_more_realizations_and_other_chunks_go_on(tmp_path):
    run(study(40, chunk=16), tmp_path / "grown")
    told = []
    run(study(150, chunk=48), tmp_path / "grown", progress=told.append)
    assert told[0].done == 160
    run(study(150, chunk=256), tmp_path / "at once")
    assert results(tmp_path / "grown") == results(tmp_path / "at once")
    for case in range(4):
        np.testing.assert_array_equal(numbers(tmp_path / "grown", case), np.arange(150))
    told = []
    run(
        study(40), tmp_path / "grown", progress=told.append
    )  # fewer: nothing to do, and as if there were no more
    run(study(40), tmp_path / "few")
    assert [p.done for p in told] == [160]
    assert results(tmp_path / "grown") == results(tmp_path / "few")


def test_another_study_is_refused(tmp_path):
    run(study(16), tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.parquet")}
    with pytest.raises(
        InputError, match=r"another study: factors\.noise was \[0.01, 0.1\], is \[0.5\]\. Name"
    ):
        run(study(16, noise=(0.5,)), tmp_path)
    with pytest.raises(InputError, match=r"factors\.rate was absent, is 5"):
        run(study(16, rate=5), tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.parquet")} == before
    run(study(16, name="another name"), tmp_path)


def test_other_versions_are_refused(tmp_path):
    run(study(16), tmp_path)
    plan = json.loads((tmp_path / "plan.json").read_text())
    plan["built_with"]["jax"] = "0.1"
    (tmp_path / "plan.json").write_text(json.dumps(plan))
    with pytest.raises(InputError, match=r"other versions: jax was \"0.1\""):
        run(study(16), tmp_path)
    (tmp_path / "plan.json").write_text("{")
    with pytest.raises(InputError, match=r"plan\.json: is damaged"):
        run(study(16), tmp_path)
    (tmp_path / "plan.json").unlink()
    with pytest.raises(InputError, match=r"no plan\.json"):
        run(study(16), tmp_path)


def test_one_process_at_a_time(tmp_path):
    with open_store(tmp_path, study(16)), pytest.raises(InputError, match=f"process {os.getpid()} on"):
        run(study(16), tmp_path)
    code = "import sys; from study_helpers import *; run(study(16), Path(sys.argv[1]))"
    with open_store(tmp_path, study(16)):
        done = subprocess.run(
            [sys.executable, "-c", code, str(tmp_path)], env=environment(), capture_output=True, text=True
        )
    assert "another jaxsid is at work" in done.stderr
    run(study(16), tmp_path)


def test_a_folder_that_cannot_be_used(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file"):
        run(study(16), tmp_path / "file")
    with pytest.raises(InputError, match="cannot be written to"):
        run(study(16), tmp_path / "file" / "below")


def test_a_full_disk_stops_with_a_message_and_goes_on(tmp_path, monkeypatch):
    plan, real, count = study(64), os.fsync, 0

    def full(descriptor):
        nonlocal count
        count += 1
        if count > 9:
            raise OSError(28, "No space left on device")
        real(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="No space left on device"):
        run(plan, tmp_path / "full")
    monkeypatch.undo()
    run(plan, tmp_path / "full")
    run(plan, tmp_path / "never")
    assert results(tmp_path / "full") == results(tmp_path / "never")


def test_a_case_that_cannot_be_made_is_told_before_any_is_computed(tmp_path):
    plan = study(16)

    def picky(case):
        if case.index == 2:
            raise InputError("too short.")
        return make(case)

    with (
        open_store(tmp_path, plan) as store,
        pytest.raises(InputError, match=r"case 2 \(noise = 0.01, algorithm = b, rows = 7\): too short"),
    ):
        run_study(plan, store, make=picky)
    assert not list(tmp_path.rglob("*.parquet"))
    assert rechunked(plan, chunk=32).source == plan.source
