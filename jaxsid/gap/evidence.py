"""How well a force of one place explains lines: evidence of a Gaussian process and of columns beside it.

The lines are r = sum_i c_i b_i + g f + noise, where f is a Matern-3/2 process of spectral density
S(w) = 4 l^3 s^2 / (l^2 + w^2)^2 behind the transfer g, the b_i are independent with known variances, and the noise is
independent from line to line (P. Whittle, Ark. Mat. 2, 1953). All follow a normal law, so that the evidence is closed.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float

from jaxsid.gap.spectra import stacked

RIDGE = 1e-12  # of a matrix with ones on its diagonal: more than its rounding


class Force(NamedTuple):
    """Matern-3/2 processes: standard deviation and rate l, 1/s, each (hypotheses,)."""

    size: Float[Array, " h"]
    rate: Float[Array, " h"]


class Table(NamedTuple):
    """What the evidence needs of a record, for each hypothesis of the force.

    Attributes:
        gram: (h, k + 1, k + 1) products of the whitened columns, the data last, over all lines.
        log_determinant: (h,) of the covariance of lines and transients, up to what all hypotheses share.
    """

    gram: Float[Array, "h k1 k1"]
    log_determinant: Float[Array, " h"]


class Evidence(NamedTuple):
    """Logarithms of evidence, and the coefficients that go with them along one more axis."""

    value: np.ndarray
    coefficients: np.ndarray


def density(force: Force, omega: Float[Array, " lines"], dt: Array) -> Float[Array, "h lines"]:
    """Variance of the lines of a sampled Matern-3/2 process.

    Args:
        force: hypotheses.
        omega: rad/s.
        dt: sampling interval, s.
    """
    size, rate = force.size[:, None], force.rate[:, None]
    return 4 * rate**3 * size**2 / (rate**2 + omega**2) ** 2 / dt


def split(
    columns: Complex[Array, "lines outputs k"], transfer: Complex[Array, "lines outputs"]
) -> tuple[Complex[Array, "lines k"], Complex[Array, "lines outputs k"], Float[Array, " lines"]]:
    """The part of columns along a transfer, the rest, and the transfer's square; all in units of the noise.

    Args:
        columns: next to the noise.
        transfer: likewise.
    """
    square = (jnp.abs(transfer) ** 2).sum(axis=1)
    unit = transfer / jnp.sqrt(jnp.where(square > 0, square, 1.0))[:, None]
    along = jnp.einsum("lp,lpk->lk", unit.conj(), columns)
    return along, columns - unit[:, :, None] * along[:, None, :], square


def table(
    columns: Complex[Array, "lines outputs k1"],
    free: Complex[Array, "lines outputs n"],
    transfer: Complex[Array, "lines outputs"],
    scale: Float[Array, "lines outputs"],
    density: Float[Array, "h lines"],
    transient: Float[Array, " n"],
) -> Table:
    """Products of columns whitened by noise and force, transients left out.

    Args:
        columns: of the model, the data last.
        free: of the state at the start less that at the end, a nuisance of the record.
        transfer: from the force.
        scale: one over the noise's standard deviation, times the root of a line's weight; 0 where nothing is known.
        density: of the force.
        transient: standard deviations of that state.
    """
    every = jnp.concatenate([free * transient, columns], axis=2) * scale[:, :, None]
    along, rest, square = split(every, transfer * scale)
    beside = 2 * stacked(rest).T @ stacked(rest)
    rows = stacked(along[:, None, :])

    def whitened(one: Array) -> Table:
        gain = 1 / (1 + one * square)
        gram = beside + 2 * (rows * jnp.concatenate([gain, gain])[:, None]).T @ rows
        # lines of half weight are real and count once; those of none have no scale
        weight = (scale > 0).any(axis=1) * 1.0
        return _without_transients(gram, (weight * jnp.log1p(one * square)).sum() * 2, free.shape[2])

    return lax.map(whitened, density)


def _without_transients(gram: Array, log_determinant: Array, count: int) -> Table:
    lower, size = factor_of(gram[:count, :count])
    half = jax.scipy.linalg.solve_triangular(lower, gram[:count, count:] / size[:, None], lower=True)
    return Table(
        gram[count:, count:] - half.T @ half,
        log_determinant + 2 * (jnp.log(jnp.diagonal(lower)) + jnp.log(size)).sum(),
    )


def factor_of(gram: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Float[Array, " n"]]:
    """Cholesky's factor L of I + gram = S L L' S, and S, which is diagonal.

    Args:
        gram: products of the columns of transients; those of a free axis' bodies are alike to the last digit.
    """
    one = jnp.eye(len(gram), dtype=gram.dtype)
    size = jnp.sqrt(jnp.diagonal(gram) + 1)
    return jnp.linalg.cholesky((gram + one) / size / size[:, None] + RIDGE * one), size


def absorbed(
    transfer: Complex[Array, "lines outputs"],
    scale: Float[Array, "lines outputs"],
    density: Float[Array, "h lines"],
) -> Float[Array, " h"]:
    """What noise alone adds to the evidence of each process, on average: the part of it that the process takes up.

    Args:
        transfer: from the force.
        scale: as of `table`.
        density: of the force.
    """
    square = (jnp.abs(transfer * scale) ** 2).sum(axis=1)
    weight = (scale > 0).any(axis=1) * 1.0
    return (weight * density * square / (1 + density * square)).sum(axis=1)


def evidence(tables: Table, prior: Float[np.ndarray, "*shape k"]) -> Evidence:
    """Of each hypothesis, from the tables of all records, added up; with numpy, since the tables are small.

    Args:
        tables: gram (..., h, k + 1, k + 1) and log determinants (..., h).
        prior: (..., variants, k) standard deviations of the coefficients; 0 leaves a column out.

    Returns:
        Evidence: values (..., variants, h), coefficients (..., variants, h, k).
    """
    k = prior.shape[-1]
    gram = np.asarray(tables.gram)[..., None, :, :, :]
    scale = prior[..., None, :]
    own = scale[..., :, None] * gram[..., :k, :k] * scale[..., None, :] + np.eye(k)
    target = scale * gram[..., :k, k]
    found, half = _solved(own, target)
    left = gram[..., k, k] - (target * found).sum(axis=-1)
    determinant = np.asarray(tables.log_determinant)[..., None, :]
    return Evidence(-0.5 * left - half - 0.5 * determinant, scale * found)


def _solved(
    own: Float[np.ndarray, "*shape k k"], target: Float[np.ndarray, "*shape k"]
) -> tuple[Float[np.ndarray, "*shape k"], Float[np.ndarray, "*shape"]]:
    """Solution, and half the logarithm of the determinant, of matrices I + G'G."""
    try:
        lower = np.linalg.cholesky(own)
    except np.linalg.LinAlgError:
        # far above the noise rounding makes eigenvalues below 1
        values, vectors = np.linalg.eigh(own)
        values = np.maximum(values, 1.0)
        parts = (np.swapaxes(vectors, -1, -2) @ target[..., None])[..., 0] / values
        return (vectors @ parts[..., None])[..., 0], 0.5 * np.log(values).sum(axis=-1)
    found = np.linalg.solve(own, target[..., None])[..., 0]
    return found, np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(axis=-1)
