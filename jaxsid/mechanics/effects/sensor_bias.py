"""A sensor whose zero is off."""

from jaxtyping import Array

from jaxsid.mechanics.effects.kind import Changes, Kind, Nominal, Parameter
from jaxsid.mechanics.effects.prior import PART, Scale


def _changes(at: Nominal, offset: Array) -> Changes:
    return Changes(offset=offset)


EFFECT = Kind(
    name="sensor_bias",
    where="sensor",
    parameters=(Parameter("offset", ("unit of the sensor", "unit of the sensor"), Scale(signal=1), PART),),
    law="output + constant",
    about="Drifted zero, gravity on a tilted accelerometer.",
    source="R. Pintelon and J. Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., 2012.",
    changes=_changes,
    steady=True,
)
