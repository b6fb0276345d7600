"""Symmetric M > 0, D >= 0, K >= 0 in the least-squares sense, from the motion of the states of a realization."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsid.least_squares import forward, levenberg_marquardt

STEPS = 60


def symmetric_positive(
    start: tuple[Float[Array, "N N"], Float[Array, "N N"], Float[Array, "N N"]],
    states: tuple[Float[Array, "N n"], Float[Array, "N n"], Float[Array, "N n"]],
    state_input: Float[Array, "n inputs"],
    gained: Float[Array, "N inputs"],
    input_matrix: Float[Array, "N inputs"],
    spring: Float[Array, "N p"],
    damper: Float[Array, "N q"],
) -> tuple[Float[Array, "N N"], Float[Array, "N N"], Float[Array, "N N"]]:
    """Mass, damping and stiffness that best obey M W + D V + K Q = 0 and M gained = B_u.

    minimize norm(S (M W + D V + K Q))^2 + w^2 norm(S (M gained - B_u))^2 over M = L L', D = F L L' F',
    K = E L L' E', with S the start's inverse mass, which makes residuals accelerations, and w the rate of the
    states. Each state counts as much as it does in the balanced realization.

    Args:
        start: mass, damping, stiffness to begin with; need not be symmetric or positive.
        states: displacement Q, velocity V, acceleration W of the bodies in each state.
        state_input: B of the realization.
        gained: M^-1 B_u as identified.
        input_matrix: B_u.
        spring, damper: complements E, F of the patterns that no spring, no damper resists.

    Source: the symmetric inverse problem of K. Alvin and K. Park, AIAA J. 32 (1994), with positivity by
    Cholesky factors.
    """
    displacement, velocity, acceleration = states
    inverse = jnp.linalg.inv(0.5 * (start[0] + start[0].T))
    rate = jnp.linalg.norm(acceleration) / jnp.linalg.norm(velocity)
    states_size = jnp.linalg.norm(acceleration)
    factors = [
        _factor(start[0], jnp.eye(len(start[0]))),
        _factor(start[1], damper),
        _factor(start[2], spring),
    ]
    sizes = [jnp.max(jnp.abs(f)) for f in factors]
    lower = [np.tril_indices(len(f)) for f in factors]
    ends = np.cumsum([len(i) for i, _ in lower])

    def matrices(x: Array) -> tuple[Array, Array, Array]:
        parts = jnp.split(x, ends[:-1])
        m, d, k = (
            jnp.zeros_like(f).at[i].set(p) * s
            for f, i, p, s in zip(factors, lower, parts, sizes, strict=True)
        )
        return m @ m.T, damper @ d @ d.T @ damper.T, spring @ k @ k.T @ spring.T

    def residual(x: Array) -> Array:
        M, D, K = matrices(x)
        motion = M @ acceleration + D @ velocity + K @ displacement
        impulse = (M @ gained - input_matrix) * rate * jnp.linalg.norm(state_input)
        return inverse @ jnp.concatenate([motion, impulse], axis=1) / states_size

    x = jnp.concatenate([f[i] / s for f, i, s in zip(factors, lower, sizes, strict=True)])
    M, D, K = matrices(levenberg_marquardt(forward(residual), x, max_steps=STEPS).value)
    return M, D, K


def _factor(matrix: Array, complement: Array) -> Array:
    """Lower Cholesky factor of the symmetric part, in the complement, with eigenvalues lifted off zero."""
    inner = complement.T @ matrix @ complement
    values, vectors = jnp.linalg.eigh(0.5 * (inner + inner.T))
    floor = 1e-4 * jnp.max(jnp.abs(values))
    return jnp.linalg.cholesky((vectors * jnp.maximum(values, floor)) @ vectors.T)
