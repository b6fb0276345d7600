"""Averaged spectra of records, the frequency response and the coherences that follow from them.

S_ab(f) = mean over segments of A(f) B(f)^H. H1 = S_yu S_uu^-1 (noise on the outputs), H2 = S_yy S_uy^-1 (noise on the
inputs; for other than as many outputs as inputs, output by output from the total output spectrum, see `h2`), Hv
(noise on both: total least squares, output by output). Source: J. Bendat and A. Piersol, Random Data, 4th ed.,
chapters 6 and 7.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jaxsid.checks import require
from jaxsid.compilation import compiled
from jaxsid.impulse.protocol import as_records
from jaxsid.records import Record, as_array

ESTIMATORS = ("h1", "h2", "hv")
WINDOWS = ("boxcar", "hann", "hamming", "blackman", "flattop")
# Cosine coefficients of the periodic windows.
COSINES = {
    "boxcar": (1.0,),
    "hann": (0.5, 0.5),
    "hamming": (0.54, 0.46),
    "blackman": (0.42, 0.5, 0.08),
    "flattop": (0.21557895, 0.41663158, 0.277263158, 0.083578947, 0.006947368),
}


class Spectra(eqx.Module):
    """One-sided averaged spectral densities.

    Attributes:
        frequencies: (f,) Hz.
        uu, yu, yy: (f, inputs, inputs), (f, outputs, inputs), (f, outputs, outputs), unit^2 / Hz.
        averages: number of segments.
        noise: (f, outputs) density of the period-to-period scatter, None without periods.
    """

    frequencies: Float[Array, " f"]
    uu: Complex[Array, "f inputs inputs"]
    yu: Complex[Array, "f outputs inputs"]
    yy: Complex[Array, "f outputs outputs"]
    averages: int = eqx.field(static=True)
    noise: Float[Array, "f outputs"] | None


class FrequencyResponse(eqx.Module):
    """A nonparametric frequency response and how far to trust it.

    Attributes:
        frequencies: (f,) Hz.
        H: (f, outputs, inputs), output unit / input unit.
        coherence: (f, outputs, inputs) ordinary coherence.
        multiple_coherence: (f, outputs), the share of each output that all inputs together explain.
        noise_psd: (f, outputs) one-sided density of what they do not explain, unit^2 / Hz.
        averages: number of segments; a coherence of one average is 1 and says nothing.
    """

    frequencies: Float[Array, " f"]
    H: Complex[Array, "f outputs inputs"]
    coherence: Float[Array, "f outputs inputs"]
    multiple_coherence: Float[Array, "f outputs"]
    noise_psd: Float[Array, "f outputs"]
    averages: int = eqx.field(static=True)


def window_samples(name: str, n: int) -> np.ndarray:
    """A periodic window of n samples."""
    require(name in COSINES, f"window '{name}' is unknown; choose from {', '.join(WINDOWS)}.")
    k = np.arange(n) * 2 * np.pi / n
    return np.sum([(-1) ** i * c * np.cos(i * k) for i, c in enumerate(COSINES[name])], axis=0)


def segments(samples: int, segment: int, overlap: float) -> np.ndarray:
    """Index table (segments, segment) of one record."""
    hop = max(1, segment - round(overlap * segment))
    first = np.arange(0, samples - segment + 1, hop)
    return first[:, None] + np.arange(segment)


def spectra(
    records: Sequence[Record],
    *,
    segment: int,
    overlap: float,
    window: str,
    detrend: bool,
    periods: int | None,
) -> Spectra:
    """Average over the segments of all records, or over whole periods; shapes as in `Spectra`."""
    many = as_records(records)
    shortest = min(r.u.shape[0] for r in many)
    require(0 <= overlap < 1, f"overlap must be from 0 to below 1, not {overlap}.")
    if periods is not None:
        require(
            1 < periods <= shortest // 2, f"periods must be between 2 and {shortest // 2}, not {periods}."
        )
        segment, overlap, window, detrend = shortest // periods, 0.0, "boxcar", False
    require(
        2 <= segment <= shortest, f"segment must be between 2 and the shortest record's {shortest} samples."
    )
    w = window_samples(window, segment)
    z = [(r.u, r.y) for r in many]
    # With periods every record gives the same number of them; a remainder at the end is not used.
    tables = [as_array(segments(segment * periods if periods else len(u), segment, overlap)) for u, _ in z]
    return _averaged(
        z,
        tables,
        jnp.asarray(w, many[0].y.dtype),
        many[0].dt,
        inputs=many[0].u.shape[1],
        detrend=detrend,
        mean=periods is not None,
    )


@compiled
def _averaged(
    z: list[tuple[Array, Array]],
    tables: list[Array],
    w: Array,
    dt: Array,
    *,
    inputs: int,
    detrend: bool,
    mean: bool,
) -> Spectra:
    n = w.shape[0]
    pieces = [jnp.concatenate(pair, axis=1)[t] for pair, t in zip(z, tables, strict=True)]
    blocks = [p - p.mean(axis=1, keepdims=True) if detrend else p for p in pieces]
    lines = [jnp.fft.rfft(p * w[:, None], axis=1) for p in blocks]
    # One-sided: every line but 0 and Nyquist counts twice.
    sides = np.full(n // 2 + 1, 2.0)
    sides[[0, -1]] = 1, 1 if n % 2 == 0 else 2
    scale = (jnp.asarray(sides, w.dtype) * dt / jnp.sum(w**2))[:, None, None]
    noise = None
    if mean:
        count = sum(len(p) for p in lines)
        scatter = jnp.concatenate([jnp.abs(p - p.mean(axis=0)) ** 2 for p in lines]).sum(axis=0)
        noise = scale[..., 0] * scatter[:, inputs:] / (count - len(lines))
        lines = [p.mean(axis=0, keepdims=True) for p in lines]
    every = jnp.concatenate(lines)
    S = scale * jnp.einsum("sfi,sfj->fij", every, every.conj()) / every.shape[0]
    f = jnp.arange(n // 2 + 1) / (n * dt)
    return Spectra(
        frequencies=f,
        uu=S[:, :inputs, :inputs],
        yu=S[:, inputs:, :inputs],
        yy=S[:, inputs:, inputs:],
        averages=sum(len(p) for p in pieces),
        noise=noise,
    )


def h1(S: Spectra) -> Complex[Array, "f outputs inputs"]:
    """S_yu S_uu^-1. Lines that the input does not excite give the solution of least norm, not noise without
    bound."""
    return S.yu @ _inverse(S.uu)


def h2(S: Spectra) -> Complex[Array, "f outputs inputs"]:
    """S_yy S_uy^-1 where outputs are as many as inputs; else each output's H1 row over its multiple
    coherence.

    For one input the two agree for each output: S_yy / S_uy = H1 / coherence.
    """
    m, r = S.yu.shape[1:]
    if m == r and r > 1:
        return S.yy @ _inverse(S.yu.conj().swapaxes(1, 2))
    share = multiple(S)[..., None]
    return h1(S) / jnp.where(share > 0, share, 1)


def hv(S: Spectra) -> Complex[Array, "f outputs inputs"]:
    """Total least squares: the eigenvector of the smallest eigenvalue of the spectra of [u, y_i], scaled to
    unit power."""

    def one_output(yu, yy):
        a = jnp.concatenate([S.uu, yu[:, None, :]], axis=1)
        b = jnp.concatenate([yu.conj()[..., None], yy[:, None, None]], axis=1)
        joint = jnp.concatenate([a, b], axis=2)
        size = jnp.sqrt(jnp.real(jnp.diagonal(joint, axis1=1, axis2=2)).mean(axis=0))
        v = jnp.linalg.eigh(joint / size[:, None] / size)[1][..., 0] / size
        last = v[:, -1:]
        return -(v[:, :-1] / jnp.where(last == 0, 1, last)).conj()

    diagonal = jnp.diagonal(S.yy, axis1=1, axis2=2)
    return jax.vmap(one_output, in_axes=1, out_axes=1)(S.yu, diagonal)


def _inverse(a: Array) -> Array:
    """Pseudo-inverse per line; directions 1e-12 below the largest of their line are dropped."""
    return jnp.linalg.pinv(a, rtol=1e-12)


def multiple(S: Spectra) -> Float[Array, "f outputs"]:
    """Multiple coherence S_yu S_uu^-1 S_uy / S_yy of each output."""
    explained = jnp.real(jnp.einsum("fmi,fij,fmj->fm", S.yu, _inverse(S.uu), S.yu.conj()))
    total = jnp.real(jnp.diagonal(S.yy, axis1=1, axis2=2))
    return jnp.clip(explained / jnp.where(total > 0, total, 1), 0, 1)


@compiled
def respond(S: Spectra, estimator: str) -> FrequencyResponse:
    """The frequency response by the estimator named, with coherences and noise."""
    uu = jnp.real(jnp.diagonal(S.uu, axis1=1, axis2=2))
    yy = jnp.real(jnp.diagonal(S.yy, axis1=1, axis2=2))
    product = uu[:, None, :] * yy[:, :, None]
    ordinary = jnp.abs(S.yu) ** 2 / jnp.where(product > 0, product, 1)
    if S.noise is None:
        share = multiple(S)
        spare = max(S.averages - S.uu.shape[1], 1) / S.averages
        noise = yy * (1 - share) / spare
    else:
        noise = S.noise
        share = jnp.clip(1 - noise / S.averages / jnp.where(yy > 0, yy, 1), 0, 1)
    H = {"h1": h1, "h2": h2, "hv": hv}[estimator](S)
    return FrequencyResponse(S.frequencies, H, ordinary, share, noise, S.averages)


def frequency_response(
    records: Record | Sequence[Record],
    *,
    estimator: str = "h1",
    segment: int | None = None,
    overlap: float = 0.5,
    window: str = "hann",
    detrend: bool = False,
    periods: int | None = None,
) -> FrequencyResponse:
    """Frequency response of one record or an ensemble by averaged spectra.

    Args:
        records: a Record or several of the same channels and rate.
        estimator: "h1", "h2" or "hv", see the module.
        segment: samples of a segment, a quarter of the shortest record if None.
        overlap: share of a segment that the next repeats.
        window: boxcar, hann, hamming, blackman or flattop.
        detrend: take the mean from each segment.
        periods: number of whole periods in each record; averages them without a window, noise from their
        scatter.

    Raises InputError where an option does not fit the records.
    """
    many = (records,) if isinstance(records, Record) else tuple(records)
    require(
        estimator in ESTIMATORS, f"estimator '{estimator}' is unknown; choose from {', '.join(ESTIMATORS)}."
    )
    require(len(many) > 0, "frequency_response: no record was given.")
    length = segment or max(2, min(r.u.shape[0] for r in many) // 4)
    S = spectra(many, segment=length, overlap=overlap, window=window, detrend=detrend, periods=periods)
    inputs, averages = S.uu.shape[1], S.averages if periods is None else len(many)
    require(
        averages >= inputs,
        f"{averages} averages cannot separate {inputs} inputs: S_uu is singular. Use shorter segments or "
        f"more records.",
    )
    return respond(S, estimator)


def coherence(
    records: Record | Sequence[Record],
    *,
    segment: int | None = None,
    overlap: float = 0.5,
    window: str = "hann",
    detrend: bool = False,
) -> tuple[Float[Array, " f"], Float[Array, "f outputs inputs"], Float[Array, "f outputs"]]:
    """Frequencies (Hz), ordinary coherence (f, outputs, inputs) and multiple coherence (f, outputs).

    Args:
        records: a Record or several of the same channels and rate.
        segment: samples of a segment, a quarter of the shortest record if None.
        overlap: share of a segment that the next repeats.
        window: boxcar, hann, hamming, blackman or flattop.
        detrend: take the mean from each segment.

    Raises InputError where an option does not fit the records.
    """
    found = frequency_response(records, segment=segment, overlap=overlap, window=window, detrend=detrend)
    return found.frequencies, found.coherence, found.multiple_coherence
