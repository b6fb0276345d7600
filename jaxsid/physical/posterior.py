"""The unknowns that measurements and priors together make most probable, and what is known of them then.

With residual r of unit variance and prior rows the posterior has the mode of least norm(r)^2, and near it the
precision J'J. The search is Levenberg's and Marquardt's: this library's own, which takes a third of the steps of
optimistix's here, or any least-squares solver of optimistix; within bounds jaxopt's LBFGSB finds out which ones hold.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jaxtyping import Array, Bool, Float, Int

from jaxsid.compilation import compiled
from jaxsid.least_squares import levenberg_marquardt, sums_of
from jaxsid.physical.elements import LinearMatrices
from jaxsid.physical.motion import MotionTerm
from jaxsid.physical.parameterization import Parameterization
from jaxsid.physical.restrictions import Prior, Restricted
from jaxsid.physical.terms import Term

STEPS = 100
SEARCHES = 80  # of the bounded quasi-Newton method, which only finds out which bounds hold
GAIN = 1e-8  # part of the sum of squares that a last step may still bring
ROUNDS = 8  # of changing which bounds hold
NEAR = 1e-7  # of an unknown's scale: closer to a bound it lies on it
Data = Term | MotionTerm
Solver = optimistix.AbstractLeastSquaresSolver


class Posterior(NamedTuple):
    """Where the posterior is largest.

    Attributes:
        theta: (p,) unknowns.
        squares: sum of the squares of the data's weighted residual.
        equations: of the data.
        information: (p, p) J'J of the data.
        gradient: (p,) J'r of data and prior, zero but for unknowns at bounds.
        steps: of the solver.
        converged: whether its tolerance was met.
    """

    theta: Float[Array, " p"]
    squares: Float[Array, ""]
    equations: Int[Array, ""]
    information: Float[Array, "p p"]
    gradient: Float[Array, " p"]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


class _Sums(NamedTuple):
    """r'r, J'J, J'r of the data."""

    squares: Array
    product: Array
    gradient: Array


def _sums(terms: tuple[Data, ...], parameterization: Parameterization, theta: Array) -> _Sums:
    parts = []
    if any(isinstance(term, Term) for term in terms):
        matrices = parameterization.matrices(theta)
        M, D, K = (jnp.moveaxis(x, -1, 0) for x in jax.jacfwd(parameterization.matrices)(theta))
        parts += [sums_of(*term.evaluate(matrices, (M, D, K))) for term in terms if isinstance(term, Term)]
    for term in terms:
        if isinstance(term, MotionTerm):
            assert isinstance(parameterization, LinearMatrices)
            r, j = term.projected(parameterization, theta)
            parts.append(sums_of(r.ravel(), j.reshape(-1, len(theta))))
    cost, product, gradient = (jnp.stack(x).sum(axis=0) for x in zip(*parts, strict=True))
    return _Sums(2 * cost, product, gradient)


def _with_prior(sums: _Sums, prior: Prior, theta: Array) -> tuple[Array, Array, Array]:
    r, j = prior.rows(theta)
    return sums.squares + r @ r, sums.product + j.T @ j, sums.gradient + j.T @ r


@compiled
def most_probable(
    terms: tuple[Data, ...],
    parameterization: Parameterization,
    prior: Prior,
    start: Float[Array, " p"],
    solver: Solver | None = None,
) -> Posterior:
    """The mode of the posterior near a start.

    Args:
        terms: the data.
        parameterization: what may vary.
        prior: of the unknowns.
        start: (p,) unknowns to begin with.
        solver: of optimistix; None for `levenberg_marquardt`.
    """
    if solver is not None:
        return _by_optimistix(terms, parameterization, prior, start, solver)

    def evaluate(theta: Array) -> tuple[Array, Array, Array]:
        squares, product, gradient = _with_prior(_sums(terms, parameterization, theta), prior, theta)
        return 0.5 * squares, product, gradient

    found = levenberg_marquardt(evaluate, start, max_steps=STEPS, tolerance=GAIN)
    r, j = prior.rows(found.value)
    return Posterior(
        found.value,
        2 * found.cost - r @ r,
        _count(terms),
        found.jacobian_product - j.T @ j,
        found.seen_gradient,
        found.steps,
        found.steps < STEPS,
    )


def _count(terms: tuple[Data, ...]) -> Array:
    return jnp.asarray(sum(term.equations for term in terms))


