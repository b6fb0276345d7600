"""Is what a linear model leaves noise of each sensor's own, and the same throughout? Tests of it made white, in time.

Noise of any colour, made white sensor by sensor, leaves values e_t that neither those of another sensor nor the time
tell anything of. A force that the model lacks moves several sensors at once; one that acts at times, or with the
motion, leaves more at some times than at others.
"""

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaincc
from jaxtyping import Float

from jaxsid.gap.input_noise import InputNoise, whitening
from jaxsid.gap.recalibrate import Linear
from jaxsid.gap.setting import Setting
from jaxsid.gap.spectra import in_time
from jaxsid.impulse.lines import line_level

LAGS = 8  # samples by which one sensor may follow another, either way
PARTS = 16  # of a record, whose powers are compared
GAUSSIAN = 2.0  # variance of the square of a normal value of variance one


class Oddity(NamedTuple):
    """What noise of each sensor's own, the same throughout, does not have.

    Attributes:
        p_value: probability of as much by chance, in all sensors together.
        part: of the power of what is left, in those that have most of it; what chance gives is taken off.
        sensors: their numbers.
    """

    p_value: float
    part: float
    sensors: tuple[int, ...]


def innovations(
    setting: Setting, linear: Linear, noise: InputNoise | None = None
) -> Float[np.ndarray, "samples outputs"]:
    """What is left of a record, made white by the level of the noise at each line, of unit variance.

    Args:
        setting: its scale is one over that level.
        linear: the model beside the record.
        noise: of the inputs, which is made white too and no longer common to sensors.

    Returns:
        Zeros for absent sensors.
    """
    lines = linear.left * setting.scale
    if noise is not None:
        lines = jnp.asarray(whitening(setting, noise)) @ linear.left[:, :, None]
        lines = lines[:, :, 0] / line_level(lines[:, :, 0], (setting.scale > 0) * 1.0)
    white = np.asarray(in_time(setting.spectra, lines))
    size = white.std(axis=0)
    present = (np.asarray(setting.spectra.present) > 0) & (size > 0)
    return np.where(present, white / np.where(present, size, 1.0), 0.0)


def coherence(records: Sequence[np.ndarray]) -> Oddity:
    """Whether sensors have something in common, and the part of the powers of the two that have most.

    samples sum_l c_ij(l)^2, with c_ij(l) = mean_t e_i(t + l) e_j(t), follows a chi-squared law of 2 LAGS + 1 degrees.

    Args:
        records: (samples, outputs) innovations of each.

    Source: L. D. Haugh, J. Am. Stat. Assoc. 71 (1976).
    """
    total, degrees, worst, most = 0.0, 0, 0.0, Oddity(1.0, 0.0, ())
    for e in records:
        lines = np.fft.rfft(e, axis=0)
        for i, j in combinations(np.flatnonzero(e.any(axis=0)).tolist(), 2):
            c = np.fft.irfft(lines[:, i] * lines[:, j].conj(), len(e)) / len(e)
            squares = len(e) * float((c[np.arange(-LAGS, LAGS + 1)] ** 2).sum())
            total, degrees = total + squares, degrees + 2 * LAGS + 1
            if squares > worst:
                part = np.sqrt(max(squares - 2 * LAGS - 1, 0.0) / len(e))
                worst, most = squares, Oddity(1.0, min(float(part), 1.0), (i, j))
    return most._replace(p_value=_chance(total, degrees))


def unsteadiness(records: Sequence[np.ndarray]) -> Oddity:
    """Whether there is more at some times than at others, and the part of the sensor's power that comes and goes.

    sum_b n_b (mean_b e^2 - 1)^2 / var(e^2) over parts b of n_b samples follows a chi-squared law of PARTS - 1 degrees;
    the variance is the one found, so that noise with outliers throughout is steady.

    Args:
        records: (samples, outputs) innovations of each.

    Source: H. Levene, Contributions to Probability and Statistics (1960).
    """
    total, degrees, worst, most = 0.0, 0, 0.0, Oddity(1.0, 0.0, ())
    for e in records:
        for j in np.flatnonzero(e.any(axis=0)).tolist():
            power = e[:, j] ** 2
            spread = max(float(power.var()), GAUSSIAN)
            parts = np.array_split(power, PARTS)
            squares = sum(len(x) * float(x.mean() - power.mean()) ** 2 for x in parts) / spread
            total, degrees = total + squares, degrees + PARTS - 1
            if squares > worst:
                part = np.sqrt(max(squares - PARTS + 1, 0.0) * spread / len(e))
                worst, most = squares, Oddity(1.0, min(float(part), 1.0), (j,))
    return most._replace(p_value=_chance(total, degrees))


def _chance(total: float, degrees: int) -> float:
    """Of a sum of squares as large."""
    return float(gammaincc(degrees / 2, total / 2)) if degrees else 1.0
