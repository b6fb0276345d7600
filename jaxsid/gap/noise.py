"""Level and colour of each sensor's noise, from the best part of the records that tells of it.

In this order: periods of a periodic record, records of equal inputs, a part without input, and else the quietest band
of what a model leaves. Free decays are taken out of all of them. Motion that does not repeat under a periodic input,
as in contact, is no noise: where a sensor differs from period to period far more than in another record, or than its
quietest band, that tells.
"""

from collections.abc import Iterable, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter
from scipy.stats import gamma

from jaxsid.checks import require
from jaxsid.gap.decay import without_decays
from jaxsid.gap.spectra import Spectra, spectra_of
from jaxsid.impulse.whitening import MOST, whitening_filter
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.lumped import LumpedModel, free_bodies, second_order
from jaxsid.mechanics.simulate import measured_sensors
from jaxsid.records import Record

SAME_INPUT = 0.02  # rms of a difference between two inputs, next to theirs, that are one
SAME_PERIOD = 1.5  # level of a difference between periods, next to the least, that is still noise
UNLIKE = 5.0  # times a sensor's noise in another record, from which on what does not repeat is motion
LARGE_PART = 0.2  # of a sensor's signal, from which on it is that
SHORTEST = 128  # samples of a period or a quiet part that tells of noise
QUIET = 1e-4  # largest input of a quiet part, next to the largest
BANDS = 24  # of which the quietest is taken for noise
STRETCHES = 8  # of time, in the quietest of which a band shows what is there throughout
STEADY = 0.4  # part of what is left, in power: where less is there throughout, that alone is noise
SHARED = 1.5  # lines that share what one shows, with a window of Hann
REFUTED = 0.7  # of noise that periods or repeated records tell, less than which none of it can be left
FINEST = 1e-7  # least noise next to a sensor's signal: that of numbers with seven digits
SOURCES = ("periods", "repeated records", "quiet part", "residual")


class Noise(eqx.Module):
    """Noise of each of a model's sensors in one record, sum_k taps_k e_(t-k) = level * white.

    Attributes:
        level: (outputs,) standard deviation of the white noise, in the sensors' units; NaN for absent sensors.
        taps: (outputs, count) of the filter that makes it white, the first 1.
        degrees: number of independent values that it was found from; 0 where it is a guess from a model's residual.
        source: "periods", "repeated records", "quiet part" or "residual".
    """

    level: Float[np.ndarray, " outputs"]
    taps: Float[np.ndarray, "outputs taps"]
    degrees: float
    source: str = eqx.field(static=True)

    def deviation(self, omega: np.ndarray, dt: float) -> Float[np.ndarray, "lines outputs"]:
        """Standard deviation of lines that are scaled by 1/sqrt(samples).

        Args:
            omega: (lines,) rad/s.
            dt: sampling interval, s.
        """
        z = np.exp(-1j * np.outer(omega * dt, np.arange(self.taps.shape[1])))
        level = np.where(np.isfinite(self.level), self.level, 1.0)
        return level / np.abs(z @ self.taps.T)

    def rms(self) -> Float[np.ndarray, " outputs"]:
        """Standard deviation of the noise with its colour."""
        omega = np.linspace(0.0, np.pi, 4097)
        return np.sqrt((self.deviation(omega, 1.0) ** 2).mean(axis=0)) + 0 * self.level


def noise_of(model: LumpedModel, records: Sequence[Record]) -> tuple[Noise, ...]:
    """The noise of each record.

    Args:
        model: whose free responses are taken out; its sensors give the order.
        records: with some of its sensors each.

    Raises:
        InputError: an input or all sensors of a record are missing.
    """
    require(len(records) > 0, "give at least one record.")
    found = [_of_record(model, r, [x for x in records if x is not r]) for r in records]
    every = list(zip(found, records, strict=True))
    like = [_unless_motion(n, model, r, every) for n, r in every]
    return tuple(_at_least(n, model, r) for n, r in zip(like, records, strict=True))


def _unless_motion(
    noise: Noise, model: LumpedModel, record: Record, every: Iterable[tuple[Noise, Record]]
) -> Noise:
    """What does not repeat in a record, if it is noise; else that of the quietest other one, sampled alike.

    Noise may well be louder in one record, of a sensor in another range, but is hardly a large part of what it reads.
    Where none of them repeats, as in chaos, nothing but the quietest band is left to tell; without input nothing moves.
    """
    others = [n for n, r in every if n.degrees > 0 and np.isclose(float(r.dt), float(record.dt))]
    large = noise.rms() > LARGE_PART * _signal_rms(model, record)
    if noise.degrees <= 0 or not large.any():
        return noise
    louder = lambda n: float(np.where(large, noise.rms() / n.rms(), 0.0).max(initial=0.0))  # noqa: E731
    quietest = max(others, key=louder, default=noise)
    bands = [] if noise.source == SOURCES[2] else [floor(spectra_of(model, record))]
    for other in (quietest, *bands):
        same = np.isfinite(noise.level) == np.isfinite(other.level)
        if louder(other) > UNLIKE and same.all():
            return other
    return noise


