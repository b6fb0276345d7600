"""A start for fits from far away: responses whose peaks are widened until they overlap."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxsid.compilation import compiled
from jaxsid.mechanics.inverses import inverse_each
from jaxsid.physical.inband_fit import Target, fit_matrices
from jaxsid.physical.parameterization import Parameterization, Triple
from jaxsid.records import ContinuousModel, SecondOrderModel

# Damping ratios that are added to every mode in turn.
WIDENED = (0.5, 0.2, 0.06)
POINTS = 96  # frequencies of a widened response


def widened_start(
    unknowns: Parameterization, measured: ContinuousModel, sensed: SecondOrderModel, highest: float
) -> Triple:
    """M, D, K near those of a measured state-space model, from numbers that may be off by half.

    A fit to resonances that lie beside those of the model sees no way to them. On a ray
    s = w (z + j sqrt(1 - z^2)) off the imaginary axis every mode has z more of damping, and its peak is as wide; the
    response there is that of the identified model, and the fits go from wide peaks to narrow ones.

    Args:
        unknowns: what may vary.
        measured: identified state-space model.
        sensed: M, D, K to begin with, the input matrix and the sensors.
        highest: rad/s, the end of the band.
    """
    matrices: Triple = (sensed.mass, sensed.damping, sensed.stiffness)
    sizes = np.abs(np.linalg.eigvals(np.asarray(measured.A)))
    lowest = max(sizes.min(), 1e-3 * sizes.max()) / 3
    w = np.geomspace(lowest, max(highest, 3 * lowest), POINTS)
    for ratio in WIDENED:
        s = jax.device_put(w * (ratio + 1j * np.sqrt(1 - ratio**2)))
        target = _responses(measured.A, measured.B, measured.C, measured.D, s)
        matrices = fit_matrices(target, unknowns, matrices, sensed).matrices
    return matrices


@compiled
def _responses(A: Array, B: Array, C: Array, D: Array, s: Array) -> Target:
    """The model's response to each input in turn at points s, as lines without transients."""
    inner = inverse_each(s[:, None, None] * jnp.eye(len(A)) - A) @ B
    outputs, points, inputs = len(C), len(s), B.shape[1]
    y = jnp.moveaxis(C @ inner + D, 2, 0).reshape(inputs * points, outputs)
    drive = jnp.repeat(jnp.eye(inputs, dtype=s.dtype), points, axis=0)
    weight = 1 / jnp.maximum(jnp.abs(y), 1e-3 * jnp.abs(y).max(axis=0))
    again = jnp.tile(s, inputs)
    return Target(again, again, jnp.zeros((len(y), 1)), jnp.zeros(1), drive, y, weight)
