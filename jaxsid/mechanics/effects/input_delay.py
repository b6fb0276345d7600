"""A drive that acts late."""

from jaxtyping import Array

from jaxsid.mechanics.effects.kind import TIME, Changes, Kind, Nominal, Parameter
from jaxsid.mechanics.effects.prior import LATE, Scale


def _changes(at: Nominal, delay: Array) -> Changes:
    return Changes(delay=delay)


EFFECT = Kind(
    name="input_delay",
    where="input",
    parameters=(Parameter("delay", TIME, Scale(rate=-1), LATE, lowest=0.0, typical=0.0),),
    law="held input at t - delay",
    about="Computing time and transmission between command and force.",
    source="R. Pintelon and J. Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., 2012.",
    changes=_changes,
)