def _at_least(noise: Noise, model: LumpedModel, record: Record) -> Noise:
    """The same where there is noise at all; records that were computed may have none."""
    least = FINEST * _signal_rms(model, record)
    return eqx.tree_at(lambda n: n.level, noise, np.fmax(noise.level, least) + 0 * noise.level)


def _signal_rms(model: LumpedModel, record: Record) -> Float[np.ndarray, " outputs"]:
    """What each of the model's sensors reads, rms; 0 for absent ones."""
    rows, columns = measured_sensors(model, record)
    rms = np.zeros(len(model.sensors))
    rms[rows] = np.sqrt((np.asarray(record.y)[:, columns] ** 2).mean(axis=0))
    return rms


def _of_record(model: LumpedModel, record: Record, others: list[Record]) -> Noise:
    period = period_of(np.asarray(record.u))
    if period is not None:
        return _of_periods(model, record, period)
    again = [x for x in others if _same_input(record, x)]
    if again:
        u, y = (
            (np.asarray(a) - np.asarray(b)) / np.sqrt(2)
            for a, b in ((record.u, again[0].u), (record.y, again[0].y))
        )
        return _of_signals(model, _part(record, _felt(model, u), _still(model, record, y)), SOURCES[1])
    quiet = quiet_part(np.asarray(record.u))
    if quiet is not None:
        y = _still(model, record, np.asarray(record.y)[quiet])
        return _of_signals(model, _part(record, np.zeros((len(y), len(record.inputs))), y), SOURCES[2])
    return floor(spectra_of(model, record))


