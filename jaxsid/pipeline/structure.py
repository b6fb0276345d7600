"""The values of the model's own elements, where the records do not contradict how it is joined."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxsid.mechanics.lumped import LumpedModel
from jaxsid.physical.elements import (
    ElementValues,
    LinearMatrices,
    blind_elements,
    element_matrices,
    element_values,
    unit_diagonal,
)
from jaxsid.physical.inband_fit import MatrixFit, Target, fit_matrices
from jaxsid.physical.parameterization import BLIND, Triple
from jaxsid.records import SecondOrderModel

CHANCE = 2.326  # standard deviations that chance exceeds once in a hundred times


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
    growth = (elements.squares - free.squares) / jnp.maximum(free.misfit, 1.0)
    return _by_chance(growth, free.unknowns.size, elements)


def _by_chance(growth: Array | float, unknowns: Array | int, elements: MatrixFit) -> bool:
    """Chi-squared at 1 % by the cube root of E. B. Wilson and M. M. Hilferty, PNAS 17 (1931)."""
    scaled, _ = unit_diagonal(np.asarray(elements.information))
    fewer = max(int(unknowns) - np.linalg.matrix_rank(scaled, tol=BLIND), 1)
    ninth = 2 / (9 * fewer)
    return bool(float(growth) < fewer * (1 - ninth + CHANCE * np.sqrt(ninth)) ** 3)


def undetermined(found: ElementFit) -> np.ndarray:
    """(e,) which elements are part of a combination of unknowns that leaves no trace in the lines.

    Args:
        found: the fit.
    """
    return blind_elements(found.unknowns, np.asarray(found.fit.information))


def fitted_values(found: ElementFit) -> ElementValues:
    """Values, standard deviations and correlation of the elements.

    Args:
        found: the fit.
    """
    return element_values(
        found.unknowns, found.fit.unknowns, np.asarray(found.fit.covariance), undetermined(found)
    )
