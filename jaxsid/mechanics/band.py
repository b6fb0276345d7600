"""The response of a continuous-time model to a band-limited input given by its samples."""

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxsid.mechanics.functions_of_matrices import phi_functions
from jaxsid.mechanics.inverses import inverse_each
from jaxsid.mechanics.recursion import run
from jaxsid.records import ContinuousModel


def extend(u: Float[Array, "samples inputs"]) -> Float[Array, "period inputs"]:
    """One period of a smooth periodic extension of u: odd reflections about both ends, faded out and in.

    Reflection keeps value and slope at the ends, so that the trigonometric interpolation rings little there.

    Args:
        u: what is to be extended.
    """
    length = min(len(u) - 1, 512)
    if length < 2:
        return u
    angle = np.pi * np.arange(1, length + 1) / (length + 1)
    fade = ((1 + np.cos(angle)) / 2).astype(u.dtype)[:, None]
    tail = (2 * u[-1] - u[-2 : -length - 2 : -1]) * fade
    head = (2 * u[0] - u[length:0:-1]) * fade[::-1]
    return jnp.concatenate([u, tail, head])


def _harmonics(model: ContinuousModel, frequencies: Array, spectrum: Array) -> tuple[Array, Array]:
    """States (j w I - A)^-1 B U and outputs at each frequency, in chunks that bound the memory."""
    chunk = max(1, min(2048, len(frequencies)))
    missing = -len(frequencies) % chunk
    w = jnp.pad(frequencies, (0, missing), mode="edge").reshape(-1, chunk)
    U = jnp.pad(spectrum, ((0, missing), (0, 0))).reshape(-1, chunk, spectrum.shape[1])
    eye = jnp.eye(len(model.A), dtype=model.A.dtype)

    def respond(pair: tuple[Array, Array]) -> tuple[Array, Array]:
        w, U = pair
        forces = (U @ model.B.T)[:, :, None]
        x = (inverse_each(1j * w[:, None, None] * eye - model.A) @ forces)[:, :, 0]
        return x, x @ model.C.T + U @ model.D.T

    states, outputs = lax.map(respond, (w, U))
    count = len(frequencies)
    return states.reshape(-1, len(model.A))[:count], outputs.reshape(-1, len(model.C))[:count]


def band_response(
    model: ContinuousModel, u: Float[Array, "samples inputs"], dt: Array, state: Float[Array, " n"]
) -> Float[Array, "samples outputs"]:
    """y of x' = A x + B u, x(0) = state, u(t) the trigonometric interpolation of the extended samples.

    The extended input's mean and its harmonics are treated apart: the harmonics' periodic response x_p has
    the spectrum (j w I - A)^-1 B U(w), and mean and start are what remains, a free motion from
    state - x_p(0) under a constant input. So nothing has to decay, and rigid-body poles do no harm; only an
    undamped pole exactly at a harmonic of the period would.

    Args:
        model: continuous-time model.
        u: samples of the input.
        dt: sampling interval, s.
        state: at the first sample.
    """
    periodic = extend(u)
    period = len(periodic)
    spectrum = jnp.fft.rfft(periodic, axis=0)
    frequencies = 2 * np.pi * jnp.fft.rfftfreq(period).astype(u.dtype) / dt
    states, outputs = _harmonics(model, frequencies[1:], spectrum[1:])
    zero = jnp.zeros((1, len(model.C)), outputs.dtype)
    steady = jnp.fft.irfft(jnp.concatenate([zero, outputs]), period, axis=0)[: len(u)]
    # the Nyquist bin of an even period counts once, and its real part only
    weights = jnp.full(len(frequencies) - 1, 2.0, u.dtype).at[-1].set(2.0 if period % 2 else 1.0)
    start = state - (weights @ states.real) / period
    one, _ = phi_functions(model.A * dt)
    constant = jnp.broadcast_to(periodic.mean(0), u.shape)
    A = jnp.eye(len(model.A), dtype=u.dtype) + dt * model.A @ one
    return steady + run(A, dt * one @ model.B, model.C, model.D, constant, start)
