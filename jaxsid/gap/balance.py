"""Whether impulses balance on bodies that no spring holds, and sensors read what they must on the mean.

A steady force there, or an offset of a sensor, shows on no line but that of zero, which is that of the free motion.
Summed over a record, x_(k+1) = E x_k + F u_k + G f gives (I - E) mean(x) = t / samples + F mean(u) + G f, with t the
state at the start less that at the end, which all other lines tell whatever f is. I - E is singular for free bodies,
so that the same equations hold the force f that is missing to balance and what sensors read on the mean. Means of which
the state takes up nothing, as of the difference of two speeds, tell of offsets.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.linalg import block_diag, null_space

from jaxsid.compilation import compiled
from jaxsid.gap.recalibrate import Linear, Recalibrated
from jaxsid.gap.setting import Setting
from jaxsid.gap.spectra import Spectra, in_time, parameter_columns
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.hold import discretise
from jaxsid.mechanics.lumped import free_bodies

TAKEN_UP = 0.9  # part of a mean's variance that the state may take up before it tells nothing of offsets


class Balance(NamedTuple):
    """What is missing, in noise.

    Attributes:
        statistic: mean square of the missing forces, or means, in their standard deviations.
        count: of them.
        share: rms of what they do to the sensors, next to the response.
    """

    statistic: float
    count: int
    share: float


class _Deviation(NamedTuple):
    """Of one record: values (k,) that should be zero, slopes by the elements (k, e), covariance (k, k) by the noise."""

    values: np.ndarray
    slopes: np.ndarray
    covariance: np.ndarray


class _Missing(NamedTuple):
    """Of one record: forces, means of sensors in noise, and those means' rms in the units of each sensor (outputs,)."""

    force: _Deviation
    means: _Deviation
    offsets: np.ndarray


def balance_of(fit: Recalibrated, settings: tuple[Setting, ...]) -> tuple[Balance, Balance] | None:
    """The balance of all free bodies in all records, and the means that the sensors read beside them.

    Args:
        fit: the model and what it leaves.
        settings: of each record, with the noise that its lines are weighed by.

    Returns:
        Of forces and of means; None where every body is held.
    """
    patterns = free_bodies(fit.model)
    if patterns.shape[1] == 0:
        return None
    parts = [_missing(s, x, patterns) for s, x in zip(settings, fit.linear, strict=True)]
    forces, means = [x.force for x in parts], [x.means for x in parts]
    done = _under_forces(settings, patterns, [x.values for x in forces])
    offsets = [
        np.broadcast_to(x.offsets, (s.spectra.samples, len(x.offsets)))
        for s, x in zip(settings, parts, strict=True)
    ]
    return (
        Balance(*_statistic(forces, fit.covariance), _share(settings, done)),
        Balance(*_statistic(means, fit.covariance), _share(settings, offsets)),
    )


def _statistic(parts: list[_Deviation], elements: Float[np.ndarray, "e e"]) -> tuple[float, int]:
    """Mean square in standard deviations, of all records, and how many there are."""
    values, slopes = (np.concatenate([x[i] for x in parts]) for i in (0, 1))
    if len(values) == 0:
        return 0.0, 0
    covariance = slopes @ elements @ slopes.T + block_diag(*(x.covariance for x in parts))
    scale = np.sqrt(np.diag(covariance))
    white = values / scale
    return float(white @ np.linalg.solve(covariance / scale / scale[:, None], white)) / len(values), len(
        values
    )


def _missing(setting: Setting, linear: Linear, patterns: Float[np.ndarray, "N k"]) -> _Missing:
    spectra, prior, scale = setting.spectra, np.asarray(setting.transient), np.asarray(setting.scale)
    root = np.sqrt(spectra.samples)
    weigh = lambda x: np.asarray(x) * scale[:, :, None]  # noqa: E731
    rows = lambda x: np.concatenate([x.real, x.imag]).reshape(-1, x.shape[2]) * np.sqrt(2)  # noqa: E731
    free = rows(weigh(spectra.free))
    columns = rows(weigh(parameter_columns(spectra, linear.motion, setting.directions)))
    # noise of means as on the lowest line, which is complex
    there = np.asarray(spectra.present) > 0
    weight = root * scale[np.asarray(spectra.weight) == 1][0, there]
    k, read = patterns.shape[1], np.real(np.asarray(spectra.y)[0, there]) / root
    # where bodies are on the whole is not known: combinations of means that it does not shift
    shifted = weight[:, None] * (np.asarray(spectra.linear.displacement_sensors)[there] @ patterns)
    held = null_space(shifted.T).T if np.any(shifted) else np.eye(len(weight))

    def at(state: np.ndarray) -> tuple[np.ndarray, ...]:
        given = jnp.asarray(patterns), jnp.asarray(state)
        f, y, *slopes = map(np.asarray, _balanced(spectra, setting.directions, *given))
        of_means = (held @ (weight[:, None] * x[k:][there]) for x in slopes)
        return f, held @ (weight * (read - y[there])), *(x[:k] for x in slopes), *of_means

    state = _state(spectra, linear)
    _, missed, *_, means = at(state)
    covariance = _inverse(free.T @ free + means.T @ means + np.diag(prior**-2))
    # the means tell of the state too; slopes by the elements are those there
    f, left, f_elements, f_state, y_elements, _ = at(state + covariance @ means.T @ missed)
    moved = -covariance @ (free.T @ columns + means.T @ y_elements)
    force = _Deviation(f, f_elements + f_state @ moved, f_state @ covariance @ f_state.T)
    # what a fit leaves is independent of what it finds
    variance, apart = np.linalg.eigh(np.eye(len(left)) - means @ covariance @ means.T)
    kept = variance > 1 - TAKEN_UP
    apart = apart[:, kept].T
    slopes = -apart @ (y_elements + means @ moved)
    offsets = np.zeros(len(there))
    offsets[there] = held.T @ apart.T @ apart @ left / weight
    return _Missing(force, _Deviation(apart @ left, slopes, np.diag(variance[kept])), offsets)


