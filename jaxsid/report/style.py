"""The look of the figures: one size that a phone can show, colours that everybody can tell apart."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MaxNLocator, NullLocator

from jaxsid.digits import minus, power_of_ten

# Okabe and Ito's colours; the page swaps each for a variable that follows light and dark.
INK, MUTED, GRID, PAPER = "#1d2733", "#66727f", "#dde2e7", "#fefefe"
BLUE, ORANGE, GREEN, PINK = "#0072b2", "#d55e00", "#009e73", "#cc79a7"
CSS_COLOURS = {
    INK: "--ink",
    MUTED: "--muted",
    GRID: "--grid",
    PAPER: "--paper",
    BLUE: "--blue",
    ORANGE: "--orange",
    GREEN: "--green",
    PINK: "--pink",
}
WIDTH = 4.4  # inches, narrow enough that its text is legible on a phone
FONT = 9.0  # points
MARKS = 5  # intervals of a linear axis, at most


def new_figure(
    title: str,
    height: float,
    *,
    rows: int = 1,
    columns: int = 1,
    ratios: Sequence[float] | None = None,
    left: float = 0.66,
    right: float = 0.14,
    top: float = 0.58,
    bottom: float = 0.46,
    between: float = 0.18,
    beside: float = 0.4,
    sharex: bool = False,
) -> tuple[Figure, np.ndarray]:
    """A figure with margins in inches and an array (rows, columns) of styled axes."""
    figure = Figure(figsize=(WIDTH, height), facecolor="white")
    inner = (height - top - bottom) / rows, (WIDTH - left - right) / columns
    axes = figure.subplots(
        rows,
        columns,
        squeeze=False,
        sharex=sharex,
        gridspec_kw={
            "height_ratios": ratios,
            "left": left / WIDTH,
            "right": 1 - right / WIDTH,
            "top": 1 - top / height,
            "bottom": bottom / height,
            "hspace": between / max(inner[0] - between, 0.1),
            "wspace": beside / max(inner[1] - beside, 0.1),
        },
    )
    for ax in axes.flat:
        style_axes(ax)
    look = {"fontsize": FONT + 1, "color": INK, "fontweight": "bold"}
    figure.text(0.08 / WIDTH, 1 - 0.08 / height, shortened(title), ha="left", va="top", **look)
    return figure, axes


def shortened(text: str, most: int = 44) -> str:
    """The text, without its middle where it is too long for a title."""
    return text if len(text) <= most else f"{text[: most // 2]}…{text[-(most // 2 - 1) :]}"


def style_axes(ax: Axes) -> None:
    ax.set_facecolor("none")
    for axis in (ax.xaxis, ax.yaxis):  # marks and their numbers take most of the time of a figure
        axis.set_major_locator(MaxNLocator(MARKS, steps=[1, 2, 2.5, 5, 10]))
    ax.tick_params(labelsize=FONT - 0.5, colors=MUTED, length=2.5, width=0.6)
    for side, spine in ax.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(MUTED)
        spine.set_linewidth(0.6)
    ax.grid(True, color=GRID, linewidth=0.6)
    ax.set_axisbelow(True)


def label(ax: Axes, x: str = "", y: str = "") -> None:
    if x:
        ax.set_xlabel(x, fontsize=FONT, color=INK, labelpad=2)
    if y:
        ax.set_ylabel(y, fontsize=FONT, color=INK, labelpad=3)


def title(ax: Axes, text: str) -> None:
    # at a given height, since to find one takes the extents of all labels
    ax.set_title(text, fontsize=FONT, color=INK, loc="left", y=1.0, pad=3)


def legend(ax: Axes, columns: int = 3, *, inside: str | None = None) -> None:
    """A legend over the axes, or in one of their corners."""
    place: dict[str, Any] = (
        {"loc": inside} if inside else {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0)}
    )
    ax.legend(
        ncols=columns,
        fontsize=FONT - 0.5,
        frameon=inside is not None,
        framealpha=0.85,
        facecolor=PAPER,
        edgecolor="none",
        labelcolor=INK,
        handlelength=1.4,
        columnspacing=1.0,
        borderaxespad=0.2,
        handletextpad=0.5,
        **place,
    )


def ten_to_the(value: float, _position: int = 0) -> str:
    exponent = np.log10(value)
    return power_of_ten(round(exponent)) if abs(exponent - round(exponent)) < 1e-6 else f"{value:g}"


def log_scale(ax: Axes, which: str) -> None:
    """A logarithmic axis, its decades as powers of ten in plain text."""
    getattr(ax, f"set_{which}scale")("log")
    axis = getattr(ax, f"{which}axis")
    axis.set_major_locator(LogLocator(numticks=6))
    axis.set_major_formatter(FuncFormatter(ten_to_the))
    axis.set_minor_locator(NullLocator())  # minor ticks take more time than the rest of a figure


def frequency_scale(ax: Axes, low: float, high: float) -> None:
    """Frequencies over more than a decade and a half are logarithmic, with plain numbers."""
    if low <= 0 or high / low < 30:
        ax.set_xlim(low, high)
        return
    ax.set_xscale("log")
    ax.set_xlim(low, high)
    marks = [m * 10.0**e for e in range(-6, 8) for m in (1, 2, 5) if low <= m * 10.0**e <= high]
    if len(marks) > 7:
        marks = marks[next(i for i, m in enumerate(marks) if f"{m:e}"[0] == "1") :: 3]
    ax.xaxis.set_major_locator(FixedLocator(marks))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    ax.xaxis.set_minor_locator(NullLocator())


def scaled(ax: Axes, which: str, text: str, size: float) -> None:
    """Label an axis; values far from 1 are shown in a power of ten that the label names, before the unit."""
    exponent = 3 * int(np.floor(np.log10(size) / 3)) if size > 0 and np.isfinite(size) else 0
    # beside a vertical axis there is room for three digits and a sign
    exponent = 0 if 0.05 <= size < (10_000 if which == "x" else 1_000) else exponent
    axis = getattr(ax, f"{which}axis")
    axis.set_major_formatter(FuncFormatter(lambda v, _: minus(f"{v / 10.0**exponent:.6g}")))
    if exponent:
        text = text.replace("(", f"({power_of_ten(exponent)} ", 1)
    label(ax, **{which: text})
