"""Dry friction between one instant and the next, as it is: sliding, coming to rest, resting, breaking loose.

Within a step each sliding speed runs straight from v0 to v1, where v1 = free - g F with F the mean force. It may keep
its sign, stop within the step and rest, or stop and turn; each case has its F in closed form, continuous from case to
case, so that nothing has to be smoothed and derivatives are those of the true motion. The error is of second order.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxsid.mechanics.effects.catalogue import Numbers, rubbing, slips

ROUNDS = 3  # of the magnitude at the mean speed, of one contact
SWEEPS = 12  # over contacts that act on each other


class Contact(NamedTuple):
    """Mean force over a step, and which way each contact slides after it, 0 where it rests."""

    force: Float[Array, " slots"]
    sliding: Float[Array, " slots"]


def friction(
    kinds: Numbers,
    parameters: Float[Array, "slots most"],
    before: Float[Array, " slots"],
    sliding: Float[Array, " slots"],
    free: Float[Array, " slots"],
    give: Float[Array, "slots slots"],
) -> Contact:
    """Mean dry friction of every slot over a step.

    Args:
        kinds: numbers of the kinds.
        parameters: in their order.
        before: relative speeds at the start.
        sliding: which way each slides there, 0 where it rests.
        free: speeds at the end if nothing rubbed.
        give: what a unit of each force takes off each speed, symmetric and positive where forces act.
    """
    able_slots = acting(kinds)
    if not able_slots:
        return Contact(jnp.zeros_like(before), sliding)
    start = jnp.where(sliding == 0, 0.0, before)
    most = slips(kinds, parameters, jnp.zeros_like(start))
    own = jnp.diag(give)
    able = (own > 0) & rubbing(kinds)
    own = jnp.where(able, own, 1.0)
    off = give - jnp.diag(jnp.diag(give))

    def sweep(_: Array | int, found: tuple[Array, Array]) -> tuple[Array, Array]:
        force, after = found
        level = slips(kinds, parameters, 0.5 * (jnp.abs(start) + jnp.abs(after)))
        for i in able_slots:
            alone = free[i] - off[i] @ force
            new = _one(start[i], sliding[i], alone, own[i], level[i], most[i], able[i])
            force, after = force.at[i].set(new[0]), after.at[i].set(new[2])
        return force, after

    found = jnp.zeros_like(start), start
    if len(able_slots) == 1:  # unrolled: a loop within a loop costs more than what it does
        for i in range(ROUNDS):
            found = sweep(i, found)
    else:
        found = lax.fori_loop(0, SWEEPS, sweep, found)
    force, after = found
    level = slips(kinds, parameters, 0.5 * (jnp.abs(start) + jnp.abs(after)))
    force, now, _ = _one(start, sliding, free - off @ force, own, level, most, able)
    return Contact(force, now)


def holding(
    kinds: Numbers,
    parameters: Float[Array, "slots most"],
    resting: Bool[Array, " slots"],
    gain: Float[Array, " slots"],
    give: Float[Array, "slots slots"],
) -> Float[Array, " slots"]:
    """Forces of contacts at rest at an instant: what balances all others, up to the static level.

    Args:
        kinds: numbers of the kinds.
        parameters: in their order.
        resting: which contacts are at rest; the others do not hold.
        gain: relative accelerations if nothing held.
        give: what a unit of each force takes off each acceleration.
    """
    able_slots = acting(kinds)
    if not able_slots:
        return jnp.zeros_like(gain)
    most = slips(kinds, parameters, jnp.zeros_like(gain))
    own = jnp.diag(give)
    held = (own > 0) & rubbing(kinds) & resting
    own = jnp.where(held, own, 1.0)
    off = give - jnp.diag(jnp.diag(give))

    def sweep(_: Array | int, force: Array) -> Array:
        for i in able_slots:
            force = force.at[i].set(
                jnp.clip((gain[i] - off[i] @ force) / own[i], -most[i], most[i]) * held[i]
            )
        return force

    if len(able_slots) < 2:
        return sweep(0, jnp.zeros_like(gain))
    return lax.fori_loop(0, SWEEPS, sweep, jnp.zeros_like(gain))


def acting(kinds: Numbers) -> list[int]:
    """Slots that may be dry friction, as far as is known while the program is traced.

    Args:
        kinds: numbers of the kinds.
    """
    rubs = rubbing(kinds)
    return [i for i in range(len(rubs)) if not isinstance(rubs, np.ndarray) or rubs[i]]


def _one(
    start: Array, sliding: Array, free: Array, give: Array, level: Array, most: Array, able: Array
) -> tuple[Array, Array, Array]:
    """Mean force, which way it slides afterwards, and speed afterwards, each contact by itself."""
    rests = sliding == 0
    way = jnp.where(rests, jnp.sign(free), sliding)
    # what breaks loose must overcome the static level first
    loose = ~rests | (jnp.abs(free) > most * give)
    ahead = free - way * level * give
    goes_on = loose & (way * ahead > 0)
    drop = jnp.where(goes_on | (start == ahead), 1.0, start - ahead)
    left = jnp.where(rests, 1.0, jnp.clip(1 - start / drop, 0.0, 1.0))  # part of the step after the stop
    back = free - start + way * level * give  # gain of speed over a whole step, sliding the other way
    turns = ~goes_on & ~rests & (way * back < 0) & (jnp.abs(free - start) > most * give)
    after = jnp.where(goes_on, ahead, jnp.where(turns, left * back, 0.0))
    now = jnp.where(goes_on, way, jnp.where(turns, -way, 0.0))
    return (
        jnp.where(able, (free - after) / give, 0.0),
        jnp.where(able, now, 0.0),
        jnp.where(able, after, free),
    )
