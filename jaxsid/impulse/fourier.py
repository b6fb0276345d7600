"""Impulse response as the inverse Fourier transform of an averaged frequency response."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxsid.compilation import compiled
from jaxsid.impulse.protocol import as_records, returned_samples
from jaxsid.impulse.spectra import FrequencyResponse, frequency_response
from jaxsid.records import ImpulseResponse, Record


class Fourier(eqx.Module):
    """H1, H2 or Hv by averaged spectra, then the inverse FFT: h[0] is the feedthrough.

    The response must have decayed within a segment, or it wraps around (a window hides that as damping). With a
    periodic excitation give `periods`: whole periods are averaged without a window, and there is no leakage once the
    transient has died.

    Attributes:
        estimator: "h1" (noise on outputs), "h2" (on inputs) or "hv" (on both).
        segment: samples of a segment; None is a quarter of the shortest record.
        overlap: share of a segment that the next repeats.
        window: boxcar, hann, hamming, blackman or flattop.
        periods: number of whole periods in each record.
    """

    estimator: str = eqx.field(static=True, default="h1")
    segment: int | None = eqx.field(static=True, default=None)
    overlap: float = eqx.field(static=True, default=0.5)
    window: str = eqx.field(static=True, default="hann")
    periods: int | None = eqx.field(static=True, default=None)

    def __call__(self, records: Sequence[Record], samples: int | None = None) -> ImpulseResponse:
        """The impulse response of one record or an ensemble; see the class."""
        many = as_records(records)
        shortest = min(r.u.shape[0] for r in many)
        segment = self.segment or max(2, shortest // 4)
        segment = shortest // self.periods if self.periods else segment
        kept = returned_samples(samples, segment, "a segment")
        found = frequency_response(
            many,
            estimator=self.estimator,
            segment=segment,
            overlap=self.overlap,
            window=self.window,
            periods=self.periods,
        )
        h, noise = _inverse(found, segment)
        return ImpulseResponse(
            h[:kept], many[0].dt, noise_std=noise, hold=many[0].hold, method=self._words(segment)
        )

    def _words(self, segment: int) -> str:
        name = {"h1": "H1", "h2": "H2", "hv": "Hv"}[self.estimator]
        if self.periods:
            return f"Fourier {name}, {self.periods} whole periods of {segment} samples, no window"
        return (
            f"Fourier {name}, segments of {segment} samples, {self.window} window, overlap {self.overlap:g}"
        )


@compiled
def _inverse(found: FrequencyResponse, segment: int) -> tuple[jax.Array, jax.Array]:
    h = jnp.fft.irfft(found.H, segment, axis=0)
    variance = found.noise_psd.sum(axis=0) * (found.frequencies[1] - found.frequencies[0])
    return h, jnp.sqrt(variance)
