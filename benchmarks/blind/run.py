"""Diagnoses every case of a set, from its model and records alone.

    .venv/bin/python benchmarks/blind/run.py OUT [--shard i/n] [--again]

OUT/found/NNNN.json gets what diagnosis.json holds and the seconds that it took, or how it failed. A second run goes on
where the first stopped, inside a case too (OUT/begun/NNNN); with --again cases that failed are tried once more.
"""

import argparse
import json
import sys
import time
import traceback
from pathlib import Path
from threading import Lock
from typing import Any

import jax

sys.path.insert(0, str(Path(__file__).parent))
from generate import written

import jaxsid
from jaxsid.compilation import default_folder, keep_programs
from jaxsid.gap.resume import resumable


class Clock:
    """Seconds that a case has taken, those of runs that were cut off included up to their last stage.

    Attributes:
        path: of a file that keeps them between runs.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._spent = json.loads(path.read_text()) if path.exists() else [0.0, 0.0]
        self._began = self._now()
        self._lock = Lock()  # stages run side by side

    def read(self) -> dict[str, float]:
        """On the wall and of the processor."""
        each = (round(s + n - b, 2) for s, n, b in zip(self._spent, self._now(), self._began, strict=True))
        return dict(zip(("seconds", "processor_seconds"), each, strict=True))

    def keep(self, _stage: str) -> None:
        """Write down what was spent."""
        with self._lock:
            written(self.path, json.dumps([*self.read().values()]))

    @staticmethod
    def _now() -> tuple[float, float]:
        return time.perf_counter(), time.process_time()


def diagnosed(folder: Path, clock: Clock) -> dict[str, Any]:
    """What is found in a case, or how it failed.

    Args:
        folder: model.toml, run1.csv and run2.csv.
        clock: of this case.
    """
    try:
        model = jaxsid.read_model(folder / "model.toml")
        records = [jaxsid.read_record(folder / f"run{i}.csv", model) for i in (1, 2)]
        found = jaxsid.diagnose(model, records, progress=clock.keep)
        return {"diagnosis": found.as_dict(), **clock.read()}
    except Exception as error:
        return {"failure": repr(error), "traceback": traceback.format_exc(), **clock.read()}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--shard", default="0/1")
    parser.add_argument("--again", action="store_true")
    asked = parser.parse_args()
    part, parts = map(int, asked.shard.split("/"))
    for folder in sorted((asked.out / "cases").iterdir())[part::parts]:
        path = asked.out / "found" / f"{folder.name}.json"
        if path.exists() and not (asked.again and "failure" in json.loads(path.read_text())):
            continue
        begun = asked.out / "begun" / folder.name
        with resumable(begun, resume=True):
            found = diagnosed(folder, Clock(begun / "seconds.json"))
            written(path, json.dumps(found, indent=1, default=float) + "\n")
        said = found.get("failure") or found["diagnosis"].get("verdict")
        print(f"{folder.name} {found['seconds']:7.1f} s  {said}", flush=True)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    keep_programs(default_folder())
    main()
