"""How long `jaxsid diagnose` takes: three masses, three sensors, records of 10 000 and 5 000 samples, 1 % noise.

    .venv/bin/python benchmarks/blind/durations.py OUT [--kinds KIND ...]

For no effect and for every second kind of the catalogue, or those given, a case of development seeds is drawn into OUT.
Each is diagnosed twice by the command, in a process of its own: first for the programs that it compiles, which are kept
on disk, then for the time. OUT/durations.json gets the wall-clock seconds of both and what was found, OUT/labels what
is true. A second run goes on where the first stopped. Nothing else should run on the machine meanwhile.
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
from draw import SAMPLES, drawn_case
from excitation import KINDS as EXCITATIONS
from generate import write_case, written
from laws import CATALOGUE
from plan import Planned

NUMBER = 50_000  # of the first case, beyond those of any set
NOISE = 0.01
NONE = "none"
PASSES = ("cold", "warm")


def timed(folder: Path) -> tuple[float, dict[str, Any]]:
    """Seconds of the command, from its start to its end, and what it says.

    Args:
        folder: model.toml, run1.csv and run2.csv.
    """
    command = Path(sys.executable).with_name("jaxsid")
    files = [folder / name for name in ("model.toml", "run1.csv", "run2.csv")]
    with tempfile.TemporaryDirectory() as out:
        began = time.perf_counter()
        subprocess.run([command, "diagnose", *files, "--out", out, "--quiet"], check=True)
        took = time.perf_counter() - began
        said = json.loads((Path(out) / "diagnosis.json").read_text())
    return took, {"verdict": said["verdict"], "selected": [[x["kind"], x["place"]] for x in said["selected"]]}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--kinds", nargs="+", choices=(NONE, *CATALOGUE), default=(NONE, *CATALOGUE[::2]))
    asked = parser.parse_args()
    path = asked.out / "durations.json"
    found = json.loads(path.read_text()) if path.exists() else {}
    every = (NONE, *CATALOGUE)
    for mode in PASSES:
        for kind in asked.kinds:
            row = found.setdefault(kind, {})
            if mode in row:
                continue
            i = every.index(kind)
            folder = asked.out / "cases" / f"{NUMBER + i:04d}"
            if not folder.exists():
                kinds = () if kind == NONE else (kind,)
                case = Planned(
                    NUMBER + i, kinds, "chain", EXCITATIONS[i % len(EXCITATIONS)], NOISE, 0.0, False
                )
                write_case(asked.out, case.number, drawn_case("dev", case, SAMPLES))
            row[mode], said = timed(folder)
            row |= said
            written(path, json.dumps(found, indent=1) + "\n")
            print(f"{kind:24s} {mode} {row[mode]:7.1f} s  {row['verdict']}", flush=True)
    for mode in PASSES:
        each = sorted(found[k][mode] for k in asked.kinds)
        print(f"{mode}: median {statistics.median(each):.1f} s, from {each[0]:.1f} to {each[-1]:.1f} s")


if __name__ == "__main__":
    main()
