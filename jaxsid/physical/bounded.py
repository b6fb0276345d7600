"""The mode of a posterior where unknowns have bounds, or matrices must be positive.

Bounds: the free mode, what it exceeds held, by an active-set method; jaxopt's LBFGSB finds out which ones hold where
that does not come to an end. Positive matrices: the free mode if it is positive, else an interior-point method.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxsid.compilation import compiled
from jaxsid.least_squares import levenberg_marquardt
from jaxsid.physical.elements import LinearMatrices
from jaxsid.physical.interior import FALL, GAP, STAGES, STEPS, Cone, Edge, barrier, edge, inside
from jaxsid.physical.posterior import (
    Data,
    Posterior,
    Solver,
    count,
    gradient_at,
    most_probable,
    posterior_at,
    sums,
    with_prior,
)
from jaxsid.physical.restrictions import Prior, Restricted

SEARCHES = 80  # of the bounded quasi-Newton method, which only finds out which bounds hold
ROUNDS = 8  # of changing which bounds hold
CLOSE = 1e-3  # of an unknown's scale or a matrix's size: where the way along the barrier ends, if it holds
NEAR = 1e-7  # of an unknown's scale: closer to a bound it lies on it


class BoundedFit(NamedTuple):
    """A mode within bounds.

    Attributes:
        posterior: over all unknowns; those at bounds have no information.
        unknowns: with those at bounds held.
        at_bound: (p,) which these are.
        singular: matrices that are positive only just: "mass", "damping", "stiffness".
    """

    posterior: Posterior
    unknowns: LinearMatrices
    at_bound: Bool[np.ndarray, " p"]
    singular: tuple[str, ...] = ()


def within_bounds(
    terms: tuple[Data, ...], known: Restricted, start: Array, solver: Solver | None = None
) -> BoundedFit:
    """The mode of the posterior within the bounds, exact for those that hold: an active-set method.

    Where the free mode lies outside, what it exceeds is held at the bounds and the rest fitted anew; bounds that are
    met on the way are added, those from which the posterior pulls inwards released. Where that does not come to an
    end a bounded search says which hold. Matrices that must be positive are, at every step.

    Args:
        terms: the data.
        known: unknowns, bounds, priors.
        start: (p,) unknowns to begin with.
        solver: as of `most_probable`.
    """
    if known.cone is not None:
        return _positive(terms, known, known.cone, start, solver)
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


def _positive(
    terms: tuple[Data, ...], known: Restricted, cone: Cone, start: Array, solver: Solver | None
) -> BoundedFit:
    """The mode among positive matrices: the free one if it is one of them, else along the central path."""
    unknowns, scale = known.unknowns, np.asarray(known.unknowns.scale)
    lower, upper = known.lower / scale, known.upper / scale
    none = np.zeros(len(scale), bool)

    def allowed(at: Array) -> bool:
        within = (np.asarray(at) >= lower) & (np.asarray(at) <= upper)
        return bool(within.all()) and min(edge(cone, unknowns, at)) > 0

    free = most_probable(terms, unknowns, known.prior, start, solver)
    if allowed(free.theta):
        return BoundedFit(free, unknowns, none)
    theta, mu = jnp.asarray(inside(cone, unknowns, start, lower, upper)), jnp.asarray(0.0)
    ends = jnp.asarray(lower), jnp.asarray(upper)
    for stage in range(STAGES):
        found, cost = _central(terms, unknowns, known.prior, cone, theta, *ends, mu)
        if stage > 0 and float(mu) <= GAP * float(cost):
            break
        theta, mu = found.theta, FALL * (mu if stage else cost)
    last = most_probable(terms, unknowns, known.prior, found.theta, solver)
    if allowed(last.theta):
        return BoundedFit(last, unknowns, none)
    # what a step without the barrier leaves is what holds the fit back
    at, left = np.asarray(found.theta), np.asarray(last.theta)
    near = ((left < lower) & (at - lower < CLOSE)) | ((left > upper) & (upper - at < CLOSE))
    here, beyond = edge(cone, unknowns, found.theta), edge(cone, unknowns, last.theta)
    singular = tuple(n for n in Edge._fields if getattr(beyond, n) <= 0 and getattr(here, n) < CLOSE)
    theta = jnp.where(near, jnp.clip(at, lower, upper), found.theta)
    return BoundedFit(
        found._replace(theta=theta), unknowns.held(near, np.asarray(theta) * scale), near, singular
    )


@compiled
def _central(
    terms: tuple[Data, ...],
    unknowns: LinearMatrices,
    prior: Prior,
    cone: Cone,
    start: Array,
    lower: Array,
    upper: Array,
    mu: Array,
) -> tuple[Posterior, Array]:
    """The mode with mu times the barrier, and half the sum of squares there; the start where mu is 0."""

    def evaluate(theta: Array) -> tuple[Array, Array, Array]:
        squares, product, gradient = with_prior(sums(terms, unknowns, theta), prior, theta)
        value, second, slope = barrier(cone, unknowns, theta, lower, upper)
        return 0.5 * squares + mu * value, product + mu * second, gradient + mu * slope

    steps = jnp.where(mu > 0, STEPS, 1)
    found = levenberg_marquardt(evaluate, start, max_steps=steps, tolerance=1e-3 * GAP)
    last = posterior_at(terms, unknowns, prior, found.value, found.steps, found.steps < steps)
    return last, 0.5 * last.squares


@compiled
def _bounded(
    terms: tuple[Data, ...],
    unknowns: LinearMatrices,
    prior: Prior,
    start: Array,
    lower: Array,
    upper: Array,
) -> Array:
    """The mode within bounds, nearly: the limited-memory quasi-Newton method of R. Byrd et al. (1995), jaxopt."""
    import jaxopt

    equations = jnp.maximum(count(terms), 1)

    def cost(theta: Array) -> tuple[Array, Array]:
        squares, _, gradient = with_prior(sums(terms, unknowns, theta), prior, theta)
        return 0.5 * squares / equations, gradient / equations

    solver = jaxopt.LBFGSB(cost, value_and_grad=True, maxiter=SEARCHES, tol=1e-9)
    return solver.run(start, bounds=(lower, upper)).params
