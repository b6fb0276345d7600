"""The most probable M > 0, D >= 0 and K >= 0: an interior-point method on the entries of symmetric matrices.

Every iterate is positive by construction: the cost gains -mu log det of each matrix and -mu log of the distance to each
bound, which no step can cross, and mu goes to zero. Unknowns that are tied or held, and patterns of zeros, stay linear.
"""

from itertools import product
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsid.checks import bad_input
from jaxsid.physical.elements import LinearMatrices
from jaxsid.physical.parameterization import Matrix

FALL = 0.01  # of mu from stage to stage
GAP = 1e-8  # part of the cost that the last mu may still add
STAGES = 12
STEPS = 60  # of one stage
LEAST = 1e-3  # smallest such eigenvalue of a start
PARTS = (0.0, 0.5, 0.8, 0.95, 1.0)  # of the way to the nominal model
LIFTS = (0.0, 0.01, 0.1, 0.5)  # of masses, springs and dampers, in their sizes
INSIDE = 1e-3  # of an unknown's scale: the least distance of a start from its bounds


class Cone(eqx.Module):
    """Where mass is positive, damping and stiffness are not negative.

    Attributes:
        bases: (N, q) orthonormal, of the motions that mass, damping and stiffness can resist at all, each column
            divided by the root of the matrix's size there.
    """

    bases: tuple[Matrix, Matrix, Matrix]


class Edge(NamedTuple):
    """Smallest eigenvalue of mass, damping and stiffness in units of their sizes."""

    mass: float
    damping: float
    stiffness: float


def positive_cone(unknowns: LinearMatrices) -> Cone:
    """The cone of unknowns that may have either sign.

    Args:
        unknowns: which couplings there are; what none of them resists, such as rigid motion, has no eigenvalue to
            bound.
    """
    moves = np.asarray(unknowns.mix).any(axis=1) | (np.asarray(unknowns.base) != 0)
    size = np.abs(np.asarray(unknowns.mix)) @ np.asarray(unknowns.scale) + np.abs(np.asarray(unknowns.base))
    bases = []
    for x in unknowns.directions:
        there = np.asarray(x)[moves]
        resisted = np.einsum("eij,ekj->ik", there, there)
        values, vectors = np.linalg.eigh(resisted)
        basis = vectors[:, values > 1e-12 * max(values[-1], 1e-300)]
        scale = np.einsum("e,eij->ij", size[moves], np.abs(there))
        bases.append(basis / np.sqrt(np.maximum(np.einsum("iq,ij,jq->q", basis, scale, basis), 1e-300)))
    return Cone((bases[0], bases[1], bases[2]))


def edge(cone: Cone, unknowns: LinearMatrices, theta: Array) -> Edge:
    """How far unknowns are from where a matrix is singular; negative outside.

    Args:
        cone: of the unknowns.
        unknowns: what theta means.
        theta: unknowns.
    """
    found = []
    for matrix, basis in zip(unknowns.matrices(theta), cone.bases, strict=True):
        inner = np.asarray(basis).T @ np.asarray(matrix) @ basis
        found.append(
            float(np.linalg.eigvalsh(inner).min(initial=np.inf)) if np.isfinite(inner).all() else -np.inf
        )
    return Edge(*found)


def inside(
    cone: Cone, unknowns: LinearMatrices, start: Array, lower: np.ndarray, upper: np.ndarray
) -> Float[np.ndarray, " p"]:
    """A start that is positive and within bounds: near the one given, masses, springs and dampers raised until it is.

    Args:
        cone: of the unknowns.
        unknowns: what theta means.
        start: (p,) unknowns.
        lower, upper: (p,) their bounds.

    Raises:
        InputError: what is held fixed leaves no room.
    """
    room = np.minimum(INSIDE, 0.25 * (upper - lower))
    diagonal = np.zeros(len(unknowns.listed))
    for x in unknowns.directions:  # what adds to a diagonal and takes from none can only help
        traces = np.einsum("eii->e", np.asarray(x))
        diagonal = np.where(traces > 0, 1.0, diagonal)
    raised = np.sign(diagonal @ np.asarray(unknowns.mix))
    nominal = np.asarray(unknowns.of_values(jnp.asarray(unknowns.nominal)))
    theta = np.asarray(start)
    for part, lift in product(PARTS, LIFTS):
        theta = (1 - part) * np.asarray(start) + part * nominal + lift * raised
        theta = np.clip(theta, lower + room, upper - room)
        if min(edge(cone, unknowns, jnp.asarray(theta))) > LEAST:
            return theta
    which = [name for name, x in edge(cone, unknowns, jnp.asarray(theta))._asdict().items() if x <= LEAST]
    bad_input(
        f"the values that are fixed, tied or bounded leave no positive {' and '.join(which)}. Free some of them, or "
        "refine the model's elements instead of matrices."
    )


def barrier(
    cone: Cone, unknowns: LinearMatrices, theta: Array, lower: Array, upper: Array
) -> tuple[Array, Array, Array]:
    """-log det of M, D and K and -log of the distances to bounds: value, matrix of second derivatives, slope.

    d(-log det A)/d theta_i = -tr(A^-1 A_i), and d2/(d theta_i d theta_j) = tr(A^-1 A_i A^-1 A_j). Not finite outside.

    Args:
        cone: of the unknowns.
        unknowns: what theta means.
        theta: (p,).
        lower, upper: (p,) bounds, infinite where there are none.
    """
    low, high = theta - lower, upper - theta
    value = -jnp.where(jnp.isfinite(low), jnp.log(low), 0.0).sum()
    value -= jnp.where(jnp.isfinite(high), jnp.log(high), 0.0).sum()
    slope = -1 / low + 1 / high
    second = jnp.diag(1 / low**2 + 1 / high**2)
    for matrix, change, basis in zip(unknowns.matrices(theta), unknowns.slopes, cone.bases, strict=True):
        inner, along = basis.T @ matrix @ basis, basis.T @ change @ basis
        root = jnp.linalg.cholesky(inner)  # NaN where it is not positive, which no step is accepted with
        half = jax.vmap(lambda x, root=root: jax.scipy.linalg.solve_triangular(root, x, lower=True))
        white = half(jnp.swapaxes(half(along), 1, 2))
        value -= 2 * jnp.log(jnp.diag(root)).sum()
        slope -= jnp.einsum("pii->p", white)
        second += jnp.einsum("pij,qij->pq", white, white)
    return value, second, slope
