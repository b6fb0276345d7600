"""A force that depends on the path: Bouc and Wen's law."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxsid.mechanics.effects.kind import NONE, STIFFNESS, Kind, Motion, Parameter, power
from jaxsid.mechanics.effects.prior import PART, Scale, size, slab

WIDER = (5.0, 1.0), (20.0, 0.5)  # times the distance at which a loop yields, and beta's part of what bends it


def _force(at: Motion, stiffness: Array, beta: Array, gamma: Array, exponent: Array) -> Array:
    return stiffness * at.memory


def _rate(at: Motion, stiffness: Array, beta: Array, gamma: Array, exponent: Array) -> Array:
    size = power(at.memory, exponent)
    return at.velocity - (beta * jnp.abs(at.velocity) * jnp.sign(at.memory) + gamma * at.velocity) * size


def _sensible(stiffness: float, beta: float, gamma: float, exponent: float) -> bool:
    # a loop that runs the other way round would feed the motion, and a memory that never saturates grows without bound
    return stiffness > 0 and beta + gamma > 0


def _hardly_bent(
    stiffness: float, beta: float, gamma: float, exponent: float
) -> tuple[tuple[float, ...], ...]:
    # one that yields too early holds the motion back as another: no search finds on from there
    if not _sensible(stiffness, beta, gamma, exponent):
        return ()
    bends = (beta + gamma) ** (1 / exponent)
    return tuple((stiffness, part * bends / k, (1 - part) * bends / k, 1.0) for k, part in WIDER)


EFFECT = Kind(
    name="hysteresis",
    where="between",
    parameters=(
        Parameter("stiffness", STIFFNESS, Scale(force=1, displacement=-1), PART),
        Parameter("beta", ("1/m^n", "1/rad^n"), Scale(displacement=-1), size(1.0, 3.0), raised="exponent"),
        Parameter("gamma", ("1/m^n", "1/rad^n"), Scale(displacement=-1), slab(1.0), raised="exponent"),
        Parameter("exponent", NONE, Scale(), slab(1.0, centre=1.0, lowest=1.0), lowest=1.0, default=1.0),
    ),
    law="F = a z, z' = v - beta abs(v) abs(z)^(n-1) z - gamma v abs(z)^n",
    about="Wire ropes, rubber, joints that slip a little: the force lags behind, as a loop of some width.",
    source="Y. K. Wen, J. Eng. Mech. Div. ASCE 102 (1976); F. Ikhouane and J. Rodellar, Nonlinear Dyn. 42 (2005).",
    force=_force,
    restoring=True,
    rate=_rate,
    sensible=_sensible,
    hardly_bent=_hardly_bent,
    states=1,
)
