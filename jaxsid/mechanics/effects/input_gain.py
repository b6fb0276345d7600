"""A drive that pushes more or less than its reading says."""

from jaxtyping import Array

from jaxsid.mechanics.effects.kind import NONE, Changes, Kind, Nominal, Parameter
from jaxsid.mechanics.effects.prior import GAIN, Scale


def _changes(at: Nominal, factor: Array) -> Changes:
    return Changes(gain=factor - 1)


EFFECT = Kind(
    name="input_gain",
    where="input",
    parameters=(Parameter("factor", NONE, Scale(), GAIN),),
    law="input x factor",
    about="A wrong force constant, a load cell out of calibration.",
    source="R. Pintelon and J. Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., 2012.",
    changes=_changes,
)
