"""Ordinary samples of an impulse response that is given in the Laguerre shift."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsid.checks import require
from jaxsid.compilation import compiled
from jaxsid.impulse.lines import laguerre_shift
from jaxsid.records import ImpulseResponse, as_array


def time_samples(ir: ImpulseResponse, samples: int) -> Float[Array, "samples outputs inputs"]:
    """Markov parameters in z of G(z) = sum_k h_k w^-k, w = (z - a) / (1 - a z), by values of G on a circle.

    The impulse response of w^-k dies soon after its delay of k (1 + a) / (1 - a) samples; the circle has points
    enough that nothing wraps around.

    Args:
        ir: in the Laguerre shift, or ordinary already.
        samples: how many are wanted; an ordinary response is continued by zeros.

    Raises:
        InputError: hold "band", whose z is that of the bilinear map and not a shift in time.
    """
    require(
        "band" not in ir.hold,
        "with hold 'band' an impulse response in the Laguerre shift has no time samples.",
    )
    pole = float(ir.pole)
    if pole == 0:
        return jnp.pad(ir.h, ((0, max(samples - len(ir.h), 0)), (0, 0), (0, 0)))[:samples]
    delay = len(ir.h) * (1 + abs(pole)) / (1 - abs(pole))
    points = 1 << int(np.ceil(np.log2(max(samples, 2 * delay))))
    z = np.exp(2j * np.pi * np.arange(points // 2 + 1) / points)
    return _on_circle(ir.h, as_array(1 / laguerre_shift(z, pole)), points)[:samples]


@compiled
def _on_circle(h: Array, back: Array, points: int) -> Array:
    """Horner's rule in 1/w, then back from the circle."""
    start = jnp.zeros((len(back), *h.shape[1:]), back.dtype)
    G = jax.lax.scan(lambda sum_, h_k: (sum_ * back[:, None, None] + h_k, None), start, h[::-1])[0]
    return jnp.fft.irfft(G, points, axis=0)
