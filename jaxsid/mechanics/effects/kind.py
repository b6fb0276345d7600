"""What a kind of effect is: its place, its parameters, and what it does there."""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from jaxsid.mechanics.effects.prior import Prior, Scale

Units = tuple[str, str]  # of bodies that move, of bodies that turn
Where = Literal["between", "body", "sensor", "input"]

FORCE: Units = ("N", "N m")
DISTANCE: Units = ("m", "rad")
SPEED: Units = ("m/s", "rad/s")
MASS: Units = ("kg", "kg m²")
STIFFNESS: Units = ("N/m", "N m/rad")
DAMPING: Units = ("N s/m", "N m s/rad")
TIME: Units = ("s", "s")
NONE: Units = ("", "")
NOTHING: Array = 0.0  # type: ignore[assignment]  # broadcasts against any


class Parameter(NamedTuple):
    """A number of a kind of effect.

    Attributes:
        name: as in the model file.
        unit: of bodies that move and of bodies that turn.
        scale: what its size goes by at a place.
        prior: of its ratio to that scale.
        lowest: least value that makes sense.
        default: what it is when it is left out; None where it must be given.
        typical: any value at which the law is finite, used where the law is not asked for.
        raised: name of the parameter whose value is the power of the scale, for a unit with such a power.
    """

    name: str
    unit: Units
    scale: Scale
    prior: Prior
    lowest: float = -float("inf")
    default: float | None = None
    typical: float = 1.0
    raised: str | None = None


class Motion(NamedTuple):
    """What a law sees; between two ends, displacement and velocity are those of the second less those of the first.

    Attributes:
        displacement: across the place, m or rad.
        velocity: its rate.
        memory: state of the law's own.
        time: since the record's start, s.
        spring: stiffness that the model has there.
    """

    displacement: Array
    velocity: Array
    memory: Array
    time: Array
    spring: Array


class Nominal(NamedTuple):
    """What the model has at a place: mass of a body; damping and stiffness of the connections between two ends."""

    mass: Array
    damping: Array
    stiffness: Array


class Changes(NamedTuple):
    """What a kind changes in the linear model or in its signals; zeros change nothing.

    Attributes:
        mass, damping, stiffness: added at the place.
        attached_mass, attached_damping, attached_stiffness: a mass on a spring and damper on the body.
        gain: of the signal, less 1.
        offset: added to the signal.
        delay: of the signal, s.
        lag: time constant of the signal, s.
        inverse_limit: one over the largest magnitude of the signal.
    """

    mass: Array = NOTHING
    damping: Array = NOTHING
    stiffness: Array = NOTHING
    attached_mass: Array = NOTHING
    attached_damping: Array = NOTHING
    attached_stiffness: Array = NOTHING
    gain: Array = NOTHING
    offset: Array = NOTHING
    delay: Array = NOTHING
    lag: Array = NOTHING
    inverse_limit: Array = NOTHING


class Kind(NamedTuple):
    """A kind of effect.

    A force between two ends acts as -F on the second and +F on the first, one on a body as +F. Functions take the
    parameters in their order after what they see, are elementwise, and have finite derivatives everywhere.

    Attributes:
        name: as in the model file.
        where: what it acts on.
        parameters: its numbers.
        law: the equation, in words and symbols.
        about: what it is, in a sentence or two.
        source: where the law is described.
        changes: of the linear model and its signals, from a `Nominal`.
        force: F, from a `Motion`; smooth, or with kinks, but without jumps.
        rate: derivative of the memory in time, from a `Motion`.
        slip: magnitude of dry friction, F = slip sign(v), from the speed; at rest it balances up to slip(0).
        states: how many of its own it has: a memory, a lag, an attached mass's displacement and velocity.
        sensible: whether parameters, in their order, are such as the law is meant for; least values apart.
        needs: "joined" or "apart" where it makes sense only between ends that the model joins, or does not; "" at any.
        wave: its amplitude and its angle, half a turn of which is the other sign of the amplitude, if it has such.
        hardly_bent: other parameters, in their order, from given ones: of laws that bend later, for a search to begin.
        vibrates: rad/s at which a part of its own swings, from its parameters in their order.
        steady: whether it is the same at all times, so that of the lines of a spectrum that of zero alone shows it.
        restoring: whether it is a spring that is not straight: its force follows the displacement alone, or its past.
        timed: whether its force goes by the time, too.
        form_of: the kind that it is a form of, told apart by a parameter more; "" for one of its own.
        holds: a kind of one number that it becomes where all its numbers of that unit are equal; "" for none.
    """

    name: str
    where: Where
    parameters: tuple[Parameter, ...]
    law: str
    about: str
    source: str
    changes: Callable[..., Changes] | None = None
    force: Callable[..., Any] | None = None
    rate: Callable[..., Any] | None = None
    slip: Callable[..., Any] | None = None
    states: int = 0
    sensible: Callable[..., bool] | None = None
    needs: Literal["", "joined", "apart"] = ""
    wave: tuple[str, str] | None = None
    hardly_bent: Callable[..., tuple[tuple[float, ...], ...]] | None = None
    vibrates: Callable[..., float] | None = None
    steady: bool = False
    restoring: bool = False
    timed: bool = False
    form_of: str = ""
    holds: str = ""

    @property
    def smooth(self) -> bool:
        """Whether it is a function of displacement and velocity between two ends, without jumps or memory."""
        of_bodies = self.where in ("between", "body")
        return of_bodies and self.slip is None and self.states == 0 and not self.timed

    @property
    def rubs(self) -> bool:
        """Whether surfaces rub: dry friction, or a force that follows the displacement with a memory."""
        return self.slip is not None or (self.restoring and self.states > 0)


def power(x: Array, exponent: Array) -> Array:
    """|x|^exponent with finite derivatives at zero, for exponents of at least 1."""
    size = jnp.abs(x)
    safe = jnp.where(size > 0, size, 1.0)
    return jnp.where(size > 0, jnp.exp(exponent * jnp.log(safe)), 0.0)
