"""Fitted values with error bars beside the nominal ones, and the correlation of their errors."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator

from jaxsid.digits import minus
from jaxsid.physical.elements import ElementValues
from jaxsid.report.plots.matrices import SIGNED
from jaxsid.report.style import BLUE, FONT, INK, MUTED, ORANGE, WIDTH, label, log_scale, new_figure, shortened

LINE = 0.19  # inches of height for a value
NAME = 20  # characters of a value's name
NAMES, RIGHT, TOP = 1.56, 0.14, 0.4  # inches for names, at the right, for a title
WRITTEN = 12  # values up to which correlations are written as numbers
STRONG = 0.5  # from which on


def parameter_figure(values: ElementValues, names: tuple[str, ...], kept: np.ndarray) -> Figure:
    """Change of each value from the nominal one with two standard deviations, and their relative size.

    Args:
        values: fitted.
        names: of all values.
        kept: numbers of those to show.
    """
    value, deviation, nominal = (
        np.asarray(x)[kept] for x in (values.values, values.deviation, values.nominal)
    )
    size = np.where(nominal == 0, np.nan, np.abs(nominal))
    known = np.where(np.isfinite(deviation), deviation, np.nan)
    figure, axes = new_figure(
        "Change from nominal, and how certain", 1.15 + LINE * len(kept), columns=2, left=NAMES, beside=0.18
    )
    moved, certain = axes[0]
    place = np.arange(len(kept))
    look = {"fmt": "o", "color": BLUE, "markersize": 3.2, "elinewidth": 1.2, "capsize": 0.0}
    moved.errorbar(100 * (value - nominal) / size, place, xerr=200 * known / size, **look)
    moved.axvline(0, color=ORANGE, linewidth=1, linestyle=(0, (4, 2)))
    moved.xaxis.set_major_locator(MaxNLocator(3))
    relative = 100 * known / np.where(value == 0, np.nan, np.abs(value))
    certain.plot(np.where(relative > 0, relative, np.nan), place, "o", color=MUTED, markersize=3.2)
    if (relative > 0).any():
        log_scale(certain, "x")
        _decades(certain, relative[relative > 0])
    for ax in axes[0]:
        ax.set_ylim(len(kept) - 0.5, -0.5)
        ax.yaxis.set_major_locator(NullLocator())
    _names(moved, [names[i] for i in kept])
    label(moved, "change (%)")
    label(certain, "std. dev. (%)")
    return figure


def _decades(ax: Axes, values: np.ndarray) -> None:
    """At least one decade, so that one mark is there."""
    ax.set_xlim(10 ** np.floor(np.log10(values.min()) - 0.05), 10 ** np.ceil(np.log10(values.max()) + 0.05))


def correlation_figure(values: ElementValues, names: tuple[str, ...], kept: np.ndarray) -> Figure:
    """Correlation of the errors of fitted values, from -1 (orange) to 1 (blue).

    Args:
        values: fitted.
        names: of all values.
        kept: numbers of those to show.
    """
    shown = np.asarray(values.correlation)[np.ix_(kept, kept)]
    side = max(WIDTH - NAMES - RIGHT, 0.75 * LINE * len(kept))
    figure, axes = new_figure(
        "Correlation of the errors", TOP + side + NAMES, left=NAMES, right=RIGHT, top=TOP, bottom=NAMES
    )
    ax = axes[0, 0]
    ax.imshow(shown, cmap=SIGNED, vmin=-1, vmax=1, aspect="auto", alpha=0.85)
    ax.grid(False)
    labels = [names[i] for i in kept]
    ax.xaxis.set_major_locator(NullLocator())
    ax.yaxis.set_major_locator(NullLocator())
    _names(ax, labels)
    _names(ax, labels, below=True)
    if len(kept) <= WRITTEN:
        for i, j in np.argwhere(np.tril(np.abs(np.nan_to_num(shown)) >= STRONG, -1)):
            ax.text(j, i, minus(f"{shown[i, j]:.2f}"), ha="center", va="center", fontsize=7, color=INK)
    return figure


def _names(ax: Axes, names: Sequence[str], *, below: bool = False) -> None:
    """Names left of the rows, or below the columns, as plain text: that takes a fraction of the time of ticks."""
    look = {"fontsize": FONT - 0.5, "color": MUTED}
    for place, name in enumerate(names):
        text = shortened(name, NAME)
        if below:
            at = {"transform": ax.get_xaxis_transform(), "ha": "center", "va": "top", "rotation": 90}
            ax.text(place, -0.02, text, **at, **look)
        else:
            at = {"transform": ax.get_yaxis_transform(), "ha": "right", "va": "center"}
            ax.text(-0.02, place, text, **at, **look)
