"""Whether the place of an effect that the catalogue does not hold is found: `jaxsid.locate` alone, no law is fitted.

    .venv/bin/python benchmarks/blind/places.py OUT [--set dev] [--cases 240] [--shard 0/2]

Draws the cases of a set that obey laws outside of the catalogue, says where, and prints shares of all in OUT/places. A
second run goes on where the first stopped.
"""

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from draw import drawn_case
from equivalent import same_place
from generate import write_case, written
from laws import OUTSIDE
from plan import SETS, plan
from score import LEAST

import jaxsid
from jaxsid.compilation import default_folder, keep_programs, release_programs
from jaxsid.gap.locate import locate

PART = 0.05  # of the response, from which on an effect is large


def judged(out: Path, number: int) -> dict[str, Any]:
    """The line of a case that has been written.

    Args:
        out: folder of the set.
        number: of the case.
    """
    folder, name = out / "cases" / f"{number:04d}", f"{number:04d}.json"
    label = json.loads((out / "labels" / name).read_text())
    model = jaxsid.read_model(folder / "model.toml")
    records = [jaxsid.read_record(path, model) for path in sorted(folder.glob("run*.csv"))]
    began = time.perf_counter()
    found = locate(model, records)
    right = [same_place(label, 0, p.as_dict()) for p in found.likely]
    (effect,) = label["effects"]
    return {
        "case": number,
        "kind": effect["kind"],
        "family": label["family"],
        "sensors": "one" if label["one_sensor"] else "two or more",
        "noise": label["noise"],
        "gap": effect.get("gap", effect["gap_alone"]),
        "first": same_place(label, 0, found.ranked[0].place.as_dict()),
        "in_set": any(right),
        "set": len(right),
        "place": effect["place"],
        "said": [p.label for p in found.likely],
        "probability": found.ranked[0].probability,
        "seconds": round(time.perf_counter() - began, 2),
    }


def summary(lines: Iterable[dict[str, Any]]) -> list[str]:
    """Shares over all cases whose gap counts, by sensors, those of large effects, by kind.

    Args:
        lines: from `judged`.
    """
    groups: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for x in (x for x in lines if x["gap"] >= LEAST):
        seen = f"{x['sensors']} sensor(s)"
        large = f"{seen}, 1 % noise at most, effect of 5 % of the response or more"
        for name in (
            "all",
            seen,
            *[large] * (x["noise"] < 0.02 and x["gap"] * x["noise"] >= PART),
            x["kind"],
        ):
            groups[name].append(x)

    def mean(each: list[dict[str, Any]], what: str) -> float:
        return float(np.mean([x[what] for x in each]))

    rows = [
        "| cases | number | first | in the set of the first | mean size of the set |",
        "|---|---|---|---|---|",
    ]
    for name, each in sorted(groups.items()):
        first, among = (f"{100 * mean(each, what):.0f} %" for what in ("first", "in_set"))
        rows.append(f"| {name} | {len(each)} | {first} | {among} | {mean(each, 'set'):.2f} |")
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--set", choices=sorted(SETS), default="dev")
    parser.add_argument(
        "--cases", type=int, nargs="+", default=[240], help="how many, or the first and how many"
    )
    parser.add_argument("--samples", type=int, nargs=2, default=(4000, 2000))
    parser.add_argument("--shard", default="0/1")
    asked = parser.parse_args()
    part, parts = map(int, asked.shard.split("/"))
    first, last = (0, *asked.cases)[-2], sum(asked.cases)
    wanted = [c for c in plan(asked.set, last)[first:] if c.kinds and c.kinds[0] in OUTSIDE]
    for case in wanted[part::parts]:
        line = asked.out / "places" / f"{case.number:04d}.json"
        if line.exists():
            continue
        if not (asked.out / "labels" / line.name).exists():
            write_case(asked.out, case.number, drawn_case(asked.set, case, tuple(asked.samples)))
        written(line, json.dumps(judged(asked.out, case.number)) + "\n")
        release_programs()
    print(
        "\n".join(summary(json.loads(x.read_text()) for x in sorted((asked.out / "places").glob("*.json"))))
    )


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    keep_programs(default_folder())
    main()
