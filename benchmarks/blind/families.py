"""Random systems: one mass, chains, drives, frames and, for development, trees of any shape, size and unit."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from systems import GROUND, Connection, Input, Sensor, System, frequencies

TOLERANCE = {"mass": 0.005, "stiffness": 0.005, "damping": 0.05}


class Nominal(NamedTuple):
    """A system as its model has it, and the band that is worth exciting, Hz."""

    system: System
    band: tuple[float, float]


def _named(count: int, letter: str) -> tuple[str, ...]:
    return tuple(f"{letter}{i + 1}" for i in range(count))


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _built(
    rng: np.random.Generator,
    name: str,
    bodies: tuple[str, ...],
    pairs: list[tuple[str, str]],
    scale: float,
    lowest: float,
) -> System:
    """Masses and springs alike within a factor, the lowest mode where asked, damping ratios of 0.3 to 3 %."""
    mass = tuple(float(scale * x) for x in rng.uniform(0.7, 1.5, len(bodies)))
    springs = scale * rng.uniform(0.7, 1.5, len(pairs))
    joined = lambda k, c: tuple(  # noqa: E731
        Connection(f"c{i + 1}", pair, float(a), float(b))
        for i, (pair, a, b) in enumerate(zip(pairs, k, c, strict=True))
    )
    system = System(name, bodies, mass, joined(springs, 0 * springs), (), (), 1.0)
    springs = springs * (2 * np.pi * lowest / frequencies(system)[0]) ** 2
    modes = frequencies(system._replace(connections=joined(springs, 0 * springs)))
    ratio = 2 * _log(rng, 0.003, 0.03) / np.exp(np.log(modes).mean())
    return system._replace(connections=joined(springs, springs * ratio * rng.uniform(0.6, 1.6, len(pairs))))


def _sampled(rng: np.random.Generator, system: System, driven: str, name: str) -> Nominal:
    """Six to sixteen samples in a period of the fastest mode; one force."""
    modes = frequencies(system) / (2 * np.pi)
    dt = float(f"{1 / (modes[-1] * rng.uniform(6, 16)):.3g}")
    system = system._replace(dt=dt, inputs=(Input(name, driven),))
    return Nominal(
        system, (float(modes[0] * rng.uniform(0.2, 0.6)), float(modes[-1] * rng.uniform(1.05, 1.5)))
    )


def mass(rng: np.random.Generator) -> Nominal:
    """A mass on a spring."""
    system = _built(rng, "one mass", ("m1",), [(GROUND, "m1")], _log(rng, 0.1, 100), _log(rng, 1, 30))
    return _sampled(rng, system, "m1", "force")


def chain(rng: np.random.Generator) -> Nominal:
    """Three masses in a row, the first on the ground."""
    names = _named(3, "m")
    pairs = list(zip((GROUND, *names), names, strict=False))
    system = _built(rng, "three-mass chain", names, pairs, _log(rng, 0.1, 100), _log(rng, 0.5, 20))
    return _sampled(rng, system, str(rng.choice(names)), "force")


def frame(rng: np.random.Generator) -> Nominal:
    """Five storeys."""
    names = _named(5, "floor")
    pairs = list(zip((GROUND, *names), names, strict=False))
    system = _built(rng, "five-storey frame", names, pairs, _log(rng, 1, 1000), _log(rng, 0.5, 5))
    return _sampled(rng, system, str(rng.choice(names)), "shaker")


def drive(rng: np.random.Generator) -> Nominal:
    """Motor and load behind an elastic gear, at 1 kHz; some with a viscous bearing of the motor."""
    motor, load = 0.0053 * _log(rng, 0.5, 2), 0.18 * _log(rng, 0.5, 2)
    w = 2 * np.pi * rng.uniform(50, 160)
    stiffness = w**2 * motor * load / (motor + load)
    gear = Connection("gear", ("motor", "load"), stiffness, 2 * _log(rng, 0.01, 0.08) * stiffness / w)
    bearing = Connection("bearing", (GROUND, "motor"), 0.0, (motor + load) / _log(rng, 0.1, 1.0))
    joined = (gear, bearing) if rng.random() < 0.6 else (gear,)
    names = ("motor", "load")
    system = System("two-inertia drive", names, (motor, load), joined, (Input("torque", "motor"),), (), 1e-3)
    return Nominal(system, (rng.uniform(1, 4), w / (2 * np.pi) * rng.uniform(1.05, 1.4)))


def tree(rng: np.random.Generator) -> Nominal:
    """Two to eight bodies, each joined to an earlier one, some with one or two connections more."""
    names = _named(int(rng.integers(2, 9)), "b")
    pairs = [(GROUND, names[0])]
    body = names[0]
    for i, body in enumerate(names[1:], start=1):
        pairs.append((names[int(rng.integers(i))], body))
    if len(names) > 2 and rng.random() < 0.3:
        a, b = sorted(rng.choice(len(names), 2, replace=False))
        if (names[a], names[b]) not in pairs:
            pairs.append((names[a], names[b]))
    if rng.random() < 0.3:
        pairs.append((GROUND, body))
    system = _built(rng, "tree", names, pairs, _log(rng, 1e-5, 1e4), _log(rng, 0.3, 200))
    return _sampled(rng, system, str(rng.choice(names)), "force")


FAMILIES: dict[str, Callable[[np.random.Generator], Nominal]] = {
    "mass": mass,
    "chain": chain,
    "drive": drive,
    "frame": frame,
    "tree": tree,
}


def sensors(rng: np.random.Generator, family: str, system: System, alone: bool) -> tuple[Sensor, ...]:
    """What is measured.

    Args:
        rng: draws bodies and kinds.
        family: of the system.
        system: names the bodies.
        alone: one sensor only.
    """
    every = ("acceleration", "velocity", "displacement")
    if family == "mass":
        kinds = [str(x) for x in rng.permutation(every)]
        at = list(system.bodies) * 3
    elif family == "drive":
        kinds, at = ["velocity"] * 2, list(system.bodies)
    else:
        n = len(system.bodies)
        count = min(n, 3) if family != "tree" else int(rng.integers(min(n, 2), n + 1))
        at = [system.bodies[i] for i in sorted(rng.choice(n, count, replace=False))]
        same = (
            "acceleration" if family == "frame" else str(rng.choice([*every, "acceleration", "acceleration"]))
        )
        mixed = family != "frame" and rng.random() < 0.4
        kinds = [str(rng.choice(every)) if mixed else same for _ in at]
    found = tuple(Sensor(f"{k[:3]}_{b}", b, k) for b, k in zip(at, kinds, strict=False))
    return (found[int(rng.integers(len(found)))],) if alone else found


def deviating(rng: np.random.Generator, system: System) -> System:
    """The true elements: off the nominal ones as the tolerance says.

    Args:
        rng: draws by how much.
        system: nominal.
    """
    off = lambda what: float(np.exp(TOLERANCE[what] * rng.standard_normal()))  # noqa: E731
    joined = tuple(
        c._replace(stiffness=c.stiffness * off("stiffness"), damping=c.damping * off("damping"))
        for c in system.connections
    )
    return system._replace(mass=tuple(m * off("mass") for m in system.mass), connections=joined)
