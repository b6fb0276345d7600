"""Final poles with indicators and standard deviations."""

from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from jaxsid.compilation import compiled
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.hold import continuous, discretise, shift_to_laguerre
from jaxsid.mechanics.recursion import markov
from jaxsid.modes import modal
from jaxsid.physical.inband_fit import MatrixFit
from jaxsid.pipeline.state_space import StateSpace
from jaxsid.realization.era import era
from jaxsid.records import (
    ContinuousModel,
    ImpulseResponse,
    Indicators,
    ModalModel,
    Realization,
    SecondOrderModel,
    as_array,
)

WINDOW = 100  # block rows and columns of the realization of a model's own response


class FinalModes(NamedTuple):
    """The model that is reported, its modes, and standard deviations of frequencies (rad/s) and damping ratios.

    Those of poles and shapes are complex, the deviation of the real part + 1j times that of the imaginary part. The
    shapes are displacements at the sensors, the largest of each 1; their deviations are NaN without matrices.
    """

    realization: Realization
    continuous: ContinuousModel
    modal: ModalModel
    frequency_std: Array
    damping_ratio_std: Array
    pole_std: Array
    shape_std: Array


def final_modes(space: StateSpace, matrices: SecondOrderModel | None, fit: MatrixFit | None) -> FinalModes:
    """Modes of the fitted matrices where these explain the records, else of the state-space model.

    MAC, EMAC and MPC always come from the realization of the measured impulse response, since a model is
    perfectly coherent with itself.

    Args:
        space: the state-space model.
        matrices: fitted mass, damping and stiffness, None where they do not explain the records.
        fit: their covariance.
    """
    if matrices is None or fit is None:
        realization, model = space.polished.realization, space.model
    else:
        realization = _minimal(matrices, space)
        model = continuous(realization)
    measured, own = modal(space.measured), modal(realization)
    indicators = _nearest(measured, own)
    own = eqx.tree_at(lambda m: m.indicators, own, indicators, is_leaf=lambda x: x is None)
    poles = np.asarray(own.poles)
    if matrices is None or fit is None:
        slopes, covariance = _slopes_of_denominators(space, poles), np.asarray(space.polished.pole_covariance)
        shape = np.full((len(model.C), len(poles)), complex(np.nan, np.nan))
    else:
        slopes, covariance = _slopes_of_matrices(fit, poles), np.asarray(fit.covariance)
        seen = matrices.displacement_sensors + matrices.velocity_sensors + matrices.acceleration_sensors
        shape = _parts(_slopes_of_shapes(fit, np.asarray(seen), poles, slopes), covariance)
    frequency, ratio = _deviations(poles, slopes, covariance)
    deviations = frequency, ratio, _parts(slopes, covariance), shape
    return FinalModes(realization, model, own, *(as_array(x) for x in deviations))


def _minimal(matrices: SecondOrderModel, space: StateSpace) -> Realization:
    """The visible states of M, D, K: ERA of its own Markov parameters in the Laguerre shift."""
    lines = space.lines
    pole = lines.pole
    sampled = discretise(physical_displacement_velocity(matrices), lines.dt, hold=lines.hold)
    shifted = shift_to_laguerre(sampled.A, sampled.B, sampled.C, sampled.D, pole)
    h = _markov(*shifted, 2 * WINDOW)
    ir = ImpulseResponse(h, lines.dt, pole=pole, band=lines.band, hold=lines.hold, method="fitted matrices")
    return era(ir, order=len(space.raw.A), rows=WINDOW - 1, cols=WINDOW - 1)


_markov = compiled(markov)


def _nearest(measured: ModalModel, own: ModalModel) -> Indicators | None:
    if measured.indicators is None:
        return None
    distance = np.abs(np.asarray(own.poles)[:, None] - np.asarray(measured.poles))
    index = distance.argmin(axis=1)
    return jax.tree.map(lambda x: as_array(np.asarray(x)[index]), measured.indicators)


