"""Outputs of a lumped model with effects, from inputs at samples to readings at samples."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsid.mechanics.augmented import Augmented, augmented
from jaxsid.mechanics.effects.catalogue import possible
from jaxsid.mechanics.held_input import Late, late_input, parabola_over_step, value_at_sample
from jaxsid.mechanics.integrate import (
    Path,
    instant_forces,
    integrate,
    integrate_twice,
    phi_columns,
    pushed,
)
from jaxsid.mechanics.slots import Slots
from jaxsid.records import SecondOrderModel


class Response(NamedTuple):
    """What a model with effects does.

    Attributes:
        outputs: (samples, outputs) readings of the sensors.
        states: (samples, n) displacements, velocities, two states of each effect.
        forces: (samples, slots) of each effect at the sampling instants.
    """

    outputs: Float[Array, "samples outputs"]
    states: Float[Array, "samples n"]
    forces: Float[Array, "samples slots"]


def state_count(bodies: int, slots: int) -> int:
    """Number of states of a model with so many bodies and effects."""
    return 2 * (bodies + slots)


def respond(
    linear: SecondOrderModel,
    slots: Slots,
    u: Float[Array, "samples inputs"],
    ramps: Bool[Array, " inputs"],
    dt: Float[Array, ""],
    state: Float[Array, " n"],
    substeps: int | Array,
) -> Response:
    """Readings of a model with effects over a whole record.

    Args:
        linear: the model without effects.
        slots: its effects.
        u: inputs.
        ramps: which are held to first order, the others to zero order.
        dt: sampling interval, s.
        state: at the first sample, as in `Response`.
        substeps: steps for each sampling interval.
    """
    system = augmented(linear, slots)
    return respond_to(system, slots, forced(system, slots, u, ramps, dt), dt, state, substeps)


def forced(
    system: Augmented,
    slots: Slots,
    u: Float[Array, "samples inputs"],
    ramps: Bool[Array, " inputs"],
    dt: Array,
) -> Late:
    """What acts on the bodies: the inputs, limited first, then scaled, then late. Their lag is part of the system.

    Args:
        system: from `augmented`.
        slots: the effects.
        u: inputs.
        ramps: which are held to first order, the others to zero order.
        dt: sampling interval, s.
    """
    return held(scaled_inputs(system, slots, dt), u, ramps)


class Scaled(NamedTuple):
    """What effects do to inputs: one over the limit, 0 where there is none; gain; delay in sampling intervals."""

    inverse_limit: Float[Array, " inputs"]
    gain: Float[Array, " inputs"]
    delay: Float[Array, " inputs"]


def scaled_inputs(system: Augmented, slots: Slots, dt: Array) -> Scaled:
    """What effects do to inputs, their lag apart.

    Args:
        system: from `augmented`.
        slots: the effects.
        dt: sampling interval, s.
    """
    change = system.changed
    return Scaled(
        change.inverse_limit @ slots.inputs, 1 + change.gain @ slots.inputs, change.delay @ slots.inputs / dt
    )


def held(scaled: Scaled, u: Float[Array, "samples inputs"], ramps: Bool[Array, " inputs"]) -> Late:
    """Inputs limited first, then scaled, then late.

    Args:
        scaled: what effects do to them.
        u: samples.
        ramps: which are held to first order, the others to zero order.
    """
    inverse = scaled.inverse_limit
    limit = jnp.where(inverse > 0, 1 / jnp.where(inverse > 0, inverse, 1.0), jnp.inf)
    return late_input(jnp.clip(u, -limit, limit) * scaled.gain, ramps, scaled.delay)


def respond_to(
    system: Augmented,
    slots: Slots,
    late: Late,
    dt: Float[Array, ""],
    state: Float[Array, " n"],
    substeps: int | Array,
    first: int | Array = 0,
) -> Response:
    """Readings of a model with effects. An output lags first, then it is delayed, scaled, shifted.

    Args:
        system: from `augmented`.
        slots: the effects.
        late: from `forced`, of a whole record or a part of it.
        dt: sampling interval, s.
        state: at the first sample, as in `Response`.
        substeps: steps for each sampling interval.
        first: number of the first sample in the record, for laws that depend on time.
    """
    return _readings(
        system, slots, late, dt, integrate(system, slots, late, dt, state, substeps, first), first
    )


def respond_twice(
    linear: SecondOrderModel,
    slots: Slots,
    u: Float[Array, "samples inputs"],
    ramps: Bool[Array, " inputs"],
    dt: Float[Array, ""],
    state: Float[Array, " n"],
) -> tuple[Response, Response]:
    """As `respond` with one step for each sampling interval, and with two, in the time of two.

    Args:
        linear: the model without effects.
        slots: its effects.
        u: inputs.
        ramps: which are held to first order, the others to zero order.
        dt: sampling interval, s.
        state: at the first sample, as in `Response`.
    """
    system = augmented(linear, slots)
    late = forced(system, slots, u, ramps, dt)
    one, two = (
        _readings(system, slots, late, dt, x) for x in integrate_twice(system, slots, late, dt, state)
    )
    return one, two


def _readings(
    system: Augmented, slots: Slots, late: Late, dt: Array, path: Path, first: int | Array = 0
) -> Response:
    change = system.changed
    forces = instant_forces(system, slots, path, value_at_sample(late), dt, first)
    if not any(kind.where == "sensor" for kind in possible(slots.kinds)):
        outputs = path.states @ system.C.T + value_at_sample(late) @ system.D.T + forces @ system.F.T
        return Response(outputs, path.states, forces[:, : slots.count])
    delays = change.delay @ slots.sensors / dt
    read = jax.vmap(_delayed, (0, 0, 0, 0, None, None, None, None, None), 1)
    outputs = read(system.C, system.D, system.F, delays, system, path, forces, late, dt)
    outputs = outputs * (1 + change.gain @ slots.sensors) + change.offset @ slots.sensors
    return Response(outputs, path.states, forces[:, : slots.count])


def _delayed(
    C: Array,
    D: Array,
    F: Array,
    delay: Array,
    system: Augmented,
    path: Path,
    forces: Array,
    late: Late,
    dt: Array,
) -> Float[Array, " samples"]:
    """One output some sampling intervals ago, from the sample before that instant; at rest before the record."""
    back = jnp.ceil(delay)
    part = back - delay
    columns = jnp.concatenate([system.G, system.B], axis=1)
    ports = system.G.shape[1]
    whole, *moved = phi_columns(system.A, columns, part * dt)
    length = jnp.where(part > 0, part, 1.0)
    lines = late._replace(arrival=None)
    push = jax.vmap(lambda line: parabola_over_step(line._replace(arrival=late.arrival), 0.0 * part, length))(
        lines
    )
    # read so long after every sample, of which those are taken that lie far enough back
    read = path.states @ (C @ whole) + path.mean_force @ (C @ moved[0][:, :ports])
    read = read + sum(x @ (C @ y[:, ports:]) for x, y in zip(push, pushed(moved, 1.0), strict=True))
    arrived = part >= late.arrival
    line = late.new + (part - late.arrival) * late.new_slope
    u = jnp.where(arrived, line, late.old + (part - late.arrival) * late.old_slope)
    after = jnp.concatenate([forces[1:], forces[-1:]])
    read = read + u @ D + (forces * (1 - part) + after * part) @ F
    at = jnp.arange(len(forces)) - back.astype(int)
    return jnp.where(at < 0, C @ path.states[0], read[jnp.maximum(at, 0)])
