"""How well the identified model repeats the records, in time and in frequency."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Array

from jaxsid.checks import JaxsidError
from jaxsid.identification import FrequencyFit
from jaxsid.impulse.lines import Lines
from jaxsid.impulse.spectra import frequency_response
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.hold import discretise
from jaxsid.mechanics.simulate import estimate_initial_state, simulate_linear
from jaxsid.pipeline.correlations import correlations
from jaxsid.records import ContinuousModel, Record, Residuals, SecondOrderModel, as_array


class TimeFit(NamedTuple):
    """Predictions, one a record, and the errors of each output over all records."""

    predictions: tuple[Array, ...]
    nrmse: np.ndarray
    floor: np.ndarray


def time_fit(
    model: ContinuousModel,
    records: Sequence[Record],
    outputs: Sequence[str],
    lines: Lines,
    noise: Array,
    at_rest: bool,
) -> TimeFit:
    """Simulate each record from an estimated initial state and compare.

    Args:
        model: identified, its outputs in the order of `outputs`.
        records: what was measured.
        outputs: names of the model's outputs.
        lines: in-band lines of the records.
        noise: (lines, outputs) standard deviation of the noise on each line.
        at_rest: start from rest instead.
    """
    predictions, left, floor, size = [], *(np.zeros(len(outputs)) for _ in range(3))
    owner = np.where(np.asarray(lines.weight).any(axis=1), np.asarray(lines.record).argmax(axis=1), -1)
    for i, r in enumerate(records):
        rows, measured, samples = [outputs.index(n) for n in r.outputs], np.asarray(r.y), len(r.y)
        predictions.append(_prediction(model, r, outputs, at_rest))
        error = measured - np.asarray(predictions[-1])[:, rows]
        level = np.asarray(noise)[owner == i][:, rows] ** 2
        inside = 2 * level.sum(axis=0)
        left[rows] += (error**2).sum(axis=0)
        floor[rows] += inside + _outside_band(error, level[0], float(r.dt), np.asarray(lines.band))
        size[rows] += samples * measured.var(axis=0)
    size = np.where(size > 0, size, 1.0)
    return TimeFit(tuple(predictions), np.sqrt(left / size), np.sqrt(np.minimum(floor, left) / size))


def no_time_fit(records: Sequence[Record], outputs: Sequence[str]) -> TimeFit:
    """NaN everywhere: what is said of a system that no simulation can follow.

    Args:
        records: what was measured.
        outputs: names of the model's outputs.
    """
    nothing = np.full(len(outputs), np.nan)
    empty = tuple(as_array(np.full((len(r.y), len(outputs)), np.nan)) for r in records)
    return TimeFit(empty, nothing, nothing)


def time_errors(
    model: SecondOrderModel, records: Sequence[Record], outputs: Sequence[str], at_rest: bool
) -> np.ndarray:
    """rms(y - yhat) / std(y) of each output over all records; NaN where the model's motion grows beyond all numbers.

    Args:
        model: mass, damping, stiffness, its outputs in the order of `outputs`.
        records: what was measured.
        outputs: names of the model's outputs.
        at_rest: start from rest instead of the initial state that fits best.
    """
    linear, left, size = physical_displacement_velocity(model), *(np.zeros(len(outputs)) for _ in range(2))
    for r in records:
        rows, measured = [outputs.index(n) for n in r.outputs], np.asarray(r.y)
        predicted = np.asarray(_prediction(linear, r, outputs, at_rest))[:, rows]
        with np.errstate(over="ignore", invalid="ignore"):
            left[rows] += ((measured - predicted) ** 2).sum(axis=0)
        size[rows] += len(measured) * measured.var(axis=0)
    left = np.where(np.isfinite(left), left, np.nan)
    return np.sqrt(left / np.where(size > 0, size, 1.0))


def residuals_of(
    records: Sequence[Record], outputs: Sequence[str], predictions: Sequence[Array]
) -> tuple[Residuals, ...]:
    """Correlations of what is left of each record with itself and with the inputs.

    Args:
        records: what was measured.
        outputs: names of the columns of the predictions.
        predictions: one a record.
    """
    found = []
    for r, predicted in zip(records, predictions, strict=True):
        rows = [outputs.index(n) for n in r.outputs]
        error = np.full(predicted.shape, np.nan)
        error[:, rows] = np.asarray(r.y) - np.asarray(predicted)[:, rows]
        found.append(correlations(error, np.asarray(r.u), float(r.dt)))
    return tuple(found)


def _prediction(model: ContinuousModel, record: Record, outputs: Sequence[str], at_rest: bool) -> Array:
    """All outputs, from the initial state that fits the measured ones."""
    sampled = discretise(model, record.dt, hold=record.hold)
    if at_rest:
        return simulate_linear(sampled, record.u)
    y = np.full((len(record.y), len(outputs)), np.nan)
    y[:, [outputs.index(n) for n in record.outputs]] = np.asarray(record.y)
    state = estimate_initial_state(sampled, record.u, y).state
    return simulate_linear(sampled, record.u, initial_state=state)


def _outside_band(error: np.ndarray, lowest: np.ndarray, dt: float, band: np.ndarray) -> np.ndarray:
    """Sum of squares of the noise at frequencies that the inputs do not excite.

    Above the band all of the error is noise. Below it may be drift of the model, so that the level of the
    lowest lines is carried on.
    """
    f = np.fft.rfftfreq(len(error), dt)
    power = np.abs(np.fft.rfft(error, axis=0)[f > band[1]]) ** 2
    return 2 * power.sum(axis=0) / len(error) + 2 * lowest * ((f > 0) & (f < band[0])).sum()


def frequency_fits(
    records: Sequence[Record],
    outputs: Sequence[str],
    model: ContinuousModel,
    matrices: SecondOrderModel | None,
    band: Sequence[float],
) -> tuple[FrequencyFit, ...]:
    """Measured (H1) and modelled frequency responses of every record, within and around the band.

    Args:
        records: what was measured.
        outputs: names of the model's outputs.
        model: identified state-space model.
        matrices: identified mass, damping and stiffness, or None.
        band: Hz.
    """
    fits = []
    for r in records:
        try:
            measured = frequency_response(r)
        except JaxsidError:  # too short to average: the time plots remain
            continue
        f = np.asarray(measured.frequencies)
        near = np.flatnonzero((f >= 0.5 * band[0]) & (f <= 1.5 * band[1]) & (f > 0))
        columns = [outputs.index(n) for n in r.outputs]
        h = np.full((len(near), len(outputs), r.u.shape[1]), np.nan, complex)
        coherence = np.full((len(near), len(outputs)), np.nan)
        h[:, columns] = np.asarray(measured.H)[near]
        coherence[:, columns] = np.asarray(measured.multiple_coherence)[near]
        physical = None if matrices is None else physical_displacement_velocity(matrices)
        fits.append(
            FrequencyFit(
                frequencies=as_array(f[near]),
                measured=as_array(h),
                coherence=as_array(coherence),
                realization=_response(model, r, f[near]),
                matrices=None if physical is None else _response(physical, r, f[near]),
            )
        )
    return tuple(fits)


def _response(model: ContinuousModel, record: Record, f: np.ndarray) -> Array:
    """Frequency response of the sampled, held system at f (Hz)."""
    half = 1j * np.pi * f * float(record.dt)
    z = (1 + half) / (1 - half) if record.hold[0] == "band" else np.exp(2 * half)
    sampled = discretise(model, record.dt, hold=record.hold)
    A, B, C, D = (np.asarray(x) for x in (sampled.A, sampled.B, sampled.C, sampled.D))
    return as_array(C @ np.linalg.solve(z[:, None, None] * np.eye(len(A)) - A, B[None]) + D)
