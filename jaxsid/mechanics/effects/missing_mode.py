"""A mass on a spring and damper that the model lacks."""

import math

from jaxtyping import Array

from jaxsid.mechanics.effects.kind import DAMPING, MASS, STIFFNESS, Changes, Kind, Nominal, Parameter
from jaxsid.mechanics.effects.prior import Scale, size


def _changes(at: Nominal, mass: Array, stiffness: Array, damping: Array) -> Changes:
    return Changes(attached_mass=mass, attached_stiffness=stiffness, attached_damping=damping)


def _vibrates(mass: float, stiffness: float, damping: float) -> float:
    return math.sqrt(stiffness / mass) if mass > 0 else math.inf


def _sensible(mass: float, stiffness: float, damping: float) -> bool:
    # a part that creeps back adds no resonance, and stands for losses of another law
    return damping < 2 * math.sqrt(max(stiffness * mass, 0.0))


EFFECT = Kind(
    name="missing_mode",
    where="body",
    parameters=(
        Parameter("mass", MASS, Scale(force=1, velocity=-1, rate=-1), size(0.1, 3.0), lowest=0.0),
        Parameter("stiffness", STIFFNESS, Scale(force=1, displacement=-1), size(0.3, 10.0), lowest=0.0),
        Parameter("damping", DAMPING, Scale(force=1, velocity=-1), size(0.01, 10.0), lowest=0.0, default=0.0),
    ),
    law="m x'' + c (x' - x_b') + k (x - x_b) = 0, its spring and damper pulling at the body",
    about="A flexible part that was taken for rigid: it adds a resonance and splits those near it.",
    source="J. P. Den Hartog, Mechanical Vibrations, 4th ed., 1956, ch. 3.",
    changes=_changes,
    states=2,
    sensible=_sensible,
    vibrates=_vibrates,
)
