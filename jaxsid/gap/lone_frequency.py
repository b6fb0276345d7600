"""Whether one frequency of what a model leaves holds more, next to those around it, than chance gives to any.

Of one record that is an F test of 2 degrees; of several that of Fisher, as what disturbs a body does so in each, and
noise of one has nothing to do with that of another. Lines are those of Hann's window, so that a frequency between two
of them has no skirts; of those around it the nearest are left out, and of the others every second, which share nothing.
It must stand out from either side.

Source: R. A. Fisher, Statistical Methods for Research Workers, 4th ed., 1932, for several records.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Complex, Float
from scipy.stats import gamma

from jaxsid.gap.setting import Setting

GUARD, AROUND = 4, 18  # lines from a lone one that it is compared with, from and to
APART = np.arange(-AROUND, AROUND + 1)
LEAST = 1e-12  # of a line's power, that those around it have: rounding
HALF = 0.5  # of all that is left, from which on a line holds most of it


def lone_frequency(
    settings: Sequence[Setting],
    left: Sequence[Complex[np.ndarray, "_ outputs"]],
    sizes: Sequence[Float[np.ndarray, "_ outputs"] | float],
) -> tuple[float, float]:
    """Probability by chance of a frequency that stands out so in a record or in all, and its part of all that is left.

    Args:
        settings: of each record.
        left: (lines, outputs) of each, what the model leaves.
        sizes: rms of all noise next to the sensors' own, of each record.
    """
    every = [_alone(*x) for x in zip(settings, left, sizes, strict=True)]
    told = [np.asarray(s.spectra.present) > 0 for s in settings]
    alone, part = (
        np.concatenate([x[i][:, seen].ravel() for x, seen in zip(every, told, strict=True)]) for i in (0, 1)
    )
    p, found = _least(alone), float(part[alone.argmin()])
    if len(every) > 1:
        together, share = _in_all(settings, every)
        p, found = min((2 * p, found), (2 * _least(together), share))
    return min(p, 1.0), found


def _alone(
    setting: Setting, every_left: Complex[np.ndarray, "lines outputs"], size: np.ndarray | float
) -> tuple[Float[np.ndarray, "lines outputs"], Float[np.ndarray, "lines outputs"]]:
    """Probability of as much in each line of a record, by chance, and the part of all that is left that it holds.

    Noise may have taken a lone frequency for its colour, which then hides in skirts as wide as the colour has. What
    holds most of all that is left is asked as it is, unless a mode of the model rings there as long as the record.
    """
    used, present = np.asarray(setting.spectra.weight) == 1, np.asarray(setting.spectra.present) > 0
    left = every_left[used][:, present]
    whole = np.maximum((np.abs(left) ** 2).sum(axis=0), np.finfo(float).tiny)
    part = _sums(np.abs(left[1:-1]) ** 2, np.ones(2 * GUARD - 1)) / whole
    alone = _standing_out(left * (np.asarray(setting.scale) / size)[used][:, present])
    most = (part > HALF) & ~_ringing(setting)[used][1:-1, None]
    alone = np.where(most, np.minimum(alone, _standing_out(left)), alone)
    every = np.ones((len(used), len(present))), np.zeros((len(used), len(present)))
    inside = np.ix_(np.flatnonzero(used)[1:-1], np.flatnonzero(present))
    for values, own in zip(every, (alone, part), strict=True):
        values[inside] = own
    return every


def _standing_out(lines: Complex[np.ndarray, "lines outputs"]) -> Float[np.ndarray, "inner outputs"]:
    """F test of each line but the outermost against those on either side: the edge of what is strong is no lone one."""
    below = ((APART >= GUARD) & (APART % 2 == GUARD % 2)).astype(float)
    power = np.abs(lines[1:-1] - (lines[:-2] + lines[2:]) / 2) ** 2
    sides = [[_sums(x, side) for x in (power, np.ones_like(power))] for side in (below, below[::-1])]
    pairs = [(np.where(n > 0, np.maximum(x, LEAST * power), np.inf), n) for x, n in sides]
    return np.maximum(*((1 + power / np.maximum(x, np.finfo(float).tiny)) ** -n for x, n in pairs))


def _ringing(setting: Setting) -> Bool[np.ndarray, " lines"]:
    """Lines about modes of the model that fade so slowly that noise which shakes them is as narrow as a lone one."""
    linear, inverse = setting.spectra.linear, np.asarray(setting.spectra.inverse_mass)
    count = len(inverse)
    below = np.hstack([-inverse @ np.asarray(linear.stiffness), -inverse @ np.asarray(linear.damping)])
    poles = np.linalg.eigvals(np.vstack([np.eye(count, 2 * count, count), below]))
    omega = np.asarray(setting.spectra.omega)
    reach = GUARD * omega[1]
    poles = poles[np.abs(poles.real) < reach]
    return (np.abs(omega[:, None] - np.abs(poles.imag)) < reach + np.abs(poles.real)).any(axis=1)


def _in_all(
    settings: Sequence[Setting], every: Sequence[tuple[np.ndarray, np.ndarray]]
) -> tuple[Float[np.ndarray, " n"], float]:
    """Probability of as much at the lines of the longest record in all that have a sensor, and the part of the least.

    Lines of the others are those nearest in frequency.
    """
    grids = [np.asarray(s.spectra.omega) for s in settings]
    long = int(np.argmax([len(x) for x in grids]))
    rows = [np.minimum(np.rint(grids[long] / grid[1]).astype(int), len(grid) - 1) for grid in grids]
    seen = np.array([np.asarray(s.spectra.present) > 0 for s in settings]).sum(axis=0)
    tiny = np.finfo(float).tiny
    total = -np.sum(
        [np.log(np.maximum(p[row], tiny)) for (p, _), row in zip(every, rows, strict=True)], axis=0
    )
    p = gamma.sf(total, np.maximum(seen, 1))[:, seen > 1]
    if not p.size:
        return np.ones(1), 0.0
    return p.ravel(), float(every[long][1][:, seen > 1].ravel()[p.argmin()])


def _least(p: Float[np.ndarray, " n"]) -> float:
    """Probability that the least of so many is as small by chance."""
    return float(-np.expm1(len(p) * np.log1p(-min(p.min(), 0.5))))


def _sums(x: np.ndarray, around: np.ndarray) -> np.ndarray:
    """Of every column, about each row, as far as there are rows."""
    half = len(around) // 2
    return np.stack([np.convolve(c, around)[half : half + len(c)] for c in x.T], axis=1)
