"""Impulse responses from the records of a study: one record for each input, driven alone from rest."""

from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsid.examples.excitation import chirp
from jaxsid.impulse.direct import Direct
from jaxsid.impulse.fourier import Fourier
from jaxsid.impulse.inband import largest_lags, observer
from jaxsid.impulse.lines import Lines, record_lines
from jaxsid.impulse.wavelet import Wavelet
from jaxsid.records import ImpulseResponse, Record

TOP = 0.4  # where a chirp ends, in units of the sampling rate
METHODS: dict[str, Callable[[list[Record], int], ImpulseResponse]] = {
    "fourier": Fourier(),
    "direct": Direct(),
    "wavelet": Wavelet(),
}


def excitation(kind: str, samples: int, seed: int) -> Float[np.ndarray, " samples"]:
    """A signal of rms 1, the same for all inputs and realizations.

    "multisine": all harmonics of the record below half the rate, equal amplitudes, random phases. "white": independent
    Gaussian numbers. "chirp": a sine from the record's first harmonic up to 0.4 times the rate; above it nothing is
    excited, which ERA on an unregularized estimate will not forgive.

    Args:
        kind: "multisine", "white" or "chirp".
        samples: length.
        seed: of chance.
    """
    rng = np.random.default_rng(seed)
    if kind == "chirp":
        u = chirp(1 / samples, TOP, duration=float(samples), dt=1.0)
    elif kind == "white":
        u = rng.standard_normal(samples)
    else:
        highest = (samples - 1) // 2
        spectrum = np.zeros(samples // 2 + 1, complex)
        spectrum[1 : highest + 1] = np.exp(2j * np.pi * rng.random(highest))
        u = np.fft.irfft(spectrum, samples)
    return u / np.sqrt(np.mean(u**2))


def one_after_another(u: Array, y: Float[Array, "samples outputs inputs"], dt: Array) -> list[Record]:
    """A record for each input, the others at rest."""
    count = y.shape[2]
    return [Record(u[:, None] * jnp.eye(count)[i], y[:, :, i], dt) for i in range(count)]


class Observer(eqx.Module):
    """The in-band observer with all that does not depend on the outputs prepared, in units of samples.

    Attributes:
        lines: of the inputs at a sampling interval of 1; its outputs are those without noise.
        line, record: number of each line in its record, and of its record.
        pole: of the Laguerre shift.
        largest: order tried.
    """

    lines: Lines
    line: Int[Array, " lines"]
    record: Int[Array, " lines"]
    pole: Float[Array, ""]
    largest: int = eqx.field(static=True)

    def __call__(self, y: Float[Array, "samples outputs inputs"], dt: Array, samples: int) -> ImpulseResponse:
        """Markov parameters in the Laguerre shift.

        Args:
            y: outputs of the records.
            dt: sampling interval, s.
            samples: number of Markov parameters.
        """
        spectrum = jnp.fft.rfft(y, axis=0) / np.sqrt(len(y))
        lines = eqx.tree_at(
            lambda x: x.y, self.lines, spectrum[self.line, :, self.record] * self.lines.weight
        )
        h, _, _ = observer(lines, jnp.arange(y.shape[1]), self.pole, self.largest, samples)
        return ImpulseResponse(h, dt, pole=self.pole, hold=lines.hold, method="in-band observer")


def prepare_observer(
    u: Float[np.ndarray, " samples"], y: Float[np.ndarray, "samples outputs inputs"]
) -> Observer:
    """The observer for records like these, whose inputs tell the band.

    Args:
        u: excitation of each input in turn.
        y: outputs without noise.

    Raises:
        InsufficientDataError: too few lines in the band.
    """
    lines = record_lines(one_after_another(jnp.asarray(u), jnp.asarray(y), jnp.ones(())))
    outputs = np.arange(lines.y.shape[1])
    line = np.round(np.asarray(lines.omega) * len(u) / (2 * np.pi)).astype(int)
    owner = np.argmax(np.asarray(lines.record), axis=1)
    # what names the records is static and would tell apart programs that are the same
    plain = replace(lines, record_dt=(), samples=())
    return Observer(
        plain, jnp.asarray(line), jnp.asarray(owner), lines.pole, largest_lags(lines, outputs, None)
    )
