"""Figures of before and after: held-out samples beside the nominal and the chosen model, in time and frequency."""

from collections.abc import Sequence
from pathlib import PurePath
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxsid.gap.diagnose import Diagnosis
from jaxsid.gap.noise import Noise
from jaxsid.mechanics.units import units_of
from jaxsid.report.envelope import envelope
from jaxsid.report.plots.time import close_look
from jaxsid.report.style import (
    BLUE,
    INK,
    MUTED,
    ORANGE,
    frequency_scale,
    label,
    legend,
    log_scale,
    new_figure,
    scaled,
    title,
)

CLOSE, PART = 300, 4  # samples of a close look: so many, or a part of all
LEAST = 60  # and no fewer
SEGMENTS = 8  # that a spectrum is averaged over, half of each shared with the next
SHORTEST = 64  # samples of one
DEEPEST = 1e-6  # of the largest value, that is still shown
POINTS = 600  # of a curve


class HeldOut(NamedTuple):
    """One sensor in the held-out end of one record.

    Attributes:
        time: (samples,) s, from the record's start.
        measured, nominal, chosen: (samples,) readings and responses.
        noise: of the record; row of the sensor.
        row: number of the sensor.
        dt: sampling interval, s.
    """

    time: np.ndarray
    measured: np.ndarray
    nominal: np.ndarray
    chosen: np.ndarray
    noise: Noise
    row: int
    dt: float


def held_out(found: Diagnosis, sensor: str, record: int) -> HeldOut:
    """What the figures show.

    Args:
        found: a diagnosis with causes.
        sensor: name.
        record: number.
    """
    assert found.causes is not None
    causes, given = found.causes, found.records[record]
    row = [s.name for s in found.nominal.sensors].index(sensor)
    measured = causes.lefts[-1].measured[record][:, row]
    nominal, chosen = (measured + x.left[record][:, row] for x in (causes.before[0], causes.lefts[-1]))
    time = (len(given.y) - len(measured) + np.arange(len(measured))) * float(given.dt)
    return HeldOut(time, measured, nominal, chosen, causes.noises[record], row, float(given.dt))


def chosen_name(found: Diagnosis) -> str:
    """What the chosen model is, in a few words.

    Args:
        found: a diagnosis with causes.
    """
    if found.causes is None or not found.causes.selected:
        return "numbers put right"
    if found.verdict == "unknown":
        return "with what is known"
    return "with the effect" if len(found.causes.selected) == 1 else "with the effects"


def held_out_pairs(found: Diagnosis, most: int) -> Sequence[tuple[str, int]]:
    """Sensor and record of the largest gaps of the nominal model, relative to the signal, on held-out samples.

    Args:
        found: a diagnosis with causes.
        most: how many at most.
    """
    assert found.causes is not None
    names = [s.name for s in found.nominal.sensors]
    sizes = {}
    for record, (y, left) in enumerate(
        zip(found.causes.lefts[-1].measured, found.causes.before[0].left, strict=True)
    ):
        for j, name in enumerate(names):
            seen = np.isfinite(y[:, j]) & np.isfinite(left[:, j])
            if seen.all() and y[:, j].std() > 0:
                sizes[name, record] = float(left[:, j].std() / y[:, j].std())
    best = sorted(sizes, key=lambda key: -sizes[key])[:most]
    return sorted(best, key=lambda key: (key[1], names.index(key[0])))


