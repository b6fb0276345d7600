"""Estimated impulse response against that of the state-space model."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxsid.identification import Identification
from jaxsid.mechanics.units import sensor_kinds, units_of
from jaxsid.report.envelope import envelope
from jaxsid.report.style import BLUE, MUTED, label, legend, new_figure, scaled, title

ROWS = 4  # outputs a figure shows
DECAYED = 0.02  # of the largest value; what follows is not shown


def impulse_figure(found: Identification, column: int = 0) -> Figure:
    """Markov parameters from one input to the first outputs: estimated, where they are plain time samples,
    and of the state-space model."""
    inputs = found.records[0].inputs
    outputs = found.outputs[:ROWS]
    modelled = np.asarray(found.time_response)[:, : len(outputs), column]
    estimated = np.asarray(found.response.h)[:, : len(outputs), column] if plain_time(found) else None
    samples = shown(modelled)
    time = np.arange(samples) * float(found.response.dt)
    height = 1.15 + 1.15 * len(outputs)
    figure, axes = new_figure(
        f"Impulse at {inputs[column]}", height, rows=len(outputs), between=0.32, sharex=True, top=0.62
    )
    units, kinds = units_of(found.nominal), sensor_kinds(found.nominal, outputs)
    for row, (name, kind) in enumerate(zip(outputs, kinds, strict=True)):
        ax = axes[row, 0]
        if estimated is not None:
            _curve(ax, time, estimated[:samples, row], color=MUTED, linewidth=1.9, label="estimated")
        _curve(ax, time, modelled[:samples, row], color=BLUE, linewidth=0.9, label="state-space model")
        title(ax, name)
        scaled(
            ax,
            "y",
            f"({units.symbol(kind + ' per force')})",
            float(np.nanmax(np.abs(modelled[:samples, row]), initial=0.0)),
        )
    axes[0, 0].set_xlim(0, time[-1])
    label(axes[-1, 0], "time after the impulse (s)")
    legend(axes[0, 0], 2)
    return figure


def plain_time(found: Identification) -> bool:
    """Whether the estimate is of ordinary time samples, not in a Laguerre shift."""
    return float(found.response.pole) == 0


def shown(h: np.ndarray) -> int:
    """Samples until the response has decayed, two at least."""
    size = np.abs(np.where(np.isfinite(h), h, 0.0)).max(axis=1)
    loud = np.flatnonzero(size[1:] > DECAYED * size[1:].max(initial=0.0)) + 1
    return int(min(len(h), max(2, 1.1 * loud[-1] + 5))) if loud.size else len(h)


def _curve(ax: Axes, time: np.ndarray, values: np.ndarray, **look) -> None:
    ax.plot(*envelope(time[: len(values)], values), **look)