def _state(spectra: Spectra, linear: Linear) -> Float[np.ndarray, " n"]:
    """The state at the start less that at the end, of a motion beside a record: what its means go by."""
    size = len(spectra.inverse_mass)
    lines = linear.motion.states[0, size:], linear.motion.accelerations[0]
    means = np.concatenate([np.real(np.asarray(x)) for x in lines])
    return -means * float(spectra.dt) * np.sqrt(spectra.samples)


@compiled
def _balanced(
    spectra: Spectra, directions: tuple[Array, Array, Array], patterns: Array, state: Array
) -> tuple[Array, Array, Array, Array]:
    """Missing forces (k,), means of sensors (outputs,), slopes of both by elements and state, (k + outputs, e or n)."""
    u = spectra.u[0].real / np.sqrt(spectra.samples)
    linear, size = spectra.linear, len(spectra.inverse_mass)

    def of(change: Array, state: Array) -> Array:
        moved = [
            x + jnp.einsum("e,eij->ij", change, d)
            for x, d in zip((linear.mass, linear.damping, linear.stiffness), directions, strict=True)
        ]
        # forces that accelerate each pattern as a whole
        whole = moved[0] @ patterns @ jnp.linalg.inv(patterns.T @ moved[0] @ patterns)
        pushed = jnp.concatenate([linear.input_matrix, whole], axis=1)
        model = eqx.tree_at(
            lambda s: (s.mass, s.damping, s.stiffness, s.input_matrix), linear, (*moved, pushed)
        )
        plain = physical_displacement_velocity(model)
        sampled = discretise(plain, spectra.dt)
        inputs, forces = jnp.split(sampled.B, [len(u)], axis=1)
        k = patterns.shape[1]
        gauge = jnp.concatenate([patterns.T, jnp.zeros_like(patterns.T)], axis=1)
        both = jnp.block([[jnp.eye(2 * size) - sampled.A, -forces], [gauge, jnp.zeros((k, k))]])
        right = jnp.concatenate([state / spectra.samples + inputs @ u, jnp.zeros(k)])
        x, f = jnp.split(jnp.linalg.solve(both, right), [2 * size])
        y = plain.C @ x + plain.D @ jnp.concatenate([u, f])
        return jnp.concatenate([f, y])

    nothing = jnp.zeros(len(directions[0]))
    found = of(nothing, state)
    by_elements, by_state = jax.jacfwd(of, argnums=(0, 1))(nothing, state)
    k = patterns.shape[1]
    return found[:k], found[k:], by_elements, by_state


def _inverse(matrix: np.ndarray) -> np.ndarray:
    """Of a positive matrix whose rows differ by orders of magnitude."""
    scale = np.sqrt(np.diag(matrix))
    return np.linalg.inv(matrix / scale / scale[:, None]) / scale / scale[:, None]


def _under_forces(
    settings: tuple[Setting, ...], patterns: Float[np.ndarray, "N k"], forces: list[np.ndarray]
) -> list[Float[np.ndarray, "samples outputs"]]:
    """What steady forces do to the sensors, about their mean."""
    found = []
    for setting, force in zip(settings, forces, strict=True):
        spectra, model = setting.spectra, setting.spectra.linear
        M, D = np.asarray(model.mass), np.asarray(model.damping)
        t = np.arange(spectra.samples) * float(spectra.dt)
        y = np.zeros((spectra.samples, len(spectra.present)))
        for phi, push in zip(patterns.T, force, strict=True):
            mass, damping = phi @ M @ phi, phi @ D @ phi
            # mass a + damping v = push from rest
            rate = max(damping / mass, 1e-9 / t[-1])
            a = push / mass * np.exp(-rate * t)
            v = push / mass * -np.expm1(-rate * t) / rate
            q = np.concatenate([[0.0], np.cumsum((v[1:] + v[:-1]) / 2)]) * float(spectra.dt)
            for x, sensors in (
                (q, model.displacement_sensors),
                (v, model.velocity_sensors),
                (a, model.acceleration_sensors),
            ):
                y += np.outer(x, np.asarray(spectra.present) * (np.asarray(sensors) @ phi))
        found.append(y - y.mean(axis=0))
    return found


def _share(settings: tuple[Setting, ...], done: list[Float[np.ndarray, "samples outputs"]]) -> float:
    """Rms of something next to that of the response about its mean, the mean over all sensors."""
    part = np.sum([(y**2).sum(axis=0) for y in done], axis=0)
    measured = [np.asarray(in_time(s.spectra, s.spectra.y)) for s in settings]
    whole = np.sum([((y - y.mean(axis=0)) ** 2).sum(axis=0) for y in measured], axis=0)
    present = whole > 0
    return float(np.sqrt((part[present] / whole[present]).mean()))
