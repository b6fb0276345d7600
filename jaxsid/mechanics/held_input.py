"""Inputs between samples: held, late by any time, and cut into steps shorter than the sampling interval.

Over a step an input is replaced by the parabola with the same mean, first and second moments, which is exact for both
holds where no late sample arrives within the step, and else errs by less than (w step)^3 of the jump's part.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class Late(NamedTuple):
    """What a held input does in each sampling interval: one line before a late sample arrives, another after it.

    Attributes:
        old, new: (samples, inputs) values of the two lines at the arrival.
        old_slope, new_slope: (samples, inputs) change of each over a sampling interval.
        arrival: (inputs,) in sampling intervals, from 0 to 1.
    """

    old: Float[Array, "samples inputs"]
    new: Float[Array, "samples inputs"]
    old_slope: Float[Array, "samples inputs"]
    new_slope: Float[Array, "samples inputs"]
    arrival: Float[Array, " inputs"]


def late_input(
    u: Float[Array, "samples inputs"], ramps: Bool[Array, " inputs"], delay: Float[Array, " inputs"]
) -> Late:
    """A held input behind a delay; before the record it was zero, after it it stays as it was last.

    Args:
        u: samples.
        ramps: which are held to first order.
        delay: in sampling intervals, not negative.
    """
    whole = jnp.floor(delay)
    number = jnp.arange(len(u))[:, None] - whole.astype(int)

    def sample(shift: int) -> Array:
        at = number + shift
        taken = jnp.take_along_axis(u, jnp.clip(at, 0, len(u) - 1), axis=0)
        return jnp.where(at < 0, 0.0, taken)

    before, now, after = sample(-1), sample(0), sample(1)
    old = jnp.where(ramps, now, before)
    return Late(
        old, now, jnp.where(ramps, now - before, 0.0), jnp.where(ramps, after - now, 0.0), delay - whole
    )


def value_at_sample(late: Late) -> Float[Array, "*samples inputs"]:
    """The input at every sampling instant.

    Args:
        late: from `late_input`, or of one sample, each field (inputs,).
    """
    old = late.old - late.arrival * late.old_slope
    return jnp.where(late.arrival > 0, old, late.new)


def parabola_over_step(late: Late, begin: Array, length: Array) -> tuple[Array, Array, Array]:
    """a, b, c of a + b s + c (6 s^2 - 6 s + 1), s from 0 to 1 over a step, with the input's mean and two moments.

    The last polynomial has neither mean nor first moment, so c is zero where no late sample arrives within the step.

    Args:
        late: of one sample, each field (inputs,).
        begin: of the step, in sampling intervals.
        length: of the step, in sampling intervals.
    """
    # in steps; a quotient in a loop would be computed apart from all else
    arrival = (late.arrival - begin) * (1 / length)
    part, bend = jnp.clip(arrival, 0.0, 1.0), (late.old_slope - late.new_slope) * length
    # of the two lines where the part of the step before the arrival ends
    jump = late.new - late.old + bend * (arrival - part)
    middle = late.new + late.new_slope * (begin + 0.5 * length - late.arrival)
    mean = middle - jump * part - 0.5 * bend * part**2
    change = late.new_slope * length + 6 * jump * part * (1 - part) + bend * (3 * part**2 - 2 * part**3)
    before_after = part * (1 - part)
    curve = -5 * before_after * (jump * (1 - 2 * part) + 0.5 * bend * before_after)
    return mean - 0.5 * change, change, curve
