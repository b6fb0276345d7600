"""The best masses, stiffnesses and dampings of a linear model for a record, by Gauss-Newton, and its motion."""

from typing import NamedTuple

import numpy as np
from plant import plant
from severity import CHANGE, linear_responses
from systems import System, numbers, recalibrated_by

ITERATIONS, FURTHEST = 40, 0.3  # relative change of a number in one iteration
PARTS = tuple(0.5**i for i in range(9))  # of a step that are tried
LITTLE = 1e-6  # part of the cost that is not worth a step


class Fit(NamedTuple):
    """A model, its state at the record's start, and what it leaves, in units of each sensor's residual."""

    system: System
    start: np.ndarray
    residual: np.ndarray


def fitted_start(system: System, u: np.ndarray, y: np.ndarray) -> Fit:
    """A model as it is, with the initial state that suits a record best.

    Args:
        system: linear.
        u: (samples,) input.
        y: (samples, sensors) readings.
    """
    n = len(plant(system, (), 0.0).A)
    found = linear_responses([system], u, np.zeros((1, n)))[0]
    free = linear_responses([system] * n, 0 * u, np.eye(n))
    std = y.std(axis=0)
    columns = (free / std).reshape(n, -1).T
    start = np.linalg.lstsq(columns, ((y - found) / std).ravel(), rcond=1e-9)[0]
    return Fit(system, start, y - found - np.einsum("n,nts->ts", start, free))


def recalibrated(system: System, u: np.ndarray, y: np.ndarray) -> Fit:
    """Numbers and initial state by least squares, each sensor weighted by what it leaves.

    Args:
        system: where to start from.
        u: (samples,) input.
        y: (samples, sensors) readings.
    """
    fit = fitted_start(system, u, y)
    for _ in range(ITERATIONS):
        values, std = numbers(fit.system), fit.residual.std(axis=0)
        at = np.flatnonzero(values)
        # mass and stiffness of a narrow mode do nearly the opposite: what else they do needs slopes from both sides
        moved = [values * (1 + c * (np.arange(len(values)) == i)) for c in (CHANGE, -CHANGE) for i in at]
        made = linear_responses(
            [recalibrated_by(system, v) for v in moved], u, np.tile(fit.start, (len(moved), 1))
        )
        n = len(fit.start)
        free = linear_responses([fit.system] * n, 0 * u, np.eye(n))
        columns = np.concatenate([(made[: len(at)] - made[len(at) :]) / (2 * CHANGE), free]) / std
        J = columns.reshape(len(columns), -1).T
        size = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
        step = np.linalg.lstsq(J / size, (fit.residual / std).ravel(), rcond=1e-6)[0] / size
        change = np.zeros(len(values))
        change[at] = np.clip(step[: len(at)], -FURTHEST, FURTHEST)
        cost = (fit.residual**2 / std**2).sum()
        # a step as long as a mode is narrow may lead past what it leads to
        for part in PARTS:
            tried = fitted_start(recalibrated_by(system, values * np.exp(part * change)), u, y)
            if (tried.residual**2 / std**2).sum() < cost * (1 - LITTLE):
                break
        else:
            break
        fit = tried
    return fit


def gap_left(system: System, u: np.ndarray, y: np.ndarray, std: np.ndarray) -> float:
    """What the best linear model leaves of a motion without noise, rms in noise.

    A linearized refit tells that of small changes alone: a spring that the model lacks may shift a mode by its width.

    Args:
        system: true elements without effects.
        u: (samples,) input.
        y: (samples, sensors) readings with the effects, without noise.
        std: (sensors,) of the noise.
    """
    return float(np.sqrt(np.mean((recalibrated(system, u, y).residual / std) ** 2)))