def _pencil(fit: MatrixFit, s: complex) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Z = s^2 M + s D + K, its derivative to s, and to the unknowns, (N, N, p)."""
    M, D, K = (np.asarray(x) for x in fit.matrices)
    dM, dD, dK = (np.asarray(x) for x in fit.slopes)
    return M * s**2 + D * s + K, 2 * s * M + D, dM * s**2 + dD * s + dK


def _slopes_of_matrices(fit: MatrixFit, poles: np.ndarray) -> np.ndarray:
    """d pole / d unknown = -phi' (s^2 dM + s dD + dK) phi / phi' (2 s M + D) phi, (poles, unknowns)."""
    rows = []
    for s in poles:
        Z, slope, change = _pencil(fit, s)
        phi = np.linalg.svd(Z)[2][-1].conj()
        rows.append(-np.einsum("i,ijp,j->p", phi, change, phi) / (phi @ slope @ phi))
    return np.stack(rows)


def _slopes_of_shapes(
    fit: MatrixFit, seen: np.ndarray, poles: np.ndarray, of_poles: np.ndarray
) -> np.ndarray:
    """d shape / d unknown at the sensors, the largest component held at 1, (outputs, poles, unknowns).

    Z phi = 0 gives Z dphi = -(dZ + Z' ds) phi, which leaves only the size of phi open.
    """
    shapes = []
    for s, ds in zip(poles, of_poles, strict=True):
        Z, slope, change = _pencil(fit, s)
        left, values, right = np.linalg.svd(Z)
        phi = right[-1].conj()
        push = np.einsum("ijp,j->ip", change, phi) + np.outer(slope @ phi, ds)
        inner = (left.conj().T @ push)[:-1] / values[:-1, None]
        moved, size = -seen @ (right[:-1].conj().T @ inner), seen @ phi
        top = np.abs(size).argmax()
        shapes.append((moved - np.outer(size / size[top], moved[top])) / size[top])
    return np.stack(shapes, axis=1)


def _slopes_of_denominators(space: StateSpace, poles: np.ndarray) -> np.ndarray:
    """d pole / d coefficient of w^2 + a_1 w + a_2 (pairs first, then an odd real root), (poles, coefficients)."""
    theta = np.asarray(space.polished.denominators)
    pairs = len(theta) // 2
    a = float(space.polished.realization.pole)
    z = np.exp(poles * float(space.lines.dt))
    if space.lines.hold[0] == "band":
        half = poles * float(space.lines.dt) / 2
        z = (1 + half) / (1 - half)
    w = (z - a) / (1 - a * z)
    quadratic = theta[: 2 * pairs].reshape(pairs, 2)
    misfit = np.abs(w[:, None] ** 2 + quadratic[:, 0] * w[:, None] + quadratic[:, 1])
    misfit = np.concatenate([misfit, np.abs(w[:, None] + theta[2 * pairs :])], axis=1)
    # z from w, then s from z
    dz = (1 - a**2) / (1 + a * w) ** 2
    ds = (
        dz / (z * float(space.lines.dt))
        if space.lines.hold[0] != "band"
        else dz * (1 - half) ** 2 / float(space.lines.dt)
    )
    slopes = np.zeros((len(poles), len(theta)), complex)
    for i, section in enumerate(misfit.argmin(axis=1)):
        if section < pairs:
            slope = -1 / (2 * w[i] + quadratic[section, 0])
            slopes[i, 2 * section : 2 * section + 2] = slope * w[i] * ds[i], slope * ds[i]
        else:
            slopes[i, pairs + section] = -ds[i]
    return slopes


def _deviations(
    poles: np.ndarray, slopes: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations of abs(s) and -real(s) / abs(s)."""
    size = np.maximum(np.abs(poles), np.finfo(float).tiny)
    frequency = np.real(slopes * poles.conj()[:, None]) / size[:, None]
    ratio = -np.real(slopes) / size[:, None] + (np.real(poles) / size**2)[:, None] * frequency
    return _spread(frequency, covariance), _spread(ratio, covariance)


def _parts(slopes: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Standard deviation of the real part + 1j times that of the imaginary part."""
    return _spread(np.real(slopes), covariance) + 1j * _spread(np.imag(slopes), covariance)


def _spread(slopes: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(np.einsum("...p,pq,...q->...", slopes, covariance, slopes), 0.0))