def _by_optimistix(
    terms: tuple[Data, ...], parameterization: Parameterization, prior: Prior, start: Array, solver: Solver
) -> Posterior:
    """The same by a solver of optimistix, to which all equations are p + 1 with the same squares and slopes."""

    def both(theta: Array) -> tuple[Array, Array]:
        return _factored(*_with_prior(_sums(terms, parameterization, theta), prior, theta))

    @jax.custom_jvp
    def residual(theta: Array) -> Array:
        return both(theta)[0]

    def moved(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
        value, jacobian = both(*primals)
        return value, jacobian @ tangents[0]

    residual.defjvp(moved)
    found = optimistix.least_squares(
        lambda theta, _: residual(theta), solver, start, max_steps=STEPS, throw=False
    )
    sums = _sums(terms, parameterization, found.value)
    _, _, gradient = _with_prior(sums, prior, found.value)
    steps, converged = jnp.asarray(found.stats["num_steps"]), found.result == optimistix.RESULTS.successful
    return Posterior(found.value, sums.squares, _count(terms), sums.product, gradient, steps, converged)


def _factored(squares: Array, product: Array, gradient: Array) -> tuple[Array, Array]:
    """A residual of p + 1 numbers and its Jacobian with these sums.

    The Jacobian is the symmetric root of J'J, which changes no faster than this does from step to step.
    """
    scale = jnp.sqrt(jnp.diag(product))
    safe = jnp.where(scale > 0, scale, 1.0)
    size = len(scale)
    values, vectors = jnp.linalg.eigh(product / safe / safe[:, None])
    seen = values > 8 * size * jnp.finfo(product.dtype).eps
    root = jnp.sqrt(jnp.where(seen, values, 1.0))
    inner = vectors @ jnp.where(seen, vectors.T @ (gradient / safe) / root, 0.0)
    rest = jnp.sqrt(jnp.maximum(squares - inner @ inner, 0.0))
    rows = (vectors * jnp.where(seen, root, 0.0)) @ vectors.T * scale
    return jnp.append(inner, rest), jnp.concatenate([rows, jnp.zeros((1, size))])


@compiled
def squares_at(terms: tuple[Data, ...], parameterization: Parameterization, theta: Array) -> Array:
    """Sum of the squares of the data's weighted residual.

    Args:
        terms: the data.
        parameterization: what the unknowns mean.
        theta: unknowns.
    """
    return _sums(terms, parameterization, theta).squares


@compiled
def _bounded(
    terms: tuple[Data, ...],
    parameterization: Parameterization,
    prior: Prior,
    start: Array,
    lower: Array,
    upper: Array,
) -> Array:
    """The mode within bounds, nearly: the limited-memory quasi-Newton method of R. Byrd et al. (1995), jaxopt."""
    import jaxopt

    count = jnp.maximum(_count(terms), 1)

    def cost(theta: Array) -> tuple[Array, Array]:
        squares, _, gradient = _with_prior(_sums(terms, parameterization, theta), prior, theta)
        return 0.5 * squares / count, gradient / count

    solver = jaxopt.LBFGSB(cost, value_and_grad=True, maxiter=SEARCHES, tol=1e-9)
    return solver.run(start, bounds=(lower, upper)).params


class BoundedFit(NamedTuple):
    """A mode within bounds.

    Attributes:
        posterior: over all unknowns; those at bounds have no information.
        unknowns: with those at bounds held.
        at_bound: (p,) which these are.
    """

    posterior: Posterior
    unknowns: LinearMatrices
    at_bound: Bool[np.ndarray, " p"]


def within_bounds(
    terms: tuple[Data, ...], known: Restricted, start: Array, solver: Solver | None = None
) -> BoundedFit:
    """The mode of the posterior within the bounds, exact for those that hold: an active-set method.

    Where the free mode lies outside, what it exceeds is held at the bounds and the rest fitted anew; bounds that are
    met on the way are added, those from which the posterior pulls inwards released. Where that does not come to an
    end a bounded search says which hold.

    Args:
        terms: the data.
        known: unknowns, bounds, priors.
        start: (p,) unknowns to begin with.
        solver: as of `most_probable`.
    """
    free, scale = known.unknowns, np.asarray(known.unknowns.scale)
    lower, upper = known.lower / scale, known.upper / scale
    begin = jnp.asarray(np.clip(np.asarray(start), lower, upper))
    found = most_probable(terms, free, known.prior, begin, solver)
    at = np.asarray(found.theta)
    outside = (at < lower) | (at > upper)
    if not np.isfinite(at).all() or not outside.any():
        return BoundedFit(found, free, np.zeros(len(at), bool))
    fit, settled = _with_active_bounds(terms, known, at, outside, solver)
    if settled:
        return fit
    at = np.clip(at, lower, upper)
    at = np.asarray(_bounded(terms, free, known.prior, *(jnp.asarray(x) for x in (at, lower, upper))))
    near = (at - lower < NEAR) | (upper - at < NEAR)
    searched, settled = _with_active_bounds(terms, known, at, near, solver)
    return searched if settled or searched.posterior.squares < fit.posterior.squares else fit


def _with_active_bounds(
    terms: tuple[Data, ...], known: Restricted, start: np.ndarray, held: np.ndarray, solver: Solver | None
) -> tuple[BoundedFit, bool]:
    """The mode with some unknowns at their bounds, these changed until all pull outwards; whether they were."""
    free, scale = known.unknowns, np.asarray(known.unknowns.scale)
    lower, upper, at = known.lower / scale, known.upper / scale, start
    for _ in range(ROUNDS):
        at = np.clip(at, lower, upper)
        unknowns = free.held(held, at * scale)
        weight = np.where(held, 0.0, np.asarray(known.prior.weight))
        found = most_probable(terms, unknowns, Prior(known.prior.mean, weight), jnp.asarray(at), solver)
        at = np.where(held, at, np.asarray(found.theta))
        fit = BoundedFit(found._replace(theta=jnp.asarray(at)), unknowns, held)
        outside = (at < lower) | (at > upper)
        if outside.any():
            held = held | outside
            continue
        pull = np.asarray(gradient_at(terms, free, known.prior, jnp.asarray(at)))
        released = held & np.where(at - lower < upper - at, pull < 0, pull > 0)
        if not released.any():
            return fit, True
        held = held & ~released
    last = found._replace(theta=jnp.asarray(np.clip(at, lower, upper)), converged=jnp.asarray(False))
    return BoundedFit(last, unknowns, held), False


@compiled
def gradient_at(
    terms: tuple[Data, ...], parameterization: Parameterization, prior: Prior, theta: Array
) -> Array:
    """Slope of half the sum of squares of data and prior.

    Args:
        terms: the data.
        parameterization: what the unknowns mean.
        prior: of the unknowns.
        theta: unknowns.
    """
    return _with_prior(_sums(terms, parameterization, theta), prior, theta)[2]
