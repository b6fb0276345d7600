"""The values of the model's own elements, where the records do not contradict how it is joined."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxsid.compilation import compiled
from jaxsid.mechanics.lumped import LumpedModel
from jaxsid.physical.elements import ElementValues, LinearMatrices, element_matrices
from jaxsid.physical.inband_fit import BLIND, MatrixFit, Target, fit_matrices
from jaxsid.physical.parameterization import Triple
from jaxsid.pipeline.state_space import StateSpace
from jaxsid.records import SecondOrderModel, as_array

CHANCE = 2.326  # standard deviations that chance exceeds once in a hundred times
TRACE = 1e-4  # part of an unknown in such combinations from which on it is not determined
# Damping ratios that are added to every mode in turn, so that modes far from where they are to be are seen from there.
WIDENED = (0.5, 0.2, 0.06)
POINTS = 96  # frequencies of a widened response


class ElementFit(NamedTuple):
    """The fit whose unknowns are the values of a model, and these."""

    fit: MatrixFit
    unknowns: LinearMatrices


def fit_elements(
    model: LumpedModel, target: Target, start: Triple, sensed: SecondOrderModel
) -> ElementFit | None:
    """The values that fit the lines best; springs and dampers that would be negative are left out.

    Args:
        model: says what is joined.
        target: the lines.
        start: M, D, K to begin with.
        sensed: gives the input matrix and the sensors.
    """
    unknowns = element_matrices(model)
    signed = np.array([model.matrices is None and x.quantity != "mass" for x in unknowns.listed])
    for _ in unknowns.listed:
        fit = fit_matrices(target, unknowns, start, sensed)
        values = np.asarray(unknowns.values(fit.unknowns))
        if not (np.isfinite(fit.misfit) and _possible(fit.matrices[0])):
            return None
        negative = signed & (values < 0)
        if not negative.any():
            return ElementFit(fit, unknowns)
        unknowns = unknowns.held(negative, np.zeros(len(values)))
        start = fit.matrices
    return None


def _possible(mass: Array) -> bool:
    return bool(np.linalg.eigvalsh(np.asarray(mass))[0] > 0)


def uncontradicted(elements: MatrixFit) -> bool:
    """Whether the lines ask for no other symmetric M, D, K, by the score test, which needs no second fit.

    Args:
        elements: a fit of elements.
    """
    return _by_chance(elements.excess, elements.reach, elements)


def as_good(elements: MatrixFit, free: MatrixFit) -> bool:
    """Whether fewer unknowns fit as well, up to chance: the growth of the sum of squares.

    Args:
        elements: the fit with fewer unknowns.
        free: the one with more, which says what noise is.
    """
    return _by_chance(elements.squares - free.squares, free.unknowns.size, elements)


def _by_chance(growth: Array | float, unknowns: Array | int, elements: MatrixFit) -> bool:
    """Chi-squared at 1 % by the cube root of E. B. Wilson and M. M. Hilferty, PNAS 17 (1931)."""
    fewer = max(int(unknowns) - np.linalg.matrix_rank(_scaled(elements)[0], tol=BLIND), 1)
    ninth = 2 / (9 * fewer)
    return bool(float(growth) < fewer * (1 - ninth + CHANCE * np.sqrt(ninth)) ** 3)


def _scaled(fit: MatrixFit) -> tuple[np.ndarray, np.ndarray]:
    """Information with a diagonal of ones, and its roots before."""
    information = np.asarray(fit.information)
    root = np.sqrt(np.diag(information))
    safe = np.where(root > 0, root, 1.0)
    return information / safe / safe[:, None], root


def undetermined(found: ElementFit) -> np.ndarray:
    """(e,) which elements are part of a combination of unknowns that leaves no trace in the lines.

    Args:
        found: the fit.
    """
    scaled, root = _scaled(found.fit)
    values, vectors = np.linalg.eigh(scaled)
    lost = np.linalg.norm(vectors[:, values < BLIND * values[-1]], axis=1)
    return (np.asarray(found.unknowns.mix) != 0) @ ((lost > TRACE) | (root == 0))


def element_values(found: ElementFit) -> ElementValues:
    """Values, standard deviations and correlation of the elements.

    Args:
        found: the fit.
    """
    unknowns = found.unknowns
    mix = np.asarray(unknowns.mix) * np.asarray(unknowns.scale)
    covariance = mix @ np.asarray(found.fit.covariance) @ mix.T
    spread = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    blind = undetermined(found)
    safe = np.where(~blind & (spread > 0), spread, np.nan)
    return ElementValues(
        unknowns.listed,
        values=as_array(np.asarray(unknowns.values(found.fit.unknowns))),
        deviation=as_array(np.where(blind, np.inf, spread)),
        correlation=as_array(covariance / safe / safe[:, None]),
        nominal=as_array(np.asarray(unknowns.nominal)),
    )


def widened_start(model: LumpedModel, space: StateSpace, sensed: SecondOrderModel, highest: float) -> Triple:
    """M, D, K near those of the state-space model, found from the nominal ones over responses of ever narrower peaks.

    The responses are those of the identified model on rays s = w (z + j sqrt(1 - z^2)) off the imaginary axis, where
    every mode has z more of damping: peaks that are apart by half of their frequencies still overlap there.

    Args:
        model: nominal.
        space: the state-space model.
        sensed: gives the input matrix and the sensors.
        highest: rad/s, the end of the band.
    """
    matrices: Triple = (sensed.mass, sensed.damping, sensed.stiffness)
    unknowns = element_matrices(model)
    sizes = np.abs(np.linalg.eigvals(np.asarray(space.model.A)))
    lowest = max(sizes.min(), 1e-3 * sizes.max()) / 3
    w = np.geomspace(lowest, max(highest, 3 * lowest), POINTS)
    for ratio in WIDENED:
        s = jax.device_put(w * (ratio + 1j * np.sqrt(1 - ratio**2)))
        target = _response_target(space, s)
        matrices = fit_matrices(target, unknowns, matrices, sensed).matrices
    return matrices


def _response_target(space: StateSpace, s: Array) -> Target:
    """The identified model's response to each input in turn at points s, as lines without transients."""
    return _stacked(space.model.A, space.model.B, space.model.C, space.model.D, s)


@compiled
def _stacked(A: Array, B: Array, C: Array, D: Array, s: Array) -> Target:
    inner = jnp.linalg.solve(s[:, None, None] * jnp.eye(len(A)) - A, B.astype(s.dtype))
    y = jnp.swapaxes(C @ inner + D, 0, 1)  # outputs, points, inputs
    count = len(s) * B.shape[1]
    y = jnp.swapaxes(y, 1, 2).reshape(len(C), count).T
    drive = jnp.repeat(jnp.eye(B.shape[1], dtype=s.dtype), len(s), axis=0)
    points = jnp.tile(s, B.shape[1])
    weight = 1 / jnp.maximum(jnp.abs(y), 1e-3 * jnp.abs(y).max(axis=0))
    return Target(points, points, jnp.zeros((count, 1)), jnp.zeros(1), drive, y, weight)
