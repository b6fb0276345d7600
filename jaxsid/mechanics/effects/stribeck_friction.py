"""Dry friction that falls with speed from a static level."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxsid.mechanics.effects.kind import FORCE, SPEED, Kind, Parameter
from jaxsid.mechanics.effects.prior import POSITIVE_PART, Scale, size, slab


def level(speed: Array, force: Array, static_force: Array, velocity: Array) -> Array:
    """What friction rubs with at a speed.

    Args:
        speed: of sliding, of either sign.
        force: at high speeds.
        static_force: at rest.
        velocity: at which it has fallen.
    """
    return force + (static_force - force) * jnp.exp(-((speed / velocity) ** 2))


def _sensible(force: float, static_force: float, velocity: float) -> bool:
    return static_force >= force


EFFECT = Kind(
    name="stribeck_friction",
    where="between",
    parameters=(
        Parameter("force", FORCE, Scale(force=1), POSITIVE_PART, lowest=0.0),
        Parameter("static_force", FORCE, Scale(force=1), slab(0.5, lowest=0.0), lowest=0.0),
        Parameter("velocity", SPEED, Scale(velocity=1), size(0.3, 3.0), lowest=0.0),
    ),
    law="F = (Fc + (Fs - Fc) exp(-(v/vs)^2)) sign(v), sticking at v = 0",
    about="Lubricated contacts break loose at a static level and slide at a lower one, so that slow motion jerks.",
    source="B. Armstrong-Helouvry, P. Dupont and C. Canudas de Wit, Automatica 30 (1994).",
    slip=level,
    sensible=_sensible,
    holds="coulomb_friction",
)
