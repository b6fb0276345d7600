"""Noise of measured inputs: what a model makes of it is left, common to all sensors and with the peaks of the model.

A recorded input u + n drives the model with n too, so that it leaves r = e - H n, with e each sensor's own. Where that
is all, lines of r have the covariance R = H s H' + diag(own), with s the powers of n. Powers are found by the largest
likelihood: those of what is expected of n and of e, given r, are what to expect them from, again and again.

Sources: R. Pintelon and J. Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., ch. 8; D. B. Rubin
and D. T. Thayer, EM algorithms for ML factor analysis, Psychometrika 47 (1982).
"""

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float
from scipy.optimize import nnls

from jaxsid.gap.recalibrate import Linear
from jaxsid.gap.setting import Setting
from jaxsid.gap.spectra import parameter_columns, stacked
from jaxsid.impulse.lines import line_level

ROUNDS = 30  # of expecting and finding
WEIGHED = 4  # rounds of weighing, before that
PARTS = 8  # of the lines, each with a power of its own where they tell it
LEAST = 1e-4  # part of a sensor's power that is its own at least
DEPENDENT = 1e-9  # size of combinations of columns, next to the largest, that are nothing
SEEN, CERTAIN = 1.5, 3.0  # standard deviations from which on noise of inputs is allowed for, and is told
LARGEST = 0.02  # rms next to the input's beyond which it is no noise of a sensor but something that acts


class InputNoise(NamedTuple):
    """Noise of one record's inputs, beside that of each sensor, in units of what is left at each line.

    Attributes:
        power: (lines, inputs) variance of the inputs' lines.
        own: (lines, outputs) of each sensor's own noise, next to all that is left.
        relative: (inputs,) rms next to that of the input; infinite for noise of an input that is zero.
        share: (outputs,) rms of what the model makes of it, next to that of what it leaves.
        seen: of the input that sensors tell most of, the power of white noise in its standard deviations.
    """

    power: Float[np.ndarray, "lines inputs"]
    own: Float[np.ndarray, "lines outputs"]
    relative: Float[np.ndarray, " inputs"]
    share: Float[np.ndarray, " outputs"]
    seen: float

    @property
    def plausible(self) -> bool:
        """Whether it is no more than what sensors of inputs may have."""
        return bool((self.relative <= LARGEST).all())


def input_noise(setting: Setting, linear: Linear, start: InputNoise | None = None) -> InputNoise:
    """The noise of inputs, and each sensor's own, that best give what is left; none where sensors hardly tell of it.

    Args:
        setting: its scale is one over the level of what is left at each line.
        linear: the model beside the record.
        start: what was found before the model was fitted anew beside it.
    """
    scale = np.asarray(setting.scale)
    left, driven = np.asarray(linear.left) * scale, np.asarray(setting.spectra.driven) * scale[:, :, None]
    parts = np.array_split(np.arange(len(left)), PARTS)
    if start is None:
        white, seen = _white(left, driven, scale)
        power = np.broadcast_to(white * (seen > SEEN), (len(left), len(white))).copy()
        own = np.maximum(1 - _around(made(driven, power)), LEAST)
    else:
        power, own, seen = start.power.copy(), start.own, start.seen
    for _ in range(ROUNDS if power.any() else 0):
        gain = (driven * power[:, None, :]).conj().transpose(0, 2, 1) @ np.linalg.inv(
            _covariance(driven, power, own)
        )
        expected = np.einsum("lip,lp->li", gain, left)
        spread = np.eye(driven.shape[2]) * power[:, None, :] - gain @ driven * power[:, None, :]
        found = np.abs(expected) ** 2 + np.einsum("lii->li", spread).real
        rest = np.abs(left - np.einsum("lpi,li->lp", driven, expected)) ** 2
        rest = rest + np.einsum("lpi,lij,lpj->lp", driven, spread, driven.conj()).real
        own = np.maximum(_around(rest), LEAST)
        for part in parts:
            power[part] = found[part].mean(axis=0)
    return InputNoise(power, own, _relative(setting, power), _share(setting, left, made(driven, power)), seen)


def whitening(setting: Setting, noise: InputNoise) -> Complex[np.ndarray, "lines outputs outputs"]:
    """Root of the inverse of the covariance of what is left: what it makes of that is white and of each sensor alone.

    Args:
        setting: as of `input_noise`.
        noise: of the inputs, and each sensor's own.
    """
    scale = np.asarray(setting.scale)
    driven = np.asarray(setting.spectra.driven) * scale[:, :, None]
    values, vectors = np.linalg.eigh(_covariance(driven, noise.power, noise.own))
    return np.asarray(
        np.einsum("lpk,lqk->lpq", vectors / np.sqrt(values)[:, None, :], vectors.conj() * scale[:, :, None])
    )


