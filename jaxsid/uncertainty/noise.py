"""Covariance of an impulse response, as far as a linear map of it needs it."""

from typing import Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsid.checks import require
from jaxsid.records import Values, as_array


@runtime_checkable
class ResponseNoise(Protocol):
    """The covariance of J h for the rows of a Jacobian J."""

    def covariance(self, rows: Float[Array, "p samples outputs inputs"]) -> Float[Array, "p p"]: ...


class IndependentNoise(eqx.Module):
    """Noise that is independent from sample to sample and from channel to channel: J diag(v) J'.

    Attributes:
        variance: of every sample; or of every output, for all samples and inputs alike.
    """

    variance: Float[Array, "..."]

    def __init__(self, variance: Values):
        """Take variances, (samples, outputs, inputs) or (outputs,).

        Args:
            variance: not negative.

        Raises:
            InputError: another number of dimensions.
        """
        variance = as_array(variance)
        require(
            variance.ndim in (1, 3),
            f"variances have the shape (samples, outputs, inputs) or (outputs,), not {variance.shape}",
        )
        self.variance = variance[:, None] if variance.ndim == 1 else variance

    def covariance(self, rows: Float[Array, "p samples outputs inputs"]) -> Float[Array, "p p"]:
        """J diag(v) J'."""
        scaled = (rows * jnp.sqrt(self.variance)).reshape(len(rows), -1)
        return scaled @ scaled.T


class CorrelatedNoise(eqx.Module):
    """Noise of covariance sum_k f_k f_k': J F' F J', for instance from repeated estimates.

    Attributes:
        factor: (k, samples, outputs, inputs); of N estimates, their deviations from the mean over sqrt(N - 1).
    """

    factor: Float[Array, "k samples outputs inputs"]

    def covariance(self, rows: Float[Array, "p samples outputs inputs"]) -> Float[Array, "p p"]:
        """J F' F J'."""
        seen = rows.reshape(len(rows), -1) @ self.factor.reshape(len(self.factor), -1).T
        return seen @ seen.T


class StationaryNoise(eqx.Module):
    """Coloured noise of one autocovariance for each output, independent from channel to channel: J Toeplitz(c) J'.

    Attributes:
        autocovariance: (lags, outputs) from lag 0; zero beyond.
    """

    autocovariance: Float[Array, "lags outputs"]

    def covariance(self, rows: Float[Array, "p samples outputs inputs"]) -> Float[Array, "p p"]:
        """J Toeplitz(c) J', the products with the Toeplitz matrix by the Fourier transform."""
        samples, lags = rows.shape[1], min(len(self.autocovariance), rows.shape[1])
        c = self.autocovariance[:lags]
        length = 2 * samples
        circle = jnp.zeros((length, c.shape[1]), c.dtype).at[:lags].set(c)
        circle = circle.at[length - lags + 1 :].set(c[:0:-1])
        spectrum = jnp.fft.rfft(circle, axis=0)[:, :, None] * jnp.fft.rfft(rows, length, axis=1)
        product = jnp.fft.irfft(spectrum, length, axis=1)[:, :samples]
        return product.reshape(len(rows), -1) @ rows.reshape(len(rows), -1).T
