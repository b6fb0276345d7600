"""A drive that cannot push harder."""

from jaxtyping import Array

from jaxsid.mechanics.effects.kind import FORCE, Changes, Kind, Nominal, Parameter
from jaxsid.mechanics.effects.prior import Scale, size


def _changes(at: Nominal, limit: Array) -> Changes:
    return Changes(inverse_limit=1 / limit)


EFFECT = Kind(
    name="actuator_saturation",
    where="input",
    parameters=(Parameter("limit", FORCE, Scale(signal=1), size(1.0, 2.0), lowest=0.0),),
    law="input clipped at +-limit",
    about="Current limits, the supply's voltage, a relief valve.",
    source="R. Pintelon and J. Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., 2012.",
    changes=_changes,
)
