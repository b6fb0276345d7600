"""A record's lines beside a model, weighed by the noise: what all places have in common."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsid.gap.spectra import Spectra
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.lumped import LumpedModel, second_order
from jaxsid.physical.elements import element_matrices

LARGE = 100.0  # deviations of a state that nothing is known of, next to what its sensors read


class Setting(eqx.Module):
    """What a record and its model have in common for all places.

    Attributes:
        spectra: lines and transfer functions.
        scale: (lines, outputs) one over the noise, times the root of a line's weight.
        transient: (n,) standard deviations of the state at the start less that at the end.
        directions: (e, N, N) each, what the elements add to M, D, K, times their values.
        rate: of the slowest vibration, rad/s.
    """

    spectra: Spectra
    scale: Float[Array, "lines outputs"]
    transient: Float[Array, " n"]
    directions: tuple[Array, Array, Array]
    rate: Float[Array, ""]


def setting_of(
    spectra: Spectra,
    noise: Float[np.ndarray, "lines outputs"],
    directions: tuple[Array, Array, Array],
    rate: float,
) -> Setting:
    """A record's setting.

    Args:
        spectra: lines and transfer functions.
        noise: standard deviation of the lines.
        directions: (e, N, N) each, what the elements add to M, D, K, times their values.
        rate: of the slowest vibration, rad/s.
    """
    root = np.sqrt(np.asarray(spectra.weight))[:, None] * np.asarray(spectra.present)
    scale = root / np.maximum(noise, np.finfo(float).tiny)
    rms = np.sqrt(2 * (np.abs(np.asarray(spectra.y)) ** 2).sum(axis=0) / spectra.samples)
    linear = spectra.linear
    sensors = (linear.displacement_sensors, linear.velocity_sensors, linear.acceleration_sensors)
    kinds = [np.abs(np.asarray(x)).sum(axis=1) for x in sensors]
    still = max((rms * kind / rate**order).max() for order, kind in enumerate(kinds))
    half = spectra.free.shape[2] // 2
    transient = LARGE * still * np.concatenate([np.ones(half), np.full(half, rate)])
    return Setting(spectra, jnp.asarray(scale), jnp.asarray(transient), directions, jnp.asarray(rate))


def element_directions(model: LumpedModel) -> tuple[Array, Array, Array]:
    """(e, N, N) each, what the elements of a model add to M, D, K, times their values.

    Args:
        model: its linear part.
    """
    elements = element_matrices(model)
    values = np.asarray(elements.nominal)
    mass, damping, stiffness = (jnp.asarray(d * values[:, None, None]) for d in elements.directions)
    return mass, damping, stiffness


def slowest_rate(model: LumpedModel) -> float:
    """Magnitude of a model's slowest pole that is not at zero, rad/s; 1 where all are.

    Args:
        model: its linear part.
    """
    poles = np.abs(np.linalg.eigvals(np.asarray(physical_displacement_velocity(second_order(model)).A)))
    return float(poles[poles > 1e-6 * poles.max()].min(initial=np.inf)) if poles.any() else 1.0
