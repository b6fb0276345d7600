"""The effects of a model as arrays, one row each, so that one program serves all kinds and places."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsid.mechanics.effects.catalogue import MOST_PARAMETERS, Numbers, kind_number, law_of, parameter_row
from jaxsid.mechanics.effects.kind import Nominal
from jaxsid.mechanics.lumped import GROUND, Effect, LumpedModel
from jaxsid.records import SecondOrderModel, as_array

ROUNDING = 1e-9  # of what joins a body: a sum below which it is none


class Slots(eqx.Module):
    """Effects, each with its kind, parameters and place; all rows may be traced.

    Attributes:
        kinds: (slots,) numbers in the catalogue; in numpy inside a program that is for these kinds only, sorted in
            one that is for their sorts.
        parameters: (slots, most) in the order of the kind.
        joints: (slots, N) +1 and -1 at the second and first end, +1 at a body; zero for signals.
        pushes: (slots, N) where and how a positive force acts: -joints between two ends, +1 at a body.
        sensors: (slots, outputs) 1 at the sensor.
        inputs: (slots, inputs) 1 at the input.
    """

    kinds: Numbers
    parameters: Float[Array, "slots most"]
    joints: Float[Array, "slots N"]
    pushes: Float[Array, "slots N"]
    sensors: Float[Array, "slots outputs"]
    inputs: Float[Array, "slots inputs"]

    @property
    def count(self) -> int:
        return len(self.kinds)


def slots_of(model: LumpedModel, record: int = 0) -> Slots:
    """The effects of a model.

    Args:
        model: with any number of effects.
        record: number of the record, for parameters of which there is one a record.
    """
    laws = [law_of(e.kind, e.parameters) for e in model.effects]
    kinds = np.array([kind_number(law.name) for law in laws], np.int32)
    rows = [parameter_row(e.kind, e.parameters, record) for e in model.effects]
    parameters = jnp.stack(rows) if rows else jnp.zeros((0, MOST_PARAMETERS))
    sensors, inputs = [s.name for s in model.sensors], [i.name for i in model.inputs]
    marks = [_marks(e, model.bodies, sensors, inputs) for e in model.effects]
    shapes = (len(model.bodies), len(model.bodies), len(sensors), len(inputs))
    columns = zip(*marks, strict=True) if marks else [()] * 4
    places = [as_array(np.array(x).reshape(len(marks), n)) for x, n in zip(columns, shapes, strict=True)]
    return Slots(jnp.asarray(kinds), parameters, *places)


def _marks(
    effect: Effect, bodies: tuple[str, ...], sensors: list[str], inputs: list[str]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    joint, push = np.zeros(len(bodies)), np.zeros(len(bodies))
    sensor, forced = np.zeros(len(sensors)), np.zeros(len(inputs))
    ((where, place),) = effect.place
    if where == "between":
        for end, sign in zip(place, (-1.0, 1.0), strict=True):
            if end != GROUND:
                joint[bodies.index(end)] = sign
        push = -joint
    elif where == "body":
        joint[bodies.index(place)] = push[bodies.index(place)] = 1.0
    elif where == "sensor":
        sensor[sensors.index(place)] = 1.0
    else:
        forced[inputs.index(place)] = 1.0
    return joint, push, sensor, forced


def nominal_at(slots: Slots, linear: SecondOrderModel) -> Nominal:
    """Mass of the body, or damping and stiffness of the connections between the two ends, of every slot.

    Between bodies a and b these are minus the entry (a, b) of D and K, between a body and the ground the sum of its
    row. For a place that is a signal the numbers mean nothing.

    Args:
        slots: the places.
        linear: M, D, K.
    """
    joints = slots.joints
    grounded = jnp.abs(joints).sum(axis=1) < 1.5
    first, second = jnp.maximum(-joints, 0.0), jnp.maximum(joints, 0.0)

    def across(matrix: Array) -> Array:
        rows = jnp.abs(joints) @ matrix
        found = jnp.where(grounded, rows.sum(axis=1), -jnp.einsum("si,ij,sj->s", first, matrix, second))
        # the springs of a body that is not joined to the ground do not quite add up to none
        return jnp.where(jnp.abs(found) > ROUNDING * jnp.abs(rows).sum(axis=1), found, 0.0)

    mass = jnp.einsum("si,ij,sj->s", joints, linear.mass, joints)
    return Nominal(mass, across(linear.damping), across(linear.stiffness))
