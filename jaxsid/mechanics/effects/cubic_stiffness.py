"""A spring that hardens or softens alike in both directions."""

from jaxtyping import Array

from jaxsid.mechanics.effects.kind import Kind, Motion, Parameter
from jaxsid.mechanics.effects.prior import PART, Scale


def _force(at: Motion, coefficient: Array) -> Array:
    return coefficient * at.displacement**3


EFFECT = Kind(
    name="cubic_stiffness",
    where="between",
    parameters=(Parameter("coefficient", ("N/m³", "N m/rad³"), Scale(force=1, displacement=-3), PART),),
    law="F = p d^3",
    about="Membranes, clamped beams and rubber stiffen as they are stretched; buckled parts soften.",
    source="K. Worden and G. R. Tomlinson, Nonlinearity in Structural Dynamics, 2001.",
    force=_force,
    restoring=True,
)
