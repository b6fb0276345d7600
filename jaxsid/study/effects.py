"""What each factor does to the errors in a random sweep, where no two cases differ in one factor alone."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsid.study.compare import Level
from jaxsid.study.summary import Row, by_case


class Effect(NamedTuple):
    """How errors depend on a factor, all other factors being equal.

    Attributes:
        factor: which.
        level: a choice, compared with `base`; None for a number.
        base: another choice; None for a number.
        value: of a choice, logarithm of the ratio of errors; of a number, the power of it that errors go with.
        error: standard error of the value.
    """

    factor: str
    level: Level | None
    base: Level | None
    value: float
    error: float


def estimate_effects(rows: Sequence[Row], factors: Sequence[str]) -> list[Effect]:
    """Least squares over the cases, each with the mean over its quantities of the logarithm of rmse over truth.

        log error = constant of all cases with these truths + sum over numbers of power log(number)
                    + sum over choices of log(ratio)

    Cases with different truths, such as those of two systems, have constants of their own. Factors that the data do
    not tell apart, and numbers that are not positive throughout, are left out.

    Args:
        rows: summary of a study.
        factors: whose effects are wanted, and are taken to be all that there are.
    """
    cases = [case for case in by_case(rows) if math.isfinite(_error(case))]
    columns = [
        column for name in factors for column in _columns(name, [case[0].factors[name] for case in cases])
    ]
    groups = [tuple((row.quantity, f"{row.truth:.6g}") for row in case) for case in cases]
    y = _centred(np.array([_error(case) for case in cases]), groups)
    usable = [(effect, _centred(x, groups)) for effect, x in columns]
    usable = [(effect, x) for effect, x in usable if np.linalg.norm(x) > 1e-9]
    free = len(cases) - len(set(groups)) - len(usable)
    X = np.array([x for _, x in usable]).T
    if not usable or free < 1 or np.linalg.matrix_rank(X) < len(usable):
        return []
    found = np.linalg.lstsq(X, y, rcond=None)[0]
    variance = float(np.sum((y - X @ found) ** 2)) / free
    errors = np.sqrt(variance * np.diag(np.linalg.inv(X.T @ X)))
    return [
        effect._replace(value=float(value), error=float(error))
        for (effect, _), value, error in zip(usable, found, errors, strict=True)
    ]


def _error(case: Sequence[Row]) -> float:
    """Mean logarithm of the relative errors of a case; NaN where one is unknown."""
    ratios = [row.rmse / abs(row.truth) for row in case if row.truth]
    return float(np.mean(np.log(ratios))) if ratios and min(ratios) > 0 else math.nan


def _columns(factor: str, values: Sequence[Level]) -> list[tuple[Effect, Float[np.ndarray, " cases"]]]:
    """The regressors of a factor: the logarithm of a number, or which cases have each choice but the first."""
    if all(isinstance(x, int | float) and not isinstance(x, bool) for x in values):
        x = np.array(values, dtype=float)
        return [(Effect(factor, None, None, 0.0, 0.0), np.log(x))] if (x > 0).all() else []
    base, *others = sorted(set(values), key=str)
    return [
        (Effect(factor, level, base, 0.0, 0.0), np.array([x == level for x in values], dtype=float))
        for level in others
    ]


def _centred(x: Float[np.ndarray, " cases"], groups: Sequence[tuple]) -> Float[np.ndarray, " cases"]:
    """x less the mean of its group."""
    x = x.copy()
    for group in set(groups):
        members = np.array([other == group for other in groups])
        x[members] -= x[members].mean()
    return x
