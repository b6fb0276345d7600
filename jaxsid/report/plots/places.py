"""Figures of where: probabilities of places, and the force there against what moves and over time."""

from pathlib import PurePath

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from jaxsid.digits import DASH
from jaxsid.gap.diagnose import Diagnosis
from jaxsid.gap.force_map import ForceMap
from jaxsid.gap.locate import Locations
from jaxsid.gap.places import Place
from jaxsid.mechanics.units import Units, units_of
from jaxsid.report.envelope import envelope
from jaxsid.report.law import law_along
from jaxsid.report.plots.time import close_look
from jaxsid.report.style import (
    BLUE,
    FONT,
    INK,
    MUTED,
    ORANGE,
    label,
    legend,
    new_figure,
    scaled,
    shortened,
    title,
)

SHOWN = 10  # places
LINE = 0.2  # inches of height for one
DOTS = 900  # of a map
BINS = 24  # along which the mean is drawn
FEWEST = 8  # samples of one
CLOSE = 400  # samples of a close look
SCATTER = (
    0.2  # step from one sample to its neighbour, next to the deviation of all, from which on it is no curve
)


def place_figure(found: Locations) -> Figure:
    """Probability of each place; those that are not told apart from the first are filled."""
    ranked = found.ranked[:SHOWN]
    figure, axes = new_figure("Where it arises", 0.95 + LINE * len(ranked), left=1.7, right=0.5, bottom=0.42)
    ax = axes[0, 0]
    colours = [BLUE if x.place in found.likely else MUTED for x in ranked]
    ax.barh(np.arange(len(ranked)), [100 * x.probability for x in ranked], color=colours, height=0.62)
    for row, x in enumerate(ranked):
        look = {"va": "center", "fontsize": FONT - 0.5, "color": INK}
        ax.text(100 * x.probability + 1, row, _percent(x.probability), ha="left", **look)
        ax.text(-2, row, shortened(label_of(x.place), 26), ha="right", **look)
    ax.set_ylim(len(ranked) - 0.5, -0.5)
    ax.set_xlim(0, 100)
    ax.yaxis.set_major_locator(NullLocator())
    label(ax, "probability (%)")
    return figure


def label_of(place: Place) -> str:
    """A place as people name it.

    Args:
        place: one.
    """
    return place.label.replace(" - ", DASH)


def _percent(share: float) -> str:
    return f"{100 * share:.0f}" if share >= 0.01 else "< 1"


def map_figure(found: Diagnosis, force: ForceMap) -> Figure:
    """The force of a place against displacement and velocity there: samples, their mean, and the chosen law."""
    units = units_of(found.nominal)
    figure, axes = new_figure(
        f"Force at {shortened(label_of(force.place), 30)}",
        2.9,
        columns=2,
        beside=0.34,
        left=0.74,
        bottom=0.64,
        top=0.72,
    )
    law, fitted = _law(force), law_along(found, force)
    top = 1.1 * float(np.abs(law).max(initial=0.0)) or 1.0
    for ax, signal, of in zip(
        axes[0], (force.displacement, force.velocity), ("displacement", "velocity"), strict=True
    ):
        step = max(len(signal) // DOTS, 1)
        ax.plot(signal[::step], law[::step], ".", color=MUTED, markersize=1.6, alpha=0.6)
        _mean(ax, signal, law)
        if fitted is not None:
            _fitted(ax, signal, fitted)
        ax.set_ylim(-top, top)
        scaled(ax, "x", f"{units.name(of)}\n({units.symbol(of)})", float(np.abs(signal).max(initial=0.0)))
    scaled(axes[0, 0], "y", _force_label(units, force), top)
    axes[0, 1].tick_params(labelleft=False)
    legend(axes[0, 1], 2)
    return figure


def _law(force: ForceMap) -> np.ndarray:
    """As the laws of the catalogue count it: F acts as -F on the second end; signals as they are."""
    return -force.force if force.place.where == "between" else force.force


def _mean(ax: Axes, signal: np.ndarray, force: np.ndarray) -> None:
    ax.plot(*_binned(signal, force, BINS), color=BLUE, linewidth=1.6, label="mean")


def _binned(signal: np.ndarray, force: np.ndarray, bins: int) -> tuple[list[float], list[float]]:
    """Mean of the force in bins of equal width."""
    edges = np.linspace(signal.min(), signal.max(), bins + 1)
    at = np.clip(np.digitize(signal, edges) - 1, 0, bins - 1)
    kept = [i for i in range(bins) if (at == i).sum() >= FEWEST]
    return [float(signal[at == i].mean()) for i in kept], [float(force[at == i].mean()) for i in kept]


def _fitted(ax: Axes, signal: np.ndarray, law: np.ndarray) -> None:
    """The law as a curve where this signal alone settles it, else its mean, dashed, along the same motion."""
    order = np.argsort(signal)
    sorted_law = law[order]
    look = {"color": ORANGE, "linewidth": 1.6, "label": "law", "zorder": 4}
    if np.abs(np.diff(sorted_law)).mean() < SCATTER * law.std():
        ax.plot(*envelope(signal[order], sorted_law), **look)
    else:
        ax.plot(*_binned(signal, law, BINS), linestyle=(0, (4, 2)), **look)


def _force_label(units: Units, force: ForceMap) -> str:
    if force.place.where == "sensor":
        return "added to the reading\n(its unit)"
    return f"{units.name('force')}\n({units.symbol('force')})"


def force_figure(found: Diagnosis, force: ForceMap) -> Figure:
    """The force of a place over time: all of it, and a close look, with two standard deviations about it."""
    units, given = units_of(found.nominal), found.records[force.record]
    where = label_of(force.place)
    which = "" if len(found.records) == 1 else f", {shortened(PurePath(given.name).name, 16)}"
    figure, axes = new_figure(
        f"Force at {shortened(where + which, 34)}", 3.3, rows=2, between=0.42, left=0.74
    )
    law, fitted = _law(force), law_along(found, force)
    size = float(np.abs(law).max(initial=0.0))
    near = close_look(law, min(CLOSE, len(force.time)))
    for ax, part in ((axes[0, 0], slice(None)), (axes[1, 0], near)):
        ax.plot(*envelope(force.time[part], law[part]), color=BLUE, linewidth=0.9, label="force")
        if fitted is not None and ax is axes[1, 0]:
            ax.plot(force.time[part], fitted[part], color=ORANGE, linewidth=1.0, label="law")
        ax.set_xlim(force.time[part][0], force.time[part][-1])
        scaled(ax, "y", _force_label(units, force), size)
    low, high = (law[near] + sign * 2 * force.deviation for sign in (-1, 1))
    axes[1, 0].fill_between(force.time[near], low, high, color=BLUE, alpha=0.18, linewidth=0)
    axes[0, 0].axvspan(
        force.time[near][0], force.time[near][-1], color=ORANGE, alpha=0.3, linewidth=1, zorder=0
    )
    title(axes[1, 0], "shaded: two standard deviations")
    if fitted is not None:
        legend(axes[1, 0], 2)
    label(axes[1, 0], "time (s)")
    return figure
