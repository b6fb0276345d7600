"""Mechanical systems, their records, and the Cramer-Rao bound of what these tell: all by scipy, from the truth."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import signal

KINDS = {"d": "displacement", "v": "velocity", "a": "acceleration"}
STEP = 1e-7  # of the finite differences, in sizes of the unknowns: 1e-5 tells too much of weak combinations
TOGETHER = 32  # simulations at once
PAST = 2000  # samples of filtered noise that are thrown away


class System(NamedTuple):
    """Masses in a row, springs and dampers from the ground on, the driven bodies, a kind of sensor for each body.

    A spring more than bodies joins the last body to the ground.
    """

    mass: list[float]
    stiffness: list[float]
    damping: list[float]
    driven: tuple[int, ...] = (0,)
    kinds: str = ""

    @property
    def sensors(self) -> str:
        return self.kinds or "a" * len(self.mass)


class Colour(NamedTuple):
    """A filter that makes noise of white numbers: its numerator and denominator in z^-1."""

    numerator: tuple[float, ...] = (1.0,)
    denominator: tuple[float, ...] = (1.0,)


WHITE, LOW = Colour(), Colour(denominator=(1.0, -0.95))


def joined(values, bodies: int) -> np.ndarray:
    """The matrix of springs or dampers in a row."""
    found = np.zeros((bodies, bodies))
    for i, value in enumerate(values):
        joint = np.zeros(bodies)
        joint[[j for j in (i - 1, i) if 0 <= j < bodies]] = [-1.0, 1.0] if 0 < i < bodies else [1.0]
        found += value * np.outer(joint, joint)
    return found


def matrices(system: System) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """M, D, K."""
    bodies = len(system.mass)
    return np.diag(system.mass), joined(system.damping, bodies), joined(system.stiffness, bodies)


def outputs(system: System, triples, states: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
    """(simulations, samples, outputs) under held inputs, each of its own M, D, K and initial state."""
    sampled = [_sampled(system, triple, dt) for triple in triples]
    A, B, C, D = (np.stack(x) for x in zip(*sampled, strict=True))
    x, path = states[:, :, None], np.empty((len(u), *states.shape))
    pushed = np.einsum("pni,ki->kpn", B, u)[:, :, :, None]
    for k in range(len(u)):
        path[k] = x[:, :, 0]
        x = A @ x + pushed[k]
    return np.einsum("pon,kpn->pko", C, path) + np.einsum("poi,ki->pko", D, u)


def _sampled(system: System, triple, dt: float) -> tuple[np.ndarray, ...]:
    M, D, K = triple
    n = len(M)
    force = np.eye(n)[:, list(system.driven)]
    lower = np.linalg.solve(M, np.concatenate([-K, -D, force], axis=1))
    A = np.concatenate([np.eye(n, 2 * n, n), lower[:, : 2 * n]])
    B = np.concatenate([np.zeros_like(force), lower[:, 2 * n :]])
    rows = {"d": np.eye(n, 2 * n), "v": np.eye(n, 2 * n, n), "a": lower[:, : 2 * n]}
    C = np.stack([rows[kind][i] for i, kind in enumerate(system.sensors)])
    through = np.stack([lower[i, 2 * n :] * (kind == "a") for i, kind in enumerate(system.sensors)])
    return signal.cont2discrete((A, B, C, through), dt)[:4]


def band_noise(
    rng: np.random.Generator, samples: int, inputs: int, dt: float, low=1.0, high=60.0
) -> np.ndarray:
    """Gaussian noise between two frequencies (Hz), (samples, inputs)."""
    sections = signal.butter(6, [low, high], "band", fs=1 / dt, output="sos")
    return signal.sosfilt(sections, rng.standard_normal((samples + PAST, inputs)), axis=0)[PAST:]


def noise(rng: np.random.Generator, shape: tuple[int, int], colour: Colour) -> np.ndarray:
    """Of unit variance, (samples, outputs)."""
    white = rng.standard_normal((shape[0] + PAST, shape[1]))
    return _filtered(colour, white, 0)[PAST:] / _size(colour)


def _size(colour: Colour) -> float:
    return float(np.linalg.norm(_filtered(colour, np.eye(1, PAST)[0], 0)))


def _filtered(colour: Colour, x: np.ndarray, axis: int) -> np.ndarray:
    return np.asarray(signal.lfilter(*colour, x, axis=axis))


def bound(
    system: System,
    of: Callable[[np.ndarray], tuple],
    truth: np.ndarray,
    scale: np.ndarray,
    u: np.ndarray,
    dt: float,
    deviation: np.ndarray,
    colour: Colour = WHITE,
) -> np.ndarray:
    """(p, p) the least covariance of unbiased estimates of p unknowns from a record with an unknown initial state.

    The inverse of J'J, J the change of the record, made white and of unit variance, with the unknowns and the states.

    Args:
        system: inputs and sensors.
        of: M, D, K of the unknowns.
        truth: unknowns.
        scale: their sizes.
        u: inputs.
        dt: sampling interval, s.
        deviation: (outputs,) of the noise.
        colour: of the noise.

    Source: S. Kay, Fundamentals of Statistical Signal Processing: Estimation Theory, 1993, section 3.9.
    """
    n = 2 * len(system.mass)
    moves = [STEP * x for x in np.diag(np.concatenate([scale, np.ones(n)]))]
    slopes = []
    for i in range(0, len(moves), TOGETHER):
        group = [sign * x for x in moves[i : i + TOGETHER] for sign in (1, -1)]
        found = outputs(
            system,
            [of(truth + x[: len(truth)]) for x in group],
            np.stack([x[len(truth) :] for x in group]),
            u,
            dt,
        )
        slopes.append((found[::2] - found[1::2]) / (2 * STEP))
    left = max(len(colour.denominator), len(colour.numerator)) - 1
    inverse = Colour(colour.denominator, colour.numerator)
    white = _filtered(inverse, np.concatenate(slopes) / deviation, 1)[:, left:] * _size(colour)
    J = white.reshape(len(white), -1)
    information = J @ J.T
    root = np.sqrt(np.diag(information))
    whole = np.linalg.inv(information / root / root[:, None]) / root / root[:, None]
    return whole[: len(truth), : len(truth)] * scale * scale[:, None]
