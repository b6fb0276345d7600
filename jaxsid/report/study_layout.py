"""How a study is laid out in figures: what runs along the axis, what tells lines apart, what makes another figure."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from jaxsid.digits import minus
from jaxsid.study.compare import MANY, Level
from jaxsid.study.summary import Row

ACROSS = ("noise", "samples", "record_samples", "rows", "cols", "order")  # preferred along the axis
APART = ("realization", "method", "colour")  # preferred as lines
OWN_FIGURE = ("system",)  # what was estimated differs, so that no axis is shared


class Layout(NamedTuple):
    """Factor along the axis, factor that tells lines apart, factors with a figure for each combination."""

    across: str | None
    apart: str | None
    panels: tuple[str, ...]


class Panel(NamedTuple):
    """The rows of one figure, and the words that say which."""

    title: str
    rows: tuple[Row, ...]


def layout(rows: Sequence[Row], varied: Sequence[str]) -> Layout:
    """A number that was varied along the axis, noise first; a choice as lines; the rest apart.

    Numbers drawn from a range can only run along the axis: those that do not are left to the tables.
    """
    free = [name for name in varied if name not in OWN_FIGURE]
    numbers = [name for name in free if all(is_number(x) for x in levels(rows, name))]
    across = _first(numbers, ACROSS) or _first(free, APART)
    free = [name for name in free if name != across]
    free = [name for name in free if len(levels(rows, name)) <= MANY]
    apart = _first([name for name in free if name not in numbers], APART) or _first(free, APART)
    own = [name for name in varied if name in free or name in OWN_FIGURE]
    return Layout(across, apart, tuple(name for name in own if name != apart))


def _first(names: Sequence[str], preferred: Sequence[str]) -> str | None:
    return next((name for name in (*preferred, *names) if name in names), None)


def is_number(value: Level) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def levels(rows: Sequence[Row], factor: str | None) -> list[Level]:
    """Values of a factor, numbers in their order, others by name, so that all figures give them the same colours."""
    if factor is None:
        return []
    found = {row.factors[factor] for row in rows}
    return sorted(found, key=float if all(is_number(x) for x in found) else str)


def panels(rows: Sequence[Row], factors: Sequence[str]) -> list[Panel]:
    """The rows, apart by the levels of these factors."""
    parts: dict[tuple, list[Row]] = {}
    for row in rows:
        parts.setdefault(tuple(row.factors[name] for name in factors), []).append(row)
    return [
        Panel(
            ", ".join(named(name, x) for name, x in zip(factors, key, strict=True)) or "All cases",
            tuple(part),
        )
        for key, part in parts.items()
    ]


def named(factor: str, value: Level) -> str:
    """A level in words: its name tells enough unless it is a number or a switch."""
    return value if isinstance(value, str) and value.isidentifier() else f"{factor} {level_text(value)}"


def level_text(value: Level) -> str:
    return minus(f"{value:.4g}") if isinstance(value, float) else str(value)


def failed_share(case: Sequence[Row]) -> float:
    """Share of the realizations of a case that gave no value for its worst quantity."""
    return max(row.failed / (row.failed + row.count) for row in case)


def kinds(rows: Sequence[Row]) -> list[str]:
    """Kinds of quantities, in their order."""
    return list(dict.fromkeys(row.kind for row in rows))


def relative(row: Row, field: str) -> float:
    """How far a quantile lies from the truth, over the size of the truth."""
    return (getattr(row, field) - row.truth) / abs(row.truth)


def pooled(rows: Sequence[Row], field: str) -> float:
    """Geometric mean over rows of a spread relative to the size of the truth; NaN where there is none."""
    values = [getattr(row, field) / abs(row.truth) for row in rows if row.truth and math.isfinite(row.truth)]
    known = [math.log(x) for x in values if x > 0 and math.isfinite(x)]
    return math.exp(sum(known) / len(known)) if known else math.nan
