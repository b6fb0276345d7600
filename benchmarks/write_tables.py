"""Put the figures of one run into README.md, between its markers.

    python benchmarks/write_tables.py FOLDER

The folder holds what the other scripts wrote: timings, structure, peers, era and rates, each .json.
"""

import json
import os
import platform
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
from era_tables import case_table, era_table, memory_table, rates_table, target_table

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


def timing_rows(timings: dict) -> list[str]:
    rows = ["| what | case | median, s |", "|---|---|---|"]
    for row in timings["benchmarks"]:
        what, _, case = row["name"].removeprefix("test_").partition("[")
        rows.append(f"| {what.replace('_', ' ')} | {case.rstrip(']')} | {row['stats']['median']:.3g} |")
    return rows


def machine(era: dict, versions: dict[str, str]) -> str:
    """What it ran on: enough to know which figures may be compared."""
    before, after = era["load"]
    peers = ", ".join(f"{name} {number}" for name, number in versions.items())
    return (
        f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}, jax {version('jax')}; "
        f"{peers}. Load average before the realizations {before:.1f}, after them {after:.1f}."
    )


def main() -> None:
    folder = Path(sys.argv[1])
    timings, structure, peers, era, rates = (
        json.loads((folder / f"{name}.json").read_text())
        for name in ("timings", "structure", "peers", "era", "rates")
    )
    sections = {
        "Targets": target_table(era, rates),
        "Cases": case_table(),
        "Realizations, by tool": era_table(era),
        "Memory": memory_table(era),
        "Ensembles and covariance": rates_table(rates),
        "Flexible structure, held-out prediction": structure_table(structure, peers),
        "Timings": timing_rows(timings),
    }
    parts = [machine(era, peers["versions"])]
    for title, rows in sections.items():
        parts += ["", f"### {title}", "", *rows]
    text = README.read_text()
    before, rest = text.split(BEGIN)
    after = rest.split(END)[1]
    README.write_text(before + BEGIN + "\n\n" + "\n".join(parts) + "\n\n" + END + after)


if __name__ == "__main__":
    main()
