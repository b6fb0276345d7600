"""Put the figures of one run into README.md, between its markers.

python benchmarks/write_tables.py TIMINGS.json STRUCTURE.json PEERS.json
"""

import json
import os
import platform
import sys
from pathlib import Path

import numpy as np

README = Path(__file__).with_name("README.md")
BEGIN, END = "<!-- figures: begin -->", "<!-- figures: end -->"


def number(x: float, form: str = "{:.2f}") -> str:
    return form.format(x) if np.isfinite(x) else "unstable"


def best(trials: list[dict]) -> dict:
    return min(trials, key=lambda row: np.median(row["nrmse"]))


def structure_rows(name: str, trials: list[dict], chosen: dict) -> list[str]:
    rows = []
    for row in trials:
        mark = "**" if row is chosen else ""
        median, worst = 100 * np.median(row["nrmse"]), 100 * np.max(row["nrmse"])
        rows.append(
            f"| {name} | {mark}{row['setting']}{mark} | {mark}{number(median)}{mark} | {number(worst)} "
            f"| {row['seconds']:.1f} |"
        )
    return rows


def structure_table(structure: dict, peers: dict) -> list[str]:
    if not structure["trials"]:
        return [f"Not run: {structure['reason']}."]
    rows = [
        "| tool | setting (its best in bold) | median NRMSE, % | worst NRMSE, % | time, s |",
        "|---|---|---|---|---|",
    ]
    for name, trials in {"jaxsid": structure["trials"], **peers["structure"]}.items():
        title = (
            f"{name} {peers['versions'].get(name, peers['versions'].get(name.removeprefix('python-'), ''))}"
        )
        rows += structure_rows(title.strip(), trials, best(trials))
    return rows


def timing_rows(timings: dict, peers: dict) -> list[str]:
    rows = ["| what | case | median, s |", "|---|---|---|"]
    for row in timings["benchmarks"]:
        what, _, case = row["name"].removeprefix("test_").partition("[")
        rows.append(f"| {what.replace('_', ' ')} | {case.rstrip(']')} | {row['stats']['median']:.3g} |")
    rows += [f"| python-control | {case} | {seconds:.3g} |" for case, seconds in peers["era"].items()]
    return rows


def main() -> None:
    timings, structure, peers = (json.loads(Path(name).read_text()) for name in sys.argv[1:4])
    text = README.read_text()
    before, rest = text.split(BEGIN)
    after = rest.split(END)[1]
    machine = f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}"
    machine += f", load average {os.getloadavg()[2]:.1f}."
    parts = [
        machine,
        "",
        "### Flexible structure, held-out prediction",
        "",
        *structure_table(structure, peers),
    ]
    parts += ["", "### Timings", "", *timing_rows(timings, peers)]
    README.write_text(before + BEGIN + "\n\n" + "\n".join(parts) + "\n\n" + END + after)


if __name__ == "__main__":
    main()
