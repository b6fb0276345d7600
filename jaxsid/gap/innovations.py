"""Is what a linear model leaves noise of each sensor's own, and the same throughout? Tests of it made white, in time.

Noise of any colour, made white sensor by sensor, leaves values e_t that neither those of another sensor nor the time
tell anything of. A force that the model lacks moves several sensors at once; one that acts at times, or with the
motion, leaves more at some times than at others.
"""

from collections.abc import Sequence

import numpy as np
from jax.scipy.special import gammaincc
from jaxtyping import Float

from jaxsid.gap.recalibrate import Linear
from jaxsid.gap.setting import Setting
from jaxsid.gap.spectra import in_time

LAGS = 8  # samples by which one sensor may follow another, either way
PARTS = 16  # of a record, whose powers are compared
GAUSSIAN = 2.0  # variance of the square of a normal value of variance one


def innovations(setting: Setting, linear: Linear) -> Float[np.ndarray, "samples sensors"]:
    """What is left of a record, made white by the level of the noise at each line, of unit variance.

    Args:
        setting: its scale is one over that level.
        linear: the model beside the record.
    """
    white = np.asarray(in_time(setting.spectra, linear.left * setting.scale))
    white = white[:, np.asarray(setting.spectra.present) > 0]
    size = white.std(axis=0)
    return white / np.where(size > 0, size, 1.0)


def coherence(records: Sequence[np.ndarray]) -> tuple[float, float]:
    """Whether sensors have something in common: probability by chance, and the part of their power that it has.

    samples sum_l c_ij(l)^2, with c_ij(l) = mean_t e_i(t + l) e_j(t), follows a chi-squared law of 2 LAGS + 1 degrees.

    Args:
        records: (samples, sensors) innovations of each.

    Source: L. D. Haugh, J. Am. Stat. Assoc. 71 (1976).
    """
    total, degrees, shared = 0.0, 0, 0.0
    for e in records:
        lines = np.fft.rfft(e, axis=0)
        for i in range(e.shape[1]):
            for j in range(i):
                c = np.fft.irfft(lines[:, i] * lines[:, j].conj(), len(e)) / len(e)
                squares = float((c[np.arange(-LAGS, LAGS + 1)] ** 2).sum())
                total, degrees = total + len(e) * squares, degrees + 2 * LAGS + 1
                shared = max(shared, np.sqrt(max(squares - (2 * LAGS + 1) / len(e), 0.0)))
    return _chance(total, degrees), min(shared, 1.0)


def unsteadiness(records: Sequence[np.ndarray]) -> tuple[float, float]:
    """Whether there is more at some times than at others: probability by chance, and the part of all power that it is.

    sum_b n_b (mean_b e^2 - 1)^2 / var(e^2) over parts b of n_b samples follows a chi-squared law of PARTS - 1 degrees;
    the variance is the one found, so that noise with outliers throughout is steady.

    Args:
        records: (samples, sensors) innovations of each.

    Source: H. Levene, Contributions to Probability and Statistics (1960).
    """
    total, degrees, more = 0.0, 0, 0.0
    for e in records:
        power = e**2
        spread = np.maximum(power.var(axis=0), GAUSSIAN)
        parts = [x.mean(axis=0) - power.mean(axis=0) for x in np.array_split(power, PARTS)]
        counts = [len(x) for x in np.array_split(power, PARTS)]
        each = sum(n * x**2 for n, x in zip(counts, parts, strict=True))
        total, degrees = total + float((each / spread).sum()), degrees + (PARTS - 1) * e.shape[1]
        above = np.mean(np.maximum(parts, 0.0), axis=0)
        more = max(more, float(above.max(initial=0.0)))
    return _chance(total, degrees), min(more, 1.0)


def _chance(total: float, degrees: int) -> float:
    """Of a sum of squares as large."""
    return float(gammaincc(degrees / 2, total / 2)) if degrees else 1.0
