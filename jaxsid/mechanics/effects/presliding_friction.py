"""Dry friction whose surfaces give a little before they slide: LuGre's law without its bristles' damping."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxsid.mechanics.effects import stribeck_friction
from jaxsid.mechanics.effects.kind import STIFFNESS, Kind, Motion, Parameter
from jaxsid.mechanics.effects.prior import Scale, size

RIGID = stribeck_friction.EFFECT


def _force(at: Motion, force: Array, static_force: Array, velocity: Array, stiffness: Array) -> Array:
    return stiffness * at.memory


def _rate(at: Motion, force: Array, static_force: Array, velocity: Array, stiffness: Array) -> Array:
    level = stribeck_friction.level(at.velocity, force, static_force, velocity)
    return at.velocity - stiffness * jnp.abs(at.velocity) * at.memory / jnp.where(level > 0, level, 1.0)


def _sensible(force: float, static_force: float, velocity: float, stiffness: float) -> bool:
    return static_force >= force > 0 and stiffness > 0


EFFECT = Kind(
    name="presliding_friction",
    form_of=RIGID.name,
    where="between",
    parameters=(
        *RIGID.parameters,
        # surfaces give within a small part of the motion
        Parameter("stiffness", STIFFNESS, Scale(force=1, displacement=-1), size(10.0, 3.0), lowest=0.0),
    ),
    law="F = k z, z' = v - k abs(v) z / (Fc + (Fs - Fc) exp(-(v/vs)^2))",
    about="Before they slide, surfaces give as a spring does: what turns round draws a loop, and nothing ever sticks.",
    source="C. Canudas de Wit, H. Olsson, K. Astrom and P. Lischinsky, IEEE Trans. Autom. Control 40 (1995).",
    force=_force,
    restoring=True,
    rate=_rate,
    sensible=_sensible,
    states=1,
)
