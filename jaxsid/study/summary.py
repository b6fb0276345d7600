"""What the realizations of a case say about each quantity: bias, spread, quantiles, and how sure these are."""

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsid.study.configuration import Case
from jaxsid.study.store import Facts

QUANTILES = (2.5, 25.0, 50.0, 75.0, 97.5)
GAUSSIAN = 1.482602218505602  # standard deviation of a Gaussian over its median absolute deviation
NUMBERS = re.compile(r"(_\d+)+$")


class Row(NamedTuple):
    """One quantity in one case; NaN where too few realizations succeeded.

    Attributes:
        case: number of the case.
        factors: its factors.
        quantity, unit, truth: what was estimated.
        count, failed: realizations that gave a value, and those that gave none.
        mean, bias, relative_bias: mean, mean - truth, and that over the size of the truth.
        std, rmse: sqrt(sum (x - mean)^2 / (n - 1)) and sqrt(mean (x - truth)^2).
        q2_5, q25, q50, q75, q97_5: quantiles.
        robust_std: 1.4826 median |x - median|, the standard deviation if all were as Gaussian as the middle half.
        cramer_rao: least standard deviation of an unbiased estimator; NaN where none is known.
        std_over_cramer_rao: 1 for an efficient estimator.
        bias_error, std_error, rmse_error: standard errors of bias, std and rmse from the number of realizations.
    """

    case: int
    factors: dict[str, str | int | float | bool]
    quantity: str
    unit: str
    truth: float
    count: int
    failed: int
    mean: float
    bias: float
    relative_bias: float
    std: float
    rmse: float
    q2_5: float
    q25: float
    q50: float
    q75: float
    q97_5: float
    robust_std: float
    cramer_rao: float
    std_over_cramer_rao: float
    bias_error: float
    std_error: float
    rmse_error: float

    @property
    def kind(self) -> str:
        """The quantity without its number: "frequency", "mass"."""
        return NUMBERS.sub("", self.quantity)


def by_case(rows: Sequence[Row]) -> list[list[Row]]:
    """The rows case by case."""
    found: dict[int, list[Row]] = {}
    for row in rows:
        found.setdefault(row.case, []).append(row)
    return list(found.values())


def summarize(case: Case, facts: Facts, values: Float[np.ndarray, "count quantities"]) -> list[Row]:
    """One row a quantity.

    Args:
        case: which case.
        facts: its quantities, units, truth and bound.
        values: one row a realization, NaN or infinite where it failed.
    """
    return [
        _row(case, facts.names[i], facts.units[i], float(facts.truth[i]), float(facts.bound[i]), values[:, i])
        for i in range(len(facts.names))
    ]


def _row(
    case: Case, name: str, unit: str, truth: float, bound: float, values: Float[np.ndarray, " count"]
) -> Row:
    x = values[np.isfinite(values)]
    mean, std, std_error = _moments(x)
    rmse, rmse_error = _rmse(x - truth)
    quantiles = np.percentile(x, QUANTILES).tolist() if len(x) else [math.nan] * len(QUANTILES)
    return Row(
        case=case.index,
        factors=case.values,
        quantity=name,
        unit=unit,
        truth=truth,
        count=len(x),
        failed=len(values) - len(x),
        mean=mean,
        bias=mean - truth,
        relative_bias=_over(mean - truth, abs(truth)),
        std=std,
        rmse=rmse,
        **dict(zip(("q2_5", "q25", "q50", "q75", "q97_5"), quantiles, strict=True)),
        robust_std=GAUSSIAN * float(np.median(np.abs(x - np.median(x)))) if len(x) else math.nan,
        cramer_rao=bound,
        std_over_cramer_rao=_over(std, bound),
        bias_error=_over(std, math.sqrt(len(x))),
        std_error=std_error,
        rmse_error=rmse_error,
    )


def _over(a: float, b: float) -> float:
    return a / b if b else math.nan


def _moments(x: Float[np.ndarray, " n"]) -> tuple[float, float, float]:
    """Mean, standard deviation s, and its standard error.

    var(s^2) = (m_4 - s^4 (n - 3) / (n - 1)) / n, whatever the distribution; s has 1 / (2 s) of its root.
    """
    n = len(x)
    if n < 2:
        return (float(x[0]) if n else math.nan), math.nan, math.nan
    mean, std = float(x.mean()), float(x.std(ddof=1))
    fourth = float(np.mean((x - mean) ** 4))
    variance = max(fourth - std**4 * (n - 3) / (n - 1), 0.0) / n
    return mean, std, _over(math.sqrt(variance), 2 * std)


def _rmse(error: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Root mean square of errors, and its standard error from the scatter of their squares."""
    n = len(error)
    if n < 2:
        return (abs(float(error[0])) if n else math.nan), math.nan
    squares = error**2
    rmse = math.sqrt(float(squares.mean()))
    return rmse, _over(float(squares.std(ddof=1)) / math.sqrt(n), 2 * rmse)
