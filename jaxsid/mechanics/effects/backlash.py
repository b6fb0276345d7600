"""Play in a connection."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxsid.mechanics.effects.kind import DISTANCE, Kind, Motion, Parameter
from jaxsid.mechanics.effects.prior import Scale, size


def _force(at: Motion, half_gap: Array) -> Array:
    return -at.spring * jnp.clip(at.displacement, -half_gap, half_gap)


EFFECT = Kind(
    name="backlash",
    where="between",
    parameters=(Parameter("half_gap", DISTANCE, Scale(displacement=1), size(0.3, 3.0), lowest=0.0),),
    law="the connection's spring acts on d - clip(d, -b, b), its damper as before",
    about="Gears, couplings and worn joints move freely within a gap before their spring takes hold.",
    source="M. Nordin and P.-O. Gutman, Automatica 38 (2002).",
    force=_force,
    restoring=True,
    needs="joined",
)
