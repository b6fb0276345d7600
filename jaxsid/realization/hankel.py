"""Block Hankel matrices as operators, multiplied by the fast Fourier transform or densely, chosen by shape.

Block (i, j) of the matrix is g[s_i + t_j] for chosen block rows s and block columns t.
"""

from functools import reduce
from math import gcd, log2

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float

from jaxsid.records import Steps

# Cost of one element of a dense product against one butterfly of a Fourier transform, measured on CPU.
BUTTERFLY_COST = 4.0
LARGEST_DENSE = 2**24  # elements; above it the matrix is never formed by the fast method


class DenseOperator(eqx.Module):
    """A linear operator held as its matrix."""

    matrix: Float[Array, "rows cols"]

    @property
    def shape(self) -> tuple[int, int]:
        return self.matrix.shape[0], self.matrix.shape[1]

    def mv(self, v: Float[Array, "cols k"]) -> Float[Array, "rows k"]:
        """Product with the matrix."""
        return self.matrix @ v

    def rmv(self, u: Float[Array, "rows k"]) -> Float[Array, "cols k"]:
        """Product with the transposed matrix."""
        return self.matrix.T @ u

    def gram(self) -> Float[Array, "cols cols"]:
        """The transposed matrix times the matrix."""
        return self.matrix.T @ self.matrix


class FourierOperator(eqx.Module):
    """A block Hankel matrix that is never formed: products are correlations, done by the Fourier transform.

    Attributes:
        spectrum: transform of the sequence g, (frequencies, outputs, inputs).
        rows, columns: block rows and block columns, from 0.
        length: of the transform.
    """

    spectrum: Complex[Array, "frequencies outputs inputs"]
    rows: tuple[int, ...] = eqx.field(static=True)
    columns: tuple[int, ...] = eqx.field(static=True)
    length: int = eqx.field(static=True)

    @property
    def shape(self) -> tuple[int, int]:
        _, outputs, inputs = self.spectrum.shape
        return len(self.rows) * outputs, len(self.columns) * inputs

    def mv(self, v: Float[Array, "cols k"]) -> Float[Array, "rows k"]:
        """Product with the block Hankel matrix."""
        return _correlate(jnp.swapaxes(self.spectrum, 1, 2), v, self.columns, self.rows, self.length)

    def rmv(self, u: Float[Array, "rows k"]) -> Float[Array, "cols k"]:
        """Product with the transposed block Hankel matrix."""
        return _correlate(self.spectrum, u, self.rows, self.columns, self.length)

    def gram(self) -> Float[Array, "cols cols"]:
        """The transposed matrix times the matrix, sum_i g[s_i + t_j]' g[s_i + t_k]: few products of samples."""
        g = jnp.fft.irfft(self.spectrum, self.length, axis=0)
        products = jnp.einsum("top,soq->tpsq", g, g)
        columns = np.asarray(self.columns)

        def added(total: Array, row: Array) -> tuple[Array, None]:
            return total + products[row + columns][:, :, row + columns], None

        inputs, count = g.shape[2], len(columns)
        zero = jnp.zeros((count, inputs, count, inputs), g.dtype)
        total = lax.scan(added, zero, jnp.asarray(self.rows))[0]
        return total.reshape(count * inputs, count * inputs)


Operator = DenseOperator | FourierOperator


def _correlate(
    spectrum: Complex[Array, "frequencies p q"],
    v: Float[Array, "given k"],
    given: Steps,
    wanted: Steps,
    length: int,
) -> Float[Array, "wanted k"]:
    """sum_j g[i + j]' v_j at the wanted i, from v_j at the given j, with g of shape (p, q)."""
    # Time is the last axis throughout: the transform runs along contiguous memory.
    blocks = v.T.reshape(v.shape[1], len(given), spectrum.shape[1])
    blocks = jnp.swapaxes(_spread(blocks, given), 1, 2)
    product = jnp.einsum("fpq,kpf->kqf", spectrum, jnp.conj(jnp.fft.rfft(blocks, length)))
    series = jnp.fft.irfft(product, length)
    series = series[..., : len(wanted)] if _contiguous(wanted) else series[..., np.asarray(wanted)]
    return jnp.swapaxes(series, 1, 2).reshape(v.shape[1], -1).T


def _contiguous(steps: Steps) -> bool:
    return steps[-1] == len(steps) - 1


def _spread(blocks: Float[Array, "k given p"], steps: Steps) -> Float[Array, "k time p"]:
    """Blocks put at their instants, zeros between."""
    if _contiguous(steps):
        return blocks
    grid = jnp.zeros((blocks.shape[0], steps[-1] + 1, blocks.shape[2]), blocks.dtype)
    return grid.at[:, np.asarray(steps)].set(blocks)


def fast_length(n: int) -> int:
    """The smallest length from n on whose only prime factors are 2, 3 and 5."""
    while True:
        rest = n
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return n
        n += 1


def last_sample(row_steps: Steps, column_steps: Steps, first: int) -> int:
    """Index of the last sample that a block Hankel matrix from `first` on reads."""
    return first + row_steps[-1] + column_steps[-1]


def hankel_matrix(
    g: Float[Array, "samples outputs inputs"],
    row_steps: Steps,
    column_steps: Steps,
    first: int = 0,
) -> Float[Array, "rows cols"]:
    """The dense block Hankel matrix with blocks g[first + s_i + t_j]. Source: thesis [4.14]."""
    g = jnp.swapaxes(g[first : first + row_steps[-1] + column_steps[-1] + 1], 0, 1)
    columns = np.asarray(column_steps)
    # in a loop, or XLA computes what g is made of again for each place that a sample is put in
    blocks = lax.map(lambda s: g[:, s + columns], jnp.asarray(row_steps))
    return blocks.reshape(len(row_steps) * g.shape[0], len(column_steps) * g.shape[2])


def hankel_operator(
    g: Float[Array, "samples outputs inputs"],
    row_steps: Steps,
    column_steps: Steps,
    first: int = 0,
    dense: bool = False,
) -> Operator:
    """The block Hankel matrix with blocks g[first + s_i + t_j] in the form whose products are cheaper.

    Args:
        g: sequence (samples, outputs, inputs).
        row_steps, column_steps: increasing; each starts at 0.
        first: index of the sample in the upper left corner.
        dense: form the matrix whatever it costs.
    """
    step = max(reduce(gcd, (*row_steps, *column_steps)), 1)
    rows = tuple(s // step for s in row_steps)
    columns = tuple(t // step for t in column_steps)
    last = last_sample(row_steps, column_steps, first)
    g = g[first : last + 1 : step]
    length = fast_length(g.shape[0])
    if dense or _dense_is_cheaper(len(rows), len(columns), length, g.shape[1], g.shape[2]):
        return DenseOperator(hankel_matrix(g, rows, columns))
    return FourierOperator(jnp.fft.rfft(g, length, axis=0), rows, columns, length)


def _dense_is_cheaper(rows: int, columns: int, length: int, outputs: int, inputs: int) -> bool:
    elements = rows * columns * outputs * inputs
    transforms = (outputs + inputs) * length * log2(max(length, 2))
    products = 2 * length * outputs * inputs
    return elements <= LARGEST_DENSE and elements <= BUTTERFLY_COST * (transforms + products)
