"""Nonlinear least squares with few unknowns and many equations, as one compiled loop."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class Minimum(NamedTuple):
    """Where a sum of squares is least.

    Attributes:
        value: (n,) the unknowns.
        cost: half the sum of squares.
        jacobian_product: (n, n) J'J there; its inverse is the covariance where the residual has unit variance.
        steps: evaluations used.
    """

    value: Float[Array, " n"]
    cost: Float[Array, ""]
    jacobian_product: Float[Array, "n n"]
    steps: Array


class _State(NamedTuple):
    value: Array
    cost: Array
    product: Array
    gradient: Array
    damping: Array
    steps: Array
    finished: Array


def forward(residual: Callable[[Array], Array]) -> Callable[[Array], tuple[Array, Array]]:
    """A function that returns the residual and its Jacobian, by forward differentiation."""

    def evaluate(value: Array) -> tuple[Array, Array]:
        jacobian, r = jax.jacfwd(lambda v: (residual(v),) * 2, has_aux=True)(value)
        return r.ravel(), jacobian.reshape(-1, len(value))

    return evaluate


def levenberg_marquardt(
    evaluate: Callable[[Array], tuple[Array, Array]],
    start: Float[Array, " n"],
    *,
    max_steps: int | Array,
    tolerance: float | Array = 1e-10,
) -> Minimum:
    """The unknowns that minimize half a sum of squares, by Levenberg and Marquardt.

    Steps solve (J'J + l diag(J'J)) d = -J'r; l falls tenfold after a step that helps and rises tenfold after
    one that does not, which is then undone. Only J'J and J'r are kept from step to step.

    Args:
        evaluate: maps the unknowns to the weighted residual (equations,) and its Jacobian (equations, n).
        start: (n,).
        max_steps: most evaluations.
        tolerance: stop when a helpful step lowers the cost by less than this part.

    Source: D. Marquardt, J. SIAM 11 (1963).
    """

    def products(value: Array) -> tuple[Array, Array, Array]:
        r, j = evaluate(value)
        return 0.5 * r @ r, j.T @ j, j.T @ r

    def advance(state: _State) -> _State:
        scale = jnp.sqrt(jnp.maximum(jnp.diag(state.product), jnp.finfo(start.dtype).tiny))
        normal = state.product / scale / scale[:, None] + state.damping * jnp.eye(len(start))
        step = -jnp.linalg.solve(normal, state.gradient / scale) / scale
        value = state.value + step
        cost, product, gradient = products(value)
        better = cost < state.cost
        gained = (state.cost - cost) / jnp.maximum(state.cost, jnp.finfo(start.dtype).tiny)
        finished = jnp.where(better, gained < tolerance, state.damping > 1e8)
        keep = lambda new, old: jnp.where(better, new, old)  # noqa: E731
        return _State(
            keep(value, state.value),
            keep(cost, state.cost),
            keep(product, state.product),
            keep(gradient, state.gradient),
            jnp.where(better, jnp.maximum(state.damping / 10, 1e-12), state.damping * 10),
            state.steps + 1,
            finished,
        )

    first = _State(start, *products(start), jnp.asarray(1e-3, start.dtype), jnp.array(1), jnp.array(False))
    last = jax.lax.while_loop(lambda s: ~s.finished & (s.steps < max_steps), advance, first)
    return Minimum(last.value, last.cost, last.product, last.steps)
