"""A sensor that follows slowly."""

from jaxtyping import Array

from jaxsid.mechanics.effects.kind import TIME, Changes, Kind, Nominal, Parameter
from jaxsid.mechanics.effects.prior import LATE, Scale


def _changes(at: Nominal, time_constant: Array) -> Changes:
    return Changes(lag=time_constant)


EFFECT = Kind(
    name="sensor_lag",
    where="sensor",
    parameters=(Parameter("time_constant", TIME, Scale(rate=-1), LATE, lowest=0.0, typical=0.0),),
    law="T y' + y = output of an ideal sensor",
    about="A low-pass filter in the transducer or its amplifier.",
    source="R. Pintelon and J. Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., 2012.",
    changes=_changes,
    states=1,
)
