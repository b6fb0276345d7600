"""Draws cases and writes them: what a user would have, and apart from it what is true.

    .venv/bin/python benchmarks/blind/generate.py OUT --set SET --cases N [--samples 10000 5000] [--shard i/n]

SET is one of those in plan.py. OUT/cases/NNNN/ gets model.toml, run1.csv and run2.csv, OUT/labels/NNNN.json the truth.
A second run goes on where the first stopped. Imports nothing of the library.
"""

import argparse
import json
import os
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from draw import SAMPLES, Case, drawn_case
from plan import SETS, plan
from systems import System


def toml(system: System) -> str:
    """The model file.

    Args:
        system: nominal.
    """
    quoted = lambda *x: ", ".join(f'"{y}"' for y in x)  # noqa: E731
    lines = [f'name = "{system.name}"', "", "[bodies]"]
    lines += [f"{b} = {m!r}" for b, m in zip(system.bodies, system.mass, strict=True)]
    for c in system.connections:
        lines += ["", "[[connections]]", f'name = "{c.name}"', f"between = [{quoted(*c.between)}]"]
        lines += [f"stiffness = {float(c.stiffness)!r}", f"damping = {float(c.damping)!r}"]
    for i in system.inputs:
        lines += ["", "[[inputs]]", f'name = "{i.name}"', f'body = "{i.body}"', 'hold = "zero"']
    for s in system.sensors:
        lines += ["", "[[sensors]]", f'name = "{s.name}"', f'body = "{s.body}"', f'kind = "{s.kind}"']
    return "\n".join(lines) + "\n"


def csv(system: System, record: np.ndarray) -> str:
    """A record with its header.

    Args:
        system: names the columns.
        record: input, then sensors.
    """
    names = ["time", system.inputs[0].name, *(s.name for s in system.sensors)]
    rows = (
        ",".join([f"{k * system.dt:.12g}", *(f"{x:.9g}" for x in row)])
        for k, row in enumerate(record.tolist())
    )
    return "\n".join([",".join(names), *rows]) + "\n"


def written(path: Path, text: str) -> None:
    """A file that is either whole or not there.

    Args:
        path: of the file.
        text: what it holds.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    part.write_text(text)
    part.replace(path)


def write_case(out: Path, number: int, case: Case) -> None:
    """The label comes last: a case that has one is complete.

    Args:
        out: folder of the set.
        number: of the case.
        case: drawn.
    """
    folder = out / "cases" / f"{number:04d}"
    written(folder / "model.toml", toml(case.nominal))
    for i, record in enumerate(case.records, start=1):
        written(folder / f"run{i}.csv", csv(case.nominal, record))
    written(out / "labels" / f"{number:04d}.json", json.dumps(case.label, indent=1) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--set", choices=sorted(SETS), required=True)
    parser.add_argument("--cases", type=int, required=True)
    parser.add_argument("--samples", type=int, nargs=2, default=SAMPLES)
    parser.add_argument("--shard", default="0/1")
    asked = parser.parse_args()
    part, parts = map(int, asked.shard.split("/"))
    for case in plan(asked.set, asked.cases)[part::parts]:
        if (asked.out / "labels" / f"{case.number:04d}.json").exists():
            continue
        began = time.perf_counter(), time.process_time()
        made = drawn_case(asked.set, case, tuple(asked.samples))
        write_case(asked.out, case.number, made)
        took = time.perf_counter() - began[0], time.process_time() - began[1]
        shown = " + ".join(case.kinds) or "none"
        print(f"{case.number:4d} {shown:45s} {took[0]:6.1f} s, processor {took[1]:5.1f} s", flush=True)


if __name__ == "__main__":
    main()
