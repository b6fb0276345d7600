"""What a true system is made of. Imports nothing of the library: what is drawn here judges it."""

from typing import Any, NamedTuple

import numpy as np

GROUND = "ground"


class Connection(NamedTuple):
    """A spring and a viscous damper between two ends."""

    name: str
    between: tuple[str, str]
    stiffness: float
    damping: float


class Input(NamedTuple):
    """A force on a body, held between samples."""

    name: str
    body: str


class Sensor(NamedTuple):
    """What is measured of a body, absolute: "displacement", "velocity" or "acceleration"."""

    name: str
    body: str
    kind: str


class Effect(NamedTuple):
    """One deviation from the linear model.

    Attributes:
        kind: as in the catalogue, or one of `laws.OUTSIDE`, `laws.UNLIKE`.
        where: "between", "body", "sensor" or "input".
        ends: names of the place.
        parameters: of the law.
    """

    kind: str
    where: str
    ends: tuple[str, ...]
    parameters: dict[str, float]

    @property
    def place(self) -> dict[str, Any]:
        """As in diagnosis.json."""
        return {self.where: list(self.ends) if self.where == "between" else self.ends[0]}


class System(NamedTuple):
    """A lumped mechanical system; `mass` is in the order of `bodies`."""

    name: str
    bodies: tuple[str, ...]
    mass: tuple[float, ...]
    connections: tuple[Connection, ...]
    inputs: tuple[Input, ...]
    sensors: tuple[Sensor, ...]
    dt: float


def joint(system: System, ends: tuple[str, ...]) -> np.ndarray:
    """-1 at the first end and +1 at the second: d = joint @ q.

    Args:
        system: names the bodies.
        ends: two bodies, or the ground and a body.
    """
    found = np.zeros(len(system.bodies))
    for end, sign in zip(ends, (-1.0, 1.0), strict=True):
        if end != GROUND:
            found[system.bodies.index(end)] = sign
    return found


def matrices(system: System) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mass, damping, stiffness.

    Args:
        system: its elements.
    """
    size = len(system.bodies)
    damping, stiffness = np.zeros((size, size)), np.zeros((size, size))
    for connection in system.connections:
        e = joint(system, connection.between)
        damping += connection.damping * np.outer(e, e)
        stiffness += connection.stiffness * np.outer(e, e)
    return np.diag(system.mass), damping, stiffness


def spring(system: System, ends: tuple[str, ...]) -> float:
    """Stiffness of all connections between two ends.

    Args:
        system: its elements.
        ends: of a place.
    """
    return sum(c.stiffness for c in system.connections if set(c.between) == set(ends))


def frequencies(system: System) -> np.ndarray:
    """Undamped natural frequencies, rad/s, rigid motion left out.

    Args:
        system: its elements.
    """
    M, _, K = matrices(system)
    roots = np.linalg.eigvals(np.linalg.solve(M, K)).real
    return np.sqrt(np.sort(roots[roots > 1e-9 * max(roots.max(), 1e-300)]))


def recalibrated_by(system: System, values: np.ndarray) -> System:
    """With other masses, stiffnesses and dampings, in this order.

    Args:
        system: gives the rest.
        values: one a mass, then one a stiffness, then one a damping.
    """
    n, m = len(system.bodies), len(system.connections)
    joined = tuple(
        c._replace(stiffness=float(k), damping=float(d))
        for c, k, d in zip(system.connections, values[n : n + m], values[n + m :], strict=True)
    )
    return system._replace(mass=tuple(map(float, values[:n])), connections=joined)


def numbers(system: System) -> np.ndarray:
    """Masses, stiffnesses, dampings, as `recalibrated_by` takes them.

    Args:
        system: its elements.
    """
    joined = system.connections
    return np.array([*system.mass, *(c.stiffness for c in joined), *(c.damping for c in joined)])
