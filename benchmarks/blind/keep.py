"""Keeps findings apart from the folder in which they were made, small enough for the repository, and gives them back.

    .venv/bin/python benchmarks/blind/keep.py OUT FILE

FILE gets a line for each case of OUT/found, with what is scored and nothing of the truth; OUT/found gets the cases
that FILE has and it has not, so that `run.py` goes on where another machine stopped.
"""

import argparse
import json
import re
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
from generate import written

WHOLE = ("verdict", "verdict_probability", "finding", "selected", "closure")
EFFECT = ("kind", "place", "probability", "round")
LOCATION = ("together", "probability")
FIRST = 10  # of effects and places
ABOVE = re.compile(r'File "[^"]*/(?=(jaxsid|benchmarks|site-packages)/)')  # folders of one machine


def scored(found: dict[str, Any]) -> dict[str, Any]:
    """The part of a case's findings that is kept: a failure but for where files lay, of a diagnosis what is scored.

    Args:
        found: as `run.py` writes it.
    """
    said = found.get("diagnosis")
    if said is None:
        return {**found, "traceback": ABOVE.sub('File "', found.get("traceback", ""))}
    part = {k: said[k] for k in WHOLE if k in said}
    for name, keys in (("effects", EFFECT), ("locations", LOCATION)):
        part[name] = [{k: x[k] for k in keys if k in x} for x in (said.get(name) or [])[:FIRST]]
    return {**found, "diagnosis": part}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("file", type=Path)
    asked = parser.parse_args()
    lines = asked.file.read_text().splitlines() if asked.file.exists() else []
    kept = {x.pop("case"): x for x in map(json.loads, lines)}
    here = {p.stem: scored(json.loads(p.read_text())) for p in (asked.out / "found").glob("*.json")}
    for case in kept.keys() - here.keys():
        written(asked.out / "found" / f"{case}.json", json.dumps(kept[case], indent=1) + "\n")
    every = {**kept, **here}
    rows = (json.dumps({"case": case, **every[case]}, separators=(",", ":")) for case in sorted(every))
    written(asked.file, "".join(f"{row}\n" for row in rows))
    print(f"{len(every)} cases: {len(kept.keys() - here.keys())} from the file, {len(here)} from {asked.out}")


if __name__ == "__main__":
    main()
