"""A sinusoidal force on a body from elsewhere."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxsid.mechanics.effects.kind import FORCE, Kind, Motion, Parameter
from jaxsid.mechanics.effects.prior import ANGLE, PART, Scale, size


def _force(at: Motion, amplitude: Array, frequency_hz: Array, phase: Array) -> Array:
    return amplitude * jnp.sin(2 * jnp.pi * frequency_hz * at.time + phase)


EFFECT = Kind(
    name="periodic_disturbance",
    where="body",
    parameters=(
        Parameter("amplitude", FORCE, Scale(force=1), PART),
        Parameter("frequency_hz", ("Hz", "Hz"), Scale(rate=1), size(0.5, 5.0), lowest=0.0),
        Parameter("phase", ("rad", "rad"), Scale(), ANGLE, default=0.0),
    ),
    law="p sin(2 pi f t + phi) on the body, t from the record's start",
    about="An unbalanced fan or a pump nearby, a mains-frequency ripple; its phase differs from record to record.",
    source="L. Ljung, System Identification, 2nd ed., 1999, ch. 14.",
    force=_force,
    wave=("amplitude", "phase"),
    timed=True,
)
