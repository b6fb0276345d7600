"""Parameters of an effect from its size, about the part that its force is of what acts at its place already."""

from typing import NamedTuple

import numpy as np

# An error of these is taken up by other numbers of the model, so that a refit leaves nothing: they count as they are.
ABSORBED = ("mass_error", "stiffness_error", "damping_error", "input_gain", "sensor_gain")
# Smallest and largest size. Errors of numbers begin well beyond the tolerance.
LIMITS = {
    "mass_error": (0.03, 0.6),
    "stiffness_error": (0.03, 0.6),
    "damping_error": (0.35, 6.0),
    "sensor_gain": (0.03, 0.5),
    "input_gain": (0.03, 0.5),
    # less is nothing but a sample late where an input jumps at a sampling instant
    "sensor_delay": (0.02, 5.0),
    "sensor_lag": (0.02, 5.0),
    "input_delay": (0.02, 5.0),
    "actuator_lag": (0.02, 5.0),
    "actuator_saturation": (0.02, 0.85),
    "end_stop": (0.02, 0.9),
    "impacts": (0.02, 0.8),
    "backlash": (1e-3, 0.9),
    "missing_mode": (1e-3, 0.6),
    "self_excitation": (1e-4, 1.0),
}
ANY = (1e-4, 5.0)


class Scale(NamedTuple):
    """Of the motion at a place, without the effect: rms force, displacement and velocity, their largest, and times.

    Attributes:
        force: rms of the spring there, or what moves the body.
        d: rms displacement.
        v: rms velocity.
        reach: largest displacement.
        mass: of the body.
        signal: rms of the sensor.
        peak: largest input.
        modes: Hz.
        length: of the record, s.
    """

    force: float
    d: float
    v: float
    reach: float
    mass: float
    signal: float
    peak: float
    modes: tuple[float, ...]
    length: float


def shape(rng: np.random.Generator) -> dict[str, float]:
    """Random numbers that the form of an effect is made of; its size is chosen afterwards.

    Args:
        rng: draws.
    """
    names = ("a", "b", "c", "sign", "phase", "mode")
    return {name: float(x) for name, x in zip(names, rng.random(len(names)), strict=True)}


def _between(low: float, high: float, part: float) -> float:
    return float(low * (high / low) ** part)


def parameters(kind: str, size: float, s: Scale, drawn: dict[str, float]) -> dict[str, float]:
    """Of an effect.

    Args:
        kind: of the catalogue or not.
        size: within `LIMITS`.
        s: of its place.
        drawn: by `shape`.
    """
    a, b, c = drawn["a"], drawn["b"], drawn["c"]
    sign = 1.0 if drawn["sign"] < 0.5 else -1.0
    either = (1 + size) ** sign
    force, phase = size * s.force, 2 * np.pi * (drawn["phase"] - 0.5)
    mode = s.modes[int(drawn["mode"] * len(s.modes))]
    n = 1 + a
    level = {"force": force, "static_force": force * (1.4 + 1.1 * a), "velocity": s.v * (0.1 + 0.4 * b)}
    late = size / (2 * np.pi * s.modes[0])
    makers = {
        "mass_error": lambda: {"factor": either},
        "stiffness_error": lambda: {"factor": either},
        "damping_error": lambda: {"factor": either},
        "missing_connection": lambda: {
            "stiffness": force / s.d if a < 0.75 else 0.0,
            "damping": (0.1 * b if a < 0.75 else 1.0) * force / s.v,
        },
        "missing_mode": lambda: _absorber(size * s.mass, 2 * np.pi * mode * _between(0.6, 1.6, a), b),
        "coulomb_friction": lambda: {"force": force},
        "stribeck_friction": lambda: level,
        "quadratic_damping": lambda: {"coefficient": force / s.v**2},
        "cubic_stiffness": lambda: {"coefficient": (1 if a < 0.75 else -0.3) * force / s.d**3},
        "quadratic_stiffness": lambda: {"coefficient": sign * force / s.d**2},
        "bilinear_stiffness": lambda: {"stiffness": max(sign * size, -0.7) * s.force / s.d},
        "backlash": lambda: {"half_gap": size * s.d},
        "end_stop": lambda: {
            "stiffness": _between(0.5, 10, a) * s.force / s.d,
            "clearance": s.reach * (1 - size),
        },
        "hysteresis": lambda: {
            "stiffness": force / s.d,
            "beta": _between(0.3, 2, b) / s.d**n,
            "gamma": _between(0.3, 2, b) * (1.5 * c - 0.5) / s.d**n,
            "exponent": n,
        },
        "cogging_ripple": lambda: {"amplitude": force, "wavenumber": (2 + 6 * a) / s.d, "phase": phase},
        "constant_load": lambda: {"force": sign * force},
        "periodic_disturbance": lambda: {
            "amplitude": force,
            "frequency_hz": mode * (0.4 + 0.9 * a),
            "phase": phase,
        },
        "time_varying_stiffness": lambda: {"rate": sign * force / s.d / s.length},
        "sensor_gain": lambda: {"factor": either},
        "sensor_bias": lambda: {"offset": sign * size * s.signal},
        "sensor_delay": lambda: {"delay": late},
        "sensor_lag": lambda: {"time_constant": late},
        "input_gain": lambda: {"factor": either},
        "input_delay": lambda: {"delay": late},
        "actuator_lag": lambda: {"time_constant": late},
        "actuator_saturation": lambda: {"limit": s.peak * (1 - size)},
        "lugre": lambda: {
            **level,
            "bristle_stiffness": force / (s.d * (0.02 + 0.04 * c)),
            "bristle_damping": 0.02 * force / s.v,
        },
        "iwan": lambda: {
            "stiffness": force / s.d,
            "yielding": s.d * (0.2 + 0.6 * a),
            "spread": 2 + 4 * b,
        },
        "hertz_contact": lambda: {"coefficient": 3 * force / s.d**1.5, "gap": s.d * a},
        "one_sided_damping": lambda: {"coefficient": 2 * force / s.v},
        "displacement_damping": lambda: {"coefficient": force / (s.d * s.v)},
        "self_excitation": lambda: {"coefficient": force / s.v, "limit": s.d * (0.7 + 0.8 * a)},
        "switching_stiffness": lambda: {
            "stiffness": max(sign * size, -0.6) * s.force / s.d,
            "instant": s.length * (0.3 + 0.4 * a),
            "rise": s.length / 1000,
        },
        "parametric_stiffness": lambda: {
            "stiffness": force / s.d,
            "frequency_hz": mode * _between(0.1, 2.5, a),
            "phase": phase,
        },
        "impacts": lambda: {"gap": s.reach * (1 - size), "restitution": 0.3 + 0.5 * a},
        "random_force": lambda: {"rms": force},
        "fifth_order_stiffness": lambda: {"coefficient": force, "limit": s.d * (0.8 + 0.7 * a)},
    }
    return {name: float(x) for name, x in makers[kind]().items()}


def _absorber(mass: float, w: float, part: float) -> dict[str, float]:
    ratio = _between(0.005, 0.05, part)
    return {"mass": mass, "stiffness": mass * w**2, "damping": 2 * ratio * mass * w}
