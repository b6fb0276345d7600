"""Nonlinear least squares with few unknowns and many equations, as one compiled loop."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

RELATIVE = 1e-12  # of J'J's largest diagonal entry: the least, where `through` makes others vanish
PROMISE = (
    1e-3  # of what a last step may bring: where the next one promises less, it is not worth an evaluation
)
LIGHT = (
    0.01  # damping up to which a step is nearly that of Gauss and Newton, so that its promise means something
)


class Minimum(NamedTuple):
    """Where a sum of squares is least.

    Attributes:
        value: (n,) the unknowns.
        cost: half the sum of squares.
        jacobian_product: (n, n) J'J there; its inverse is the covariance where the residual has unit variance.
        steps: evaluations used.
        seen_product, seen_gradient: J'J and J'r for what `evaluate` sees, (m, m) and (m,).
    """

    value: Float[Array, " n"]
    cost: Float[Array, ""]
    jacobian_product: Float[Array, "n n"]
    steps: Array
    seen_product: Float[Array, "m m"]
    seen_gradient: Float[Array, " m"]


class _State(NamedTuple):
    value: Array
    cost: Array
    product: Array
    gradient: Array
    candidate: Array
    promised: Array
    damping: Array
    growth: Array
    steps: Array
    finished: Array


def forward(residual: Callable[[Array], Array]) -> Callable[[Array], tuple[Array, Array]]:
    """A function that returns the residual and its Jacobian, by forward differentiation."""

    def evaluate(value: Array) -> tuple[Array, Array]:
        jacobian, r = jax.jacfwd(lambda v: (residual(v),) * 2, has_aux=True)(value)
        return r.ravel(), jacobian.reshape(-1, len(value))

    return evaluate


Sums = tuple[Array, Array, Array]  # half of r'r, J'J, J'r


def sums_of(residual: Array, jacobian: Array) -> Sums:
    """What a step needs of a residual (equations,) and its Jacobian (equations, n)."""
    return 0.5 * residual @ residual, jacobian.T @ jacobian, jacobian.T @ residual


def levenberg_marquardt(
    evaluate: Callable[[Array], tuple[Array, Array] | Sums],
    start: Float[Array, " n"],
    *,
    max_steps: int | Array,
    tolerance: float | Array = 1e-10,
    through: Callable[[Array], Array] | None = None,
) -> Minimum:
    """The unknowns that minimize half a sum of squares, by Levenberg and Marquardt.

    Steps solve (J'J + l diag(J'J)) d = -J'r. After a step that helps l falls, the more the better the parabola
    foretold the gain; after one that does not, which is undone, it rises faster and faster. Only J'J and J'r are kept
    from step to step.

    Args:
        evaluate: maps the unknowns to the weighted residual (equations,) and its Jacobian (equations, n), or to the
            three sums over them that are needed.
        start: (n,).
        max_steps: most evaluations.
        tolerance: stop when a helpful step lowers the cost by less than this part, or the next one promises to lower
            it by far less.
        through: the unknowns are put through this map before `evaluate` sees them. Its curvature is taken into
            account, as a map that keeps to a set of allowed values needs where the best ones lie on the edge.

    Source: D. Marquardt, J. SIAM 11 (1963); the rule for l: H. B. Nielsen, IMM-REP-1999-05, DTU.
    """
    tiny = jnp.finfo(start.dtype).tiny

    def products(value: Array) -> Sums:
        found = evaluate(value if through is None else through(value))
        return found if len(found) == 3 else sums_of(*found)

    # the start is the first candidate, so that the evaluation is compiled once
    def advance(state: _State) -> _State:
        found = products(state.candidate)
        better, first = found[0] < state.cost, state.steps == 0
        gain = state.cost - found[0]
        small = gain < tolerance * jnp.maximum(state.cost, tiny)
        finished = jnp.where(better, small, state.damping > 1e10) & ~first
        keep = lambda new, old: jnp.where(better, new, old)  # noqa: E731
        value, (cost, product, gradient) = (
            keep(state.candidate, state.value),
            map(keep, found, (state.cost, state.product, state.gradient)),
        )
        foretold = gain / jnp.maximum(state.promised, tiny)
        eased = state.damping * jnp.maximum(1 - (2 * foretold - 1) ** 3, 0.1)
        damping = jnp.where(better, jnp.maximum(eased, 1e-12), state.damping * state.growth)
        damping = jnp.where(first, state.damping, damping)
        growth = jnp.where(better, 2.0, 2 * state.growth)
        candidate, promised = _step(through, value, product, gradient, damping)
        hopeless = (promised < PROMISE * tolerance * cost) & (damping < LIGHT)
        finished = finished | (better & hopeless)
        return _State(
            value, cost, product, gradient, candidate, promised, damping, growth, state.steps + 1, finished
        )

    most, one = jnp.asarray(jnp.inf, start.dtype), jnp.ones((), start.dtype)
    seen = start if through is None else through(start)
    nothing = jnp.eye(len(seen), dtype=start.dtype), jnp.zeros_like(seen)
    state = _State(start, most, *nothing, start, one, 1e-3 * one, 2 * one, jnp.array(0), jnp.array(False))
    last = jax.lax.while_loop(lambda s: ~s.finished & (s.steps < max_steps), advance, state)
    product = last.product
    if through is not None:
        product, _ = _pulled_back(through, last.value, last.product, last.gradient)
    return Minimum(last.value, last.cost, product, last.steps, last.product, last.gradient)


def _step(
    through: Callable[[Array], Array] | None, value: Array, product: Array, gradient: Array, damping: Array
) -> tuple[Array, Array]:
    """The next candidate, and by how much the cost should fall there."""
    if through is None:
        scale = jnp.sqrt(jnp.maximum(jnp.diag(product), jnp.finfo(value.dtype).tiny))
        scaled = product / scale / scale[:, None]
    else:
        outer = gradient
        product, gradient = _pulled_back(through, value, product, outer)
        size = jnp.diag(product)
        scale = jnp.sqrt(jnp.maximum(size, RELATIVE * size.max()))
        scaled = (product + jax.hessian(lambda v: outer @ through(v))(value)) / scale / scale[:, None]
        damping = jnp.maximum(damping, -1.1 * jnp.linalg.eigvalsh(scaled)[0])
    downhill = -gradient / scale
    d = jnp.linalg.solve(scaled + damping * jnp.eye(len(value)), downhill)
    return value + d / scale, downhill @ d - 0.5 * d @ scaled @ d


def _pulled_back(
    through: Callable[[Array], Array], value: Array, product: Array, gradient: Array
) -> tuple[Array, Array]:
    """J'J and J'r for the unknowns that `through` starts from."""
    slopes = jax.jacfwd(through)(value)
    return slopes.T @ product @ slopes, slopes.T @ gradient
