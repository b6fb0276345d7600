"""A sensor that reads too much or too little."""

from jaxtyping import Array

from jaxsid.mechanics.effects.kind import NONE, Changes, Kind, Nominal, Parameter
from jaxsid.mechanics.effects.prior import GAIN, Scale


def _changes(at: Nominal, factor: Array) -> Changes:
    return Changes(gain=factor - 1)


EFFECT = Kind(
    name="sensor_gain",
    where="sensor",
    parameters=(Parameter("factor", NONE, Scale(), GAIN),),
    law="output x factor",
    about="A wrong calibration, a loose transducer, a reading in other units.",
    source="R. Pintelon and J. Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., 2012.",
    changes=_changes,
)
