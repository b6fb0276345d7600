"""Figures of a study: spread against what was varied, and where the estimates lie."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedFormatter, FixedLocator, FuncFormatter

from jaxsid.digits import minus
from jaxsid.report.study_layout import Panel, is_number, kinds, level_text, levels, pooled, relative
from jaxsid.report.style import (
    BLUE,
    FONT,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    PINK,
    label,
    log_scale,
    new_figure,
    title,
)
from jaxsid.study.compare import MANY, Level
from jaxsid.study.summary import Row

LOOKS = ((BLUE, "o"), (ORANGE, "s"), (GREEN, "^"), (PINK, "D"), (INK, "v"), (MUTED, "P"))
MOST_KINDS = 5
MOST_QUANTITIES = 8  # of a kind, in one figure
BAR = 0.13  # inches from bar to bar


def spread_figure(panel: Panel, across: str, apart: str | None) -> Figure:
    """Standard deviation over truth of each kind of quantity, and the Cramer-Rao bound.

    Args:
        panel: rows to show.
        across: factor along the axis.
        apart: factor with a line for each level.
    """
    shown = kinds(panel.rows)[:MOST_KINDS]
    height = 1.3 + 1.25 * len(shown)
    figure, axes = new_figure(
        panel.title,
        height,
        rows=len(shown),
        top=0.72 + 0.17 * (len(levels(panel.rows, apart)) > 2),
        between=0.32,
        sharex=True,
    )
    for ax, kind in zip(axes[:, 0], shown, strict=True):
        _spread(ax, [row for row in panel.rows if row.kind == kind], across, apart)
        title(ax, kind.replace("_", " "))
    label(axes[-1, 0], across)
    label(axes[len(shown) // 2, 0], y="standard deviation over truth")
    _legend_on_top(figure, axes[0, 0], height)
    return figure


def _spread(ax: Axes, rows: Sequence[Row], across: str, apart: str | None) -> None:
    places = levels(rows, across)
    x = _axis(ax, places)
    line = 1.2 if len(places) <= MANY else 0  # cases drawn at random lie on no line
    at = [[row for row in rows if row.factors[across] == place] for place in places]
    for (colour, marker), level in zip(LOOKS, levels(rows, apart) or [None], strict=False):
        y = [pooled([r for r in some if apart is None or r.factors[apart] == level], "std") for some in at]
        name = "estimated" if level is None else level_text(level)
        ax.plot(x, y, color=colour, marker=marker, markersize=4, linewidth=line, label=name)
    bound = [pooled(some, "cramer_rao") for some in at]
    if np.isfinite(bound).any():
        look: dict[str, Any] = {"linestyle": (0, (4, 2))} if line else {"linestyle": "none", "marker": "_"}
        ax.plot(x, bound, color=INK, linewidth=1.2, label="Cramér-Rao", **look)
    log_scale(ax, "y")


def _axis(ax: Axes, places: Sequence[Level]) -> list[float]:
    """Where the levels stand: numbers to scale, logarithmic over a wide range; others in a row."""
    numbers = [float(x) for x in places if is_number(x)]
    x = numbers if len(numbers) == len(places) else [float(i) for i in range(len(places))]
    if numbers and min(numbers) > 0 and max(numbers) / min(numbers) >= 3:
        log_scale(ax, "x")
    else:
        ax.set_xlim(min(x) - 0.15 * (np.ptp(x) or 1), max(x) + 0.15 * (np.ptp(x) or 1))
    if len(places) <= MANY:
        ax.xaxis.set_major_locator(FixedLocator(x))
        ax.xaxis.set_major_formatter(FixedFormatter([level_text(place) for place in places]))
    return x


def _legend_on_top(figure: Figure, ax: Axes, height: float) -> None:
    """A legend below the title of the figure, over the width of all axes."""
    look: dict[str, Any] = {"frameon": False, "fontsize": FONT - 0.5, "labelcolor": INK, "handlelength": 1.8}
    handles, names = ax.get_legend_handles_labels()
    columns = 2 if max(map(len, names)) > 14 else 3
    figure.legend(
        handles, names, loc="upper left", bbox_to_anchor=(0.01, 1 - 0.24 / height), ncols=columns, **look
    )


def quantile_figure(panel: Panel, apart: str | None) -> Figure:
    """Where the estimates lie around the truth: median, middle half, and 95 % of them.

    Args:
        panel: rows to show.
        apart: factor with a bar for each level.
    """
    shown = [kind for kind in kinds(panel.rows) if any(_drawn(panel.rows, kind))][:MOST_KINDS]
    groups = levels(panel.rows, apart)[: len(LOOKS)] or [None]
    bars = [len(_drawn(panel.rows, kind)) * (len(groups) + 0.8) for kind in shown]
    height = 1.3 + 0.5 * (len(shown) - 1) + BAR * sum(bars)
    figure, axes = new_figure(
        panel.title, height, rows=len(shown), ratios=bars, top=0.84 if apart else 0.6, between=0.5, left=1.25
    )
    for ax, kind in zip(axes[:, 0], shown, strict=True):
        _bars(ax, panel.rows, _drawn(panel.rows, kind), apart, groups)
        title(ax, kind.replace("_", " "))
    label(axes[-1, 0], "error (% of the truth)")
    if apart:
        _legend_on_top(figure, axes[0, 0], height)
    return figure


def _drawn(rows: Sequence[Row], kind: str) -> list[str]:
    """Quantities of a kind that have bars: those with a truth to compare with."""
    names = dict.fromkeys(row.quantity for row in rows if row.kind == kind and row.count and row.truth)
    return list(names)[:MOST_QUANTITIES]


def _bars(
    ax: Axes, rows: Sequence[Row], names: Sequence[str], apart: str | None, groups: Sequence[Level | None]
) -> None:
    step = len(groups) + 0.8
    for j, ((colour, _), level) in enumerate(zip(LOOKS, groups, strict=False)):
        of_level = [r for r in rows if r.quantity in names and (apart is None or r.factors[apart] == level)]
        y = np.array([step * names.index(row.quantity) + j for row in of_level])
        low, first, middle, third, high = (
            np.array([100 * relative(row, q) for row in of_level])
            for q in ("q2_5", "q25", "q50", "q75", "q97_5")
        )
        ax.hlines(y, low, high, color=colour, linewidth=1)
        ax.hlines(
            y, first, third, color=colour, linewidth=5, label="" if level is None else level_text(level)
        )
        ax.plot(middle, y, "|", color=INK, markersize=7, markeredgewidth=1.4)
    ax.axvline(0, color=MUTED, linewidth=0.9)
    ax.yaxis.set_major_locator(FixedLocator([step * i + (len(groups) - 1) / 2 for i in range(len(names))]))
    ax.yaxis.set_major_formatter(FixedFormatter([name.replace("_", " ") for name in names]))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: minus(f"{x:g}")))
    ax.grid(False, axis="y")
    ax.set_ylim(step * len(names) - 1 + 0.1, -0.9)
