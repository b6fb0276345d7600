"""How large a parameter of an effect may be: a scale from how its place moves, and a broad distribution around it."""

import math
from typing import Literal, NamedTuple

import jax.numpy as jnp
from jax.lax import erf
from jaxtyping import Array

REACH = 4.0  # standard deviations at which a slab ends
SYMBOLS = ("F", "d", "v", "s", "w", "T")
POWERS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


class Amplitudes(NamedTuple):
    """How a place moves in a record.

    Attributes:
        force: rms of what the connection there carries, or of all forces on the place together if that is larger.
        displacement: rms, across the place.
        velocity: rms, across the place.
        signal: rms of the sensor's reading or of the input; of no meaning at other places.
        rate: of the slowest mode, rad/s.
        duration: of the record, s.
    """

    force: Array
    displacement: Array
    velocity: Array
    signal: Array
    rate: Array
    duration: Array


class Scale(NamedTuple):
    """A product of powers of a place's `Amplitudes`, field by field; 1 where all are zero."""

    force: int = 0
    displacement: int = 0
    velocity: int = 0
    signal: int = 0
    rate: int = 0
    duration: int = 0

    def of(self, at: Amplitudes) -> Array:
        """The scale at a place."""
        return math.prod((x**p for x, p in zip(at, self, strict=True) if p), start=jnp.ones(()))

    def __str__(self) -> str:
        """In symbols: F force, d displacement, v velocity, s signal, w slowest rate, T duration."""
        parts = [(s, p) for s, p in zip(SYMBOLS, self, strict=True) if p]
        return " ".join(s if p == 1 else s + str(p).translate(POWERS) for s, p in parts)


class Prior(NamedTuple):
    """A distribution of a parameter's ratio to its scale, broad, and of mass one between its ends.

    Attributes:
        shape: "normal", "log-normal" or "uniform".
        centre: mean, or median of a log-normal.
        spread: standard deviation, or the factor that is one of a log-normal's; of no meaning if uniform.
        lowest, highest: ends.
    """

    shape: Literal["normal", "log-normal", "uniform"]
    centre: float
    spread: float
    lowest: float
    highest: float

    @property
    def example(self) -> float:
        """A ratio to look at: the median of a size, an angle of zero, else one standard deviation up."""
        return self.centre + self.spread if self.shape == "normal" else self.centre

    @property
    def bounded(self) -> bool:
        """Whether it ends below where it is still likely, because less makes no sense."""
        if self.shape == "log-normal":
            return self.lowest > self.centre / self.spread**REACH
        return self.shape == "normal" and self.lowest > self.centre - REACH * self.spread

    def log_density(self, ratio: Array) -> Array:
        """Logarithm of the density at a ratio to the scale; -inf beyond the ends."""
        x = jnp.asarray(ratio)
        inside = (x >= self.lowest) & (x <= self.highest)
        safe = jnp.where(inside, x, self.centre)
        if self.shape == "uniform":
            log = jnp.full_like(safe, -math.log(self.highest - self.lowest))
        else:
            place, width, log = self._standard(safe)
            ends = (self._standard(jnp.asarray(end))[0] for end in (self.lowest, self.highest))
            low, high = ends
            mass = 0.5 * (erf(high / math.sqrt(2)) - erf(low / math.sqrt(2)))
            log = log - 0.5 * place**2 - math.log(width * math.sqrt(2 * math.pi)) - jnp.log(mass)
        return jnp.where(inside, log, -jnp.inf)

    def _standard(self, x: Array) -> tuple[Array, float, Array]:
        """Standard normal variable, its width, and the logarithm of what the change of variable adds."""
        if self.shape == "normal":
            return (x - self.centre) / self.spread, self.spread, jnp.zeros(())
        width = math.log(self.spread)
        return jnp.log(x / self.centre) / width, width, -jnp.log(x)

    def __str__(self) -> str:
        if self.shape == "uniform":
            return f"{self.lowest:.3g} to {self.highest:.3g}"
        about = ", times or over " if self.shape == "log-normal" else " ± "
        ends = f", at least {self.lowest:.3g}" if self.bounded else ""
        return f"{self.centre:.3g}{about}{self.spread:.3g}{ends}"


def slab(spread: float, *, centre: float = 0.0, lowest: float = -math.inf) -> Prior:
    """A normal distribution that ends four standard deviations away, or where the parameter does.

    Args:
        spread: standard deviation.
        centre: mean.
        lowest: least ratio that makes sense.
    """
    low = max(lowest, centre - REACH * spread)
    return Prior("normal", centre, spread, low, centre + REACH * spread)


def size(median: float, factor: float, *, lowest: float = 0.0) -> Prior:
    """A positive number known to a factor, as one standard deviation; it ends four of them away.

    Args:
        median: of the ratio.
        factor: above 1.
        lowest: least ratio that makes sense.
    """
    reach = factor**REACH
    return Prior("log-normal", median, factor, max(lowest, median / reach), median * reach)


ANGLE = Prior("uniform", 0.0, math.inf, -math.pi, math.pi)
GAIN = slab(0.3, centre=1.0, lowest=0.0)  # of a nominal value
PART = slab(0.3)  # of the force that the place carries
POSITIVE_PART = slab(0.3, lowest=0.0)
# of one over the slowest rate: 1 to 25 ms for a mode at 3 Hz, and some samples for a stiff axis
LATE = size(0.1, 5.0)
