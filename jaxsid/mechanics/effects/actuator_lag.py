"""A drive that follows slowly."""

from jaxtyping import Array

from jaxsid.mechanics.effects.kind import TIME, Changes, Kind, Nominal, Parameter
from jaxsid.mechanics.effects.prior import LATE, Scale


def _changes(at: Nominal, time_constant: Array) -> Changes:
    return Changes(lag=time_constant)


EFFECT = Kind(
    name="actuator_lag",
    where="input",
    parameters=(Parameter("time_constant", TIME, Scale(rate=-1), LATE, lowest=0.0, typical=0.0),),
    law="T f' + f = held input",
    about="The current loop of a motor, a valve, a shaker's coil.",
    source="R. Pintelon and J. Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., 2012.",
    changes=_changes,
    states=1,
)
