"""Runs a study: computes what its folder does not hold yet, then makes the tables.

    with open_store(folder, study) as store:
        run_study(study, store)
        rows = write_tables(study, store)

The same realizations come out whatever the chunk, the number of workers and the number of times it was stopped, since
each has its own random numbers and always runs in the same program.
"""

import functools
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxsid.checks import InputError, JaxsidError
from jaxsid.compilation import release_programs
from jaxsid.study.configuration import Case, Study
from jaxsid.study.experiment import make_experiment
from jaxsid.study.parts import missing, sound_parts, write_part
from jaxsid.study.store import Facts, case_folder, read_facts, write_facts
from jaxsid.uncertainty.ensemble import BATCH, ensemble

KEPT = 16  # experiments in memory
RECENT = 32  # finished chunks that the remaining time is told from


@runtime_checkable
class Estimator(Protocol):
    """What `jaxsid.study.experiment.Experiment` is: from a key to estimates of named quantities, whose truth is known.

    Modules that differ in arrays only share a compiled program.
    """

    @property
    def names(self) -> tuple[str, ...]: ...

    @property
    def units(self) -> tuple[str, ...]: ...

    @property
    def truth(self) -> Float[Array, " q"]: ...

    @property
    def bound(self) -> Float[Array, " q"]: ...

    def __call__(self, key: Array) -> Float[Array, " q"]: ...


class Job(NamedTuple):
    """Some realizations of a case."""

    case: int
    first: int
    count: int
    seed: int
    experiment: Estimator


class Done(NamedTuple):
    """Results of a job, one row a realization."""

    job: Job
    values: Float[np.ndarray, "count quantities"]


class Progress(NamedTuple):
    """Realizations that are on disk, of how many, and the seconds that the others will take if that can be told."""

    done: int
    total: int
    seconds_left: float | None


Execute = Callable[[Iterable[Job]], Iterator[Done]]


def in_process(jobs: Iterable[Job]) -> Iterator[Done]:
    """Do one job after another, here."""
    for job in jobs:
        yield Done(job, realizations(job))


def realizations(job: Job, threads: int | None = None) -> Float[np.ndarray, "count quantities"]:
    """Do a job, in batches: one program serves every chunk, and an interrupt is heard between them.

    Args:
        job: what to do.
        threads: as for `ensemble`.
    """
    release_programs()
    key = jax.random.fold_in(jax.random.key(job.seed), job.case)
    return ensemble(job.experiment, key, job.count, first=job.first, chunk=BATCH, threads=threads)


def run_study(
    study: Study,
    store: Path,
    *,
    execute: Execute = in_process,
    progress: Callable[[Progress], None] = lambda _: None,
    say: Callable[[str], None] = lambda _: None,
    make: Callable[[Case], Estimator] = make_experiment,
) -> None:
    """Compute every realization that the store lacks.

    Args:
        study: what to compute.
        store: folder that `open_store` gave.
        execute: does jobs, here or elsewhere, and yields their results in any order; only this process writes.
        progress: told how far it is, at the start and after each chunk.
        say: told in words what is going on.
        make: the experiment of a case.

    Raises:
        InputError: a case that cannot be computed; the folder cannot be written to.
    """
    made = functools.lru_cache(maxsize=KEPT)(lambda index: _made(study.cases[index], make))
    for case in study.cases:  # before hours of computing, so that a case that cannot be made is told at once
        if read_facts(store, case.index) is None:
            say(f"preparing case {case.index + 1} of {len(study.cases)}")
            write_facts(store, case.index, _facts(made(case.index)))
    say("looking for what is there")
    todo = [span for case in sorted(study.cases, key=_program) for span in _missing(study, store, case)]
    total = study.realizations * len(study.cases)
    clock = Clock(total, total - sum(count for _, _, count in todo))
    progress(clock.step(0))
    jobs = (Job(index, first, count, study.seed, made(index)) for index, first, count in todo)
    for job, values in execute(jobs):
        write_part(case_folder(store, job.case), job.first, job.experiment.names, values)
        progress(clock.step(job.count))


def _made(case: Case, make: Callable[[Case], Estimator]) -> Estimator:
    """The experiment; an error says which case it was."""
    release_programs()
    try:
        return make(case)
    except JaxsidError as error:
        factors = ", ".join(f"{name} = {value}" for name, value in case.values.items())
        raise InputError(f"case {case.index} ({factors}): {error}") from error


def _facts(experiment: Estimator) -> Facts:
    return Facts(
        experiment.names, experiment.units, np.asarray(experiment.truth), np.asarray(experiment.bound)
    )


def _program(case: Case) -> tuple:
    """Sorts cases that differ in real numbers only, which share a program, next to one another."""
    return tuple(str(x) for x in case.values.values() if not isinstance(x, float)), case.index


def _missing(study: Study, store: Path, case: Case) -> list[tuple[int, int, int]]:
    """Case, first realization and their number, for each chunk that is to be computed."""
    facts = read_facts(store, case.index)
    assert facts is not None
    there = sound_parts(case_folder(store, case.index), facts.names)
    return [(case.index, a, b - a) for a, b in missing(there, study.realizations, study.chunk)]


class Clock:
    """Tells the remaining time from the chunks that were finished last, since the first ones also compile."""

    def __init__(self, total: int, done: int, now: Callable[[], float] = time.monotonic):
        self.total, self.done, self.now = total, done, now
        self.recent = deque([(now(), done)], maxlen=RECENT)

    def step(self, count: int) -> Progress:
        self.done += count
        if count:
            self.recent.append((self.now(), self.done))
        (begin, before), (end, after) = self.recent[0], self.recent[-1]
        rate = (after - before) / (end - begin) if end > begin else 0.0
        return Progress(self.done, self.total, (self.total - self.done) / rate if rate else None)
