"""The discrete Fourier transform of records, cut to the band that their inputs excite.

For a record of any length the transforms of input and output obey, exactly and without a window,
Y(z) = G(z) U(z) + T(z), with z = exp(j w dt) and T the transform of the free response to the state at the
record's start less that at its end; T has the poles of G. Working with such lines needs no decimation and
no anti-alias filter, and an unexcited band leaves no trace.

Source: R. Pintelon and J. Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., ch. 6.
"""

from collections.abc import Sequence
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jaxsid.checks import (
    InsufficientDataError,
    check_excitation,
    check_record,
    check_sensors,
    is_concrete,
    require,
)
from jaxsid.compilation import compiled
from jaxsid.records import Record

# Excited means: smoothed input power within this ratio of its largest value.
EXCITED = 1 / 400
FEWEST_LINES = 12  # with power; a tone has up to six
NEIGHBOURS = 24  # lines on either side over which a level is averaged
# By how much variances grow as weights are such levels and not the truth: J. Schoukens, R. Pintelon, G. Vandersteen and
# P. Guillaume, Automatica 33 (1997), for as many averages.
NOISE_LOSS = ((2 * NEIGHBOURS) / (2 * NEIGHBOURS - 1)) ** 2
# The band is spread over this part of the circle of the Laguerre shift, so that regressions in it are well posed.
BAND_ANGLE = 0.8 * np.pi
Points = TypeVar("Points", Array, np.ndarray)


class Lines(eqx.Module):
    """In-band Fourier lines of one or more records, stacked.

    Attributes:
        z: (lines,) point of each line on the unit circle, exp(j w dt) with the common dt; for hold "band" the
            bilinear map of j w.
        omega: (lines,) rad/s.
        u: (lines, inputs), scaled by 1/sqrt(samples).
        y: (lines, outputs), likewise; 0 where the output was absent from the record.
        weight: (lines, outputs) 1 where measured, 0 where absent or padding.
        record: (lines, records) one-hot, which record a line belongs to.
        dt: common sampling interval, s: that of the longest record.
        record_dt: sampling interval of each record, s.
        samples: number of samples of each record.
        band: (2,) Hz.
        hold: of the inputs.
    """

    z: Complex[Array, " lines"]
    omega: Float[Array, " lines"]
    u: Complex[Array, "lines inputs"]
    y: Complex[Array, "lines outputs"]
    weight: Float[Array, "lines outputs"]
    record: Float[Array, "lines records"]
    dt: Float[Array, ""]
    record_dt: tuple[float, ...] = eqx.field(static=True)
    samples: tuple[int, ...] = eqx.field(static=True)
    band: Float[Array, " 2"]
    hold: tuple[str, ...] = eqx.field(static=True)

    @property
    def pole(self) -> Float[Array, ""]:
        """The Laguerre pole for this band; an array, since a plain number would compile anew for every band."""
        return jax.device_put(np.asarray(laguerre_pole(float(np.asarray(self.band)[1]), float(self.dt))))


def laguerre_shift(z: Points, pole: Array | float) -> Points:
    """The Laguerre shift w = (z - a) / (1 - a z) at points z of the unit circle."""
    return (z - pole) / (1 - pole * z)


def laguerre_pole(band_end: float, dt: float) -> float:
    """The pole a in [0, 1) that spreads 0 to band_end (Hz) over most of the unit circle of w."""
    stretch = np.tan(BAND_ANGLE / 2) / np.tan(min(np.pi * band_end * dt, 0.499 * np.pi))
    return float(max((stretch - 1) / (stretch + 1), 0.0))


