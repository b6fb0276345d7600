"""Ordinary samples of an impulse response that is given in the Laguerre shift."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsid.checks import require
from jaxsid.compilation import compiled
from jaxsid.mechanics.hold import laguerre_to_shift
from jaxsid.mechanics.recursion import markov
from jaxsid.records import ImpulseResponse, as_array

compiled_markov = compiled(markov)


def time_samples(ir: ImpulseResponse, samples: int) -> Float[Array, "samples outputs inputs"]:
    """Markov parameters in z of G(z) = sum_k h_k w^-k, w = (z - a) / (1 - a z): h_0, then sum_k h_k g_k(t).

    g_k is the impulse response of w^-k, an all-pass: the k-th state of a chain of delays in w.

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
    if float(ir.pole) == 0:
        return jnp.pad(ir.h, ((0, max(samples - len(ir.h), 0)), (0, 0), (0, 0)))[:samples]
    count = len(ir.h) - 1
    delays, first, zero = np.eye(count, k=-1), np.eye(count, 1), np.zeros((count, 1))
    A, B, C, D = (as_array(x.astype(ir.h.dtype)) for x in (delays, first, np.eye(count), zero))
    A, B, C, D = laguerre_to_shift(A, B, C, D, ir.pole)
    g = compiled_markov(A, B, C, D, samples)[..., 0]
    h = jnp.einsum("tk,kmr->tmr", g, ir.h[1:])
    return h.at[0].add(ir.h[0])
