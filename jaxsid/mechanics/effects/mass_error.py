"""A body whose mass is not what the model says."""

from jaxtyping import Array

from jaxsid.mechanics.effects.kind import MASS, NONE, Changes, Kind, Nominal, Parameter
from jaxsid.mechanics.effects.prior import GAIN, PART, Scale


def _changes(at: Nominal, factor: Array, value: Array) -> Changes:
    return Changes(mass=(factor - 1) * at.mass + value)


EFFECT = Kind(
    name="mass_error",
    where="body",
    parameters=(
        Parameter("factor", NONE, Scale(), GAIN, lowest=0.0, default=1.0),
        Parameter("value", MASS, Scale(force=1, velocity=-1, rate=-1), PART, default=0.0),
    ),
    law="m = factor m_nominal, or m_nominal + value",
    about="The mass or inertia differs from the nominal one: an unmodelled part moves along, or its size was guessed.",
    source="M. Friswell and J. Mottershead, Finite Element Model Updating in Structural Dynamics, 1995.",
    changes=_changes,
)
