"""Tables of the realizations: targets and whether they are met, times and errors, rates, memory."""

import json
from pathlib import Path
from typing import NamedTuple

from era_cases import CASES

GPU = Path(__file__).parent / "figures" / "gpu.json"  # written by rates.py on a machine that has one


class Target(NamedTuple):
    """What was promised, what was measured, and whether that is enough; each in the unit of the words."""

    case: str
    words: str
    measured: float | None
    limit: float
    at_least: bool = True

    @property
    def row(self) -> str:
        if self.measured is None:
            return f"| {self.case} | {self.words} | not measured | |"
        met = self.measured >= self.limit if self.at_least else self.measured <= self.limit
        return f"| {self.case} | {self.words} | {self.measured:.3g} | {'yes' if met else '**no**'} |"


def faster(cases: dict, name: str, peer: str, times: float) -> Target:
    """How many times the peer's time is ours."""
    ratio = cases[name][peer]["median"] / cases[name]["jaxsid"]["median"]
    return Target(name, f"times faster than {peer}: {times:g} or more", ratio, times)


def targets(era: dict, rates: dict) -> list[Target]:
    """All of them, in the order of the cases."""
    cases, delta = era["cases"], rates["delta method"]
    error = {tool: cases["A"][tool]["errors"]["truth"] for tool in ("jaxsid", "numpy")}
    few, many = rates["memory"]["256"], rates["memory"]["4096"]
    growth = None if few is None else many - few
    covariance = delta["with covariance, s"] / delta["one realization, s"]
    usual = next(iter(rates["rates"].items()))
    return [
        faster(cases, "A", "pyMOR randomized", 2),
        Target("A", "pole error over numpy's: 3 or less", error["jaxsid"] / error["numpy"], 3, False),
        faster(cases, "B", "pyMOR randomized", 1),
        Target("B", "memory above baseline, MB: 20 or less", era["memory"]["jaxsid"], 20, False),
        faster(cases, "C", "numpy", 10),
        faster(cases, "C", "pyMOR randomized", 3),
        Target(
            "C",
            "poles off numpy's, in spreads by noise: 0.001 or less",
            cases["C"]["jaxsid"]["errors"]["full"],
            1e-3,
            False,
        ),
        *(faster(cases, name, "numpy", 3) for name in ("D1", "D1 noisy")),
        *(faster(cases, name, "numpy", 8) for name in ("D2", "D2 noisy")),
        Target("chain", f"realizations a second, {usual[0]}: 1000 or more", usual[1], 1000),
        Target("chain", "memory of 4096 realizations over that of 256, MB: 10 or less", growth, 10, False),
        Target("delta method", "times one realization: 5 or less", covariance, 5, False),
        Target(
            "delta method",
            "deviations off 10 000 samples of Monte Carlo, worst, %: 10 or less",
            100 * delta["worst deviation"],
            10,
            False,
        ),
    ]


def target_table(era: dict, rates: dict) -> list[str]:
    head = ["| case | target | measured | met |", "|---|---|---|---|"]
    return head + [target.row for target in targets(era, rates)]


def era_table(era: dict) -> list[str]:
    rows = [
        "| case | tool | median, ms | lowest, ms | threads | pole error | off full SVD |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, tools in era["cases"].items():
        for tool, row in tools.items():
            off = "" if CASES[name].noise == 0 else f"{row['errors']['full']:.1e}"
            form = ".1e" if CASES[name].noise == 0 else ".2f"
            rows.append(
                f"| {name} | {tool} | {1e3 * row['median']:.3g} | {1e3 * row['lowest']:.3g} | {row['threads']} "
                f"| {row['errors']['truth']:{form}} | {off} |"
            )
    return rows


def memory_table(era: dict) -> list[str]:
    rows = ["| tool, case B | peak above baseline, MB |", "|---|---|"]
    return rows + [f"| {tool} | {number(peak)} |" for tool, peak in era["memory"].items()]


def number(x: float | None) -> str:
    return "not measured" if x is None else f"{x:.3g}"


def rates_table(rates: dict) -> list[str]:
    """One column for this machine and, where it was recorded, one for a GPU."""
    columns = [rates, *([json.loads(GPU.read_text())] if GPU.exists() else [])]
    titles = [f"{x['cores']} cores" if x["platform"] == "cpu" else x["device"] for x in columns]
    rows = ["| what | " + " | ".join(titles) + " |", "|---" * (1 + len(columns)) + "|"]
    lines = []
    for words, here in rates["rates"].items():
        found = [x["rates"][words] for x in columns]
        lines.append((f"realizations a second, {words}", found))
        if len(columns) > 1:
            lines.append((f"the same, over the first column: {words}", [x / here for x in found]))
    for count in rates["memory"]:
        peaks = [x["memory"][count] for x in columns]
        lines.append((f"memory of {count} realizations above that of the first chunks, MB", peaks))
    for words in rates["delta method"]:
        lines.append((f"delta method: {words}", [x["delta method"][words] for x in columns]))
    return rows + [f"| {words} | " + " | ".join(map(number, values)) + " |" for words, values in lines]


def case_table() -> list[str]:
    rows = ["| case | Hankel matrix | order | dt, ms | noise |", "|---|---|---|---|---|"]
    for name, case in CASES.items():
        noise = f"{100 * case.noise:g} %" if case.noise else ""
        rows.append(f"| {name} | {case.title} | {case.order} | {1e3 * case.dt:.3g} | {noise} |")
    return rows
