"""Forces across a place as functions of time, relative displacement and relative velocity.

`force_law(effect, spring)` gives f(t, d, v), a plain function of numbers. What needs a state of its own, jumps, or
acts on signals is built in `plant`.
"""

import math
from collections.abc import Callable

from systems import Effect

Law = Callable[[float, float, float], float]

LINEAR = ("mass_error", "stiffness_error", "damping_error", "missing_connection", "missing_mode")
FRICTION = ("coulomb_friction", "stribeck_friction")
SMOOTH = ("quadratic_damping", "cubic_stiffness", "quadratic_stiffness", "cogging_ripple")
KINKED = ("bilinear_stiffness", "backlash", "end_stop")
FORCES = ("constant_load", "periodic_disturbance")
SENSOR = ("sensor_gain", "sensor_bias", "sensor_delay", "sensor_lag")
INPUT = ("input_gain", "input_delay", "actuator_lag", "actuator_saturation")
CATALOGUE = (
    *LINEAR,
    *FRICTION,
    *SMOOTH,
    *KINKED,
    "hysteresis",
    "time_varying_stiffness",
    *FORCES,
    *SENSOR,
    *INPUT,
)
# The same physical effect by another law: what a diagnosis should call it.
UNLIKE = {"lugre": ("coulomb_friction", "stribeck_friction"), "iwan": ("hysteresis",)}
# Nothing in the catalogue has these laws.
OUTSIDE = (
    "hertz_contact",
    "displacement_damping",
    "self_excitation",
    "switching_stiffness",
    "parametric_stiffness",
    "impacts",
    "random_force",
    "fifth_order_stiffness",
    "one_sided_damping",
)
# Friction with another level each way is not among them: it is Coulomb friction and a constant load.


class Iwan:
    """Parallel Jenkins elements, each a spring that slides at its limit; the memory moves on with `commit`.

    Source: W. Iwan, J. Appl. Mech. 33 (1966).
    """

    def __init__(self, stiffness: float, limits: tuple[float, ...]) -> None:
        self.each, self.limits = stiffness / len(limits), limits
        self.stretch, self.last = [0.0] * len(limits), 0.0

    def __call__(self, t: float, d: float, v: float) -> float:
        """Force at d; the motion from the last step's end to here has one direction."""
        moved = d - self.last
        parts = (
            max(-limit, min(limit, z + moved)) for z, limit in zip(self.stretch, self.limits, strict=True)
        )
        return self.each * sum(parts)

    def commit(self, d: float) -> None:
        """A step has ended at d."""
        moved, self.last = d - self.last, d
        self.stretch = [max(-x, min(x, z + moved)) for z, x in zip(self.stretch, self.limits, strict=True)]


def iwan_limits(yielding: float, spread: float) -> tuple[float, ...]:
    """Displacements at which eight elements begin to slide, evenly spread in their logarithm.

    Args:
        yielding: their geometric mean.
        spread: ratio of the largest to the mean.
    """
    return tuple(yielding * spread ** (-1 + 2 * i / 7) for i in range(8))


def force_law(effect: Effect, spring: float) -> Law | None:
    """The law of an effect across a place, None if it is not one of time, displacement and velocity alone.

    Args:
        effect: with its parameters.
        spring: stiffness of the connection there.
    """
    p = effect.parameters
    one = p.get("coefficient", 0.0)
    if effect.kind == "end_stop":
        return _end_stop(p["stiffness"], p["clearance"])
    if effect.kind == "backlash":
        gap = p["half_gap"]
        return lambda t, d, v: -spring * (d if -gap < d < gap else math.copysign(gap, d))
    if effect.kind == "iwan":
        return Iwan(p["stiffness"], iwan_limits(p["yielding"], p["spread"]))
    makers: dict[str, Law] = {
        "quadratic_damping": lambda t, d, v: one * abs(v) * v,
        "cubic_stiffness": lambda t, d, v: one * d * d * d,
        "quadratic_stiffness": lambda t, d, v: one * d * d,
        "bilinear_stiffness": lambda t, d, v: p["stiffness"] * d if d > 0 else 0.0,
        "cogging_ripple": lambda t, d, v: p["amplitude"] * math.sin(p["wavenumber"] * d + p["phase"]),
        "time_varying_stiffness": lambda t, d, v: p["rate"] * t * d if t > 0 else 0.0,
        "hertz_contact": lambda t, d, v: one * (d - p["gap"]) ** 1.5 if d > p["gap"] else 0.0,
        "one_sided_damping": lambda t, d, v: one * v if v > 0 else 0.0,
        "displacement_damping": lambda t, d, v: one * d * abs(v),
        "self_excitation": lambda t, d, v: one * ((d / p["limit"]) ** 2 - 1) * v,
        "switching_stiffness": lambda t, d, v: (
            p["stiffness"] * d * min(max((t - p["instant"]) / p["rise"], 0.0), 1.0)
        ),
        "parametric_stiffness": lambda t, d, v: (
            p["stiffness"] * math.sin(2 * math.pi * p["frequency_hz"] * t + p["phase"]) * d
        ),
        "fifth_order_stiffness": lambda t, d, v: one * ((d / p["limit"]) ** 5 - (d / p["limit"]) ** 3),
    }
    return makers.get(effect.kind)


def _end_stop(stiffness: float, clearance: float) -> Law:
    def law(t: float, d: float, v: float) -> float:
        if d > clearance:
            return stiffness * (d - clearance)
        return stiffness * (d + clearance) if d < -clearance else 0.0

    return law


def friction_level(effect: Effect) -> Callable[[float], float]:
    """Largest force of dry friction, as a function of the speed.

    Args:
        effect: one of `FRICTION`.
    """
    p = effect.parameters
    if effect.kind == "coulomb_friction":
        return lambda speed: p["force"]
    return lambda speed: (
        p["force"] + (p["static_force"] - p["force"]) * math.exp(-((speed / p["velocity"]) ** 2))
    )
