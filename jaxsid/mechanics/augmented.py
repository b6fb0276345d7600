"""A lumped model with effects, split: what is linear, as one state-space model, and ports for the laws that are not."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsid.mechanics.effects.catalogue import changes
from jaxsid.mechanics.effects.kind import Changes
from jaxsid.mechanics.slots import Slots, nominal_at
from jaxsid.records import SecondOrderModel


class Augmented(NamedTuple):
    """x' = A x + B u + G f, y = C x + D u + F f.

    States are displacements, velocities and two of each slot: those of an attached mass, of the lag of a signal, or
    the memory of a law. f holds a force and a rate of memory of each slot.

    Attributes:
        A: (n, n).
        B: (n, inputs).
        G: (n, 2 slots).
        C: (outputs, n).
        D: (outputs, inputs).
        F: (outputs, 2 slots).
        seen: (3 slots, n) displacement, velocity and memory that the laws see.
        spring: (slots,) stiffness that the model has at each place.
        changed: what each slot does to signals.
    """

    A: Float[Array, "n n"]
    B: Float[Array, "n inputs"]
    G: Float[Array, "n ports"]
    C: Float[Array, "outputs n"]
    D: Float[Array, "outputs inputs"]
    F: Float[Array, "outputs ports"]
    seen: Float[Array, "seen n"]
    spring: Float[Array, " slots"]
    changed: Changes


class _Accelerations(NamedTuple):
    """Of the bodies, from the state, (N, n), the inputs, (N, inputs), the slots' forces, (N, slots)."""

    states: Array
    inputs: Array
    forces: Array


def augmented(linear: SecondOrderModel, slots: Slots) -> Augmented:
    """The linear part of a model with effects, and where the others' forces enter.

    Args:
        linear: M, D, K, inputs and sensors without effects.
        slots: the effects.
    """
    nominal = nominal_at(slots, linear)
    change = changes(slots.kinds, slots.parameters, nominal)
    count, size, dtype = slots.count, len(linear.mass), linear.mass.dtype
    n = 2 * size + 2 * count
    one = jnp.eye(n, dtype=dtype)
    velocities, first = slice(size, 2 * size), slice(2 * size, 2 * size + count)
    lagging, rate = change.lag > 0, 1 / jnp.where(change.lag > 0, change.lag, 1.0)
    slow_inputs = jnp.where(lagging[:, None], slots.inputs, 0.0)
    slow_sensors = jnp.where(lagging[:, None], slots.sensors, 0.0)
    moved = _accelerations(linear, slots, change, slow_inputs)
    C = jnp.concatenate([linear.displacement_sensors, linear.velocity_sensors], axis=1)
    C = jnp.pad(C, ((0, 0), (0, 2 * count))) + linear.acceleration_sensors @ moved.states
    D, pushed = (linear.acceleration_sensors @ x for x in moved[1:])
    signals = (slow_inputs.sum(axis=1) + slow_sensors.sum(axis=1)) * rate
    A = jnp.zeros((n, n), dtype).at[:size].set(one[velocities]).at[velocities].set(moved.states)
    A = A.at[2 * size :].set(_attached(slots, change, n))
    A = A.at[first].add(rate[:, None] * (slow_sensors @ C) - signals[:, None] * one[first])
    B = jnp.zeros((n, D.shape[1]), dtype).at[velocities].set(moved.inputs)
    B = B.at[first].set(rate[:, None] * (slow_inputs + slow_sensors @ D))
    G = jnp.zeros((n, 2 * count), dtype).at[velocities, :count].set(moved.forces)
    G = G.at[first, :count].set(rate[:, None] * (slow_sensors @ pushed))
    G = G.at[first, count:].set(jnp.eye(count, dtype=dtype))
    slow = slow_sensors.sum(axis=0)[:, None]
    seen = jnp.zeros((3 * count, n), dtype).at[:count, :size].set(slots.joints)
    seen = seen.at[count : 2 * count, velocities].set(slots.joints).at[2 * count :].set(one[first])
    return Augmented(
        A,
        B,
        G,
        C=(1 - slow) * C + slow_sensors.T @ one[first],
        D=(1 - slow) * D,
        F=(1 - slow) * jnp.pad(pushed, ((0, 0), (0, count))),
        seen=seen,
        spring=nominal.stiffness,
        changed=change,
    )


def _accelerations(
    linear: SecondOrderModel, slots: Slots, change: Changes, slow_inputs: Array
) -> _Accelerations:
    joints = slots.joints

    def with_joints(matrix: Array, added: Array) -> Array:
        return matrix + jnp.einsum("s,si,sj->ij", added, joints, joints)

    mass = with_joints(linear.mass, change.mass)
    damping = with_joints(linear.damping, change.damping + change.attached_damping)
    stiffness = with_joints(linear.stiffness, change.stiffness + change.attached_stiffness)
    pull, drag = (x[:, None] * joints for x in (change.attached_stiffness, change.attached_damping))
    lagged = linear.input_matrix @ slow_inputs.T
    forces = jnp.concatenate([-stiffness, -damping, pull.T + lagged, drag.T], axis=1)
    direct = linear.input_matrix * (1 - slow_inputs.sum(axis=0))
    inverse = jnp.linalg.inv(mass)
    return _Accelerations(inverse @ forces, inverse @ direct, inverse @ slots.pushes.T)


def _attached(slots: Slots, change: Changes, n: int) -> Array:
    """(2 slots, n) rates of displacement and velocity of attached masses, zero where there is none."""
    heavy = change.attached_mass > 0
    per_mass = jnp.where(heavy, 1 / jnp.where(heavy, change.attached_mass, 1.0), 0.0)
    k, c = (jnp.diag(per_mass * x) for x in (change.attached_stiffness, change.attached_damping))
    moves = jnp.diag(heavy.astype(k.dtype))
    body = jnp.concatenate([jnp.zeros((slots.count, n - 2 * slots.count), k.dtype), 0 * k, moves], axis=1)
    own = jnp.concatenate([k @ slots.joints, c @ slots.joints, -k, -c], axis=1)
    return jnp.concatenate([body, own])
