"""Mass, damping and stiffness as heat maps: nominal, identified, standard deviation."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from jaxsid.checks import require
from jaxsid.digits import significant
from jaxsid.identification import Identification
from jaxsid.mechanics.lumped import second_order
from jaxsid.mechanics.units import units_of
from jaxsid.report.style import BLUE, INK, ORANGE, label, new_figure, title

ANNOTATED = 6  # larger matrices are coloured only
SIGNED = LinearSegmentedColormap.from_list("signed", [ORANGE, "#f7f7f7", BLUE])


def matrix_figure(found: Identification, which: str) -> Figure:
    """One of "mass", "damping" and "stiffness": nominal, identified and its standard deviation."""
    require(
        found.matrices is not None, f"{found.nominal.name}: no matrices were identified, none can be shown."
    )
    nominal = np.asarray(getattr(second_order(found.nominal), which))
    panels = [("nominal", nominal), ("identified", np.asarray(getattr(found.matrices, which)))]
    if found.matrices_std is not None:
        panels.append(("standard deviation", np.asarray(getattr(found.matrices_std, which))))
    size = len(nominal)
    units = units_of(found.nominal)
    side = 0.9 + 0.3 * min(size, 10)
    figure, axes = new_figure(
        f"{units.name(which).capitalize()} ({units.symbol(which)})",
        0.75 + (side + 0.42) * len(panels), rows=len(panels), between=0.42, left=0.8, top=0.62, bottom=0.2,
    )  # fmt: skip
    for ax, (name, values) in zip(axes[:, 0], panels, strict=True):
        _heat(ax, values, found.nominal.bodies)
        title(ax, name)
        label(ax, y="body")
    return figure


def _heat(ax: Axes, values: np.ndarray, bodies: tuple[str, ...]) -> None:
    top = float(np.nanmax(np.abs(values), initial=0.0)) or 1.0
    ax.imshow(values, cmap=SIGNED, vmin=-top, vmax=top, aspect="auto", alpha=0.75)
    ax.grid(False)
    place = np.arange(len(values))
    if len(values) <= 12:
        ax.set_xticks(place, bodies)
        ax.set_yticks(place, bodies)
    if len(values) <= ANNOTATED:
        for i, j in np.ndindex(values.shape):
            ax.text(j, i, significant(float(values[i, j])), ha="center", va="center", fontsize=7.5, color=INK)
