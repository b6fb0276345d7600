"""What is left of a record after a fit: is it white, and has it to do with the inputs?"""

import numpy as np
from jaxtyping import Float

from jaxsid.records import Residuals, as_array

LAGS = 200  # of the correlations of what is left, at most
SMOOTHED = 33  # lines over which the spectrum of what is left is averaged before it is made white
ONE_PERCENT = 2.576  # standard deviations that chance exceeds once in a hundred times, either side


def correlations(
    error: Float[np.ndarray, "samples outputs"], u: Float[np.ndarray, "samples inputs"], dt: float
) -> Residuals:
    """Correlations of what is left with itself and with the inputs, and what chance exceeds once in a hundred times.

    What is left is made white before it is compared with the inputs. Otherwise a resonance in it, whose few lines say
    little of chance, would hide what the inputs do at all other frequencies.

    Args:
        error: what is left; NaN in the columns of absent sensors.
        u: inputs.
        dt: sampling interval, s.

    Source: L. Ljung, System Identification, 2nd ed., 1999, section 16.6.
    """
    samples, lags = len(error), min(LAGS, len(error) // 4)
    seen = np.isfinite(error).all(axis=0)
    error = np.where(seen, error, 0.0)
    error = error - error.mean(axis=0)
    u = u - u.mean(axis=0)
    size = 2 * samples
    error = error / np.maximum(error.std(axis=0), np.finfo(float).tiny)
    u = u / np.maximum(u.std(axis=0), np.finfo(float).tiny)
    E, U = np.fft.rfft(error, size, axis=0), np.fft.rfft(u, size, axis=0)
    W = _white(E, samples)
    own, flat, driving = (np.fft.irfft(np.abs(x) ** 2, size, axis=0) / samples for x in (E, W, U))
    both = np.fft.irfft(W[:, :, None] * U.conj()[:, None, :], size, axis=0) / samples
    # the variance of a cross-correlation of independent signals: the sum of the products of their autocorrelations
    spread = np.sqrt(np.maximum((flat[:, :, None] * driving[:, None, :]).sum(axis=0), 0.0) / samples)
    absent = np.where(seen, 1.0, np.nan)
    return Residuals(
        lags=as_array(dt * np.arange(lags + 1)),
        autocorrelation=as_array(own[: lags + 1] * absent),
        white_limit=float(ONE_PERCENT / np.sqrt(samples)),
        cross_lags=as_array(dt * np.arange(-lags, lags + 1)),
        cross_correlation=as_array(np.concatenate([both[size - lags :], both[: lags + 1]]) * absent[:, None]),
        cross_limit=as_array(ONE_PERCENT * spread * absent[:, None]),
    )


def _white(E: np.ndarray, samples: int) -> np.ndarray:
    """The spectrum with a smoothed magnitude of one at all lines, of a signal with unit variance."""
    total = np.cumsum(np.pad(np.abs(E) ** 2, ((1, 0), (0, 0))), axis=0)
    first = np.maximum(np.arange(len(E)) - SMOOTHED // 2, 0)
    last = np.minimum(first + SMOOTHED, len(E))
    level = (total[last] - total[first]) / (last - first)[:, None]
    return E * np.sqrt(samples / np.where(level > 0, level, np.inf))
