"""Fitted values one by one: nominal, refined, how certain, and which errors go together."""

import numpy as np

from jaxsid.digits import MISSING, change, minus, significant
from jaxsid.identification import Identification
from jaxsid.mechanics.lumped import LumpedModel
from jaxsid.mechanics.units import Units, units_of
from jaxsid.physical.elements import ElementValues
from jaxsid.records import as_array
from jaxsid.report.frame import Block, Cell, Gallery, Section, Table, Text, picture
from jaxsid.report.plots import correlation_figure, parameter_figure
from jaxsid.report.plots.parameters import STRONG

MOST = 24  # values in a figure
NAMED = 3  # pairs
FAR = 3.0  # standard deviations from the nominal value that are more than chance


def parameters_section(found: Identification) -> Section:
    """Table of values with standard deviations, their picture, the correlation of their errors; empty without a fit."""
    values = found.elements or found.entries
    if values is None:
        return Section("Parameters", ())
    values, names = _present(values), value_names(_present(values), found.nominal)
    blocks: list[Block] = [Text(_intro(found)), _table(values, names, found.nominal)]
    blocks.append(Text(correlation_words(values, names)))
    figures = [picture(parameter_figure(values, names, _least_certain(values)), PICTURED)]
    together = _together(values)
    if len(together) > 1:
        figures.append(picture(correlation_figure(values, names, together), CORRELATED))
    return Section("Parameters", (*blocks, Gallery(tuple(figures))))


PICTURED = (
    "Left: change from the nominal value (dashed) with two standard deviations either side, where these are wide "
    "enough to be seen. Right: standard deviation relative to the value; far left is known best."
)
CORRELATED = (
    "Blue: the errors of both go up together; orange: one goes up as the other goes down. White: they have nothing to "
    "do with each other. Strong ones are written."
)


def _present(values: ElementValues) -> ElementValues:
    """Without springs that the model does not have: a connection may damp only."""
    value, nominal, std = (np.asarray(x) for x in (values.values, values.nominal, values.deviation))
    kept = np.flatnonzero((value != 0) | (nominal != 0) | (std != 0))
    return ElementValues(
        tuple(values.listed[i] for i in kept),
        as_array(value[kept]),
        as_array(std[kept]),
        as_array(np.asarray(values.correlation)[np.ix_(kept, kept)]),
        as_array(nominal[kept]),
    )


def value_names(values: ElementValues, model: LumpedModel) -> tuple[str, ...]:
    """Such as "gearbox stiffness"; a mass is an inertia where bodies turn.

    Args:
        values: of elements or entries.
        model: nominal.
    """
    units = units_of(model)
    return tuple(f"{x.element} {units.name(x.quantity)}" for x in values.listed)


def _intro(found: Identification) -> str:
    if found.elements is not None:
        return (
            "The values of the model's own elements before and after the fit. A change of many standard deviations is "
            "no chance: the nominal value is not that of the system that was measured."
        )
    return (
        "The largest entries of the fitted matrices, on and above their diagonals, before and after the fit. A "
        "change of many standard deviations is no chance."
    )


def _table(values: ElementValues, names: tuple[str, ...], model: LumpedModel) -> Table:
    header = ("Parameter", "Nominal", "Refined", "Standard deviation", "Change", "Change / std. deviation")
    units = units_of(model)
    ends = {c.name: f" {MISSING} ".join(c.between) for c in model.connections}
    rows = tuple(
        (
            Cell(name, ends.get(x.element, "")),
            *_row(float(value), float(std), float(nominal), units, x.quantity),
        )
        for x, name, value, std, nominal in zip(
            values.listed, names, values.values, values.deviation, values.nominal, strict=True
        )
    )
    return Table(header, rows, "Before and after", f"The last column is marked from {FAR:g} on.")


def _row(value: float, std: float, nominal: float, units: Units, quantity: str) -> tuple[str | Cell, ...]:
    known = np.isfinite(std) and std > 0
    pull = (value - nominal) / std if known else float("nan")
    relative = f"{significant(100 * std / abs(value), 2)} %" if known and value else ""
    doubt = "not determined" if np.isinf(std) else "held at a bound" if std == 0 else relative
    return (
        significant(nominal, 5),
        Cell(_digits(value, std), units.symbol(quantity)),
        Cell(significant(std, 2) if known else MISSING, doubt, tone="warning" if np.isinf(std) else ""),
        change(value, nominal),
        Cell(_signed(pull), tone="warning" if abs(pull) > FAR else ""),
    )


def _digits(value: float, std: float) -> str:
    """As many digits as the deviation allows, three to eight."""
    if not (np.isfinite(std) and std > 0 and value):
        return significant(value, 5)
    return significant(value, int(np.clip(np.floor(np.log10(abs(value) / std)) + 2, 3, 8)))


def _signed(value: float) -> str:
    return minus(f"{value:+.3g}" if abs(value) < 1000 else f"{value:+.0f}") if np.isfinite(value) else MISSING


def _least_certain(values: ElementValues) -> np.ndarray:
    """Numbers of the values to draw, in their order; where there are too many, the least certain."""
    value, std = np.abs(np.asarray(values.values)), np.asarray(values.deviation)
    doubt = np.nan_to_num(std / np.where(value > 0, value, np.nan), posinf=np.inf)
    return np.sort(np.argsort(-doubt, kind="stable")[:MOST])


def _together(values: ElementValues) -> np.ndarray:
    """Numbers of the values with a correlation, in their order; where there are too many, those with the strongest."""
    size = np.abs(np.asarray(values.correlation))
    known = np.isfinite(np.diag(size))
    strongest = np.where(known, np.nan_to_num(size - np.diag(np.diag(size))).max(axis=1), -1.0)
    return np.sort(np.argsort(-strongest, kind="stable")[: min(MOST, int(known.sum()))])


def strongest_pairs(values: ElementValues, least: float = STRONG) -> list[tuple[int, int, float]]:
    """Pairs of values and the correlation of their errors, the strongest first.

    Args:
        values: fitted.
        least: size of correlations that count.
    """
    lower = np.tril(np.nan_to_num(np.asarray(values.correlation)), -1)
    pairs = [(int(i), int(j), float(lower[i, j])) for i, j in np.argwhere(np.abs(lower) >= least)]
    return sorted(pairs, key=lambda x: -abs(x[2]))


def correlation_words(values: ElementValues, names: tuple[str, ...]) -> str:
    """Which values the records tell apart badly, in a sentence or two.

    Args:
        values: fitted.
        names: of all of them.
    """
    pairs = strongest_pairs(values)
    if not pairs:
        return f"No two errors correlate by {STRONG:g} or more: each value stands on its own."
    told = "; ".join(f"{names[j]} and {names[i]} ({minus(f'{r:+.2f}')})" for i, j, r in pairs[:NAMED])
    more = f" {len(pairs)} pairs correlate by {STRONG:g} or more." if len(pairs) > NAMED else ""
    return (
        f"Errors that go together most: {told}.{more} Near +1 the records would hardly notice if both values rose "
        f"together, near {minus('-1')} if one rose while the other fell: the pair is then known better in combination "
        "than either."
    )
