"""The confusion matrix and the calibration plot of a scored set.

.venv/bin/python benchmarks/blind/figures.py OUT FOLDER
"""

import json
import sys
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt
import numpy as np

INK, PAPER = "#1f4e79", "#c8d6e5"


def confusion(table: dict[str, dict[str, int]], path: Path) -> None:
    """Rows are what is true, columns what was said, shares of a row.

    Args:
        table: counts.
        path: of the picture.
    """
    said = sorted({x.removesuffix(", elsewhere") for row in table.values() for x in row} | set(table))
    last = [x for x in ("none", "unknown", "failure", "elsewhere") if x in said or x == "elsewhere"]
    columns = [x for x in said if x not in last and any(x in row for row in table.values())] + last
    rows = [x for x in columns if x in table] + sorted(set(table) - set(columns))
    shares = np.zeros((len(rows), len(columns)))
    for i, true in enumerate(rows):
        for name, count in table[true].items():
            column = "elsewhere" if name.endswith(", elsewhere") else name
            shares[i, columns.index(column)] += count / sum(table[true].values())
    figure, axes = plt.subplots(
        figsize=(0.28 * len(columns) + 3, 0.28 * len(rows) + 2.2), layout="constrained"
    )
    axes.imshow(shares, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    for i, j in np.argwhere(shares > 0):
        axes.text(j, i, f"{100 * shares[i, j]:.0f}", ha="center", va="center", fontsize=6,
                  color="white" if shares[i, j] > 0.6 else "black")  # fmt: skip
    axes.set_xticks(range(len(columns)), [x.replace("_", " ") for x in columns], rotation=90, fontsize=7)
    labels = [f"{x.replace('_', ' ')} ({sum(table[x].values())})" for x in rows]
    axes.set_yticks(range(len(rows)), labels, fontsize=7)
    axes.set_xlabel("called, % of row")
    axes.set_ylabel("true (cases)")
    figure.savefig(path)
    plt.close(figure)


def calibration(bins: list[dict[str, Any]], path: Path) -> None:
    """How often the first effect is right over how sure of it the diagnosis is.

    Args:
        bins: of the score.
        path: of the picture.
    """
    figure, axes = plt.subplots(figsize=(3.6, 3.4), layout="constrained")
    axes.plot([0, 1], [0, 1], color=PAPER, lw=1, zorder=0)
    if bins:
        x, y, n = (np.array([b[name] for b in bins]) for name in ("said", "right", "cases"))
        error = np.sqrt(np.maximum(y * (1 - y), 0.25 / n) / n)
        axes.errorbar(x, y, yerr=error, fmt="none", color=INK, lw=0.8)
        axes.scatter(x, y, s=10 + 3 * n, color=INK)
        for a, b, count in zip(x, y, n, strict=True):
            inward = {"xytext": (-3, -19), "ha": "right"} if a > 0.9 else {"xytext": (6, -9), "ha": "left"}
            axes.annotate(str(count), (a, b), textcoords="offset points", fontsize=7, **inward)
    axes.set(xlim=(0, 1.02), ylim=(0, 1.05), xlabel="probability said", ylabel="share that is right")
    figure.savefig(path)
    plt.close(figure)


def main() -> None:
    out, folder = Path(sys.argv[1]), Path(sys.argv[2])
    folder.mkdir(parents=True, exist_ok=True)
    found = json.loads((out / "score.json").read_text())
    confusion(found["confusion"], folder / "confusion.svg")
    calibration(found["calibration"]["bins"], folder / "calibration.svg")


if __name__ == "__main__":
    main()
