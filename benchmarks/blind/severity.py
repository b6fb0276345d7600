"""How large an effect is next to the noise: with and without it, and after the best refit of the linear model.

The refit is that of the linearized response: what is left of the difference once all that masses, stiffnesses,
dampings and the initial state can do to first order is taken out.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg
from plant import HELD, plant
from systems import System, numbers, recalibrated_by

CHANGE = 1e-4  # relative, of a number, for its sensitivity


class Severity(NamedTuple):
    """Of a record.

    Attributes:
        gap: rms over time and sensors of the difference that the effects make, in noise.
        gap_recalibrated: the same after the linearized refit.
        change: that rms next to the response's, of the sensors together.
    """

    gap: float
    gap_recalibrated: float
    change: float


def linear_responses(systems: list[System], u: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Readings (variants, samples, sensors) of linear systems that differ in their numbers.

    Args:
        systems: of the same shape.
        u: (samples,) held input.
        starts: (variants, states).
    """
    made = [plant(s, (), 0.0) for s in systems]
    n = len(made[0].A)
    block = lambda p: np.block([[p.A, p.B], [np.zeros((HELD, n + HELD))]]) * systems[0].dt  # noqa: E731
    steps = np.stack([scipy.linalg.expm(block(p))[:n] for p in made])
    F, G = steps[:, :, :n], steps[:, :, n]
    C, D = np.stack([p.C for p in made]), np.stack([p.D[:, 0] for p in made])
    x, states = starts, np.empty((len(u), *starts.shape))
    for k, push in enumerate(u):
        states[k] = x
        x = np.einsum("pij,pj->pi", F, x) + G * push
    return np.einsum("psi,tpi->pts", C, states) + D[:, None, :] * u[None, :, None]


def severity(
    system: System,
    u: np.ndarray,
    y: np.ndarray,
    std: np.ndarray,
    before: int,
    without: np.ndarray | None = None,
) -> Severity:
    """Of effects, from a motion with them.

    Args:
        system: true elements without effects.
        u: (before + samples,) recorded input.
        y: (before + samples, sensors) readings with the effects, without noise.
        std: (sensors,) of the noise.
        before: samples ahead of the record.
        without: (before + samples, sensors) readings without them; those of the linear system where left out.
    """
    values = numbers(system)
    at = np.flatnonzero(values)
    changed = [recalibrated_by(system, values * (1 + CHANGE * (np.arange(len(values)) == i))) for i in at]
    n = 2 * len(system.bodies)
    found = linear_responses([system, *changed], u, np.zeros((1 + len(at), n)))[:, before:]
    free = linear_responses([system] * n, 0 * u[before:], np.eye(n))
    columns = np.concatenate([(found[1:] - found[0]) / CHANGE, free])
    own = y[before:]
    other = found[0] if without is None else without[before:]
    gap = (own - other) / std
    J = (columns / std).reshape(len(columns), -1).T
    J = J / np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    left = gap.ravel() - J @ np.linalg.lstsq(J, gap.ravel(), rcond=1e-10)[0]
    rms = lambda x: float(np.sqrt(np.mean(np.square(x))))  # noqa: E731
    return Severity(rms(gap), rms(left), rms((own - other) / own.std(axis=0)))
