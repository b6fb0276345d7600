"""A sensor that reports late."""

from jaxtyping import Array

from jaxsid.mechanics.effects.kind import TIME, Changes, Kind, Nominal, Parameter
from jaxsid.mechanics.effects.prior import LATE, Scale


def _changes(at: Nominal, delay: Array) -> Changes:
    return Changes(delay=delay)


EFFECT = Kind(
    name="sensor_delay",
    where="sensor",
    parameters=(Parameter("delay", TIME, Scale(rate=-1), LATE, lowest=0.0, typical=0.0),),
    law="output at t - delay",
    about="Transmission, buffers, converters that read their channels one after another.",
    source="R. Pintelon and J. Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., 2012.",
    changes=_changes,
)
