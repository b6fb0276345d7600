"""The command `jaxsid study`: tables, report, exit codes, and a real process that is interrupted and killed."""

import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pyarrow.parquet as pq
import pytest
from study_helpers import numbers, results
from test_report_page import Reader
from typer.testing import CliRunner

from jaxsid import cli
from jaxsid.report import html

STUDY = """name = "one mass & <two> noises"
seed = 4
realizations = 64
chunk = 32
[factors]
system = "one_dof"
samples = 40
noise = [0.01, 0.05]
realization = ["era", "era_dc"]
"""
FILES = {"results.parquet", "summary.parquet", "summary.csv", "report.html", "plan.json", "lock", "parts"}


@pytest.fixture(autouse=True, scope="module")
def own_cache(request):
    """The command keeps compiled programs where the tests keep theirs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAXSID_CACHE", str(request.config.rootpath / ".pytest_cache" / "jax"))
        yield


def call(*arguments):
    return CliRunner().invoke(cli.app, ["study", *(str(a) for a in arguments)])


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    (folder / "study.toml").write_text(STUDY)
    done = call(folder / "study.toml", "--out", folder / "out")
    assert done.exit_code == 0, done.output
    return folder, done


def test_it_writes_tables_and_a_report(finished):
    folder, done = finished
    out = folder / "out"
    assert {path.name for path in out.iterdir()} == FILES
    summary = pq.read_table(out / "summary.parquet").to_pandas()
    assert set(summary.quantity) == {
        "frequency_1",
        "damping_ratio_1",
        "mass_1_1",
        "damping_1_1",
        "stiffness_1_1",
    }
    assert len(summary) == 4 * 5
    assert (summary["count"] == 64).all()
    frequency = summary[summary.quantity == "frequency_1"].sort_values("noise")
    assert (np.abs(frequency.relative_bias) < 1e-3).all()
    assert (frequency["std"] > 0.7 * frequency.cramer_rao).all()
    assert "realizations" in done.stderr
    assert "one mass" in done.stdout
    assert "Written to" in done.stdout


def test_the_report_says_what_is_better_and_fetches_nothing(finished):
    page = (finished[0] / "out" / "report.html").read_text()
    reader = Reader(page)
    assert "one mass & <two> noises" in reader.text
    assert "Noise: 0.01 has the smallest errors. With 0.05 the root mean square error is" in reader.text
    assert "4 cases of 64 realizations each" in reader.text
    for text in ("In every case at least 99 %", "Cramér-Rao", "stiffness 1 1", "noise 0.05, era_dc"):
        assert text in reader.text
    assert "nan" not in re.sub(r"domi?nan|resonan", "", reader.text)
    assert reader.tags.count("svg") == 2
    assert "script" not in reader.tags
    assert all(address.startswith("#") for address in (*reader.fetched, *reader.links))
    inside = [a[1:] for a in (*reader.links, *reader.fetched)]
    assert set(inside) | set(re.findall(r"url\(#([^)]+)\)", page)) <= set(reader.ids)


def test_again_it_has_nothing_to_do_and_quiet_says_nothing(finished):
    folder, _ = finished
    before = {path: path.stat().st_mtime_ns for path in folder.glob("out/parts/*/*")}
    tables = results(folder / "out")
    done = call(folder / "study.toml", "--out", folder / "out", "--quiet")
    assert (done.exit_code, done.output) == (0, "")
    assert results(folder / "out") == tables
    assert {path: path.stat().st_mtime_ns for path in folder.glob("out/parts/*/*")} == before


def refused(done, *texts, code=2):
    assert done.exit_code == code, done.output
    message = " ".join(done.stderr.split())
    assert "Traceback" not in message
    for text in texts:
        assert text in message


def test_bad_studies_and_options(finished, tmp_path, monkeypatch):
    folder, _ = finished
    file, out = tmp_path / "study.toml", tmp_path / "out"
    refused(call(file, "--out", out), "study.toml")
    file.write_text(STUDY.replace("0.05", '"loud"'))
    refused(call(file, "--out", out), "study.toml", "noise", "'loud'")
    file.write_text(STUDY)
    refused(
        call(file, "--out", out, "--workers", "1", "--scheduler", "tcp://127.0.0.1:9"), "exclude each other"
    )
    refused(call(file, "--out", out, "--workers", "0"), "at least 1")
    refused(call(file), "--out")
    file.write_text(STUDY.replace("0.05", "0.06"))
    refused(call(file, "--out", folder / "out"), "holds another study", "0.06")
    monkeypatch.setattr(html, "find_spec", lambda name: None if name == "pyarrow" else True)
    refused(call(file, "--out", out), "A study needs pyarrow", 'pip install ".[study]"')
    assert not list(out.glob("parts/*/*.parquet"))


def start(file, out, *options):
    command = [sys.executable, "-m", "jaxsid.cli", "study", str(file), "--out", str(out), *options]
    return subprocess.Popen(
        command,
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=dict(os.environ),
        start_new_session=True,
    )


def parts(out):
    return len(list(out.glob("parts/*/*.parquet")))


def test_interrupted_and_killed_it_goes_on(tmp_path):
    """Ctrl-C, which its worker hears too, says how to go on; after that and kill -9 all is as if not."""
    file, out = tmp_path / "study.toml", tmp_path / "out"
    text = STUDY.replace("realizations = 64", "realizations = 3200").replace("chunk = 32", "chunk = 16")
    file.write_text(text.replace('["era", "era_dc"]', '"era"'))
    for number, stop in ((2, signal.SIGINT), (60, signal.SIGKILL)):
        process = start(file, out, *(["--workers", "1"] if stop == signal.SIGINT else []))
        while parts(out) < number and process.poll() is None:
            time.sleep(0.005)
        os.killpg(process.pid, stop)
        errors = process.communicate(timeout=60)[1]
        assert process.returncode == (130 if stop == signal.SIGINT else -signal.SIGKILL)
        assert ("the same command goes on" in errors) == (stop == signal.SIGINT)
        assert "Traceback" not in errors
    assert call(file, "--out", out).exit_code == 0
    for case in range(2):
        np.testing.assert_array_equal(numbers(out, case), np.arange(3200))
    assert call(file, "--out", tmp_path / "undisturbed").exit_code == 0
    assert results(out) == results(tmp_path / "undisturbed")
