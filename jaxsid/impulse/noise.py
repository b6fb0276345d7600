"""How noisy a record is, before any model of it is chosen."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

# More lags describe the noise better, but the regression's cost grows with their square.
MOST_LAGS = 40
MOST_ROWS = 16384


def noise_level(
    u: Float[Array, "records samples inputs"],
    y: Float[Array, "records samples outputs"],
    mask: Float[Array, "records samples"],
) -> Float[Array, " outputs"]:
    """Standard deviation of what past outputs and inputs do not explain in each output.

    The residual of the regression y_t = sum_(i=1)^p a_i y_(t-i) + sum_(i=0)^p b_i u_(t-i) + e_t, corrected for the
    number of its parameters. It is zero to rounding for a noise-free linear system of order up to p, and close to the
    noise where white noise is added to the output. Source: L. Ljung, System Identification, section 7.2.
    """
    # one output after another: batched factorizations side by side can lock up the CPU's thread pool
    return jax.lax.stop_gradient(jax.lax.map(lambda one: _one_output(u, one, mask), jnp.moveaxis(y, 2, 0)))


def _one_output(u: Array, y: Array, mask: Array) -> Array:
    records, s, inputs = u.shape
    lags = max(1, min(MOST_LAGS, records * s // (4 * (1 + inputs))))
    rows = min(s, max(MOST_ROWS // records, 4 * lags))
    u, y, weight = u[:, :rows], y[:, :rows, None], mask[:, :rows].reshape(-1, 1)
    past = [_delay(y, i) for i in range(1, lags + 1)] + [_delay(u, i) for i in range(lags + 1)]
    table = jnp.concatenate([*past, y], axis=2).reshape(records * rows, -1) * weight
    # The last diagonal entry of R is the distance of y from the span of the regressors, free of cancellation.
    distance = jnp.abs(jnp.linalg.qr(table, mode="r")[-1, -1])
    return distance / jnp.sqrt(jnp.maximum(weight.sum() - table.shape[1] + 1, 1))


def _delay(x: Array, lag: int) -> Array:
    """x_(t-lag), zero before the record: it starts at rest."""
    return jnp.pad(x, ((0, 0), (lag, 0), (0, 0)))[:, : x.shape[1]]
