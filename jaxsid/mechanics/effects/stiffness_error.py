"""A spring that is not what the model says."""

from jaxtyping import Array

from jaxsid.mechanics.effects.kind import NONE, STIFFNESS, Changes, Kind, Nominal, Parameter
from jaxsid.mechanics.effects.prior import GAIN, PART, Scale


def _changes(at: Nominal, factor: Array, value: Array) -> Changes:
    return Changes(stiffness=(factor - 1) * at.stiffness + value)


EFFECT = Kind(
    name="stiffness_error",
    where="between",
    parameters=(
        Parameter("factor", NONE, Scale(), GAIN, lowest=0.0, default=1.0),
        Parameter("value", STIFFNESS, Scale(force=1, displacement=-1), PART, default=0.0),
    ),
    law="k = factor k_nominal; value where k_nominal is 0",
    about="Springs are softer or stiffer than the nominal ones: wear, a loose joint, a wrong dimension.",
    source="M. Friswell and J. Mottershead, Finite Element Model Updating in Structural Dynamics, 1995.",
    changes=_changes,
    needs="joined",
)
