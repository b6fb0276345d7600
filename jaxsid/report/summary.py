"""A summary of an identification for the terminal."""

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.panel import Panel
from rich.table import Table

from jaxsid.digits import MISSING, change, misfit, percent, significant, with_std
from jaxsid.identification import Identification
from jaxsid.mechanics.lumped import second_order
from jaxsid.mechanics.units import units_of
from jaxsid.report.modes import compared, modes_of, worst_fits
from jaxsid.report.results import MATRICES

SHOWN = 6  # larger matrices are left to the files


def print_summary(found: Identification, console: Console | None = None) -> None:
    """Modes, matrices, fit and warnings as rich tables, on standard output unless a console is given."""
    console = Console() if console is None else console
    console.print(
        f"\n[bold]{escape(found.nominal.name)}[/]: order {found.order}. {escape(found.order_reason)}"
    )
    console.print(_modes(found))
    for made in _matrices(found):
        console.print(made)
    console.print(_fit(found))
    if found.warnings:
        text = "\n".join(f"• {escape(warning)}" for warning in found.warnings)
        console.print(Panel(text, title="Warnings", border_style="yellow", title_align="left"))


def table(title: str, *header: str) -> Table:
    """An empty table, numbers to the right.

    Args:
        title: over it.
        header: of the columns.
    """
    made = Table(title=title, title_justify="left", title_style="bold", header_style="dim")
    for column, name in enumerate(header):
        made.add_column(name, justify="right" if column else "left", overflow="fold")
    return made


def _modes(found: Identification) -> Table:
    made = table("Modes", "", "Hz", "change", "damping ratio (%)", "MAC", "EMAC", "MPC", "MSV")
    for number, mode in enumerate(modes_of(found), 1):
        made.add_row(
            f"{number}{' real' if mode.real else ''}",
            with_std(mode.frequency, mode.frequency_std),
            change(mode.frequency, mode.nominal_frequency),
            MISSING if mode.real else with_std(100 * mode.damping_ratio, 100 * mode.damping_ratio_std),
            *(significant(mode.indicators[name], 3) for name in ("mac", "emac", "mpc", "msv")),
        )
    return made


def _matrices(found: Identification) -> list[Table]:
    if found.matrices is None or len(found.matrices.mass) > SHOWN:
        return []
    nominal, units, tables = second_order(found.nominal), units_of(found.nominal), []
    for which in MATRICES:
        values, old = (np.asarray(getattr(x, which)) for x in (found.matrices, nominal))
        std = None if found.matrices_std is None else np.asarray(getattr(found.matrices_std, which))
        made = table(f"{units.name(which).capitalize()} ({units.symbol(which)})", "", *found.nominal.bodies)
        for i, body in enumerate(found.nominal.bodies):
            made.add_row(body, *(_entry(values[i, j], None if std is None else std[i, j], old[i, j])
                                  for j in range(len(values))))  # fmt: skip
        tables.append(made)
    return tables


def _entry(value: float, std: float | None, nominal: float) -> str:
    text = with_std(float(value), std)
    return f"{text}\n[dim]{change(value, nominal)}[/]" if nominal else text


def _fit(found: Identification) -> Table:
    models = compared(found)
    made = table(
        "Fit (NRMSE)", "sensor", *(name.lower().replace("cbsi", "CBSI") for name, _ in models), "noise floor"
    )
    for i in worst_fits(found):
        floor = percent(float(found.noise_floor[i]))
        made.add_row(escape(found.outputs[i]), *(misfit(float(values[i])) for _, values in models), floor)
    return made
