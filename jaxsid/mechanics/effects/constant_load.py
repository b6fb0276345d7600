"""A constant force on a body."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxsid.mechanics.effects.kind import FORCE, Kind, Motion, Parameter
from jaxsid.mechanics.effects.prior import Scale, slab


def _force(at: Motion, force: Array) -> Array:
    return force * jnp.ones_like(at.displacement)


EFFECT = Kind(
    name="constant_load",
    where="body",
    # unlike other forces it does not go by how the place moves
    parameters=(Parameter("force", FORCE, Scale(force=1), slab(10.0)),),
    law="constant force on the body",
    about="Weight along a tilted axis, a preload, an offset of the drive's amplifier.",
    source="A. Janot, M. Gautier and M. Brunot, Data set and reference models of EMPS, 2019.",
    force=_force,
    steady=True,
)
