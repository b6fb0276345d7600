"""Unknowns that a fit may vary, and the mass, damping and stiffness that they mean."""

from typing import Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

BLIND = 1e-10  # of the largest eigenvalue of scaled J'J: nothing is known of that combination of unknowns
Matrix = Array | np.ndarray
Triple = tuple[Float[Array, "N N"], Float[Array, "N N"], Float[Array, "N N"]]
Slopes = tuple[Float[Array, "p N N"], Float[Array, "p N N"], Float[Array, "p N N"]]


@runtime_checkable
class Parameterization(Protocol):
    """Maps unknowns to mass, damping, stiffness, differentiably, and back."""

    def matrices(self, theta: Array) -> Triple: ...

    def unknowns(self, matrices: Triple) -> Array: ...


class SymmetricMatrices(eqx.Module):
    """Every entry of symmetric M, D and K, free; D and K vanish on patterns that nothing resists.

    Attributes:
        scale: (3, N, N) size of each entry, so that the unknowns are of order one.
        complements: orthonormal bases of the coordinates that M, D and K act on, (N, N), (N, q), (N, p).
    """

    scale: tuple[Matrix, Matrix, Matrix]
    complements: tuple[Matrix, Matrix, Matrix]

    def matrices(self, theta: Array) -> Triple:
        """M, D, K from the upper triangles."""
        M, D, K = (
            jnp.asarray(e) @ _symmetric(part, len(scale), scale) @ jnp.asarray(e).T
            for part, scale, e in zip(self._parts(theta), self.scale, self.complements, strict=True)
        )
        return M, D, K

    def unknowns(self, matrices: Triple) -> Array:
        """Upper triangles of M, D, K in their coordinates."""
        parts = []
        for matrix, scale, e in zip(matrices, self.scale, self.complements, strict=True):
            inner = jnp.asarray(e).T @ matrix @ e / scale
            parts.append((0.5 * (inner + inner.T))[np.triu_indices(len(scale))])
        return jnp.concatenate(parts)

    def _parts(self, theta: Array) -> list[Array]:
        sizes = [len(s) * (len(s) + 1) // 2 for s in self.scale]
        return jnp.split(theta, np.cumsum(sizes)[:-1])


class PositiveMatrices(eqx.Module):
    """Symmetric M > 0, D >= 0 and K >= 0 by construction, through triangular factors L L'.

    Attributes:
        scale, complements: as for `SymmetricMatrices`.
    """

    scale: tuple[Matrix, Matrix, Matrix]
    complements: tuple[Matrix, Matrix, Matrix]

    def matrices(self, theta: Array) -> Triple:
        """M, D, K from lower triangular factors."""
        sizes = [len(s) * (len(s) + 1) // 2 for s in self.scale]
        found = []
        for part, scale, e in zip(
            jnp.split(theta, np.cumsum(sizes)[:-1]), self.scale, self.complements, strict=True
        ):
            lower = jnp.zeros_like(scale).at[np.tril_indices(len(scale))].set(part)
            lower = e @ (lower * jnp.sqrt(jnp.diag(scale))[:, None])
            found.append(lower @ lower.T)
        M, D, K = found
        return M, D, K

    def unknowns(self, matrices: Triple) -> Array:
        """Lower factors; eigenvalues below 1 % of the largest are lifted to that."""
        parts = []
        for matrix, scale, e in zip(matrices, self.scale, self.complements, strict=True):
            root = jnp.sqrt(jnp.diag(scale))
            inner = jnp.asarray(e).T @ matrix @ e / root / root[:, None]
            values, vectors = jnp.linalg.eigh(0.5 * (inner + inner.T))
            values = jnp.maximum(values, 0.01 * jnp.abs(values).max(initial=0.0))
            lower = jnp.linalg.cholesky((vectors * values) @ vectors.T)
            parts.append(lower[np.tril_indices(len(scale))])
        return jnp.concatenate(parts)


def entry_sizes(
    matrices: tuple[np.ndarray, np.ndarray, np.ndarray],
    complements: tuple[np.ndarray, np.ndarray, np.ndarray],
    rate: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Typical size of the entries of M, D, K, from the diagonals of M, of 1 % of rate * M, and of K.

    Args:
        matrices: a first guess of M, D, K.
        complements: as for `SymmetricMatrices`.
        rate: a typical angular frequency, rad/s.
    """
    sizes = []
    for matrix, e in zip((matrices[0], 0.01 * rate * matrices[0], matrices[2]), complements, strict=True):
        diagonal = np.abs(np.diag(e.T @ matrix @ e))
        root = np.sqrt(np.maximum(diagonal, 1e-6 * diagonal.max(initial=0.0)))
        sizes.append(root * root[:, None])
    return sizes[0], sizes[1], sizes[2]


def _symmetric(upper: Array, size: int, scale: Matrix) -> Array:
    i, j = np.triu_indices(size)
    x = jnp.zeros((size, size), upper.dtype).at[i, j].set(upper)
    return (x + jnp.triu(x, 1).T) * scale
