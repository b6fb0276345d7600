"""A process that runs the tasks of one module as told, so that tools of two environments can take turns.

    python benchmarks/era_worker.py MODULE CASES.npz

Each line on standard input names a task; each line on standard output answers it. Both are JSON.
"""

import ctypes
import json
import os
import sys
import time
from importlib import import_module
from pathlib import Path

import numpy as np
from era_cases import errors

STATUS = Path("/proc/self/status")
RESET_PEAK = "5"  # written to clear_refs, it sets the peak to what is resident now


def resident(entry: str) -> float:
    """Resident memory in MB: VmRSS now, VmHWM at its peak."""
    line = next(x for x in STATUS.read_text().splitlines() if x.startswith(entry))
    return int(line.split()[1]) / 1024


def start_peak() -> float:
    """Forget the peak so far and what was freed, lest it hide what is taken now; MB resident."""
    ctypes.CDLL(None).malloc_trim(0)
    Path("/proc/self/clear_refs").write_text(RESET_PEAK)
    return resident("VmRSS")


def peak_above_baseline(run) -> float | None:
    """Highest resident memory during a call above that before it, MB; None where the system does not tell."""
    if not STATUS.exists():
        return None
    before = start_peak()
    run()
    return resident("VmHWM") - before


def timed(run, repeats: int) -> tuple[list[float], np.ndarray]:
    seconds, result = [], np.empty(0)
    for _ in range(repeats):
        begin = time.perf_counter()
        result = run()
        seconds.append(time.perf_counter() - begin)
    return seconds, result


class Worker:
    """Tasks of a module on the given impulse responses; each is made once."""

    def __init__(self, module: str, file: str):
        self.tools, self.data, self.tasks = import_module(module), dict(np.load(file)), {}

    def task(self, tool: str, case: str):
        """The same callable whenever it is asked for, so that what it compiled stays."""
        if (tool, case) not in self.tasks:
            self.tasks[tool, case] = self.tools.task(tool, case, self.data[case])
        return self.tasks[tool, case]

    def times(self, tool: str, case: str, repeats: int, warm: bool) -> dict:
        """Seconds of each repetition, after one that does not count where `warm`; errors of the last."""
        run = self.task(tool, case)
        if warm:
            run()
        seconds, A = timed(run, repeats)
        return {"seconds": seconds, "errors": errors(self.data, case, A)}

    def memory(self, tool: str, case: str, compiled: bool) -> float | None:
        """Peak of the first call, all libraries being warm from another case; MB."""
        self.task(tool, "A")()
        make = self.tools.prepared if compiled else self.tools.task
        return peak_above_baseline(make(tool, case, self.data[case]))


def main() -> None:
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # a tool that prints must not disturb the answers
    worker = Worker(*sys.argv[1:3])
    for line in sys.stdin:
        wanted = json.loads(line)
        answer = getattr(worker, wanted.pop("do"))(**wanted)
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
