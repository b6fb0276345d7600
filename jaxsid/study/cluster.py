"""The jobs of a study on other processes, here or on many machines, through dask.distributed.

Workers compute and hand results back; the process that began the study is the only one that writes. A job travels with
its experiment, so that workers need no files. What a worker that dies was at goes to the others. When the scheduler is
lost the study stops, and goes on when it is begun again.
"""

import functools
import logging
import math
import os
import pickle
import queue
import signal
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

# Before JAX loads, on workers: it logs a needless warning for each program that it reads back.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import dask.config
import jax
import numpy as np
from distributed import Client, KilledWorker, LocalCluster
from distributed.client import Future, FutureCancelledError
from jaxtyping import Float

from jaxsid.checks import InputError, JaxsidError, require
from jaxsid.compilation import default_folder, keep_programs
from jaxsid.study.engine import Done, Estimator, Execute, Job, realizations
from jaxsid.study.store import versions

AHEAD = 3  # jobs given out for each thread of a worker, so that none waits for the next
FEWEST = 8  # threads that jobs are given out for, even while fewer are there
LIVES = 3  # times that a job is given out anew after dask gave it up, since worker after worker died over it
LOOK = 5.0  # seconds after which a look at the workers is taken
PATIENCE = 60.0  # seconds that workers of this machine have to come back
FAILURES = 10  # workers that may die over a job before dask gives it up


class LostClusterError(JaxsidError):
    """The scheduler or all workers went away while a study ran."""


class Parcel(NamedTuple):
    """A job on its way to a worker, and what the worker must have installed for it."""

    case: int
    first: int
    count: int
    seed: int
    experiment: bytes
    double: bool
    versions: dict[str, str]

    def called(self) -> bytes:
        """A pickle whose loading does the job, so that even the name of this module is first met within a task.

        A worker without the library that got `work` itself would die of the message, without a word to anybody.
        """
        return pickle.dumps(_Call(self))


class _Call(NamedTuple):
    parcel: Parcel

    def __reduce__(self) -> tuple:
        return work, (self.parcel,)


@contextmanager
def local_workers(count: int) -> Iterator[Execute]:
    """As many processes on this machine, gone when the block ends.

    Raises:
        InputError: fewer than one.
    """
    require(count >= 1, f"the number of workers must be at least 1, not {count}.")
    settings = {
        "distributed.scheduler.allowed-failures": FAILURES,
        "distributed.nanny.pre-spawn-environ.OPENBLAS_NUM_THREADS": 1,
    }
    with dask.config.set(settings), _interrupts_kept_from_children():
        cluster = LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            processes=True,
            # Without a port named, its web server asks for 8787, which another study may hold.
            scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
            memory_limit=0,
            silence_logs=logging.CRITICAL,
        )
    with cluster, Client(cluster) as client:
        yield functools.partial(on_cluster, client, patience=PATIENCE)


