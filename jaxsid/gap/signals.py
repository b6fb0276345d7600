"""Shapes that the force of an effect may have: functions of what the place does, on one fixed basis.

They span no law exactly, but every law of the catalogue, and most others, well: hats in displacement and in velocity
hold elastic laws, gaps, stops and friction; plays (L. Prandtl 1928; A. Iwan, J. Appl. Mech. 33, 1966) hysteresis;
delays and lags what signals suffer.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float

from jaxsid.gap.spectra import Motion, Spectra, in_time, readings, to_lines

HATS = 11
KNOTS = np.sign(np.linspace(-1, 1, HATS)) * np.abs(np.linspace(-1, 1, HATS)) ** 1.5  # denser about zero
STEPS = (0.02, 0.1)  # widths of smoothed signs of the velocity, next to its rms
PLAYS = (0.05, 0.15, 0.4, 0.8, 1.5)  # next to the displacement's rms
LAGS = (0.02, 0.05, 0.15, 0.3, 0.6)  # time constants, times the rate of the model's slowest vibration
LATE = (0.02, 0.05, 0.1, 0.2, 0.4)  # delays, likewise
MOST = 2 * HATS + len(STEPS) + 9 + len(PLAYS)
LINEAR = slice(2 * HATS, 2 * HATS + len(LAGS) + len(LATE) + 1)  # what delays and lags a signal
UNUSED = MOST - 1  # no shape of a signal


class Extent(NamedTuple):
    """Largest size and rms of the two signals of a place."""

    most: Float[Array, "2"]
    rms: Float[Array, "2"]


def signals(
    kind: Array, spectra: Spectra, motion: Motion, joint: Array, sensor: Array, drive: Array
) -> Complex[Array, "lines 2"]:
    """Relative displacement and velocity; or a sensor's ideal reading, or an input, twice.

    Args:
        kind: 0 between two ends, 1 a sensor, 2 an input.
        spectra: of the record.
        motion: of the bodies.
        joint: (N,) of the place.
        sensor: (outputs,) 1 at the place.
        drive: (inputs,) likewise.
    """
    q, v = jnp.split(motion.states, 2, axis=1)
    read, given = readings(spectra, motion) @ sensor, spectra.u @ drive
    both = [jnp.stack([a, b], axis=1) for a, b in ((q @ joint, v @ joint), (read, read), (given, given))]
    return jnp.stack(both)[kind]


def extent(spectra: Spectra, pair: Complex[Array, "lines 2"]) -> Extent:
    """Of two signals; arguments as of `shapes`."""
    x = in_time(spectra, pair)
    return Extent(jnp.abs(x).max(axis=0), jnp.sqrt((x**2).mean(axis=0)))


def shapes(
    kind: Array, spectra: Spectra, pair: Complex[Array, "lines 2"], size: Extent, rate: Array
) -> Complex[Array, "lines k"]:
    """Lines of the basis.

    Args:
        kind: 0 between two ends, 1 a sensor, 2 an input.
        spectra: of the record.
        pair: the place's signals.
        size: over all records.
        rate: of the model's slowest vibration, rad/s.
    """
    tiny = jnp.finfo(rate.dtype).tiny
    most, rms = jnp.maximum(size.most, tiny), jnp.maximum(size.rms, tiny)
    return lax.cond(kind == 0, _of_motion, _of_signal, spectra, pair, most, rms, rate)


def _hats(x: Array, most: Array) -> Array:
    grid = jnp.asarray(KNOTS, x.dtype)
    x = jnp.clip(x / most, -1, 1)[:, None]
    left = jnp.concatenate([grid[:1] - 1, grid[:-1]])
    right = jnp.concatenate([grid[1:], grid[-1:] + 1])
    return jnp.maximum(jnp.minimum((x - left) / (grid - left), (right - x) / (right - grid)), 0.0)


def _of_motion(spectra: Spectra, pair: Array, most: Array, rms: Array, rate: Array) -> Array:
    d, v = in_time(spectra, pair).T
    a, b, t = d / rms[0], v / rms[1], jnp.linspace(0.0, 1.0, spectra.samples, dtype=most.dtype)
    mixed = [a * b, a * a * b, a * b * b, a * jnp.abs(b), jnp.abs(a) * b, a**3 * b, t, a * t, b * t]
    columns = [jnp.tanh(b / w) for w in STEPS] + mixed
    widths = jnp.asarray(PLAYS, most.dtype)

    def follow(p: Array, x: Array) -> tuple[Array, Array]:
        moved = jnp.clip(p, x - widths, x + widths)
        return moved, moved

    _, plays = lax.scan(follow, jnp.zeros_like(widths), a)
    return to_lines(
        spectra,
        jnp.concatenate([_hats(d, most[0]), _hats(v, most[1]), jnp.stack(columns, axis=1), plays], axis=1),
    )


def _of_signal(spectra: Spectra, pair: Array, most: Array, rms: Array, rate: Array) -> Array:
    """Of a sensor's ideal reading or an input; nothing follows what the signal has yet to do.

    A controller feeds noise back, so that the inputs to come are made of what is left now, as those before are not.
    """
    s = in_time(spectra, pair[:, :1])[:, 0]
    ago = jnp.exp(-1j * spectra.omega * spectra.dt)[:, None]
    keeps = jnp.exp(-spectra.dt * rate / jnp.asarray(LAGS, most.dtype))
    lagged = (1 - keeps) / (1 - keeps * ago) - 1
    steps = jnp.asarray(LATE, most.dtype) / (rate * spectra.dt)
    late = ago ** jnp.floor(steps) * (1 + (steps - jnp.floor(steps)) * (ago - 1)) - 1
    change = (1 - ago) / (rate * spectra.dt)
    moved = pair[:, :1] / rms[0] * jnp.concatenate([lagged, late, change], axis=1)
    both = jnp.concatenate([_hats(s, most[0]), jnp.zeros((len(s), HATS), s.dtype)], axis=1)
    known = jnp.concatenate([to_lines(spectra, both), moved], axis=1)
    return jnp.pad(known, ((0, 0), (0, MOST - known.shape[1])))
