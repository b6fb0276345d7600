"""Noise of a chosen colour on sampled outputs, and the filter that makes it white again."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

COLOURS = ("white", "coloured", "quantization")
POLE = 0.8  # of the coloured noise
STEP = np.sqrt(12.0)  # of a converter, in standard deviations of its error


def disturbed(
    y: Float[Array, "samples ..."], deviation: Float[Array, "..."], key: Array, colour: str
) -> Float[Array, "samples ..."]:
    """The samples y with one realization of noise of a standard deviation for each.

    "white": independent Gaussian numbers. "coloured": e_k = 0.8 e_(k-1) + 0.6 w_k, w white and Gaussian, stationary
    from the first sample on. "quantization": a converter of step q = sqrt(12) deviation reads
    q round((y + o) / q) - o; its offset o is uniform in +-q/2, one for each channel and realization, and is all that
    chance decides: where the steps lie is what differs from one test to the next. Over the offsets the error has mean
    0 and variance q^2 / 12 exactly, yet neighbouring samples of a slow or small signal have nearly the same error.

    Args:
        y: exact, time first.
        deviation: standard deviation, of a shape that broadcasts to that of y, the same for all samples.
        key: of chance.
        colour: "white", "coloured" or "quantization".
    """
    if colour == "quantization":
        step = STEP * deviation
        safe = jnp.where(step > 0, step, 1.0)
        offset = safe * jax.random.uniform(key, y.shape[1:], y.dtype, -0.5, 0.5)
        return jnp.where(step > 0, safe * jnp.round((y + offset) / safe) - offset, y)
    white = jax.random.normal(key, y.shape, y.dtype)
    return y + deviation * (_coloured(white) if colour == "coloured" else white)


def _coloured(white: Float[Array, "samples ..."]) -> Float[Array, "samples ..."]:
    def step(before: Array, w: Array) -> tuple[Array, Array]:
        now = POLE * before + np.sqrt(1 - POLE**2) * w
        return now, now

    rest = jax.lax.scan(step, white[0], white[1:])[1]
    return jnp.concatenate([white[:1], rest])


def whitened(x: Float[np.ndarray, "samples ..."], colour: str) -> Float[np.ndarray, "samples ..."]:
    """x filtered as turns unit noise of this colour into unit white noise; quantization counts as white.

    For coloured noise of pole a exactly x_0, (x_k - a x_(k-1)) / sqrt(1 - a^2).

    Args:
        x: in units of the standard deviation, time first.
        colour: of the noise.
    """
    if colour != "coloured":
        return x
    return np.concatenate([x[:1], (x[1:] - POLE * x[:-1]) / np.sqrt(1 - POLE**2)])
