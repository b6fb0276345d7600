"""Damping by the square of the speed."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxsid.mechanics.effects.kind import Kind, Motion, Parameter
from jaxsid.mechanics.effects.prior import PART, Scale


def _force(at: Motion, coefficient: Array) -> Array:
    return coefficient * jnp.abs(at.velocity) * at.velocity


EFFECT = Kind(
    name="quadratic_damping",
    where="between",
    parameters=(Parameter("coefficient", ("N s²/m²", "N m s²/rad²"), Scale(force=1, velocity=-2), PART),),
    law="F = p abs(v) v",
    about="Fluid pushed aside by a moving part, orifices, air drag.",
    source="K. Worden and G. R. Tomlinson, Nonlinearity in Structural Dynamics, 2001.",
    force=_force,
)