def period_of(u: Float[np.ndarray, "samples inputs"]) -> int | None:
    """Samples after which the inputs repeat, at least twice in the record; None where they do not.

    Args:
        u: inputs.
    """
    samples = len(u)
    if samples < 2 * SHORTEST:
        return None
    centred = u - u.mean(axis=0)
    size = 1 << (2 * samples - 1).bit_length()
    power = np.abs(np.fft.rfft(centred, size, axis=0)) ** 2
    same = np.fft.irfft(power, size, axis=0)[:samples].sum(axis=1)
    energy = np.cumsum((centred**2).sum(axis=1))
    lag = np.arange(SHORTEST, samples // 2 + 1)
    both = energy[samples - 1 - lag] + energy[-1] - energy[lag - 1]
    if energy[-1] <= 0:
        return None
    apart = np.sqrt(np.maximum(both - 2 * same[lag], 0.0) / np.maximum(both, np.finfo(float).tiny))
    good = np.flatnonzero(apart < SAME_INPUT)
    if not len(good):
        return None
    # around a period the difference grows again; a slow input differs little from itself at any short lag
    end = good[0] + int(np.argmax(np.append(apart[good[0] :] >= SAME_INPUT, True)))
    best = int(good[0] + np.argmin(apart[good[0] : end]))
    return int(lag[best]) if apart[:best].max(initial=0.0) > 0.5 else None


def _same_input(one: Record, other: Record) -> bool:
    a, b = np.asarray(one.u), np.asarray(other.u)
    alike = a.shape == b.shape and one.inputs == other.inputs and one.outputs == other.outputs
    return alike and bool(np.sqrt(((a - b) ** 2).sum()) <= SAME_INPUT * np.sqrt((a**2).sum()))


def quiet_part(u: Float[np.ndarray, "samples inputs"]) -> slice | None:
    """Where the record begins without input, None where that is too short.

    Args:
        u: inputs.
    """
    loud = (np.abs(u) > QUIET * np.abs(u).max(axis=0)).any(axis=1)
    first = int(np.argmax(loud)) if loud.any() else len(u)
    return slice(0, first) if first >= SHORTEST else None


def _felt(model: LumpedModel, u: np.ndarray) -> np.ndarray:
    """What inputs that should be one differ by: the model is driven with it, so that their noise is in what it leaves.

    Nothing where bodies are free: there it drifts far away, and friction takes up most of it.
    """
    return np.zeros_like(u) if free_bodies(model).shape[1] else u


def _part(record: Record, u: np.ndarray, y: np.ndarray) -> Record:
    return Record(
        u, y, record.dt, inputs=record.inputs, outputs=record.outputs, hold=record.hold, name=record.name
    )


def _of_periods(model: LumpedModel, record: Record, period: int) -> Noise:
    count = len(record.u) // period
    u, y = (np.asarray(x)[-count * period :] for x in (record.u, record.y))
    other = _felt(model, (u[period:] - u[:-period]) / np.sqrt(2)).reshape(count - 1, period, -1)
    apart = _still(model, record, (y[period:] - y[:-period]) / np.sqrt(2)).reshape(count - 1, period, -1)
    signals = np.stack(
        [_cleared(spectra_of(model, _part(record, *x))) for x in zip(other, apart, strict=True)]
    )
    # what a law beside the model does to free responses dies out from period to period
    level = np.sqrt((signals**2).mean(axis=1))
    used = (level <= SAME_PERIOD * level.min(axis=0)) | np.isnan(level)
    return _fitted(signals[used.all(axis=1)] if used.all(axis=1).any() else signals[-1:], SOURCES[0])


def _still(model: LumpedModel, record: Record, y: np.ndarray) -> np.ndarray:
    """Samples without input, and without the free decays of what was measured."""
    poles = np.linalg.eigvals(np.asarray(physical_displacement_velocity(second_order(model)).A))
    return without_decays(y, len(poles), float(np.abs(poles).max() * float(record.dt)))


def _of_signals(model: LumpedModel, record: Record, source: str) -> Noise:
    return _fitted(_cleared(spectra_of(model, record))[None], source)


def _cleared(spectra: Spectra) -> Float[np.ndarray, "samples outputs"]:
    """What the model and its free responses leave; NaN for absent sensors."""
    present, used = np.asarray(spectra.present) > 0, np.asarray(spectra.weight) > 0
    left = np.asarray(spectra.y - spectra.response)
    free = np.asarray(spectra.free)
    size = np.sqrt((np.abs(left[used]) ** 2).mean(axis=0))
    scale = (present / np.where(size > 0, size, 1.0))[:, None]
    columns = (free[used] * scale).reshape(-1, free.shape[2])
    target = (left[used] * scale[:, 0]).ravel()
    norm = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(norm > 0, norm, 1.0)
    stack = lambda x: np.concatenate([x.real, x.imag])  # noqa: E731
    state = np.linalg.lstsq(stack(columns), stack(target), rcond=1e-9)[0] / np.where(norm > 0, norm, 1.0)
    left = np.where(used[:, None], left - free @ state, 0.0)
    signal = np.fft.irfft(left * np.sqrt(spectra.samples), spectra.samples, axis=0)
    return np.where(present, signal, np.nan)


def _fitted(signals: Float[np.ndarray, "segments samples outputs"], source: str) -> Noise:
    """Burg's filter of each sensor, and the level of what it leaves."""
    outputs = signals.shape[2]
    level, taps = np.full(outputs, np.nan), np.zeros((outputs, MOST + 1))
    taps[:, 0] = 1.0
    for j in range(outputs):
        if not np.isfinite(signals[:, :, j]).all():
            continue
        # an offset is no noise: a filter that took it for some would hide it
        own = signals[:, :, j] - signals[:, :, j].mean()
        taps[j] = whitening_filter(own)
        white = sum(c * np.roll(own, k, axis=1) for k, c in enumerate(taps[j]))
        level[j] = np.sqrt((np.asarray(white)[:, MOST:] ** 2).mean())
    return Noise(level, taps, float(signals[:, :, 0].size), source)


def residual_noise(signals: Float[np.ndarray, "*segments samples outputs"]) -> Noise:
    """Level and colour of what a model left, taken for noise: all of it, or what of it is there throughout.

    What a law leaves comes and goes with the motion, as with the frequency of a stepped sine, or with impacts. Noise
    does not: it is no more, in any band, than where that is quietest.

    Args:
        signals: what it left, in one piece or several of equal length, in the order of time; NaN for absent sensors.

    Source: R. Martin, IEEE Trans. Speech and Audio Processing 9 (2001), for noise by its least power in time.
    """
    signals = signals if signals.ndim == 3 else signals[None]
    noise = _fitted(signals, SOURCES[3])
    level, taps = noise.level.copy(), noise.taps.copy()
    # of too few samples nothing tells whether they are alike throughout
    long = (signals.shape[1] - MOST) // _parts(len(signals)) >= 4 * BANDS
    for j in np.flatnonzero(np.isfinite(level) & long):
        own = signals[:, :, j] - signals[:, :, j].mean()
        # where what is there throughout is white all bands tell as much
        colour, _ = _filter_of(_steady_power(own)[1])
        whole, steady = _steady_power(np.asarray(lfilter(colour, 1.0, own))[:, MOST:])
        if steady.sum() < STEADY * whole.sum():
            response = np.fft.rfft(colour, 2 * (len(steady) - 1))
            taps[j], level[j] = _filter_of(steady / np.abs(response) ** 2)
    return Noise(level, taps, 0.0, SOURCES[3])


def _parts(count: int) -> int:
    """That each of so many pieces is cut into, for as many stretches as are compared."""
    return -(-STRETCHES // count)


def _steady_power(
    signal: Float[np.ndarray, "segments samples"],
) -> tuple[Float[np.ndarray, " lines"], Float[np.ndarray, " lines"]]:
    """Power by frequency: the mean over time, and the least, in bands, of as many stretches as are compared."""
    count, length = signal.shape
    each = _parts(count)
    even = length // each // 2 * 2
    pieces = signal[:, : each * even].reshape(count * each, even)
    window = np.hanning(even)
    lines = np.abs(np.fft.rfft(pieces * window)) ** 2 / max((window**2).sum(), np.finfo(float).tiny)
    whole = lines.mean(axis=0)
    stretches = np.stack([x.mean(axis=0) for x in np.array_split(lines, STRETCHES)])
    steady = np.empty_like(whole)
    for band in np.array_split(np.arange(len(whole)), BANDS):
        # the least of so many averages of squares of normal numbers lies low; a window shares them among lines
        told = len(lines) // STRETCHES * len(band) / SHARED
        low = gamma.ppf(1 - 0.5 ** (1 / STRETCHES), told) / told
        steady[band] = stretches[:, band].mean(axis=1).min(axis=0) / low
    return whole, steady


def _filter_of(power: Float[np.ndarray, " lines"]) -> tuple[Float[np.ndarray, " taps"], float]:
    """The filter that makes noise of this power by frequency white, and the deviation of what it leaves."""
    covariance = np.fft.irfft(power)[: MOST + 1]
    taps = np.concatenate([[1.0], solve_toeplitz(covariance[:MOST], -covariance[1:])])
    return taps, float(np.sqrt(max(taps @ covariance, np.finfo(float).tiny)))


def quieter(guess: Noise, left: Noise, found: float = 1.0) -> Noise:
    """Each sensor's noise where all that tells of it is a guess: no more than a model leaves, nor less than tests miss.

    Noise that is coloured, or shaken into the lines of a resonance, may be far above the quietest band.

    Args:
        guess: of a record; it stands where it is no guess.
        left: what a model leaves of that record, taken for noise.
        found: part of that, in power, in which tests find more than noise.
    """
    least = np.sqrt(max(0.0, 1.0 - found))
    level = np.divide(guess.rms(), left.rms(), out=np.ones_like(guess.level), where=left.rms() > 0)
    change = np.clip(level, least, 1.0)
    own = (guess.degrees <= 0) & (change != level)
    return Noise(
        np.where(own, change * left.level, guess.level),
        np.where(own[:, None], left.taps, guess.taps),
        guess.degrees,
        guess.source,
    )


def no_louder(
    noise: Noise, left: Float[np.ndarray, "samples outputs"], refuted: float = REFUTED, guessed: float = 1.0
) -> Noise:
    """Each sensor's noise, no more than a model leaves of other samples.

    What disturbs the input, say, may be louder in one part of a record than in another. Noise that is no guess stands
    but where that is far less: motion under a law need not repeat when the input does.

    Args:
        noise: of a record.
        left: of samples that the model was not fitted to; NaN where nothing was measured.
        refuted: part of noise that is no guess, less than which none of it can be left; 0 where that tells nothing.
        guessed: likewise of noise that is one.
    """
    counts, squares = np.isfinite(left).sum(axis=0), np.nansum(left**2, axis=0)
    least = np.where(counts > 0, np.sqrt(squares / np.maximum(counts, 1)), np.inf)
    rms = noise.rms()
    less = least < (guessed if noise.degrees <= 0 else refuted) * rms
    level = np.where(less, noise.level * least / np.where(less, rms, 1.0), noise.level)
    return Noise(level, noise.taps, noise.degrees, noise.source)


def floor(spectra: Spectra) -> Noise:
    """White noise of the level of the quietest band of what a model leaves.

    Args:
        spectra: of the record.
    """
    # a window keeps what the effect leaves at its own frequencies out of the others
    signal, window = _cleared(spectra), np.hanning(spectra.samples)[:, None]
    power = np.abs(np.fft.rfft(signal * window, axis=0)) ** 2 / (window**2).sum()
    parts = np.array_split(power[2:-1], BANDS)
    # the least of so many averages lies about two of their deviations low
    level = [x.mean(axis=0) / max(1 - 2 / np.sqrt(max(len(x), 1)), 0.3) for x in parts if len(x)]
    taps = np.zeros((signal.shape[1], MOST + 1))
    taps[:, 0] = 1.0
    return Noise(np.sqrt(np.min(level, axis=0)), taps, 0.0, SOURCES[3])


def deviations(noise: Noise, spectra: Spectra) -> Float[np.ndarray, "lines outputs"]:
    """Standard deviations of a record's lines; arguments as of `Noise.deviation`."""
    return noise.deviation(np.asarray(spectra.omega), float(spectra.dt))
