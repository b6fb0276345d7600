"""A spring that differs by direction, smoothly."""

from jaxtyping import Array

from jaxsid.mechanics.effects.kind import Kind, Motion, Parameter
from jaxsid.mechanics.effects.prior import PART, Scale


def _force(at: Motion, coefficient: Array) -> Array:
    return coefficient * at.displacement**2


EFFECT = Kind(
    name="quadratic_stiffness",
    where="between",
    parameters=(Parameter("coefficient", ("N/m²", "N m/rad²"), Scale(force=1, displacement=-2), PART),),
    law="F = p d^2",
    about="A preloaded or sagging spring, a curved part: stiffer one way, softer the other.",
    source="K. Worden and G. R. Tomlinson, Nonlinearity in Structural Dynamics, 2001.",
    force=_force,
    restoring=True,
)
