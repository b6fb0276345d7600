"""A sinusoidal force on a body from elsewhere."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxsid.mechanics.effects.kind import FORCE, Kind, Motion, Parameter


def _force(at: Motion, amplitude: Array, frequency_hz: Array, phase: Array) -> Array:
    return amplitude * jnp.sin(2 * jnp.pi * frequency_hz * at.time + phase)


EFFECT = Kind(
    name="periodic_disturbance",
    where="body",
    parameters=(
        Parameter("amplitude", FORCE),
        Parameter("frequency_hz", ("Hz", "Hz"), lowest=0.0),
        Parameter("phase", ("rad", "rad"), default=0.0),
    ),
    law="p sin(2 pi f t + phi) on the body, t from the record's start",
    about="An unbalanced fan or a pump nearby, a mains-frequency ripple; its phase differs from record to record.",
    source="L. Ljung, System Identification, 2nd ed., 1999, ch. 14.",
    force=_force,
)