def before_after_figure(found: Diagnosis, sensor: str, record: int) -> Figure:
    """One sensor in held-out samples: all of them, a close look where the nominal model misses most, what is left.

    Args:
        found: a diagnosis with causes.
        sensor: name.
        record: number.
    """
    x = held_out(found, sensor, record)
    figure, axes = new_figure(
        _name(found, sensor, record), 4.4, rows=3, ratios=(1.0, 1.25, 0.8), between=0.36, left=0.74
    )
    text = _label(found, x.row)
    near = close_look(
        x.measured - x.nominal, int(np.clip(len(x.time) // PART, min(LEAST, len(x.time)), CLOSE))
    )
    limit = 1.6 * float(np.abs(x.measured).max())
    for ax, part, width in ((axes[0, 0], slice(None), 0.8), (axes[1, 0], near, 1.2)):
        curves = (
            (x.measured, MUTED, 1.9, "measured"),
            (x.nominal, ORANGE, 0.9, "nominal"),
            (x.chosen, BLUE, 0.9, chosen_name(found)),
        )
        for curve, colour, line, said in curves:
            look = {"color": colour, "linewidth": line * width, "label": said}
            ax.plot(*envelope(x.time[part], np.clip(curve[part], -2 * limit, 2 * limit)), **look)
        ax.set_xlim(x.time[part][0], x.time[part][-1])
        _bounded(ax, x.nominal[part], limit)
        scaled(ax, "y", text, limit)
    legend(axes[0, 0], 3)
    axes[0, 0].axvspan(x.time[near][0], x.time[near][-1], color=ORANGE, alpha=0.25, linewidth=1, zorder=0)
    for curve, colour in ((x.nominal, ORANGE), (x.chosen, BLUE)):
        left = np.clip(x.measured - curve, -2 * limit, 2 * limit)
        axes[2, 0].plot(*envelope(x.time, left), color=colour, linewidth=0.6)
    axes[2, 0].set_xlim(x.time[0], x.time[-1])
    most = float(np.abs(x.measured - x.nominal).max())
    _bounded(axes[2, 0], x.measured - x.nominal, limit)
    scaled(axes[2, 0], "y", "left\n" + text[text.index("(") :], min(most, limit))
    label(axes[2, 0], "time (s)")
    return figure


def spectra_figure(found: Diagnosis, sensor: str, record: int) -> Figure:
    """Spectra of one sensor in held-out samples and of both models; below, of what is left, with the noise floor.

    Args:
        found: a diagnosis with causes.
        sensor: name.
        record: number.
    """
    x = held_out(found, sensor, record)
    figure, axes = new_figure(
        f"{_name(found, sensor, record)}: spectra",
        4.2,
        rows=2,
        between=0.4,
        left=0.74,
        top=0.74,
    )
    f, measured = density(x.measured, x.dt)
    models = ((x.nominal, ORANGE, "nominal"), (x.chosen, BLUE, chosen_name(found)))
    upper = [(density(y, x.dt)[1], colour, 1.0, said) for y, colour, said in models]
    lower = [(density(x.measured - y, x.dt)[1], colour, 1.0, said) for y, colour, said in models]
    noise = x.noise.deviation(2 * np.pi * f, x.dt)[:, x.row] * np.sqrt(2 * x.dt)
    unit = _label(found, x.row)
    unit = unit[unit.index("(") + 1 : -1]
    rows = (((measured, MUTED, 1.9, "measured"), *upper), "amplitude"), (tuple(lower), "left")
    for ax, (curves, said) in zip(axes[:, 0], rows, strict=True):
        for curve, colour, width, name in curves:
            ax.plot(*envelope(f, curve, POINTS), color=colour, linewidth=width, label=name)
        ax.plot(f, noise, color=INK, linewidth=1.0, linestyle=(0, (4, 2)))
        frequency_scale(ax, float(f[0]), float(f[-1]))
        label(ax, y=f"{said}\n({unit} per √Hz)")
        _decades(ax, np.concatenate([measured if said == "amplitude" else lower[0][0], lower[1][0], noise]))
    legend(axes[0, 0], 3)
    title(axes[1, 0], "dashed: noise alone")
    label(axes[1, 0], "frequency (Hz)")
    return figure


def _decades(ax: Axes, values: np.ndarray) -> None:
    """A logarithmic axis about these values; what lies far below them is cut."""
    log_scale(ax, "y")
    values = values[np.isfinite(values) & (values > 0)]
    if len(values):
        high = float(values.max())
        ax.set_ylim(max(float(values.min()), high * DEEPEST) / 2, 2 * high)


def density(y: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies (Hz) and the root of the one-sided power spectral density, by Welch's averages; no line at 0.

    Args:
        y: (samples,) signal; its mean is taken out.
        dt: sampling interval, s.
    """
    length = int(min(len(y), max(SHORTEST, 2 * len(y) // (SEGMENTS + 1))))
    starts = range(0, len(y) - length + 1, max(length // 2, 1))
    window = np.hanning(length + 1)[:-1]
    parts = np.stack([y[i : i + length] for i in starts]) - y.mean()
    power = (np.abs(np.fft.rfft(parts * window, axis=1)) ** 2).mean(axis=0)
    return np.fft.rfftfreq(length, dt)[1:], np.sqrt(2 * dt * power / (window**2).sum())[1:]


def _bounded(ax: Axes, values: np.ndarray, limit: float) -> None:
    """A model that moves by itself is cut where it leaves the picture."""
    if np.abs(values).max(initial=0.0) > 2 * limit:
        ax.set_ylim(-limit, limit)


def _name(found: Diagnosis, sensor: str, record: int) -> str:
    given = found.records[record]
    return sensor if len(found.records) == 1 else f"{sensor} in {PurePath(given.name).name}"


def _label(found: Diagnosis, row: int) -> str:
    return units_of(found.nominal).label(found.nominal.sensors[row].kind).replace(" (", "\n(")
