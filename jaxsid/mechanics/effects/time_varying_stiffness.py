"""A spring that drifts."""

from jaxtyping import Array

from jaxsid.mechanics.effects.kind import Kind, Motion, Parameter
from jaxsid.mechanics.effects.prior import PART, Scale


def _force(at: Motion, rate: Array) -> Array:
    return rate * at.time * at.displacement


EFFECT = Kind(
    name="time_varying_stiffness",
    where="between",
    parameters=(
        Parameter("rate", ("N/(m s)", "N m/(rad s)"), Scale(force=1, displacement=-1, duration=-1), PART),
    ),
    law="F = p t d, t from the record's start",
    about="Warming, loosening or damage during the measurement.",
    source="K. Liu, J. Sound Vib. 206 (1997).",
    force=_force,
    timed=True,
)
