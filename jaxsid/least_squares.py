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
    candidate: Array
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

    def step(product: Array, gradient: Array, damping: Array) -> Array:
        scale = jnp.sqrt(jnp.maximum(jnp.diag(product), jnp.finfo(start.dtype).tiny))
        normal = product / scale / scale[:, None] + damping * jnp.eye(len(start))
        return -jnp.linalg.solve(normal, gradient / scale) / scale

    # the start is the first candidate, so that the evaluation is compiled once
    def advance(state: _State) -> _State:
        found = products(state.candidate)
        better, first = found[0] < state.cost, state.steps == 0
        gained = (state.cost - found[0]) / jnp.maximum(state.cost, jnp.finfo(start.dtype).tiny)
        finished = jnp.where(better, gained < tolerance, state.damping > 1e8) & ~first
        keep = lambda new, old: jnp.where(better, new, old)  # noqa: E731
        value, (cost, product, gradient) = (
            keep(state.candidate, state.value),
            map(keep, found, (state.cost, state.product, state.gradient)),
        )
        changed = jnp.where(better, jnp.maximum(state.damping / 10, 1e-12), state.damping * 10)
        damping = jnp.where(first, state.damping, changed)
        candidate = value + step(product, gradient, damping)
        return _State(value, cost, product, gradient, candidate, damping, state.steps + 1, finished)

    most = jnp.asarray(jnp.inf, start.dtype)
    nothing = jnp.eye(len(start), dtype=start.dtype), jnp.zeros_like(start)
    damping = jnp.asarray(1e-3, start.dtype)
    state = _State(start, most, *nothing, start, damping, jnp.array(0), jnp.array(False))
    last = jax.lax.while_loop(lambda s: ~s.finished & (s.steps < max_steps), advance, state)
    return Minimum(last.value, last.cost, last.product, last.steps)
