"""The unknowns that measurements and priors together make most probable, and what is known of them then.

With residual r of unit variance and prior rows the posterior has the mode of least norm(r)^2, and near it the
precision J'J. The search is Levenberg's and Marquardt's: this library's own, which takes a third of the steps of
optimistix's here, or any least-squares solver of optimistix.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optimistix
from jaxtyping import Array, Bool, Float, Int

from jaxsid.compilation import compiled
from jaxsid.least_squares import levenberg_marquardt, sums_of
from jaxsid.physical.elements import LinearMatrices
from jaxsid.physical.motion import MotionTerm
from jaxsid.physical.restrictions import Prior
from jaxsid.physical.terms import Term

STEPS = 100
GAIN = 1e-8  # part of the sum of squares that a last step may still bring
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


class Sums(NamedTuple):
    """r'r, J'J, J'r of the data."""

    squares: Array
    product: Array
    gradient: Array


def sums(terms: tuple[Data, ...], unknowns: LinearMatrices, theta: Array) -> Sums:
    """Of the weighted residual.

    Args:
        terms: the data.
        unknowns: what theta means.
        theta: (p,).
    """
    parts = []
    for term in terms:
        if isinstance(term, MotionTerm):
            r, j = term.projected(unknowns, theta)
            parts.append(sums_of(r.ravel(), j.reshape(-1, len(theta))))
        else:
            parts.append(term.sums(unknowns.matrices(theta), unknowns.slopes))
    cost, product, gradient = (jnp.stack(x).sum(axis=0) for x in zip(*parts, strict=True))
    return Sums(2 * cost, product, gradient)


def with_prior(found: Sums, prior: Prior, theta: Array) -> tuple[Array, Array, Array]:
    """Sum of squares, J'J and J'r of data and prior.

    Args:
        found: those of the data.
        prior: of the unknowns.
        theta: (p,) unknowns.
    """
    r, j = prior.rows(theta)
    return found.squares + r @ r, found.product + j.T @ j, found.gradient + j.T @ r


@compiled
def most_probable(
    terms: tuple[Data, ...],
    unknowns: LinearMatrices,
    prior: Prior,
    start: Float[Array, " p"],
    solver: Solver | None = None,
) -> Posterior:
    """The mode of the posterior near a start.

    Args:
        terms: the data.
        unknowns: what may vary.
        prior: of the unknowns.
        start: (p,) unknowns to begin with.
        solver: of optimistix; None for `levenberg_marquardt`.
    """
    if solver is not None:
        return _by_optimistix(terms, unknowns, prior, start, solver)

    def evaluate(theta: Array) -> tuple[Array, Array, Array]:
        squares, product, gradient = with_prior(sums(terms, unknowns, theta), prior, theta)
        return 0.5 * squares, product, gradient

    found = levenberg_marquardt(evaluate, start, max_steps=STEPS, tolerance=GAIN)
    r, j = prior.rows(found.value)
    return Posterior(
        found.value,
        2 * found.cost - r @ r,
        count(terms),
        found.jacobian_product - j.T @ j,
        found.seen_gradient,
        found.steps,
        found.steps < STEPS,
    )


def count(terms: tuple[Data, ...]) -> Array:
    """Number of equations.

    Args:
        terms: the data.
    """
    return jnp.asarray(sum(term.equations for term in terms))


def _by_optimistix(
    terms: tuple[Data, ...], unknowns: LinearMatrices, prior: Prior, start: Array, solver: Solver
) -> Posterior:
    """The same by a solver of optimistix, to which all equations are p + 1 with the same squares and slopes."""

    def both(theta: Array) -> tuple[Array, Array]:
        return _factored(*with_prior(sums(terms, unknowns, theta), prior, theta))

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
    steps, converged = jnp.asarray(found.stats["num_steps"]), found.result == optimistix.RESULTS.successful
    return posterior_at(terms, unknowns, prior, found.value, steps, converged)


def posterior_at(
    terms: tuple[Data, ...],
    unknowns: LinearMatrices,
    prior: Prior,
    theta: Array,
    steps: Array,
    converged: Array,
) -> Posterior:
    """What is known near unknowns that a search has come to.

    Args:
        terms: the data.
        unknowns: what theta means.
        prior: of the unknowns.
        theta: (p,) unknowns.
        steps, converged: of the search.
    """
    found = sums(terms, unknowns, theta)
    _, _, gradient = with_prior(found, prior, theta)
    return Posterior(theta, found.squares, count(terms), found.product, gradient, steps, converged)


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
def from_each(
    terms: tuple[Data, ...],
    unknowns: LinearMatrices,
    prior: Prior,
    starts: Float[Array, "starts p"],
    solver: Solver | None = None,
) -> Posterior:
    """`most_probable` from several starts: together, or one by one where each is a long simulation.

    Args:
        terms: the data.
        unknowns: what may vary.
        prior: of the unknowns.
        starts: unknowns to begin with.
        solver: of optimistix; None for `levenberg_marquardt`.
    """
    one = lambda start: most_probable(terms, unknowns, prior, start, solver)  # noqa: E731
    together = all(isinstance(term, Term) for term in terms)
    return jax.vmap(one)(starts) if together else jax.lax.map(one, starts)


@compiled
def squares_at(terms: tuple[Data, ...], unknowns: LinearMatrices, theta: Array) -> Array:
    """Sum of the squares of the data's weighted residual.

    Args:
        terms: the data.
        unknowns: what theta means.
        theta: unknowns.
    """
    return sums(terms, unknowns, theta).squares


@compiled
def gradient_at(terms: tuple[Data, ...], unknowns: LinearMatrices, prior: Prior, theta: Array) -> Array:
    """Slope of half the sum of squares of data and prior.

    Args:
        terms: the data.
        unknowns: what theta means.
        prior: of the unknowns.
        theta: unknowns.
    """
    return with_prior(sums(terms, unknowns, theta), prior, theta)[2]
