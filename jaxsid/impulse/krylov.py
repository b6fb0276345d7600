"""Regularized least squares with an operator that is only applied: y = A z + noise, z ~ N(0, tau^2 I).

Golub-Kahan bidiagonalization A V = U B projects the problem once; every strength of the regularization is then a
small problem in B. The strength is the one that maximizes the marginal likelihood of y at a known noise level.
Sources: D. O'Leary and J. Simmons, SIAM J. Sci. Stat. Comput. 2 (1981) 474-489; for the likelihood, G. Pillonetto et
al., Automatica 50 (2014) 657-682.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

# Ratios of the regularization to the largest squared singular value that are tried.
STRENGTHS = 49


class Quadrature(eqx.Module):
    """Gauss quadrature for traces of functions of A A': sum_i weights_i f(nodes_i). Attributes: nodes,
    weights."""

    nodes: Float[Array, " k"]
    weights: Float[Array, " k"]


class Solution(eqx.Module):
    """Attributes: z the solution, cost -2 log likelihood, freedom effective number of parameters, misfit |y
    - A z|^2."""

    z: Float[Array, " n"]
    cost: Float[Array, ""]
    freedom: Float[Array, ""]
    misfit: Float[Array, ""]


def bidiagonalize(
    forward: Callable[[Array], Array], y: Array, z: Array, steps: int
) -> tuple[Float[Array, ""], Float[Array, "k1 k"], Float[Array, "k n"]]:
    """beta, B (steps + 1, steps) lower bidiagonal and V (steps, n) with A V' = U B, y = beta U e_1.

    V is reorthogonalized, which keeps U orthogonal too (H. Simon and H. Zha, SIAM J. Sci. Comput. 21, 2000).
    Once the space is exhausted the rest is zero.
    """
    backward = jax.linear_transpose(forward, jax.ShapeDtypeStruct(z.shape, z.dtype))
    tiny = jnp.finfo(z.dtype).eps
    beta, u = _unit(y, 0.0)
    alpha, v = _unit(backward(u)[0], 0.0)
    scale = alpha

    def step(i, carry):
        u, alpha, V, B = carry
        v = V[i]
        B = B.at[i, i].set(alpha)
        b, u = _unit(forward(v) - alpha * u, tiny * scale)
        B = B.at[i + 1, i].set(b)
        w = backward(u)[0] - b * v
        w = w - V.T @ (V @ w)
        w = w - V.T @ (V @ w)
        alpha, w = _unit(w, tiny * scale)
        return u, alpha, V.at[i + 1].set(w), B

    V = jnp.zeros((steps + 1, z.size), z.dtype).at[0].set(v)
    B = jnp.zeros((steps + 1, steps), z.dtype)
    *_, V, B = jax.lax.fori_loop(0, steps, step, (u, alpha, V, B))
    return beta, B, V[:steps]


def _unit(x: Array, floor: Array | float) -> tuple[Array, Array]:
    """Length and direction; both zero at or below the floor."""
    squared = jnp.sum(x**2)
    kept = squared > jnp.asarray(floor, x.dtype) ** 2
    length = jnp.where(kept, jnp.sqrt(jnp.where(kept, squared, 1)), 0)
    return length, jnp.where(kept, x / jnp.where(kept, length, 1), 0)


def trace_quadrature(
    forward: Callable[[Array], Array], mask: Array, z: Array, key: Array, steps: int
) -> Quadrature:
    """Stochastic Lanczos quadrature from one random sign vector (S. Ubaru, J. Chen, Y. Saad, SIMAX 38, 2017).

    The bidiagonalization from y knows the singular values that y excites but not how many there are of each, and so
    would count too few parameters; a random start counts them.
    """
    probe = jax.random.rademacher(key, mask.shape, z.dtype) * mask
    _, B, _ = bidiagonalize(forward, probe, z, steps)
    P, s, _ = jnp.linalg.svd(B)
    return jax.lax.stop_gradient(Quadrature(nodes=s**2, weights=mask.sum() * P[0, :-1] ** 2))


def solve(
    forward: Callable[[Array], Array],
    y: Array,
    z: Array,
    noise_std: Array,
    trace: Quadrature,
    steps: int,
    ridge: float | None,
) -> Solution:
    """The most likely z; `ridge` fixes the regularization, relative to the largest squared singular value."""
    beta, B, V = bidiagonalize(forward, y, z, steps)
    P, s, _ = jnp.linalg.svd(jax.lax.stop_gradient(B))
    c = (jax.lax.stop_gradient(beta) * P[0]) ** 2
    eps = jnp.finfo(z.dtype).eps
    grid = jnp.logspace(2 * jnp.log10(eps), 1, STRENGTHS) if ridge is None else jnp.full((1,), ridge)
    grid = (grid * s[0] ** 2).astype(z.dtype)
    variance = jnp.maximum(noise_std, eps * jnp.sqrt(jnp.mean(y**2))) ** 2

    def cost(gamma):
        damped = jnp.append(gamma / (s**2 + gamma), 1.0)
        return jnp.sum(c * damped) / variance + trace.weights @ jnp.log1p(trace.nodes / gamma)

    costs = jax.vmap(cost)(grid)
    best = jnp.argmin(costs)
    gamma = grid[best]
    # By QR of [B; sqrt(gamma) I]: it has a derivative and keeps what normal equations would lose.
    k = B.shape[1]
    Q, R = jnp.linalg.qr(jnp.concatenate([B, jnp.sqrt(gamma) * jnp.eye(k, dtype=B.dtype)]))
    x = jax.scipy.linalg.solve_triangular(R, beta * Q[0], lower=False)
    misfit = jnp.sum((B @ x - beta * jnp.eye(k + 1, 1, dtype=B.dtype)[:, 0]) ** 2)
    freedom = trace.weights @ (trace.nodes / (trace.nodes + gamma))
    return Solution(z=V.T @ x, cost=costs[best], freedom=freedom, misfit=misfit)
