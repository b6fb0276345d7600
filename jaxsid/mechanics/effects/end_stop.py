"""Elastic stops on both sides."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxsid.mechanics.effects.kind import DISTANCE, STIFFNESS, Kind, Motion, Parameter
from jaxsid.mechanics.effects.prior import Scale, size


def _force(at: Motion, stiffness: Array, clearance: Array) -> Array:
    beyond = jnp.maximum(at.displacement - clearance, 0.0) + jnp.minimum(at.displacement + clearance, 0.0)
    return stiffness * beyond


EFFECT = Kind(
    name="end_stop",
    where="between",
    parameters=(
        Parameter("stiffness", STIFFNESS, Scale(force=1, displacement=-1), size(1.0, 10.0), lowest=0.0),
        Parameter("clearance", DISTANCE, Scale(displacement=1), size(1.0, 2.0), lowest=0.0),
    ),
    law="F = p (d - b) for d > b, p (d + b) for d < -b",
    about="A part that reaches a bumper, a neighbour or the end of its travel.",
    source="S. W. Shaw and P. J. Holmes, J. Sound Vib. 90 (1983).",
    force=_force,
    restoring=True,
)
