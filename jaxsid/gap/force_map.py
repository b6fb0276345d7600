"""The force of a place over time, with its standard deviation, against what moves there."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsid.compilation import compiled
from jaxsid.gap.evidence import Force
from jaxsid.gap.noise import Noise
from jaxsid.gap.places import Place, joint_of
from jaxsid.gap.ports import Explained
from jaxsid.gap.setting import Setting
from jaxsid.gap.smoother import latent_model, smooth
from jaxsid.gap.spectra import Spectra, in_time
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.lumped import LumpedModel, second_order

UNSEEN = 1e-9  # of the largest response to a force: one that is rounding
LARGEST = 10.0  # steady part of a force, which no sensor sees, next to the rms of the rest
SLIGHT = 1e-9  # of a motion: what else moves it each sample, so that one that grows by itself is followed too
ABSENT = 1e6  # noise of a sensor that a record lacks, next to that of the others


class ForceMap(NamedTuple):
    """A force over a record, and what moves where it acts.

    Attributes:
        place: where.
        record: number of the record.
        time: (samples,) s.
        force: (samples,) on the second end, N or N m, the first end bearing its opposite; for a sensor, what is added
            to its reading.
        deviation: of the force, away from the ends of the record.
        displacement, velocity: (samples,) of the second end less those of the first; the body's of an input; zeros for
            a sensor.
    """

    place: Place
    record: int
    time: Float[np.ndarray, " samples"]
    force: Float[np.ndarray, " samples"]
    deviation: float
    displacement: Float[np.ndarray, " samples"]
    velocity: Float[np.ndarray, " samples"]


def force_map(
    model: LumpedModel,
    place: Place,
    setting: Setting,
    made: Explained,
    row: int,
    force: Force,
    noise: Noise,
    number: int,
) -> ForceMap:
    """Smoothed force of one place in one record.

    Args:
        model: nominal.
        place: where.
        setting: of the record.
        made: what the hypotheses make of the record, a row a place.
        row: of this place.
        force: process of every place.
        noise: of the record, whose colour is left out here.
        number: of the record.
    """
    own = jax.tree.map(lambda x: x[row], made)
    joint = joint_of(model, place)
    sensor = np.array([float(place.where == "sensor" and s.name == place.ends[0]) for s in model.sensors])
    level = np.nan_to_num(noise.rms(), nan=ABSENT * float(np.nanmax(noise.rms())))
    size, rate = (x[row] for x in force)
    linear = second_order(model)
    plain = physical_displacement_velocity(linear)
    moved = setting.spectra.inverse_mass @ jnp.asarray(joint)
    direct = linear.acceleration_sensors @ moved + jnp.asarray(sensor)
    system = plain.A, jnp.concatenate([jnp.zeros_like(moved), moved]), plain.C, direct
    signals, deviation = _smoothed(
        setting.spectra, own, system, jnp.asarray(joint), jnp.asarray(sensor), size, rate, jnp.asarray(level)
    )
    signals = np.asarray(signals)
    time = np.arange(setting.spectra.samples) * float(setting.spectra.dt)
    return ForceMap(place, number, time, signals[:, 0], float(deviation), signals[:, 1], signals[:, 2])


@compiled
def _smoothed(
    spectra: Spectra,
    made: Explained,
    system: tuple[Array, Array, Array, Array],
    joint: Array,
    sensor: Array,
    size: Array,
    rate: Array,
    level: Array,
) -> tuple[Float[Array, "samples 3"], Array]:
    """Force, displacement and velocity; the force's standard deviation."""
    transfer = spectra.forced @ joint + sensor
    # a line on a pole tells nothing: left out here, and a free body's steady force is that of its balance; nor does
    # one that no sensor sees, as accelerometers do not see a steady force
    size_seen = jnp.sqrt((jnp.abs(transfer) ** 2).sum(axis=1))
    used = (spectra.weight > 0) & (size_seen > UNSEEN * size_seen.max())
    force = jnp.where(used, made.force, 0.0)
    y = in_time(spectra, jnp.where(used[:, None], made.left + transfer * force[:, None], 0.0))
    moved = (spectra.forced_states @ joint) * force[:, None]
    rates = jnp.stack([force, 1j * spectra.omega * force], axis=1)
    start = jnp.concatenate([in_time(spectra, moved)[0], in_time(spectra, rates)[0]])
    states = in_time(spectra, made.motion.states)
    latent = latent_model(*system, size, rate, level, spectra.dt)
    slight = jnp.zeros(len(latent.Q)).at[: states.shape[1]].set(SLIGHT**2 * (states**2).mean(axis=0))
    found = smooth(latent._replace(Q=latent.Q + jnp.diag(slight)), y, start)
    q, v = jnp.split(states, 2, axis=1)
    n = len(start) - 2
    rest = jnp.sqrt(2 * (jnp.abs(force) ** 2).sum())
    steady = jnp.where(used[0], 0.0, _steady_force(spectra, made, joint, LARGEST * rest)) / np.sqrt(
        spectra.samples
    )
    signals = jnp.stack([found.state[:, n] + steady, q @ joint, v @ joint], axis=1)
    return signals, jnp.sqrt(jnp.maximum(found.covariance[n, n], 0.0))


def _steady_force(spectra: Spectra, made: Explained, joint: Array, most: Array) -> Array:
    """Line 0 of a force that acts on free bodies, from the balance of impulses; the shapes' own where it does not.

    None where that is absurd beside the rest of the force: then the shapes tell nothing of it either.
    """
    linear, motion = spectra.linear, made.motion
    v = motion.states[0, len(joint) :].real
    missing = linear.mass @ motion.accelerations[0].real + linear.damping @ v
    missing = missing - linear.input_matrix @ spectra.u[0].real
    along = joint - linear.stiffness @ (spectra.flexibility @ joint)
    square = along @ joint
    balanced = square > 1e-9 * (joint @ joint)
    found = along @ missing / jnp.where(balanced, square, 1.0)
    own = made.force[0].real
    return jnp.where(balanced, found, jnp.where(jnp.abs(own) > most, 0.0, own))