@compiled
def line_level(
    x: Complex[Array, "lines outputs"],
    weight: Float[Array, "lines outputs"],
    left: Float[Array, "lines outputs"] | float = 1.0,
) -> Float[Array, "lines outputs"]:
    """Root of the mean square of lines over their neighbours of the same output, never below 1e-12 of the largest.

    Args:
        x: one value a line and output.
        weight: 1 where it was measured, else 0.
        left: part of the noise power that the fit left in each line: around a lightly damped mode it fits noise too.
    """
    count = len(x)
    low = jnp.maximum(jnp.arange(count) - NEIGHBOURS, 0)
    high = jnp.minimum(jnp.arange(count) + NEIGHBOURS + 1, count)

    def average(v: Array) -> Array:
        total = jnp.concatenate([jnp.zeros_like(v[:1]), jnp.cumsum(v, axis=0)])
        return total[high] - total[low]

    power = average(jnp.abs(x) ** 2 * weight) / jnp.maximum(average(weight * left), 1.0)
    return jnp.sqrt(jnp.maximum(power, 1e-24 * power.max(axis=0) + jnp.finfo(x.real.dtype).tiny))


def excited_band(records: Sequence[Record]) -> tuple[float, float]:
    """The frequencies (Hz) between which every input has power, over all records together.

    Raises:
        InsufficientDataError: no common band.
    """
    nyquist = min(0.5 / float(r.dt) for r in records)
    longest = max(r.u.shape[0] * float(r.dt) for r in records)
    grid = np.linspace(0.0, nyquist, max(16, int(nyquist * longest)) + 1)[1:]
    power = np.sum([_smoothed_power(r, grid) for r in records], axis=0)
    excited = np.flatnonzero((power > EXCITED * power.max(axis=0)).all(axis=1))
    if len(excited) < 8:
        raise InsufficientDataError(
            f"{records[0].name}: the inputs share no band of frequencies with power in it "
            f"({len(excited)} spectral lines). Excite a band (sweep, noise, multisine) that covers the modes."
        )
    tones = int(np.sum([_strong_lines(r) for r in records], axis=0).min())
    if tones < FEWEST_LINES:
        raise InsufficientDataError(
            f"{records[0].name}: an input holds hardly more than a single tone ({tones} spectral lines): it tells of "
            "one frequency, not of a band. Excite a band (sweep, noise, multisine) that covers the modes."
        )
    return float(grid[excited[0]]), float(grid[excited[-1]])


def _strong_lines(record: Record) -> np.ndarray:
    """For each input the number of lines with power; a Hann window keeps a tone to a few."""
    u = np.asarray(record.u, dtype=float)
    power = np.abs(np.fft.rfft((u - u.mean(axis=0)) * np.hanning(len(u))[:, None], axis=0)) ** 2
    return (power > EXCITED * np.maximum(power.max(axis=0), np.finfo(float).tiny)).sum(axis=0)


