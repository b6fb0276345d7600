"""Test signals, as NumPy vectors of samples."""

import numpy as np
from jaxtyping import Float

from jaxsid.checks import require


def chirp(
    start: float,
    stop: float,
    *,
    duration: float,
    dt: float,
    samples: int | None = None,
    amplitude: float = 1.0,
) -> Float[np.ndarray, " samples"]:
    """A sine whose frequency rises linearly: u(t) = a sin(2 pi (f0 t + (f1 - f0) t^2 / (2 T))).

    Args:
        start, stop: f0 and f1, Hz.
        duration: T in which the frequency goes from f0 to f1, s.
        dt: sampling interval, s.
        samples: how many, from t = 0; by default as many as the duration holds.
        amplitude: a.

    Raises:
        InputError: a frequency above half the sampling rate, a time that is not positive.
    """
    _check_band(start, stop, dt)
    require(duration > 0, f"chirp: the duration must be positive, not {duration} s.")
    t = np.arange(round(duration / dt) if samples is None else samples) * dt
    return amplitude * np.sin(2 * np.pi * (start * t + (stop - start) * t**2 / (2 * duration)))


def stepped_sine(
    start: float,
    stop: float,
    *,
    step: float,
    cycles: int,
    dt: float,
    amplitude: float = 1.0,
    rest: int = 0,
) -> Float[np.ndarray, " samples"]:
    """Whole periods of one frequency after the other, without a jump: u(t) = a sin(2 pi f_i (t - t_i)).

    A step begins where the last one ends, t_(i+1) = t_i + cycles / f_i, whether or not a sample falls there.

    Args:
        start, stop: first and last frequency, Hz.
        step: between frequencies, Hz.
        cycles: periods of each frequency.
        dt: sampling interval, s.
        amplitude: a.
        rest: samples of zero before the first step.

    Raises:
        InputError: a frequency above half the sampling rate, no step or no cycle.
    """
    _check_band(start, stop, dt)
    require(step > 0 and cycles > 0, f"stepped_sine: step {step} Hz and cycles {cycles} must be positive.")
    frequencies = start + step * np.arange(int((stop - start) / step + 1e-9) + 1)
    ends = np.cumsum(cycles / frequencies)
    t = np.arange(int(np.ceil(ends[-1] / dt))) * dt
    segment = np.minimum(np.searchsorted(ends, t, side="right"), len(ends) - 1)
    since = t - (ends - cycles / frequencies)[segment]
    return np.concatenate([np.zeros(rest), amplitude * np.sin(2 * np.pi * frequencies[segment] * since)])


def _check_band(start: float, stop: float, dt: float) -> None:
    require(dt > 0, f"the sampling interval must be positive, not {dt} s.")
    require(
        0 < start <= stop < 0.5 / dt,
        f"the band {start:g} to {stop:g} Hz must lie between 0 and half the sampling rate, {0.5 / dt:g} Hz.",
    )
