"""A spring and damper where the model has none."""

from jaxtyping import Array

from jaxsid.mechanics.effects.kind import DAMPING, STIFFNESS, Changes, Kind, Nominal, Parameter
from jaxsid.mechanics.effects.prior import POSITIVE_PART, Scale


def _changes(at: Nominal, stiffness: Array, damping: Array) -> Changes:
    return Changes(stiffness=stiffness, damping=damping)


EFFECT = Kind(
    name="missing_connection",
    where="between",
    parameters=(
        Parameter(
            "stiffness", STIFFNESS, Scale(force=1, displacement=-1), POSITIVE_PART, lowest=0.0, default=0.0
        ),
        Parameter("damping", DAMPING, Scale(force=1, velocity=-1), POSITIVE_PART, lowest=0.0, default=0.0),
    ),
    law="F = k d + c v",
    about="Two bodies, or a body and the ground, touch where the model has nothing: a cable, a hose, a guide.",
    source="M. Friswell and J. Mottershead, Finite Element Model Updating in Structural Dynamics, 1995.",
    changes=_changes,
    needs="apart",
)
