"""Workers: real processes, one of which is killed, give the bytes of a run in one process."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from study_helpers import Guess, environment, make, results, run, study

from jaxsid.checks import InputError
from jaxsid.study import cluster
from jaxsid.study.cluster import LostClusterError, local_workers, remote_workers
from jaxsid.study.engine import run_study
from jaxsid.study.store import open_store

PLAN = study(400)


class Deadly(Guess):
    """Whoever unpacks it is gone, as if killed for want of memory."""

    def __reduce__(self):
        return os._exit, (1,)


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    folder = tmp_path_factory.mktemp("alone")
    run(PLAN, folder)
    return results(folder)


class Cluster:
    """A scheduler and workers as processes of their own, as on several machines."""

    def __init__(self, folder):
        self.folder, self.address, self.workers = folder, folder / "scheduler.json", []
        self.scheduler = self.start("scheduler", "--port", "0", "--no-dashboard", "--host", "127.0.0.1")
        end = time.monotonic() + 60
        while not self.address.exists():
            assert time.monotonic() < end
            time.sleep(0.05)
        self.address = json.loads(self.address.read_text())["address"]

    def start(self, kind, *options, **variables):
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}"]
        where = ["--scheduler-file", str(self.folder / "scheduler.json")]
        with (self.folder / "log").open("a") as log:
            return subprocess.Popen(
                [*command, *where, *options],
                env=environment() | variables,
                cwd=self.folder,
                stdout=log,
                stderr=log,
            )

    def add_worker(self, **variables):
        folder = ["--local-directory", str(self.folder)]
        self.workers.append(
            self.start("worker", "--nthreads", "1", "--no-nanny", "--no-dashboard", *folder, **variables)
        )

    def stop(self):
        for process in (self.scheduler, *self.workers):
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def machines(tmp_path_factory):
    made = Cluster(tmp_path_factory.mktemp("cluster"))
    made.add_worker()
    made.add_worker()
    yield made
    made.stop()


def at(count, act):
    """A progress callback that acts once so many realizations are done."""
    acted = []

    def progress(p):
        if p.done >= count and not acted:
            acted.append(act())

    return progress


def test_two_workers_give_the_same_bytes_beside_another_cluster(tmp_path, expected):
    with socket.socket() as other:
        with contextlib.suppress(OSError):  # whoever holds it already is another as well
            other.bind(("0.0.0.0", 8787))
            other.listen()
        with local_workers(2) as execute:
            run(PLAN, tmp_path, execute=execute)
    assert results(tmp_path) == expected


def test_a_worker_is_killed(tmp_path, machines, expected):
    def kill():
        machines.workers[0].send_signal(signal.SIGKILL)
        machines.workers[0].wait()

    with remote_workers(machines.address) as execute:
        run(PLAN, tmp_path, execute=execute, progress=at(320, kill))
    assert machines.workers[0].returncode == -signal.SIGKILL
    assert results(tmp_path) == expected


def test_other_versions_on_a_worker_are_told(tmp_path, machines, monkeypatch):
    monkeypatch.setattr(cluster, "versions", lambda: {"jaxsid": "0.0.1"})
    with remote_workers(machines.address) as execute, pytest.raises(InputError, match=r"instead of 0\.0\.1"):
        run(PLAN, tmp_path, execute=execute)


def test_the_scheduler_is_killed(tmp_path, machines, expected):
    with (
        pytest.raises(LostClusterError, match="What was done is kept"),
        remote_workers(machines.address, timeout=2.0) as execute,
    ):
        run(PLAN, tmp_path, execute=execute, progress=at(160, machines.scheduler.kill))
    told = []
    run(PLAN, tmp_path, progress=told.append)
    assert 160 <= told[0].done < 1600
    assert results(tmp_path) == expected


def test_no_scheduler_is_told():
    with (
        pytest.raises(InputError, match=r"no dask scheduler answers at 'tcp://127\.0\.0\.1:9'"),
        remote_workers("tcp://127.0.0.1:9", timeout=0.5),
    ):
        pass
    with (
        pytest.raises(InputError, match="no dask scheduler answers at 'nonsense'"),
        remote_workers("nonsense", 0.5),
    ):
        pass
    with pytest.raises(InputError, match="at least 1, not 0"), local_workers(0):
        pass


def test_a_job_that_kills_its_workers_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "FAILURES", 0)
    monkeypatch.setattr(cluster, "LIVES", 1)

    def deadly(case):
        made = make(case)
        return Deadly(made.names, made.units, made.truth, made.bound)

    with (
        local_workers(1) as execute,
        open_store(tmp_path, study(32, noise=(0.1,))) as store,
        pytest.raises(InputError, match="killed worker after worker: most likely for want of memory"),
    ):
        run_study(study(32, noise=(0.1,)), store, execute=execute, make=deadly)


def test_a_worker_without_the_library_is_told(tmp_path, tmp_path_factory):
    blocked = tmp_path_factory.mktemp("blocked")
    (blocked / "jaxsid").mkdir()
    (blocked / "jaxsid" / "__init__.py").write_text("raise ModuleNotFoundError(\"No module named 'jaxsid'\")")
    machines = Cluster(tmp_path_factory.mktemp("cluster"))
    try:
        machines.add_worker(PYTHONPATH=f"{blocked}:{Path(__file__).parent}")
        with remote_workers(machines.address) as execute, pytest.raises(InputError, match=r"\.\[study\]"):
            run(PLAN, tmp_path, execute=execute)
    finally:
        machines.stop()
