"""Choice of the order: singular values of the Hankel matrix and poles over growing orders."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxsid.identification import Identification
from jaxsid.report.envelope import envelope
from jaxsid.report.plots.frequency import frequency_range
from jaxsid.report.style import (
    BLUE,
    GREEN,
    GRID,
    MUTED,
    ORANGE,
    PINK,
    frequency_scale,
    label,
    legend,
    log_scale,
    new_figure,
)

MANY = 4000  # unstable poles beyond this are drawn as an image


def singular_value_figure(found: Identification) -> Figure:
    """Singular values of the Hankel matrix, relative to the largest; those of the model are filled."""
    values = np.asarray(found.stabilization.singular_values)
    if found.realization.singular_values is not None and not len(values):
        values = np.asarray(found.realization.singular_values)
    values = values[: max(4 * found.order, 30)]
    values = np.where(values > 0, values, np.nan) / (values[0] if len(values) else 1)
    count = np.arange(1, len(values) + 1)
    figure, axes = new_figure("Singular values", 3.0)
    ax, n = axes[0, 0], found.order
    ax.plot(count[n:], values[n:], "o", color=MUTED, markersize=3.5, fillstyle="none", label="left out")
    ax.plot(count[:n], values[:n], "o", color=BLUE, markersize=4, label=f"in the model, order {n}")
    ax.axvline(n + 0.5, color=ORANGE, linewidth=1, linestyle=(0, (4, 2)))
    log_scale(ax, "y")
    label(ax, "number", "relative to the largest (-)")
    legend(ax, 1, inside="upper right")
    return figure


def stabilization_figure(found: Identification) -> Figure:
    """Poles of models of growing order over frequency, behind them the sum of the measured responses."""
    figure, axes = new_figure("Stabilization diagram", 3.9, right=0.16, top=0.78)
    ax = axes[0, 0]
    low, high = _range(found)
    _measured_sum(ax, found, low, high)
    _poles(ax, found)
    ax.axhline(found.order, color=ORANGE, linewidth=1, linestyle=(0, (4, 2)))
    orders = np.asarray(found.stabilization.order)
    ax.set_ylim(0, 1.06 * max(orders.max(initial=0), found.order + 1))
    frequency_scale(ax, low, high)
    label(ax, "frequency (Hz)", "order of the model")
    legend(ax, 2)
    return figure


def _range(found: Identification) -> tuple[float, float]:
    if found.frequency_fit:
        return frequency_range(found, found.frequency_fit[0])
    fastest = float(np.max(np.asarray(found.modal.frequencies), initial=0.0)) / (2 * np.pi)
    return 0.0, 1.5 * fastest or 1.0


def _poles(ax: Axes, found: Identification) -> None:
    """Filled: stable in all; hollow: in frequency and damping; cross: in frequency; dot: new."""
    table = found.stabilization
    frequency, order = np.asarray(table.frequency) / (2 * np.pi), np.asarray(table.order)
    usable = np.asarray(table.damping_ratio) > -0.02
    steady = np.asarray(table.stable_frequency)
    damped = steady & np.asarray(table.stable_damping)
    every = np.asarray(table.stable)
    for chosen, look in (
        (~steady, {"marker": ".", "color": MUTED, "markersize": 2.5, "label": "new"}),
        (steady & ~damped, {"marker": "x", "color": PINK, "markersize": 3.2, "label": "frequency stable"}),
        (damped & ~every, {"marker": "o", "color": BLUE, "markersize": 3.6, "fillstyle": "none",
                           "markeredgewidth": 0.8, "label": "and damping"}),
        (every, {"marker": "o", "color": GREEN, "markersize": 3.6, "label": "and shape"}),
    ):  # fmt: skip
        pick = chosen & usable
        ax.plot(frequency[pick], order[pick], linestyle="none", rasterized=pick.sum() > MANY, **look)


def _measured_sum(ax: Axes, found: Identification, low: float, high: float) -> None:
    """Sum of the magnitudes of all measured frequency responses, logarithmic, without a scale of its own."""
    if not found.frequency_fit:
        return
    fit = found.frequency_fit[0]
    f = np.asarray(fit.frequencies)
    total = np.nansum(np.abs(np.asarray(fit.measured)), axis=(1, 2))
    inside = (f >= low) & (f <= high) & (total > 0)
    if not inside.any():
        return
    behind = ax.twinx()
    behind.set_zorder(ax.get_zorder() - 1)
    behind.set_axis_off()
    x, y = envelope(f[inside], np.log10(total[inside]), 600)
    behind.fill_between(x, y, np.nanmin(y), color=GRID, linewidth=0)
    behind.set_ylim(np.nanmin(y), np.nanmax(y) + 0.15 * np.ptp(y) + 1e-9)
    ax.patch.set_visible(False)
