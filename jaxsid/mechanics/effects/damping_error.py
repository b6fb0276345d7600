"""A damper that is not what the model says."""

from jaxtyping import Array

from jaxsid.mechanics.effects.kind import DAMPING, NONE, Changes, Kind, Nominal, Parameter
from jaxsid.mechanics.effects.prior import PART, Scale, slab


def _changes(at: Nominal, factor: Array, value: Array) -> Changes:
    return Changes(damping=(factor - 1) * at.damping + value)


EFFECT = Kind(
    name="damping_error",
    where="between",
    parameters=(
        Parameter("factor", NONE, Scale(), slab(2.0, centre=1.0, lowest=0.0), lowest=0.0, default=1.0),
        Parameter("value", DAMPING, Scale(force=1, velocity=-1), PART, default=0.0),
    ),
    law="c = factor c_nominal; value where c_nominal is 0",
    about="Damping differs from the nominal one, which is seldom known better than by a factor of two.",
    source="M. Friswell and J. Mottershead, Finite Element Model Updating in Structural Dynamics, 1995.",
    changes=_changes,
    needs="joined",
)
