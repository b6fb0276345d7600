"""Every tool on every case, in turns; times, errors and memory of one run.

    .venv/bin/python benchmarks/era_rounds.py CASES.npz PEERS_PYTHON OUT.json [CASE ...]

The tools of a case take turns, round after round, so that what else the machine does falls on all of them. Each tool
is tried with the linear algebra's default number of threads and with one, and goes on with the better.
"""

import json
import os
import statistics
import subprocess
import sys
from typing import NamedTuple

JAXSID, PEERS = "era_jaxsid", "era_peers"
THREADS = {"default": None, "one": "1"}
BOTH, ONE, MANY = ("default", "one"), ("one",), ("default",)


class Entry(NamedTuple):
    """A tool on a case.

    Attributes:
        rounds: in which it takes part.
        repeats: timed calls each time.
        warm: whether a call that does not count goes before them.
        threads: settings that are tried.
    """

    module: str
    tool: str
    rounds: int = 5
    repeats: int = 3
    warm: bool = True
    threads: tuple[str, ...] = BOTH

    def once(self, rounds: int = 1, threads: tuple[str, ...] | None = None) -> "Entry":
        """For what takes seconds: one call in each of few rounds."""
        return self._replace(rounds=rounds, repeats=1, warm=False, threads=threads or self.threads)


FAST = Entry(JAXSID, "jaxsid")
FULL = Entry(JAXSID, "jaxsid, full decomposition", rounds=3, repeats=1, threads=ONE)
PYMOR = Entry(PEERS, "pyMOR randomized")
PROJECTED = Entry(PEERS, "pyMOR randomized, 15 output directions", rounds=3, repeats=1)
NUMPY = Entry(PEERS, "numpy", repeats=1)
CONTROL = Entry(PEERS, "python-control", rounds=3, repeats=1)
PYYETI = Entry(PEERS, "pyYeti", rounds=3, repeats=1)
SLOW = [entry.once(threads=MANY) for entry in (CONTROL, PYYETI)]
THIN = [FAST, PYMOR.once(2), PROJECTED, NUMPY, FULL]
PLAN = {
    "A": [FAST, PYMOR, NUMPY.once(2), CONTROL.once(2), PYYETI.once(2)],
    "B": [FAST, PYMOR, NUMPY.once(threads=MANY), *SLOW],
    "C": [
        FAST._replace(repeats=1),
        PYMOR.once(3),
        NUMPY.once(2),
        CONTROL.once(threads=ONE),
        PYYETI.once(threads=ONE),
        FULL.once(),
    ],
    "D1": [*THIN, CONTROL, PYYETI],
    "D1 noisy": [*THIN, CONTROL, PYYETI],
    "D2": [*THIN, *SLOW],
    "D2 noisy": THIN,
}
# Tools whose memory is measured on B, and whether their compilation is done beforehand.
MEMORY = {
    "jaxsid": (JAXSID, "jaxsid", True),
    "jaxsid, its compilation included": (JAXSID, "jaxsid", False),
    "pyMOR randomized": (PEERS, "pyMOR randomized", True),
    "numpy": (PEERS, "numpy", True),
}


class Worker:
    """A process that answers; see era_worker.py."""

    def __init__(self, python: str, module: str, cases: str, threads: str):
        script = os.path.join(os.path.dirname(os.path.abspath(__file__)), "era_worker.py")
        limit = {"OPENBLAS_NUM_THREADS": THREADS[threads]} if THREADS[threads] else {}
        self.process = subprocess.Popen(
            [python, script, module, cases],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | limit,
        )

    def ask(self, **wanted):
        """The answer, waited for."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        print(json.dumps(wanted), file=self.process.stdin, flush=True)
        answer = self.process.stdout.readline()
        if not answer:
            raise RuntimeError(f"the process that was asked for {wanted} ended with {self.process.wait()}")
        return json.loads(answer)

    def end(self) -> None:
        self.process.communicate()


def rounds(entries: list[Entry], case: str, workers: dict[tuple[str, str], Worker]) -> dict[str, dict]:
    """All tools of a case; each goes on with the number of threads that was better in the first round."""
    found: dict[str, dict] = {}
    for turn in range(max(e.rounds for e in entries)):
        for entry in entries:
            if turn == 0:
                rows = [measured(entry, case, threads, workers) for threads in entry.threads]
                found[entry.tool] = min(rows, key=lambda row: statistics.median(row["seconds"]))
            elif turn < entry.rounds:
                row = found[entry.tool]
                row["seconds"] += measured(entry, case, row["threads"], workers)["seconds"]
    for tool, row in found.items():
        row["median"], row["lowest"] = statistics.median(row["seconds"]), min(row["seconds"])
        print(f"{case}: {tool}, {row['threads']}: {1e3 * row['median']:.3g} ms", file=sys.stderr, flush=True)
    return found


def measured(entry: Entry, case: str, threads: str, workers: dict[tuple[str, str], Worker]) -> dict:
    """One turn of a tool."""
    asked = {"tool": entry.tool, "case": case, "repeats": entry.repeats, "warm": entry.warm}
    return workers[entry.module, threads].ask(do="times", **asked) | {"threads": threads}


def memory(python: dict[str, str], cases: str) -> dict[str, float | None]:
    """Peaks above the baseline on B, each in a process of its own, MB."""
    peaks = {}
    for words, (module, tool, compiled) in MEMORY.items():
        worker = Worker(python[module], module, cases, "default")
        peaks[words] = worker.ask(do="memory", tool=tool, case="B", compiled=compiled)
        worker.end()
    return peaks


def main() -> None:
    cases, peers, out, *chosen = sys.argv[1:]
    python = {JAXSID: sys.executable, PEERS: peers}
    load = [os.getloadavg()[0]]
    workers = {(m, t): Worker(path, m, cases, t) for m, path in python.items() for t in THREADS}
    found = {
        case: rounds(entries, case, workers) for case, entries in PLAN.items() if case in (chosen or PLAN)
    }
    for worker in workers.values():
        worker.end()
    peaks = memory(python, cases)
    load.append(os.getloadavg()[0])
    with open(out, "w") as file:
        json.dump({"load": load, "cases": found, "memory": peaks}, file)


if __name__ == "__main__":
    main()
