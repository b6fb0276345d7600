"""Mode shapes: displacement of every sensor with its sign, and how complex the shape is."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxsid.digits import significant
from jaxsid.identification import Identification
from jaxsid.mechanics.units import sensor_kinds
from jaxsid.report.modes import Mode, displacement_shapes, modes_of
from jaxsid.report.style import BLUE, MUTED, ORANGE, label, new_figure, title

NAMED = 12  # sensors beyond this are numbered


def mode_shape_figure(found: Identification, first: int = 0, count: int = 4) -> Figure:
    """Some of the modes, a row each: real part over the sensors; components in the complex plane."""
    modes = modes_of(found)[first : first + count]
    shapes = displacement_shapes(found, sensor_kinds(found.nominal, found.outputs))
    figure, axes = new_figure(
        "Mode shapes", 0.95 + 1.42 * len(modes), rows=len(modes), columns=2, between=0.42, beside=0.5,
        left=0.55, top=0.5,
    )  # fmt: skip
    for row, mode in enumerate(modes):
        _bars(axes[row, 0], np.real(shapes[:, mode.index]), found.outputs)
        _plane(axes[row, 1], shapes[:, mode.index])
        title(axes[row, 0], _title(mode, first + row))
    label(axes[-1, 0], x="sensor")
    label(axes[-1, 1], x="real part (-)")
    return figure


def _title(mode: Mode, number: int) -> str:
    if mode.real:
        return f"{number + 1}: real, {significant(mode.pole.real, 3)} 1/s"
    return f"{number + 1}: {significant(mode.frequency)} Hz, {significant(100 * mode.damping_ratio, 3)} %"


def _bars(ax: Axes, values: np.ndarray, names: tuple[str, ...]) -> None:
    """A bar a sensor, joined by a line that shows the shape."""
    place = np.arange(1, len(values) + 1)
    if len(values) <= 40:
        ax.bar(place, values, width=0.5, color=BLUE, alpha=0.35)
    ax.plot(place, values, color=BLUE, linewidth=1.2, marker="o" if len(values) <= 40 else None, markersize=3)
    ax.axhline(0, color=MUTED, linewidth=0.7)
    ax.set_ylim(-1.15, 1.15)
    ax.set_yticks([-1, 0, 1])
    if len(values) <= NAMED:
        long = max(map(len, names)) * len(names) > 24
        ax.set_xticks(place, names, rotation=30 if long else 0, ha="right" if long else "center")
    label(ax, y="relative (-)")


def _plane(ax: Axes, shape: np.ndarray) -> None:
    """Arrows from 0; on one line for a real mode."""
    turn = np.linspace(0, 2 * np.pi, 73)
    ax.plot(np.cos(turn), np.sin(turn), color=MUTED, linewidth=0.6)
    for component in shape:
        ax.plot([0, component.real], [0, component.imag], color=ORANGE, linewidth=1)
    ax.plot(np.real(shape), np.imag(shape), "o", color=ORANGE, markersize=3)
    ax.set_xlim(-1.15, 1.15)
    ax.set_ylim(-1.15, 1.15)
    ax.set_aspect("equal")
    ax.set_xticks([-1, 0, 1])
    ax.set_yticks([-1, 0, 1])
    label(ax, y="imaginary (-)")
