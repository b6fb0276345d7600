"""Impulse and frequency responses as terms of a fit: what noise is on them, which samples count."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxsid.checks import is_concrete, require, require_finite
from jaxsid.impulse.spectra import FrequencyResponse
from jaxsid.mechanics.hold import check_holds
from jaxsid.physical.terms import FrequencyTerm, ResponseTerm, in_blocks
from jaxsid.records import ImpulseResponse, SecondOrderModel, as_array

HELD_OUT = 4  # every fourth sample or line is kept for validation


class Weights(NamedTuple):
    """One over the noise of every sample, and what makes it independent in time."""

    weight: Float[Array, "samples outputs inputs"]
    whitener: Float[Array, "outputs samples samples"] | None


def response_term(
    ir: ImpulseResponse, sensed: SecondOrderModel, weights: Weights, used: np.ndarray | None = None
) -> ResponseTerm:
    """An impulse response as a term.

    Args:
        ir: the response, in plain time samples.
        sensed: gives the input matrix and the sensors.
        weights: from `response_weights`.
        used: (samples,) of bool, those that count; all where None.
    """
    # a part of the samples is weighed as if its noise were white, which costs that fit precision but no truth
    weight = weights.weight if used is None else weights.weight * jnp.asarray(used)[:, None, None]
    ramps = tuple(h == "first" for h in ir.hold)
    whitener = weights.whitener if used is None else None
    return ResponseTerm(ir.h, weight, (in_blocks(ir.h), in_blocks(weight)), whitener, ir.dt, sensed, ramps)


def check_response(ir: ImpulseResponse, outputs: int, inputs: int) -> None:
    """Raise InputError where an impulse response does not fit a model of so many sensors and inputs.

    Args:
        ir: the response.
        outputs: of the model.
        inputs: of the model.
    """
    require(
        ir.h.shape[1:] == (outputs, inputs),
        f"the impulse response has {ir.h.shape[1]} outputs and {ir.h.shape[2]} inputs, the model {outputs} sensors and "
        f"{inputs} inputs. Name those of the response in the model's order, no others.",
    )
    require(
        not is_concrete(ir.pole) or float(ir.pole) == 0,
        "this impulse response is in a Laguerre basis, not in time samples: refine against its records instead.",
    )
    check_holds(ir.hold, inputs)
    require(
        "band" not in ir.hold, "a band-limited system has no impulse response in samples: use its records."
    )
    require_finite(ir.h, "impulse response")


def response_weights(ir: ImpulseResponse, noise: object | None, left: Array | None = None) -> Weights:
    """Weights from what is known of the noise: its model, else the rms of what a fit left, or of the response itself.

    Args:
        ir: the response.
        noise: `IndependentNoise`, `StationaryNoise` or `CorrelatedNoise`; None where nothing is known.
        left: (samples, outputs, inputs) of a first fit; None before that.
    """
    shape = ir.h.shape
    if noise is None:
        level = jnp.sqrt(jnp.mean((ir.h if left is None else left) ** 2, axis=(0, 2)))
        # what an exact response leaves is rounding, which differs from fit to fit
        level = jnp.maximum(
            level, 100 * jnp.finfo(level.dtype).eps * jnp.sqrt(jnp.mean(ir.h**2, axis=(0, 2)))
        )
        variance = jnp.broadcast_to(level[:, None] ** 2, shape)
        return Weights(_inverse_root(variance, ir.h), None)
    if hasattr(noise, "autocovariance"):
        # numpy: made once, also where the response is traced and threads would wait for each other in LAPACK
        c = np.asarray(noise.autocovariance)[: shape[0]]  # type: ignore[attr-defined]
        c = np.pad(c, ((0, shape[0] - len(c)), (0, 0)))
        lag = np.abs(np.arange(shape[0])[:, None] - np.arange(shape[0]))
        lower = np.linalg.cholesky(np.moveaxis(c[lag] / c[0], 2, 0) + 1e-10 * np.eye(shape[0]))
        inverse = np.tril(np.linalg.inv(lower))
        variance = jnp.broadcast_to(jnp.asarray(c[0])[:, None], shape)
        return Weights(_inverse_root(variance, ir.h), as_array(inverse))
    if hasattr(noise, "factor"):
        return Weights(_inverse_root((noise.factor**2).sum(axis=0), ir.h), None)  # type: ignore[attr-defined]
    variance = jnp.broadcast_to(noise.variance, shape)  # type: ignore[attr-defined]
    return Weights(_inverse_root(variance, ir.h), None)


def _inverse_root(variance: Array, values: Array) -> Array:
    """One over the standard deviation, which is never taken for less than a tiny part of the values."""
    floor = 1e-30 * jnp.mean(values**2, axis=0) + jnp.finfo(values.dtype).tiny
    return 1 / jnp.sqrt(jnp.maximum(variance, floor))


def frequency_term(
    response: FrequencyResponse,
    sensed: SecondOrderModel,
    dt: ArrayLike | None,
    hold: tuple[str, ...],
    used: np.ndarray | None = None,
) -> FrequencyTerm:
    """A frequency response as a term, weighted by its coherence: var H = |H|^2 (1 - g^2) / (g^2 n).

    Args:
        response: from `frequency_response` or measured by an analyser.
        sensed: gives the input matrix and the sensors.
        dt: sampling interval of the records it came from; None for a response in continuous time.
        hold: of the inputs between samples.
        used: (lines,) of bool, those that count; all where None.

    Source: J. Bendat and A. Piersol, Random Data, 4th ed., section 9.2.
    """
    H = jnp.asarray(response.H)
    single = H.shape[2] == 1
    seen = (
        response.coherence if single else jnp.broadcast_to(response.multiple_coherence[:, :, None], H.shape)
    )
    g = jnp.clip(seen, 1e-6, 1 - 1e-9)
    plain = response.averages < 2
    size = jnp.sqrt(jnp.mean(jnp.abs(H) ** 2, axis=0))
    deviation = size * jnp.ones_like(g) if plain else jnp.abs(H) * jnp.sqrt((1 - g) / g / response.averages)
    weight = jnp.sqrt(2.0) / jnp.maximum(deviation, 1e-12 * size)
    s = 2j * jnp.pi * response.frequencies
    weight = weight * ((response.frequencies > 0)[:, None, None])
    if used is not None:
        weight = weight * jnp.asarray(used)[:, None, None]
    interval = None if dt is None else jnp.asarray(dt, weight.dtype)
    return FrequencyTerm(s, H, weight, interval, sensed, tuple(h == "first" for h in hold))


def every_other(count: int) -> np.ndarray:
    """(count,) False for every fourth, which is kept for validation."""
    return np.arange(count) % HELD_OUT != HELD_OUT - 1
