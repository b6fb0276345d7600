"""Entries of fitted matrices as values with deviations and correlation, where they are not made of elements."""

import numpy as np

from jaxsid.mechanics.lumped import LumpedModel, second_order
from jaxsid.physical.elements import QUANTITIES, Element, ElementValues, pair_name
from jaxsid.physical.inband_fit import MatrixFit
from jaxsid.records import as_array

MOST = 24  # entries; the largest are kept
TINY = 1e-9  # next to the largest entry of a matrix: none at all


def fitted_entries(fit: MatrixFit, model: LumpedModel) -> ElementValues:
    """The largest entries of M, D and K on and above the diagonal, each next to its matrix's largest.

    Args:
        fit: of free matrices.
        model: nominal; gives names and numbers to compare with.
    """
    size = len(model.bodies)
    upper = np.triu_indices(size)
    matrices = np.stack([np.asarray(x)[upper] for x in fit.matrices])
    relative = np.abs(matrices) / np.abs(matrices).max(axis=1, keepdims=True)
    order = np.argsort(-relative.ravel(), kind="stable")[:MOST]
    kept = np.sort(order[relative.ravel()[order] > TINY])
    which, entry = np.divmod(kept, len(upper[0]))
    i, j = upper[0][entry], upper[1][entry]
    slopes = np.stack([np.asarray(fit.slopes[w])[a, b] for w, a, b in zip(which, i, j, strict=True)])
    covariance = slopes @ np.asarray(fit.covariance) @ slopes.T
    deviation = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(deviation > 0, deviation, np.nan)
    nominal = second_order(model)
    numbers = np.stack([np.asarray(getattr(nominal, quantity))[upper] for quantity in QUANTITIES])
    return ElementValues(
        tuple(
            Element(pair_name(model.bodies[a], model.bodies[b]), QUANTITIES[w])
            for w, a, b in zip(which, i, j, strict=True)
        ),
        values=as_array(matrices[which, entry]),
        deviation=as_array(deviation),
        correlation=as_array(covariance / safe / safe[:, None]),
        nominal=as_array(numbers[which, entry]),
    )
