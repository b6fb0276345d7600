"""A force that repeats along the way."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxsid.mechanics.effects.kind import FORCE, Kind, Motion, Parameter
from jaxsid.mechanics.effects.prior import ANGLE, PART, Scale, size

LEAST = 1.0  # of the angle's rms: what goes through less than half a turn is a load and a spring


def _force(at: Motion, amplitude: Array, wavenumber: Array, phase: Array) -> Array:
    return amplitude * jnp.sin(wavenumber * at.displacement + phase)


EFFECT = Kind(
    name="cogging_ripple",
    where="between",
    parameters=(
        Parameter("amplitude", FORCE, Scale(force=1), PART),
        Parameter("wavenumber", ("rad/m", "rad/rad"), Scale(displacement=-1), size(3.0, 5.0, lowest=LEAST)),
        Parameter("phase", ("rad", "rad"), Scale(), ANGLE, default=0.0),
    ),
    law="F = p sin(w d + phi)",
    about="Magnets of a motor attract its teeth, balls of a guide pass its edge, teeth of a gear mesh.",
    source="T. M. Jahns and W. L. Soong, IEEE Trans. Ind. Electron. 43 (1996).",
    force=_force,
    wave=("amplitude", "phase"),
    restoring=True,
)