def refitted(
    settings: Sequence[Setting], linear: Sequence[Linear], noises: Sequence[InputNoise]
) -> tuple[Linear, ...]:
    """Elements and states at the start fitted anew, as noise of the inputs asks for: what that leaves.

    Fitted as if noise were each sensor's own they are off by far more than sensors may be that are quieter than the
    inputs' noise.

    Args:
        settings: of each record, as of `input_noise`.
        linear: the model beside them.
        noises: of the inputs.
    """
    parts = [_columns(*x) for x in zip(settings, linear, noises, strict=True)]
    reduced = []
    for slopes, free, left in parts:
        state = np.linalg.lstsq(free, np.column_stack([slopes, left]), rcond=DEPENDENT)[0]
        reduced.append(np.column_stack([slopes, left]) - free @ state)
    every = np.concatenate(reduced)
    change = np.linalg.lstsq(every[:, :-1], every[:, -1], rcond=DEPENDENT)[0]
    found = []
    for setting, x, (slopes, free, left) in zip(settings, linear, parts, strict=True):
        state = np.linalg.lstsq(free, left - slopes @ change, rcond=DEPENDENT)[0]
        moved = parameter_columns(setting.spectra, x.motion, setting.directions) @ change
        moved += setting.spectra.free @ (setting.transient * state)
        found.append(eqx.tree_at(lambda x: x.left, x, x.left - moved))
    return tuple(found)


def _columns(setting: Setting, linear: Linear, noise: InputNoise) -> list[np.ndarray]:
    """What changes of elements and of the state do, and what is left, in rows of white noise."""
    white = jnp.asarray(whitening(setting, noise))
    slopes = parameter_columns(setting.spectra, linear.motion, setting.directions)
    free = setting.spectra.free * setting.transient
    rows = [np.asarray(stacked(white @ x)) for x in (slopes, free, linear.left[:, :, None])]
    return [*rows[:2], rows[2][:, 0]]


def _white(left: np.ndarray, driven: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, float]:
    """Powers (inputs,) of white noise that best give products of sensors, and the largest in its standard deviations.

    Those of two sensors, which their own noise does not enter; of one alone the square, next to what is around it: its
    own noise is smooth there, while what noise of the inputs makes has the peaks and dips of the model. Products are
    weighed by the powers that those found before give.
    """
    present, inputs = np.flatnonzero(left.any(axis=0)), driven.shape[2]
    alone = len(present) == 1
    pairs = [(present[0], present[0])] if alone else list(combinations(present, 2))
    found, seen = np.zeros(inputs), 0.0
    if not pairs:
        return found, seen
    a, b = np.array(pairs).T
    columns, common = driven[:, a] * driven[:, b].conj(), left[:, a] * left[:, b].conj()
    if alone:
        columns = columns - _beside(np.abs(columns[:, 0]), scale[:, a])[:, None]
        common = common - _beside(np.abs(common), scale[:, a])
    # products of white lines have a variance of one; real and imaginary parts of those of two sensors have half of it
    variance = 1.0 if alone else 0.5
    for _ in range(WEIGHED):
        of = made(driven, np.broadcast_to(found, (len(left), inputs)))
        power = np.maximum(1 - _around(of), LEAST) + of
        weight = 1 / np.sqrt(power[:, a] * power[:, b])
        flat, target = (columns * weight[:, :, None]).reshape(-1, inputs), (common * weight).ravel()
        rows = np.concatenate([flat.real, flat.imag])
        size = np.linalg.norm(rows, axis=0)
        rows, size = rows / np.where(size > 0, size, 1.0), np.where(size > 0, size, np.inf)
        scaled = nnls(rows, np.concatenate([target.real, target.imag]))[0]
        each = np.maximum(np.diag(np.linalg.pinv(rows.T @ rows)), 1.0)
        seen = float((scaled / np.sqrt(variance * each)).max())
        found = scaled / size
    return found, seen


def made(driven: np.ndarray, power: np.ndarray) -> np.ndarray:
    """Power of each sensor that noise of the inputs gives, (lines, outputs).

    Args:
        driven: (lines, outputs, inputs) from the inputs.
        power: (lines, inputs) of the noise.
    """
    return np.asarray(np.einsum("lpi,li->lp", np.abs(driven) ** 2, power))


def _covariance(driven: np.ndarray, power: np.ndarray, own: np.ndarray) -> np.ndarray:
    columns = driven * np.sqrt(power)[:, None, :]
    return np.einsum("lpi,lqi->lpq", columns, columns.conj()) + own[:, :, None] * np.eye(own.shape[1])


def _around(power: np.ndarray) -> np.ndarray:
    """Mean of powers over neighbouring lines."""
    return np.asarray(line_level(jnp.sqrt(power) + 0j, jnp.ones(power.shape))) ** 2


def _beside(power: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Likewise, without the scale, whose own chance both sides of an equation would have in common."""
    return _around(np.divide(power, scale**2, out=np.zeros_like(power), where=scale > 0)) * scale**2


def _relative(setting: Setting, power: np.ndarray) -> np.ndarray:
    size = np.sqrt((np.abs(np.asarray(setting.spectra.u)) ** 2).mean(axis=0))
    some = np.where(power.any(axis=0), np.inf, 0.0)
    return np.divide(np.sqrt(power.mean(axis=0)), size, out=some, where=size > 0)


def _share(setting: Setting, left: np.ndarray, made: np.ndarray) -> np.ndarray:
    scale = np.asarray(setting.scale)
    level = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0)
    part, whole = (level**2 * made).sum(axis=0), (level**2 * np.abs(left) ** 2).sum(axis=0)
    return np.sqrt(np.divide(part, whole, out=np.zeros_like(whole), where=whole > 0))
