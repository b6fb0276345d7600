"""Is what a model leaves of records noise? The strongest correlations, and a warning where the inputs are in it."""

from collections.abc import Sequence
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from jaxsid.pipeline.correlations import ONE_PERCENT
from jaxsid.records import Residuals

CHANCE = (
    1e-4  # of calling any correlation of noise more than chance, over all lags, outputs, inputs and records
)
NEGLIGIBLE = 1e-4  # part of an output that is not worth a warning, however well it follows the inputs
NAMED = 3  # pairs of output and input


class Peaks(NamedTuple):
    """The strongest correlation of each output, or of each output with each input, in one record.

    Attributes:
        value: the correlation; NaN where there is none, as of an absent sensor.
        lag: s.
        score: its size in standard deviations of chance.
        limit: the score that chance exceeds once in ten thousand times over all lags and pairs of all records.
    """

    value: np.ndarray
    lag: np.ndarray
    score: np.ndarray
    limit: float


def own_peaks(residuals: Sequence[Residuals]) -> tuple[Peaks, ...]:
    """The strongest autocorrelation of each output, (outputs,), at any lag but 0, a record each.

    Args:
        residuals: of each record.
    """
    parts = [
        (
            np.asarray(r.autocorrelation)[1:],
            np.asarray(r.lags)[1:],
            np.full(r.autocorrelation.shape[1], r.white_limit),
        )
        for r in residuals
    ]
    return _peaks(parts)


def cross_peaks(residuals: Sequence[Residuals]) -> tuple[Peaks, ...]:
    """The strongest correlation of each output with each input before it, (outputs, inputs), a record each.

    An input after the output is left out: that it follows what is left is the work of feedback, no fault of the model.

    Args:
        residuals: of each record.
    """
    parts = []
    for r in residuals:
        after = np.asarray(r.cross_lags) >= 0
        values, lags = np.asarray(r.cross_correlation)[after], np.asarray(r.cross_lags)[after]
        parts.append((values, lags, np.asarray(r.cross_limit)))
    return _peaks(parts)


def _peaks(parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> tuple[Peaks, ...]:
    """Of correlations, their lags and the limits that chance exceeds once in a hundred times at a lag."""
    tests = max(sum(int(np.isfinite(values).sum()) for values, _, _ in parts), 1)
    limit = NormalDist().inv_cdf(1 - CHANCE / (2 * tests))
    found = []
    for values, lags, once in parts:
        known = np.isfinite(values).all(axis=0) & (once > 0)
        if not len(lags):
            nothing = np.full(once.shape, np.nan)
            found.append(Peaks(nothing, nothing, nothing, limit))
            continue
        top = np.abs(np.nan_to_num(values)).argmax(axis=0)
        value = np.take_along_axis(values, top[None], axis=0)[0]
        score = ONE_PERCENT * np.abs(value) / np.where(known, once, 1.0)
        value, lag, score = (np.where(known, x, np.nan) for x in (value, lags[top], score))
        found.append(Peaks(value, lag, score, limit))
    return tuple(found)


def input_warning(
    residuals: Sequence[Residuals],
    records: Sequence[str],
    outputs: Sequence[str],
    inputs: Sequence[Sequence[str]],
    left: np.ndarray,
) -> tuple[str, ...]:
    """One warning where what is left of outputs follows inputs far beyond chance, else none.

    Args:
        residuals: of each record.
        records: their names.
        outputs: names.
        inputs: names, those of each record.
        left: (outputs,) what is left, relative to the output.
    """
    worst: dict[tuple[str, str], tuple[float, str]] = {}
    peaks = cross_peaks(residuals)
    for at, names, record in zip(peaks, inputs, records, strict=True):
        where = f" in {record}" if len(records) > 1 else ""
        for i, j in np.argwhere((at.score > at.limit) & (np.asarray(left) > NEGLIGIBLE)[:, None]).tolist():
            pair, score = (outputs[i], names[j]), float(at.score[i, j])
            if score > worst.get(pair, (0.0, ""))[0]:
                worst[pair] = score, _told(outputs[i], names[j], at.value[i, j], at.lag[i, j], score) + where
    if not worst:
        return ()
    told = [text for _, text in sorted(worst.values(), reverse=True)]
    more = f", and of {len(told) - NAMED} more pairs" if len(told) > NAMED else ""
    return (
        "The model misses something that the inputs drive: what it leaves of the outputs follows the inputs, where "
        f"chance would reach {peaks[0].limit:.2g} standard deviations: {'; '.join(told[:NAMED])}{more}. Look for "
        "bodies or connections that the model does not have, for friction, play or stops, and for a wrong place, gain, "
        "delay or hold of a sensor or input.",
    )


def _told(output: str, given: str, value: float, lag: float, score: float) -> str:
    return f"{output} with {given}, correlation {value:.2g} at a lag of {lag:.3g} s, {score:.3g} standard deviations"