def _smoothed_power(record: Record, grid: np.ndarray) -> np.ndarray:
    """Periodogram of the inputs, averaged over 17 neighbouring lines, on a frequency grid (grid, inputs)."""
    u = np.asarray(record.u, dtype=float)
    power = np.abs(np.fft.rfft(u - u.mean(axis=0), axis=0)) ** 2
    width = min(17, len(power) // 4 * 2 + 1)
    kernel = np.ones(width) / width
    f = np.fft.rfftfreq(len(u), float(record.dt))
    return np.stack([np.interp(grid, f, np.convolve(p, kernel, mode="same")) for p in power.T], axis=1)


def record_lines(
    records: Sequence[Record],
    *,
    outputs: Sequence[str] | None = None,
    band: tuple[float, float] | None = None,
) -> Lines:
    """Fourier lines of the records within a band, outputs matched by name.

    Args:
        records: they may differ in length, in rate and in which outputs they hold, not in their inputs.
        outputs: order of the outputs; by default that of first appearance.
        band: Hz; by default the band that the inputs excite.

    Raises:
        InputError: malformed records, differing inputs or holds.
        InsufficientDataError: too few lines in the band.
    """
    _check_together(records)
    names = tuple(dict.fromkeys(n for r in records for n in r.outputs)) if outputs is None else tuple(outputs)
    used = _usable(band, records)
    dt = float(max(records, key=lambda r: r.u.shape[0]).dt)
    parts = [_one_record(r, names, used, dt) for r in records]
    counts = [len(p[0]) for p in parts]
    if min(counts) < 8:
        raise InsufficientDataError(
            f"{records[int(np.argmin(counts))].name}: only {min(counts)} spectral lines between {used[0]:.3g} and "
            f"{used[1]:.3g} Hz: the record is too short for this band."
        )
    owner = np.repeat(np.eye(len(records)), counts, axis=0)
    lines = [*(np.concatenate(column) for column in zip(*parts, strict=True)), owner]
    padding = _bucket(sum(counts)) - sum(counts)
    z, omega, u, y, weight, owner = (np.pad(a, [(0, padding)] + [(0, 0)] * (a.ndim - 1)) for a in lines)
    z[sum(counts) :], omega[sum(counts) :] = z[0], omega[0]  # padding must not hit a pole
    return Lines(
        *jax.device_put((z, omega, u, y, weight, owner, np.asarray(dt))),
        record_dt=tuple(float(r.dt) for r in records),
        samples=tuple(r.u.shape[0] for r in records),
        band=jax.device_put(np.asarray(used, float)),
        hold=records[0].hold,
    )


def _check_together(records: Sequence[Record]) -> None:
    """Raise where the records are malformed, excite or show nothing, or differ in inputs or holds."""
    for r in records:
        check_record(r)
        check_sensors(r)
        require(
            r.inputs == records[0].inputs and r.hold == records[0].hold,
            f"{r.name}: its inputs {r.inputs} or holds differ from those of {records[0].name}",
        )
    require(
        len(set(records[0].hold)) == 1 or "band" not in records[0].hold,
        "hold 'band' cannot be mixed with others",
    )
    if len(records) == 1:
        check_excitation(records[0])


def _usable(band: tuple[float, float] | None, records: Sequence[Record]) -> tuple[float, float]:
    """The band asked for, or the one that the inputs excite."""
    if band is None:
        require(all(is_concrete(r.u, r.dt) for r in records), "name the band when the records are traced")
        return excited_band(records)
    nyquist = min(0.5 / float(r.dt) for r in records)
    require(
        0 <= band[0] < band[1] and band[0] < nyquist,
        f"band {band[0]:g} to {band[1]:g} Hz cannot be used: name the lower end first, below {nyquist:g} Hz, which "
        "is half the sampling rate.",
    )
    return band


def _one_record(
    record: Record, names: Sequence[str], band: tuple[float, float], dt: float
) -> tuple[np.ndarray, ...]:
    """z, omega, u, y, weight of one record's lines; the mean (line 0) is left to sensor offsets."""
    samples = record.u.shape[0]
    f = np.fft.rfftfreq(samples, float(record.dt))
    inside = np.flatnonzero((f >= band[0]) & (f <= band[1]) & (f > 0) & (f < 0.4999 / float(record.dt)))
    spectrum = lambda x: np.fft.rfft(np.asarray(x, dtype=float), axis=0)[inside] / np.sqrt(samples)  # noqa: E731
    omega = 2 * np.pi * f[inside]
    half = 0.5j * omega * dt
    z = (1 + half) / (1 - half) if record.hold[0] == "band" else np.exp(2 * half)
    y = np.zeros((len(inside), len(names)), complex)
    weight = np.zeros((len(inside), len(names)))
    columns = [names.index(n) for n in record.outputs if n in names]
    kept = [i for i, n in enumerate(record.outputs) if n in names]
    y[:, columns] = spectrum(record.y)[:, kept]
    weight[:, columns] = 1.0
    return z, omega, spectrum(record.u), y, weight


def _bucket(count: int) -> int:
    """The next size of the form 2^k or 3 * 2^(k-1), so that records of like length share compiled programs."""
    power = 1 << max(count - 1, 1).bit_length()
    return power * 3 // 4 if power * 3 // 4 >= count else power