@contextmanager
def _interrupts_kept_from_children() -> Iterator[None]:
    """Ctrl-C reaches all processes of a terminal; those begun here leave it to this one, which ends them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def remote_workers(address: str, timeout: float = 30.0) -> Iterator[Execute]:
    """The workers of a scheduler, whenever they come and go.

    Args:
        address: of the scheduler, as `tcp://host:8786`.
        timeout: seconds to wait for it.

    Raises:
        InputError: no scheduler answers there.
    """
    try:
        client = Client(address, timeout=timeout)
    except (OSError, ValueError) as error:
        raise InputError(
            f"no dask scheduler answers at '{address}' ({error}). Start one with `dask scheduler`, and give the "
            "address that it prints, as tcp://host:8786."
        ) from error
    with client:
        yield functools.partial(on_cluster, client)


def on_cluster(client: Client, jobs: Iterable[Job], *, patience: float = math.inf) -> Iterator[Done]:
    """Give out a few jobs for each worker, and a new one for each result.

    Args:
        client: of the scheduler.
        jobs: to do.
        patience: seconds to wait while there is no worker at all.

    Raises:
        LostClusterError: the scheduler or all workers went away.
        InputError: a worker has no jaxsid, or other versions; a job killed worker after worker.
    """
    out = _Out(client, iter(jobs))
    try:
        out.fill()
        while out.given:
            future = out.next(patience)
            job, lives = out.given.pop(future)
            try:
                values = future.result()
            except KilledWorker as error:
                out.again(job, lives, error)
                continue
            yield Done(job, values)
            out.fill()
    except (FutureCancelledError, OSError) as error:
        raise LostClusterError(
            "the dask scheduler was lost. What was done is kept; start a scheduler and run the same command again."
        ) from error
    except (ImportError, RuntimeError) as error:
        if isinstance(error, ImportError) or "deserialization" in str(error):
            raise InputError(
                f"a worker or the scheduler cannot load what the study needs ({error}). Install the same versions of "
                'Python and of jaxsid there as here; in a checkout: pip install ".[study]".'
            ) from error
        raise


class _Out:
    """The jobs that are out, each with the number of times it may be given out again."""

    def __init__(self, client: Client, jobs: Iterator[Job]):
        self.client, self.jobs = client, jobs
        self.given: dict[Future, tuple[Job, int]] = {}
        self.finished: queue.Queue[Future] = queue.Queue()
        self.packed: tuple[Estimator | None, bytes] = (None, b"")

    def fill(self) -> None:
        """Give out new jobs, as many as the workers that are there now want."""
        most = AHEAD * max(self._threads(), FEWEST)
        while len(self.given) < most and (job := next(self.jobs, None)) is not None:
            self.submit(job, LIVES)

    def next(self, patience: float) -> Future:
        """The next one that is finished, well or not."""
        alone_since = None
        while True:
            try:
                return self.finished.get(timeout=LOOK)
            except queue.Empty:
                now = time.monotonic()
                alone_since = None if self._threads() else alone_since or now
            if alone_since is not None and now - alone_since > patience:
                raise LostClusterError(
                    "all workers ended and none came back. What was done is kept; run the same command again."
                )

    def submit(self, job: Job, lives: int) -> None:
        if self.packed[0] is not job.experiment:
            self.packed = (job.experiment, pickle.dumps(job.experiment))
        what = Parcel(*job[:4], self.packed[1], bool(jax.config.read("jax_enable_x64")), versions())
        future = self.client.submit(pickle.loads, what.called(), pure=False, priority=LIVES - lives)
        self.given[future] = (job, lives)
        future.add_done_callback(self.finished.put)

    def again(self, job: Job, lives: int, error: KilledWorker) -> None:
        """Give the job out once more after dask gave it up."""
        if lives == 0:
            raise InputError(
                f"realizations {job.first} to {job.first + job.count - 1} of case {job.case} killed worker after "
                "worker: most likely for want of memory. Give each worker more, or write a smaller chunk in the study."
            ) from error
        self.submit(job, lives - 1)

    def _threads(self) -> int:
        there = self.client.nthreads()
        assert isinstance(there, dict)  # a coroutine for asynchronous clients only
        return sum(there.values())


def work(parcel: Parcel) -> Float[np.ndarray, "count quantities"]:
    """Do a job: this runs on a worker, in as many threads at once as that has."""
    here = versions()
    differ = [f"{name} {here[name]} instead of {x}" for name, x in parcel.versions.items() if here[name] != x]
    require(not differ, f"a worker has {', '.join(differ)}. Install the same versions on every machine.")
    _prepare(parcel.double)
    job = Job(parcel.case, parcel.first, parcel.count, parcel.seed, _unpacked(parcel.experiment))
    return realizations(job, threads=1)


@functools.cache
def _prepare(double: bool) -> None:
    """The precision of the process that began the study, and programs kept on disk for all workers of a machine."""
    jax.config.update("jax_enable_x64", double)
    keep_programs(default_folder())


@functools.lru_cache(maxsize=4)
def _unpacked(experiment: bytes) -> Estimator:
    return pickle.loads(experiment)
