"""Inverses of many small matrices, one for each frequency.

jaxlib's batched LAPACK calls on CPU wait, inside the thread pool, for other threads of it; two of them at once lock
each other out for good on a machine of few cores. Here all matrices are eliminated side by side, without LAPACK.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Inexact

CACHED = 8192  # numbers eliminated at a time, which fit into a core's cache


@jax.custom_jvp
def inverse_each(matrices: Inexact[Array, "*batch n n"]) -> Inexact[Array, "*batch n n"]:
    """The inverse of every matrix, by Gauss and Jordan with partial pivoting; not finite where there is none.

    Args:
        matrices: small, real or complex.
    """
    shape, n = matrices.shape, matrices.shape[-1]
    flat = matrices.reshape(-1, n, n)
    chunk = max(CACHED // n**2, 1)
    if len(flat) <= chunk:
        return _eliminated(flat).reshape(shape)
    missing = -len(flat) % chunk
    padded = jnp.concatenate([flat, jnp.broadcast_to(jnp.eye(n, dtype=flat.dtype), (missing, n, n))])
    inverse = lax.map(_eliminated, padded.reshape(-1, chunk, n, n))
    return inverse.reshape(-1, n, n)[: len(flat)].reshape(shape)


def _eliminated(matrices: Inexact[Array, "batch n n"]) -> Inexact[Array, "batch n n"]:
    """In place: column k of the matrices becomes that of the inverses of their rows as pivoted so far."""
    n = matrices.shape[1]
    x = jnp.moveaxis(matrices, 0, -1)  # the batch last, for vector instructions
    order = jnp.broadcast_to(jnp.arange(n)[:, None], (n, x.shape[2]))
    rows = jnp.arange(n)[:, None]

    def eliminate(k: Array, given: tuple[Array, Array]) -> tuple[Array, Array]:
        x, order = given
        column = lax.dynamic_index_in_dim(x, k, axis=1, keepdims=False)
        pivot = jnp.where(rows >= k, jnp.abs(column), -1.0).argmax(axis=0)
        here, there = rows == k, rows == pivot
        chosen = jnp.take_along_axis(x, pivot[None, None, :], axis=0)[0]
        moved = lax.dynamic_index_in_dim(x, k, axis=0, keepdims=False)
        swapped = jnp.take_along_axis(order, pivot[None, :], axis=0)[0]
        other = lax.dynamic_index_in_dim(order, k, axis=0, keepdims=False)
        order = jnp.where(here, swapped, jnp.where(there, other, order))
        column = jnp.where(there, lax.dynamic_index_in_dim(column, k, axis=0), column)
        rest = 1 / lax.dynamic_index_in_dim(chosen, k, axis=0)
        unit = jnp.where(here, rest, chosen * rest)  # the row of the pivot, over columns
        x = jnp.where(there[:, None], moved, x)
        left = jnp.where(here[None], 0.0, x) - column[:, None] * unit
        return jnp.where(here[:, None], unit, left), order

    x, order = lax.fori_loop(0, n, eliminate, (x, order))
    return jnp.moveaxis(jnp.take_along_axis(x, order.argsort(axis=0)[None], axis=1), -1, 0)


@inverse_each.defjvp
def _change(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    inverse = inverse_each(primals[0])
    return inverse, -inverse @ tangents[0] @ inverse
