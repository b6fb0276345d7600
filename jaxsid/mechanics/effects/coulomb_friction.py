"""Dry friction of one strength."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxsid.mechanics.effects.kind import FORCE, Kind, Parameter
from jaxsid.mechanics.effects.prior import POSITIVE_PART, Scale


def _slip(speed: Array, force: Array) -> Array:
    return force * jnp.ones_like(speed)


EFFECT = Kind(
    name="coulomb_friction",
    where="between",
    parameters=(Parameter("force", FORCE, Scale(force=1), POSITIVE_PART, lowest=0.0),),
    law="F = Fc sign(v), sticking at v = 0",
    about="Guides, seals and gears rub with a force that hardly depends on speed and holds what stands still.",
    source="B. Armstrong-Helouvry, P. Dupont and C. Canudas de Wit, Automatica 30 (1994).",
    slip=_slip,
)
