"""Poles in the complex plane: identified and nominal."""

import numpy as np
from matplotlib.figure import Figure

from jaxsid.identification import Identification
from jaxsid.report.modes import modes_of, nominal_poles, poles_of
from jaxsid.report.style import BLUE, INK, MUTED, ORANGE, legend, new_figure, scaled


def pole_figure(found: Identification) -> Figure:
    """Upper half of the complex plane; bars are two standard deviations."""
    figure, axes = new_figure("Poles", 3.2, top=0.62)
    ax = axes[0, 0]
    nominal = nominal_poles(found.nominal)
    ax.plot(
        np.real(nominal), np.imag(nominal), "s", color=MUTED, fillstyle="none", markersize=6, label="nominal"
    )
    identified = np.array([mode.pole for mode in modes_of(found)])
    xerr, yerr = (2 * std for std in _deviations(found))
    look = {"color": BLUE, "markersize": 4.5, "elinewidth": 1, "capsize": 2, "label": "identified"}
    ax.errorbar(np.real(identified), np.imag(identified), xerr=xerr, yerr=yerr, fmt="o", **look)
    if found.matrices is not None:
        poles = poles_of(found.matrices)
        look = {"color": ORANGE, "markersize": 6, "markeredgewidth": 1.2, "label": "matrices"}
        ax.plot(np.real(poles), np.imag(poles), "x", **look)
    ax.axvline(0, color=INK, linewidth=0.7)
    every = np.concatenate([nominal, identified])
    for axis, text, part in (("x", "real part (1/s)", np.real), ("y", "imaginary part (rad/s)", np.imag)):
        scaled(ax, axis, text, float(np.abs(part(every)).max(initial=0.0)))
    ax.margins(0.1)
    legend(ax)
    return figure


def _deviations(found: Identification) -> tuple[np.ndarray, np.ndarray]:
    """Of real and imaginary parts, from those of frequency and damping ratio; 0 where unknown.

    p = w (-z + i sqrt(1 - z^2)), the two errors taken as independent.
    """
    modes = modes_of(found)
    w = np.array([2 * np.pi * mode.frequency for mode in modes])
    dw = np.array([2 * np.pi * mode.frequency_std for mode in modes])
    z = np.array([np.clip(mode.damping_ratio, -1, 1) for mode in modes])
    dz = np.array([mode.damping_ratio_std for mode in modes])
    root = np.sqrt(np.maximum(1 - z**2, 1e-12))
    real = np.hypot(z * dw, w * dz)
    imaginary = np.where(np.abs(z) < 1, np.hypot(root * dw, w * z * dz / root), 0.0)
    return np.nan_to_num(real), np.nan_to_num(imaginary)
