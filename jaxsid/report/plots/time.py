"""Measured and modelled response in time: all of it, a close look, and what is left."""

from pathlib import PurePath

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxsid.identification import Identification
from jaxsid.mechanics.units import sensor_kinds, units_of
from jaxsid.report.envelope import envelope
from jaxsid.report.style import BLUE, INK, MUTED, ORANGE, label, legend, new_figure, scaled


def time_figure(found: Identification, output: str, record: int = 0) -> Figure:
    """One sensor in one record: the whole response, a close look at its strongest part, and the residual."""
    given = found.records[record]
    column = found.outputs.index(output)
    measured = np.asarray(given.y)[:, given.outputs.index(output)]
    modelled = np.asarray(found.predictions[record])[:, column]
    time = np.arange(len(measured)) * float(given.dt)
    kind = sensor_kinds(found.nominal, (output,))[0]
    title = output if len(found.records) == 1 else f"{output} in {PurePath(given.name).name}"
    figure, axes = new_figure(title, 4.4, rows=3, ratios=(1.0, 1.25, 0.8), between=0.36, left=0.74)
    text = units_of(found.nominal).label(kind).replace(" (", "\n(")
    size = float(np.nanmax(np.abs(measured), initial=0.0))
    near = close_look(measured, _width(found, float(given.dt), len(time)))
    _curves(axes[0, 0], time, measured, modelled)
    _curves(axes[1, 0], time[near], measured[near], modelled[near], 1.2)
    axes[0, 0].axvspan(time[near][0], time[near][-1], color=ORANGE, alpha=0.6, linewidth=1, zorder=5)
    for ax in axes[:2, 0]:
        scaled(ax, "y", text, size)
    legend(axes[0, 0], 2)
    _residual(
        axes[2, 0],
        time,
        measured - modelled,
        float(np.asarray(found.noise_floor)[column] * np.nanstd(measured)),
    )
    scaled(
        axes[2, 0],
        "y",
        "residual\n" + text[text.index("(") :],
        float(np.nanmax(np.abs(measured - modelled), initial=0.0)),
    )
    label(axes[2, 0], "time (s)")
    return figure


def close_look(signal: np.ndarray, width: int) -> slice:
    """The stretch of `width` samples around the largest value."""
    centre = int(np.nanargmax(np.abs(np.where(np.isfinite(signal), signal, 0.0))))
    first = min(max(centre - width // 3, 0), max(len(signal) - width, 0))
    return slice(first, first + width)


def _width(found: Identification, dt: float, samples: int) -> int:
    """Some eight periods of the middle mode, between 60 and 600 samples."""
    frequencies = np.asarray(found.modal.frequencies)
    middle = float(np.median(frequencies)) if frequencies.size else 0.0
    periods = 8 * 2 * np.pi / middle / dt if middle > 0 else 200
    return int(min(samples, np.clip(periods, 60, 600)))


def _curves(
    ax: Axes, time: np.ndarray, measured: np.ndarray, modelled: np.ndarray, width: float = 0.8
) -> None:
    ax.plot(*envelope(time, measured), color=MUTED, linewidth=1.9 * width, label="measured")
    ax.plot(*envelope(time, modelled), color=BLUE, linewidth=0.9 * width, label="model")
    ax.set_xlim(time[0], time[-1])


def _residual(ax: Axes, time: np.ndarray, residual: np.ndarray, floor: float) -> None:
    ax.plot(*envelope(time, residual), color=INK, linewidth=0.6)
    ax.set_xlim(time[0], time[-1])
    if np.isfinite(floor) and floor > 0:
        for sign in (-2, 2):
            ax.axhline(sign * floor, color=ORANGE, linewidth=1.1, linestyle=(0, (4, 2)), zorder=5)
