"""The recursion x' = A x + B u, y = C x + D u over many samples, in blocks of matrix products."""

import math

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float


def powers(A: Float[Array, "n n"], X: Float[Array, "n k"], count: int) -> Float[Array, "count n k"]:
    """X, A X, A^2 X, ... by doubling: log2(count) products.

    Args:
        A: square.
        X: where to begin.
        count: how many, static.
    """
    out = X[None]
    while len(out) < count:
        out = jnp.concatenate([out, A @ out])
        A = A @ A
    return out[:count]


def markov(A: Array, B: Array, C: Array, D: Array, samples: int) -> Float[Array, "samples outputs inputs"]:
    """D, C B, C A B, ..., C A^(samples - 2) B as products of about sqrt(samples) rows with as many columns.

    Args:
        A: (n, n).
        B: (n, inputs).
        C: (outputs, n).
        D: (outputs, inputs).
        samples: how many, static.
    """
    inner = max(1, math.isqrt(max(samples - 1, 0)))
    outer = -(-(samples - 1) // inner)
    columns = powers(A, B, inner)
    stride = jnp.linalg.matrix_power(A, inner)
    rows = jnp.swapaxes(powers(stride.T, C.T, max(outer, 1)), 1, 2)
    h = jnp.einsum("jon,kni->jkoi", rows, columns).reshape(-1, *D.shape)
    return jnp.concatenate([D[None], h])[:samples]


def run(A: Array, B: Array, C: Array, D: Array, u: Array, state: Array) -> Float[Array, "samples outputs"]:
    """Outputs from a state at the first sample, a block of samples in one matrix product.

    y_block = [C; C A; ...] x + Toeplitz(D, C B, C A B, ...) u_block, x -> A^block x + [... A B, B] u_block.

    Args:
        A: (n, n).
        B: (n, inputs).
        C: (outputs, n).
        D: (outputs, inputs).
        u: (samples, inputs).
        state: (n,) at the first sample.
    """
    samples, inputs = u.shape
    block = max(1, min(64, samples))
    count = -(-samples // block)
    blocks = jnp.pad(u, ((0, count * block - samples), (0, 0))).reshape(count, block * inputs)
    h = markov(A, B, C, D, block)
    lag = np.arange(block)[:, None] - np.arange(block)
    toeplitz = jnp.where((lag >= 0)[:, :, None, None], h[np.maximum(lag, 0)], 0.0)
    forced = blocks @ toeplitz.transpose(1, 3, 0, 2).reshape(block * inputs, -1)
    reach = powers(A, B, block)[::-1].transpose(0, 2, 1).reshape(block * inputs, -1)
    leap = jnp.linalg.matrix_power(A, block)
    _, states = lax.scan(lambda x, push: (leap @ x + push, x), state, blocks @ reach)
    seen = jnp.swapaxes(powers(A.T, C.T, block), 1, 2).reshape(-1, len(A))
    return (forced + states @ seen.T).reshape(count * block, len(C))[:samples]
