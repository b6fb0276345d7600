"""Whether impulses balance on bodies that no spring holds: a steady force there shows on no line but that of zero.

Summed over a record, x_(k+1) = E x_k + F u_k + G f gives (I - E) mean(x) = t / samples + F mean(u) + G f, with t the
state at the start less that at the end, which all other lines tell whatever f is. I - E is singular for free bodies,
so that the same equations hold the force f that is missing to balance and what sensors read on the mean.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsid.compilation import compiled
from jaxsid.gap.recalibrate import Linear, Recalibrated
from jaxsid.gap.setting import Setting
from jaxsid.gap.spectra import Spectra, in_time, parameter_columns
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.hold import discretise
from jaxsid.mechanics.lumped import free_bodies


class Balance(NamedTuple):
    """What is missing, in noise.

    Attributes:
        statistic: mean square of the missing forces in their standard deviations.
        count: of them.
        share: rms of what they do to the sensors, next to the response.
    """

    statistic: float
    count: int
    share: float


class _Missing(NamedTuple):
    """Of one record: forces (k,), slopes by the elements (k, e), covariance (k, k) by the noise."""

    force: np.ndarray
    slopes: np.ndarray
    covariance: np.ndarray


def balance_of(fit: Recalibrated, settings: tuple[Setting, ...]) -> Balance | None:
    """The balance of all free bodies in all records.

    Args:
        fit: the model and what it leaves.
        settings: of each record, with the noise that its lines are weighed by.

    Returns:
        None where every body is held.
    """
    patterns = free_bodies(fit.model)
    if patterns.shape[1] == 0:
        return None
    parts = [_missing(s, x, patterns) for s, x in zip(settings, fit.linear, strict=True)]
    force = np.concatenate([x.force for x in parts])
    slopes = np.concatenate([x.slopes for x in parts])
    covariance = slopes @ fit.covariance @ slopes.T
    k = patterns.shape[1]
    for i, x in enumerate(parts):
        covariance[i * k : (i + 1) * k, i * k : (i + 1) * k] += x.covariance
    scale = np.sqrt(np.diag(covariance))
    white = force / scale
    apart = covariance / scale / scale[:, None]
    statistic = float(white @ np.linalg.solve(apart, white)) / len(force)
    return Balance(statistic, len(force), _share(settings, patterns, [x.force for x in parts]))


def _missing(setting: Setting, linear: Linear, patterns: Float[np.ndarray, "N k"]) -> _Missing:
    spectra, prior, scale = setting.spectra, np.asarray(setting.transient), np.asarray(setting.scale)
    root = np.sqrt(spectra.samples)
    weigh = lambda x: np.asarray(x) * scale[:, :, None]  # noqa: E731
    rows = lambda x: np.concatenate([x.real, x.imag]).reshape(-1, x.shape[2]) * np.sqrt(2)  # noqa: E731
    free = rows(weigh(spectra.free))
    columns = rows(weigh(parameter_columns(spectra, linear.motion, setting.directions)))
    # means that sensors read where no free motion shifts them; noise as on the lowest line, which is complex
    there = np.asarray(spectra.present) > 0
    there &= np.abs(np.asarray(spectra.linear.displacement_sensors) @ patterns).sum(axis=1) == 0
    weight = root * scale[np.asarray(spectra.weight) == 1][0, there]
    k, read = patterns.shape[1], np.asarray(spectra.y)[0, there].real / root

    def at(state: np.ndarray) -> tuple[np.ndarray, ...]:
        given = jnp.asarray(patterns), jnp.asarray(state)
        f, y, *slopes = map(np.asarray, _balanced(spectra, setting.directions, *given))
        return f, weight * (read - y[there]), *slopes

    state = _state(spectra, linear)
    _, missed, _, by_state = at(state)
    means = weight[:, None] * by_state[k:][there]
    covariance = _inverse(free.T @ free + means.T @ means + np.diag(prior**-2))
    # the means tell of the state too; slopes by the elements are those there
    f, _, by_elements, by_state = at(state + covariance @ means.T @ missed)
    moved = -covariance @ (free.T @ columns + means.T @ (weight[:, None] * by_elements[k:][there]))
    return _Missing(f, by_elements[:k] + by_state[:k] @ moved, by_state[:k] @ covariance @ by_state[:k].T)


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


def _share(
    settings: tuple[Setting, ...], patterns: Float[np.ndarray, "N k"], forces: list[np.ndarray]
) -> float:
    """Rms of what steady forces do to the sensors next to that of the response, the mean over all sensors."""
    done = whole = np.zeros(len(settings[0].spectra.present))
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
        done = done + ((y - y.mean(axis=0)) ** 2).sum(axis=0)
        measured = np.asarray(in_time(spectra, spectra.y))
        whole = whole + ((measured - measured.mean(axis=0)) ** 2).sum(axis=0)
    present = whole > 0
    return float(np.sqrt((done[present] / whole[present]).mean()))
