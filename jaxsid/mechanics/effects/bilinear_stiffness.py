"""A spring that has another stiffness in one direction."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxsid.mechanics.effects.kind import STIFFNESS, Kind, Motion, Parameter
from jaxsid.mechanics.effects.prior import PART, Scale


def _force(at: Motion, stiffness: Array) -> Array:
    return stiffness * jnp.maximum(at.displacement, 0.0)


EFFECT = Kind(
    name="bilinear_stiffness",
    where="between",
    parameters=(Parameter("stiffness", STIFFNESS, Scale(force=1, displacement=-1), PART),),
    law="F = p d for d > 0 only",
    about="A crack that closes, a chain, a belt, a one-sided support.",
    source="K. Worden and G. R. Tomlinson, Nonlinearity in Structural Dynamics, 2001.",
    force=_force,
    restoring=True,
)
