"""Many outputs that move together, written in few directions where that loses nothing.

If Y_k = Q X_k for all Markov parameters, with the columns of Q orthonormal, the block Hankel matrix of Y is I x Q times
that of X: the right singular vectors and the singular values are the same, the left ones those of X times I x Q. A
structure with few modes and many sensors has such a Q, its shapes; noise has none.

Source: B. Kramer and S. Gugercin, Math. Comput. Model. Dyn. Syst. 22 (2016), there as an approximation.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsid.realization.lapack import qr

ROUNDING = 30.0  # what is left of an exact response, in units of eps


class FewOutputs(NamedTuple):
    """A response in few directions of its outputs.

    Attributes:
        directions: (outputs, width) orthonormal; a constant for derivatives.
        h: (samples, width, inputs) the response in them.
        rest: (samples, outputs, inputs) what they miss.
        exact: whether that is rounding.
    """

    directions: Float[Array, "outputs width"]
    h: Float[Array, "samples width inputs"]
    rest: Float[Array, "samples outputs inputs"]
    exact: Bool[Array, ""]


def few_outputs(h: Float[Array, "samples outputs inputs"], width: int) -> FewOutputs:
    """The response in the directions of a random sample of its columns: all of them where they are few.

    Args:
        h: Markov parameters.
        width: number of directions, not above the number of outputs.
    """
    columns = jnp.swapaxes(jax.lax.stop_gradient(h), 0, 1).reshape(h.shape[1], -1)
    mixed = jax.random.uniform(jax.random.key(1), (columns.shape[1], width), h.dtype, -1.0, 1.0)
    directions = jax.lax.stop_gradient(qr(columns @ mixed)[0])
    few = jnp.einsum("tmr,mw->twr", h, directions)
    rest = h - jnp.einsum("twr,mw->tmr", few, directions)
    exact = jnp.linalg.norm(rest.ravel()) <= ROUNDING * jnp.finfo(h.dtype).eps * jnp.linalg.norm(h.ravel())
    return FewOutputs(directions, few, rest, exact)
