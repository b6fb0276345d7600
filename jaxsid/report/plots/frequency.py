"""Frequency responses: measured, of the state-space model and of the matrices."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxsid.identification import FrequencyFit, Identification
from jaxsid.mechanics.units import sensor_kinds, units_of
from jaxsid.report.envelope import envelope
from jaxsid.report.style import (
    BLUE,
    GREEN,
    GRID,
    INK,
    MUTED,
    ORANGE,
    frequency_scale,
    label,
    legend,
    log_scale,
    new_figure,
)


def frequency_figure(found: Identification, output: str, column: int = 0, record: int = 0) -> Figure:
    """Magnitude, phase and coherence from one input to one output; vertical lines at the modes."""
    fit = found.frequency_fit[record]
    row = found.outputs.index(output)
    inputs = found.records[record].inputs
    figure, axes = new_figure(
        f"{output} / {inputs[column]}", 4.8, rows=3, ratios=(2.2, 1.0, 0.85), between=0.2, sharex=True
    )
    size, phase, coherence = axes[:, 0]
    f = np.asarray(fit.frequencies)
    low, high = frequency_range(found, fit)
    inside = (f >= low) & (f <= high)
    for curve, look in _curves(fit, row, column):
        size.plot(*envelope(f[inside], np.abs(curve[inside]), 900), **look)
        _phase(phase, f[inside], curve[inside], look)
    _coherence(coherence, f[inside], np.asarray(fit.coherence)[inside, row])
    mark_modes(axes[:, 0], found, low, high)
    frequency_scale(size, low, high)
    log_scale(size, "y")
    _limit(size, fit, row, column, inside)
    kind = sensor_kinds(found.nominal, (output,))[0]
    label(size, y=units_of(found.nominal).label(f"{kind} per force"))
    label(phase, y="phase (°)")
    label(coherence, "frequency (Hz)", "coherence (-)")
    legend(size)
    return figure


def frequency_range(found: Identification, fit: FrequencyFit) -> tuple[float, float]:
    """From below the slowest mode to a little over the trusted band, or to four times the fastest mode."""
    f = np.asarray(fit.frequencies)
    positive = f[f > 0]
    frequencies = np.asarray(found.modal.frequencies)[np.imag(np.asarray(found.modal.poles)) > 0] / (
        2 * np.pi
    )
    fastest, slowest = (float(np.max(x, initial=0.0)) for x in (frequencies, frequencies[:1]))
    low = (
        slowest / 4
        if found.response.band is None
        else min(slowest / 4, float(np.asarray(found.response.band)[0]))
    )
    high = 4 * fastest if found.response.band is None else 1.1 * float(np.asarray(found.response.band)[1])
    high = min(max(high, 1.3 * fastest), positive[-1])
    return float(max(low, positive[0])), float(max(high, positive[min(10, len(positive) - 1)]))


def mark_modes(axes: np.ndarray, found: Identification, low: float, high: float) -> None:
    """Dotted lines at the modes, grey where the impulse response is not trusted."""
    frequencies = np.asarray(found.modal.frequencies)[np.imag(np.asarray(found.modal.poles)) > 0] / (
        2 * np.pi
    )
    for ax in axes:
        for frequency in frequencies[(frequencies >= low) & (frequencies <= high)]:
            ax.axvline(frequency, color=GREEN, linewidth=0.8, linestyle=(0, (1, 2)))
        if found.response.band is not None:
            first, last = np.asarray(found.response.band).tolist()
            for start, end in ((low, first), (last, high)):
                if end > start:
                    ax.axvspan(start, end, color=GRID, alpha=0.6, linewidth=0, zorder=0)


def _curves(fit: FrequencyFit, row: int, column: int) -> list:
    looks = [
        (fit.measured, {"color": MUTED, "linewidth": 1.5, "label": "measured"}),
        (fit.realization, {"color": BLUE, "linewidth": 1.1, "label": "state space"}),
        (fit.matrices, {"color": ORANGE, "linewidth": 1.1, "linestyle": (0, (4, 2)), "label": "matrices"}),
    ]
    return [(np.asarray(values)[:, row, column], look) for values, look in looks if values is not None]


def _limit(ax: Axes, fit: FrequencyFit, row: int, column: int, inside: np.ndarray) -> None:
    """Half a decade below the model and above all; measured noise further down is cut."""
    model = np.abs(np.asarray(fit.realization)[inside, row, column])
    measured = np.abs(np.asarray(fit.measured)[inside, row, column])
    low, high = model[model > 0].min(initial=np.inf), np.nanmax(np.append(measured, model), initial=0.0)
    if 0 < low < high:
        ax.set_ylim(low / 3, 3 * high)


def _phase(ax: Axes, f: np.ndarray, curve: np.ndarray, look: dict) -> None:
    """In degrees between -180 and 180, with gaps where it wraps."""
    step = max(1, len(f) // 600)
    angle = np.degrees(np.angle(curve[::step]))
    jumps = np.flatnonzero(np.abs(np.diff(angle)) > 180)
    ax.plot(np.insert(f[::step], jumps + 1, np.nan), np.insert(angle, jumps + 1, np.nan), **look)
    ax.set_ylim(-190, 190)
    ax.set_yticks([-180, 0, 180])


def _coherence(ax: Axes, f: np.ndarray, coherence: np.ndarray) -> None:
    ax.plot(*envelope(f, coherence, 600), color=INK, linewidth=0.8)
    ax.set_ylim(0, 1.05)
    ax.set_yticks([0, 0.5, 1])
