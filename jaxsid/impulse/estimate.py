"""The one call for an impulse response, and the estimators to choose from."""

from collections.abc import Sequence

from jaxsid.impulse.direct import Direct
from jaxsid.impulse.ensemble import WaveletEnsemble
from jaxsid.impulse.fourier import Fourier
from jaxsid.impulse.protocol import ImpulseMethod
from jaxsid.impulse.wavelet import Wavelet
from jaxsid.records import ImpulseResponse, Record

# Every estimator at its defaults; the protocol test runs them all.
METHODS: tuple[ImpulseMethod, ...] = (Fourier(), Direct(), Wavelet(), WaveletEnsemble())


def impulse_response(
    records: Record | Sequence[Record],
    method: ImpulseMethod = Wavelet("db4", level=None),  # noqa: B008 - a frozen value
    samples: int | None = None,
) -> ImpulseResponse:
    """Impulse response (Markov parameters) of the system behind one record or several.

    y_t = sum_k h_k u_(t-k), h (samples, outputs, inputs), h[0] the feedthrough, output unit / input unit.

    Args:
        records: a Record, or several of one system with the same channels and sampling interval.
        method: Fourier, Direct, Wavelet, WaveletEnsemble, InBand or another estimator of the same signature.
        samples: how many taps to return; None returns as many as the method estimates.

    Raises InputError where the records cannot be used together or an option does not fit them.
    """
    return method((records,) if isinstance(records, Record) else tuple(records), samples)
