"""Correlation of what a model leaves of its sensors, with itself and with the inputs."""

from collections.abc import Sequence
from pathlib import PurePath

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxsid.identification import Identification
from jaxsid.report.style import BLUE, GREEN, INK, ORANGE, PINK, label, legend, new_figure, shortened

COLOURS = (BLUE, GREEN, PINK, INK)  # of as many sensors; more are left out
ROOM = 1.15  # of an axis next to what it shows


def residual_figure(found: Identification, outputs: Sequence[str], record: int = 0) -> Figure:
    """Autocorrelation of what is left of sensors, and its correlation with the input that each follows most.

    Args:
        found: with residuals.
        outputs: sensors of that record, as many as there are colours.
        record: its number.
    """
    left, given = found.residuals[record], found.records[record]
    name = "" if len(found.records) == 1 else f" of {PurePath(given.name).name}"
    figure, axes = new_figure(
        f"Correlation of what is left{name}", 4.2, rows=2, between=0.74, left=0.74, top=0.78
    )
    own, crossed = axes[:, 0]
    for output, colour in zip(outputs, COLOURS, strict=False):
        column = found.outputs.index(output)
        look = {"color": colour, "linewidth": 0.8}
        curve = np.asarray(left.autocorrelation)[1:, column]
        own.plot(np.asarray(left.lags)[1:], curve, label=shortened(output, 14), **look)
        share = np.asarray(left.cross_correlation)[:, column] / np.asarray(left.cross_limit)[column]
        most = int(np.abs(share).max(axis=0).argmax())
        pair = f"{output}, {given.inputs[most]}"
        crossed.plot(np.asarray(left.cross_lags), share[:, most], label=shortened(pair, 20), **look)
    _frame(own, left.white_limit)
    _frame(crossed, 1.0)
    label(own, "lag (s)", "with itself (-)")
    label(crossed, "sensor later than input by (s)", "with an input,\nover its limit (-)")
    legend(own, 4)
    legend(crossed, 2)
    return figure


def _frame(ax: Axes, limit: float) -> None:
    """Limits of chance, dashed, and few marks: these take most of the time of a figure."""
    curves = [(np.asarray(line.get_xdata()), np.asarray(line.get_ydata())) for line in ax.lines]
    top = max([limit, *(float(np.abs(y).max(initial=0.0)) for _, y in curves)])
    ax.set_xlim(min(x[0] for x, _ in curves), max(x[-1] for x, _ in curves))
    ax.set_ylim(-ROOM * top, ROOM * top)
    for sign in (-1, 1):
        ax.axhline(sign * limit, color=ORANGE, linewidth=1.1, linestyle=(0, (4, 2)), zorder=5)
    ax.xaxis.set_major_locator(MaxNLocator(4))
    ax.yaxis.set_major_locator(MaxNLocator(4))
