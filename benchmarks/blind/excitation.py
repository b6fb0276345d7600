"""Forces that drive a system: random, multisine, chirp, stepped sine, and the reference of a closed loop."""

import numpy as np
import scipy.signal
from scipy.signal.windows import tukey

KINDS = ("random", "multisine", "chirp", "stepped_sine", "closed_loop")
RAMP = 0.05  # of a step of the stepped sine, in which its amplitude fades


def drawn(
    kind: str, rng: np.random.Generator, samples: int, dt: float, band: tuple[float, float]
) -> np.ndarray:
    """A signal of unit rms.

    Args:
        kind: one of `KINDS`.
        rng: draws phases, samples, steps.
        samples: its length; that of whole periods is that of `period_of`.
        dt: s.
        band: lowest and highest frequency, Hz.
    """
    low, high = band[0], min(band[1], 0.45 / dt)
    if kind in ("random", "closed_loop"):
        sos = scipy.signal.butter(3, [2 * low * dt, 2 * high * dt], "bandpass", output="sos")
        u = np.asarray(scipy.signal.sosfilt(sos, rng.standard_normal(samples + 2000)))[2000:]
    elif kind == "multisine":
        u = _multisine(rng, samples, dt, low, high)
    elif kind == "chirp":
        t = np.arange(samples) * dt
        ends = (low, high) if rng.random() < 0.7 else (high, low)
        way = "linear" if rng.random() < 0.5 else "logarithmic"
        u = scipy.signal.chirp(t, ends[0], t[-1], ends[1], method=way, phi=int(rng.integers(360)))
    else:
        u = _stepped(rng, samples, dt, low, high)
    return u / u.std()


def _multisine(rng: np.random.Generator, samples: int, dt: float, low: float, high: float) -> np.ndarray:
    """Four to eight periods of random phases, all lines or the odd ones."""
    period = samples // int(rng.integers(4, 9))
    f = np.fft.rfftfreq(period, dt)
    lines = np.where((f >= low) & (f <= high), np.exp(2j * np.pi * rng.random(len(f))), 0)
    if rng.random() < 0.5:
        lines[::2] = 0
    return np.resize(np.fft.irfft(lines, period), samples)


def _stepped(rng: np.random.Generator, samples: int, dt: float, low: float, high: float) -> np.ndarray:
    """A dozen frequencies in turn, each for as many samples."""
    count = 12
    edges = np.linspace(0, samples, count + 1).astype(int)
    frequencies = np.geomspace(low, high, count) * rng.uniform(0.97, 1.03, count)
    u = np.zeros(samples)
    for a, b, f in zip(edges, edges[1:], frequencies, strict=False):
        fade = tukey(b - a, 2 * RAMP)
        u[a:b] = fade * np.sin(2 * np.pi * f * np.arange(b - a) * dt)
    return u
