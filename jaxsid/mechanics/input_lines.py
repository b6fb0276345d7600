"""Inputs of many windows as columns with their slopes, so that what they do to states and readings are small matrices.

Between two samples a held input follows one line before a late sample arrives and another after it. All that is asked
of it is linear in the values and slopes of these lines, with factors that depend on the arrival only.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsid.mechanics.held_input import Late, parabola_over_step
from jaxsid.mechanics.nonlinear import Scaled, held

LINES = 4  # fields of `Late` but the arrival: two values, two slopes


class Arrival(NamedTuple):
    """When late samples arrive.

    Attributes:
        value: (inputs,) in sampling intervals.
        slopes: (inputs, p) by the unknowns.
    """

    value: Float[Array, " inputs"]
    slopes: Float[Array, "inputs p"]


def input_lines(
    own: Scaled, slopes: Scaled, u: Float[Array, "windows samples inputs"], ramps: Bool[Array, " inputs"]
) -> tuple[Float[Array, "samples lines columns windows"], Arrival]:
    """Values and slopes of the lines, (samples, 4 inputs, 1 + p, windows), and the arrival.

    Args:
        own: limits, gains and delays of the inputs.
        slopes: by the unknowns, the last axis.
        u: samples.
        ramps: which are held to first order.
    """

    def of(move: Array) -> tuple[Array, Array]:
        scaled = jax.tree.map(lambda x, slope: x + slope @ move, own, slopes)
        late = jax.vmap(lambda x: held(scaled, x, ramps))(u)
        return jnp.moveaxis(jnp.concatenate(late[:LINES], axis=2), 0, -1), late.arrival[0]

    nothing = jnp.zeros(slopes.gain.shape[-1], u.dtype)
    value, arrival = of(nothing)
    moved = jax.vmap(lambda move: jax.jvp(of, (nothing,), (move,))[1], out_axes=(2, 1))
    moved, arrival_slopes = moved(jnp.eye(len(nothing), dtype=nothing.dtype))
    return jnp.concatenate([value[:, :, None], moved], axis=2), Arrival(arrival, arrival_slopes)


def of_lines(
    functions: Callable[[Late], Sequence[Array]], arrival: Arrival
) -> tuple[Float[Array, "k lines"], Float[Array, "k p lines"]]:
    """What functions of each input do to the lines, as a matrix, (k inputs, 4 inputs), and its slopes.

    Args:
        functions: k, each (inputs,), linear in the lines.
        arrival: of late samples.
    """
    value = _matrix(functions, arrival.value)
    # each input's functions depend on its own arrival only
    by = jax.jvp(partial(_matrix, functions), (arrival.value,), (jnp.ones_like(arrival.value),))[1]
    return value, by[:, None] * jnp.tile(arrival.slopes, (LINES, 1)).T


def direct_of_lines(
    direct: tuple[Float[Array, "outputs lines"], Float[Array, "outputs lines p"]],
    part: tuple[Float[Array, " outputs"], Float[Array, "outputs p"]],
    arrival: Arrival,
) -> tuple[Float[Array, "outputs lines"], Float[Array, "outputs p lines"]]:
    """What inputs add at once to readings that are late, as a matrix to the lines, and its slopes.

    Args:
        direct: (outputs, 4 inputs) from the inputs' parabola up to the reading, and their value then; and slopes.
        part: of an interval, how long after the sample is read; and slopes.
        arrival: of late samples.
    """

    def of(move: Array) -> Array:
        at = arrival.value + arrival.slopes @ move
        each = jax.vmap(lambda row, part: row @ _matrix(partial(_until, part), at))
        return each(direct[0] + direct[1] @ move, part[0] + part[1] @ move)

    nothing = jnp.zeros(part[1].shape[-1], part[0].dtype)
    return of(nothing), jnp.swapaxes(jax.jacfwd(of)(nothing), -1, -2)


def _until(part: Array, late: Late) -> list[Array]:
    push = parabola_over_step(late, 0.0 * part, jnp.where(part > 0, part, 1.0))
    since = part - late.arrival
    before, after = late.old + since * late.old_slope, late.new + since * late.new_slope
    return [*push, jnp.where(since >= 0, after, before)]


def _matrix(functions: Callable[[Late], Sequence[Array]], arrival: Array) -> Array:
    def of(unit: Array) -> Array:
        old, new, old_slope, new_slope = unit.reshape(LINES, -1)
        return jnp.concatenate(functions(Late(old, new, old_slope, new_slope, arrival)))

    return jax.vmap(of, out_axes=1)(jnp.eye(LINES * len(arrival), dtype=arrival.dtype))
