"""Figures of the gap: in noise units over frequency, time, amplitude and horizon, and in time beside the records."""

from collections.abc import Sequence
from pathlib import PurePath
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import StepPatch

from jaxsid.digits import DASH
from jaxsid.gap.diagnose import Diagnosis
from jaxsid.mechanics.units import units_of
from jaxsid.report.envelope import envelope
from jaxsid.report.plots.time import close_look
from jaxsid.report.style import (
    BLUE,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    PINK,
    frequency_scale,
    label,
    legend,
    log_scale,
    new_figure,
    scaled,
    shortened,
    title,
)

COLOURS = (BLUE, GREEN, PINK, INK)  # of as many sensors; more are left out
CLOSE = 300  # samples of a close look


def worst_sensors(found: Diagnosis, most: int = len(COLOURS)) -> tuple[str, ...]:
    """Names of the sensors with the largest gap in noise, in the model's order.

    Args:
        found: a diagnosis.
        most: how many at most.
    """
    units = {name: x for name, x in found.examination.before.noise_units.items() if np.isfinite(x)}
    kept = sorted(units, key=lambda name: -units[name])[:most]
    return tuple(name for name in units if name in kept)


def band_figure(found: Diagnosis) -> Figure:
    """Gap of each sensor in third octaves, nominal and refitted."""
    figure, axes = new_figure("Gap over frequency", 3.9, rows=2, between=0.5, top=0.74)
    tables = found.examination.before.by_frequency, found.examination.recalibrated.by_frequency
    for ax, rows, text in zip(axes[:, 0], tables, ("nominal model", "refitted"), strict=True):
        for name, colour in zip(worst_sensors(found), COLOURS, strict=False):
            own = [row for row in rows if row["sensor"] == name]
            centre = [float(np.sqrt(np.prod(row["band_hz"]))) for row in own]
            ax.plot(
                centre,
                [row["noise_units"] for row in own],
                color=colour,
                linewidth=1.2,
                label=shortened(name, 14),
            )
            marked = [
                (c, row["noise_units"]) for c, row in zip(centre, own, strict=True) if row["significant"]
            ]
            if marked:
                ax.plot(*zip(*marked, strict=True), "o", color=colour, markersize=3.2)
        _noise_axis(ax)
        bands = [row["band_hz"] for row in rows]
        frequency_scale(ax, min(low for low, _ in bands), max(high for _, high in bands))
        title(ax, text)
    label(axes[1, 0], "frequency (Hz)")
    legend(axes[0, 0], 4)
    return figure


def history_figure(found: Diagnosis) -> Figure:
    """Gap of each sensor over the time of the record where it is largest."""
    rows = found.examination.before.by_time
    record = max(rows, key=lambda row: row["noise_units"])["record"]
    given = found.records[record]
    which = "" if len(found.records) == 1 else f" of {shortened(PurePath(given.name).name, 20)}"
    figure, axes = new_figure(f"Gap over time{which}", 2.5, top=0.6)
    ax = axes[0, 0]
    for name, colour in zip(worst_sensors(found), COLOURS, strict=False):
        own = [row for row in rows if row["sensor"] == name and row["record"] == record]
        if own:
            edges = [own[0]["from_s"], *(row["to_s"] for row in own)]
            look = {"color": colour, "linewidth": 1.2, "baseline": None, "label": shortened(name, 14)}
            ax.stairs([row["noise_units"] for row in own], edges, **look)
    _noise_axis(ax)
    label(ax, "time (s)")
    legend(ax, 4)
    return figure


def amplitude_figure(found: Diagnosis) -> Figure:
    """Gap over the motion of the connection where it depends on that most, all sensors together."""
    rows = found.examination.before.by_amplitude
    places = {tuple(row["between"]) for row in rows}
    ends = max(sorted(places), key=lambda between: _contrast(rows, between))
    figure, axes = new_figure(
        f"Gap over the motion of {shortened(DASH.join(ends), 24)}", 2.7, columns=2, beside=0.5, bottom=0.64
    )
    units = units_of(found.nominal)
    for ax, of in zip(axes[0], ("displacement", "velocity"), strict=True):
        own = [row for row in rows if tuple(row["between"]) == ends and row["of"] == of]
        edges = np.array([own[0]["range"][0], *(row["range"][1] for row in own)])
        ax.stairs([row["noise_units"] for row in own], edges, color=BLUE, linewidth=1.3, baseline=None)
        _noise_axis(ax)
        scaled(ax, "x", f"{units.name(of)}\n({units.symbol(of)})", float(np.abs(edges).max()))
    axes[0, 1].set_ylabel("")
    return figure


