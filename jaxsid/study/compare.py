"""Which level of a factor estimates better: pairs of cases that differ in that factor alone."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from jaxsid.study.summary import Row

SIGNIFICANT = 3.0  # standard errors
MANY = 8  # levels, beyond which a factor was drawn from a range
SAME = 1e-6  # relative difference of truths that are one and the same
Level = str | int | float | bool


class Comparison(NamedTuple):
    """A level of a factor against the best one.

    Attributes:
        factor, level, best: which.
        pairs: quantities of pairs of cases that were compared.
        ratio: geometric mean of the root mean square errors over those with the best level.
        worse, better: pairs in which it is so by more than three standard errors.
    """

    factor: str
    level: Level
    best: Level
    pairs: int
    ratio: float
    worse: int
    better: int


def compare_levels(rows: Sequence[Row], varied: Sequence[str]) -> list[Comparison]:
    """Every level of every varied factor against that factor's best level, where cases allow it.

    Two cases are compared, quantity by quantity, where all other varied factors and the truth are the same; so factors
    that change the truth, such as the system, have no entry, nor have those of a random sweep, nor those
    with more than eight levels: for these see `estimate_effects`.

    Args:
        rows: summary of a study.
        varied: names of the factors that differ between its cases.
    """
    return [entry for factor in varied for entry in _compare(rows, factor, set(varied) - {factor})]


def _compare(rows: Sequence[Row], factor: str, others: set[str]) -> list[Comparison]:
    levels = list(dict.fromkeys(row.factors[factor] for row in rows))
    against_first = [(_against(rows, factor, others, level, levels[0]), level) for level in levels[1:]]
    usable = [(entry.ratio, level) for entry, level in against_first if entry.pairs]
    if not usable or len(levels) > MANY:
        return []
    best = min([(1.0, levels[0]), *usable], key=lambda x: x[0])[1]
    entries = [_against(rows, factor, others, level, best) for level in levels if level != best]
    return sorted((x for x in entries if x.pairs), key=lambda x: x.ratio)


def _against(rows: Sequence[Row], factor: str, others: set[str], level: Level, best: Level) -> Comparison:
    pairs = list(_pairs(rows, factor, others, level, best))
    apart = [(a.rmse - b.rmse) / (math.hypot(a.rmse_error, b.rmse_error) or math.inf) for a, b in pairs]
    logs = [math.log(a.rmse / b.rmse) for a, b in pairs]
    return Comparison(
        factor,
        level,
        best,
        len(pairs),
        math.exp(sum(logs) / len(logs)) if logs else math.nan,
        sum(x > SIGNIFICANT for x in apart),
        sum(x < -SIGNIFICANT for x in apart),
    )


def _pairs(
    rows: Sequence[Row], factor: str, others: set[str], level: Level, best: Level
) -> Iterator[tuple[Row, Row]]:
    """Rows with the level, each with that of the same quantity in the case that has the best level instead."""
    twins = _by_setting(rows, factor, others, best)
    for setting, case in _by_setting(rows, factor, others, level).items():
        both = [(row, twins[setting][name]) for name, row in case.items() if name in twins.get(setting, {})]
        if all(math.isclose(a.truth, b.truth, rel_tol=SAME) for a, b in both):
            yield from ((a, b) for a, b in both if _known(a) and _known(b))


def _by_setting(
    rows: Sequence[Row], factor: str, others: set[str], level: Level
) -> dict[tuple, dict[str, Row]]:
    """Rows with a level of the factor, by the levels of the other factors and by quantity."""
    found: dict[tuple, dict[str, Row]] = {}
    for row in rows:
        if row.factors[factor] == level:
            setting = tuple(row.factors[name] for name in sorted(others))
            found.setdefault(setting, {})[row.quantity] = row
    return found


def _known(row: Row) -> bool:
    return row.rmse > 0 and math.isfinite(row.rmse) and math.isfinite(row.rmse_error)