def _contrast(rows: Sequence[dict[str, Any]], ends: tuple[str, ...]) -> float:
    return float(np.ptp([row["noise_units"] for row in rows if tuple(row["between"]) == ends]))


def horizon_figure(found: Diagnosis) -> Figure:
    """Gap over how far the models foretell, from the state that fits the window best."""
    figure, axes = new_figure("Gap over the horizon", 2.5, top=0.6)
    ax = axes[0, 0]
    tables = (found.examination.before, MUTED, "nominal"), (found.examination.recalibrated, BLUE, "refitted")
    for gap, colour, text in tables:
        rows = sorted(gap.by_horizon, key=lambda row: row["horizon_s"])
        at = [row["horizon_s"] for row in rows], [row["noise_units"] for row in rows]
        ax.plot(*at, "o-", color=colour, markersize=3.6, linewidth=1.2, label=text)
    _noise_axis(ax)
    log_scale(ax, "x")
    label(ax, "horizon (s)")
    legend(ax, 2)
    return figure


def beside_figure(found: Diagnosis, sensor: str, record: int) -> Figure:
    """One sensor in one record beside both models: all of it, a close look where the gap is largest, what is left."""
    column = [s.name for s in found.nominal.sensors].index(sensor)
    kind = found.nominal.sensors[column].kind
    beside, given = found.examination.beside[record], found.records[record]
    measured, nominal, refit = (x[:, column] for x in (beside.measured, beside.nominal, beside.refit))
    time = np.arange(len(measured)) * float(given.dt)
    name = sensor if len(found.records) == 1 else f"{sensor} in {PurePath(given.name).name}"
    figure, axes = new_figure(name, 4.4, rows=3, ratios=(1.0, 1.25, 0.8), between=0.36, left=0.74)
    text = units_of(found.nominal).label(kind).replace(" (", "\n(")
    near = close_look(measured - nominal, min(CLOSE, len(time)))
    size = float(np.abs(measured).max())
    for ax, part, width in ((axes[0, 0], slice(None), 0.8), (axes[1, 0], near, 1.2)):
        curves = (
            (measured, MUTED, 1.9, "measured"),
            (nominal, ORANGE, 0.9, "nominal"),
            (refit, BLUE, 0.9, "refitted"),
        )
        for curve, colour, line, said in curves:
            ax.plot(*envelope(time[part], curve[part]), color=colour, linewidth=line * width, label=said)
        ax.set_xlim(time[part][0], time[part][-1])
        scaled(ax, "y", text, size)
    legend(axes[0, 0], 3)
    for curve, colour in ((nominal, ORANGE), (refit, BLUE)):
        axes[2, 0].plot(*envelope(time, measured - curve), color=colour, linewidth=0.6)
    axes[2, 0].set_xlim(time[0], time[-1])
    left = float(np.abs(measured - nominal).max())
    scaled(axes[2, 0], "y", "left\n" + text[text.index("(") :], left)
    label(axes[2, 0], "time (s)")
    return figure


def pairs(found: Diagnosis, most: int) -> Sequence[tuple[str, int]]:
    """Sensor and record of the largest gaps relative to the signal.

    Args:
        found: a diagnosis.
        most: how many at most.
    """
    names = [s.name for s in found.nominal.sensors]
    sizes: dict[tuple[str, int], Any] = {}
    for record, beside in enumerate(found.examination.beside):
        for j, name in enumerate(names):
            y = beside.measured[:, j]
            if np.isfinite(y).all() and y.std() > 0:
                sizes[name, record] = float((y - beside.nominal[:, j]).std() / y.std())
    return sorted(
        sorted(sizes, key=lambda key: -sizes[key])[:most], key=lambda key: (key[1], names.index(key[0]))
    )


def _noise_axis(ax: Axes) -> None:
    values = np.concatenate([np.asarray(line.get_ydata(), float) for line in ax.lines] or [np.ones(1)])
    stairs = [np.asarray(p.get_data()[0], float) for p in ax.patches if isinstance(p, StepPatch)]
    values = np.concatenate([values, *stairs])
    top = float(np.nanmax(values, initial=1.0))
    if top > 20:
        ax.set_ylim(0.5, 2 * top)
        log_scale(ax, "y")
    else:
        ax.set_ylim(0, max(1.15 * top, 2.0))
    ax.axhline(1, color=ORANGE, linewidth=1.1, linestyle=(0, (4, 2)), zorder=5)
    label(ax, y="gap (noise = 1)")
