"""A system and its effects as x' = A x + B w + E f + G r, what jumps and what the sensors show.

w is held between samples: the input as it acts, 1, and a disturbance. f are laws of two rows of the state each. r is
dry friction. Whatever is linear is in A: bodies that the model lacks, lags, a sinusoidal force as an oscillator, the
elastic part of hysteresis.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from laws import FRICTION, LINEAR, Law, force_law, friction_level
from systems import GROUND, Effect, System, joint, matrices, spring

HELD = 3  # input, 1, disturbance


class Port(NamedTuple):
    """A force by a law: f = law(t, R x), entering the state by `column`, the readings by `through`."""

    law: Law
    rows: np.ndarray
    column: np.ndarray
    through: np.ndarray


class Contact(NamedTuple):
    """Dry friction: its level by the speed, the row of the speed, how a force enters state and readings."""

    level: Callable[[float], float]
    row: np.ndarray
    column: np.ndarray
    through: np.ndarray


class Impact(NamedTuple):
    """A rigid one-sided stop at d = gap; a jump of its speed by 1 moves the state by `column`, then `shift` per s."""

    gap: float
    restitution: float
    rows: np.ndarray
    column: np.ndarray
    shift: np.ndarray


class Plant(NamedTuple):
    """Matrices and laws; `start` is the state of rest, `force` the column of the input's unit force."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    ports: tuple[Port, ...]
    contacts: tuple[Contact, ...]
    impacts: tuple[Impact, ...]
    start: np.ndarray


class Mechanics(NamedTuple):
    """Masses and springs with linear effects in, absorbers as further bodies."""

    M: np.ndarray
    damping: np.ndarray
    K: np.ndarray
    bodies: tuple[str, ...]


def mechanics(system: System, effects: tuple[Effect, ...]) -> Mechanics:
    """Matrices of the true system.

    Args:
        system: its elements.
        effects: those of `LINEAR` are put in.
    """
    for effect in effects:
        if effect.kind.endswith("_error"):
            system = _scaled(system, effect)
    M, damping, K = matrices(system)
    bodies = system.bodies
    for effect in (x for x in effects if x.kind in LINEAR):
        p = effect.parameters
        if effect.kind == "missing_connection":
            e = joint(system, effect.ends)
            e = np.concatenate([e, np.zeros(len(M) - len(e))])
            K, damping = K + p["stiffness"] * np.outer(e, e), damping + p["damping"] * np.outer(e, e)
        if effect.kind == "missing_mode":
            e = np.concatenate([-np.eye(len(M))[bodies.index(effect.ends[0])], [1.0]])
            M, damping, K = (np.pad(x, (0, 1)) for x in (M, damping, K))
            M[-1, -1] = p["mass"]
            K, damping = K + p["stiffness"] * np.outer(e, e), damping + p["damping"] * np.outer(e, e)
            bodies = (*bodies, f"absorber {len(M)}")
    return Mechanics(M, damping, K, bodies)


def _scaled(system: System, effect: Effect) -> System:
    factor, ends = effect.parameters["factor"], effect.ends
    if effect.kind == "mass_error":
        mass = (m * factor if b == ends[0] else m for b, m in zip(system.bodies, system.mass, strict=True))
        return system._replace(mass=tuple(mass))
    name = effect.kind.removesuffix("_error")
    joined = (
        c._replace(**{name: getattr(c, name) * factor}) if set(c.between) == set(ends) else c
        for c in system.connections
    )
    return system._replace(connections=tuple(joined))


class _Builder:
    """Grows the state; the rows of q and v come first, then what effects add."""

    def __init__(self, system: System, effects: tuple[Effect, ...], before: float) -> None:
        self.system, self.before = system, before
        M, damping, K, self.bodies = mechanics(system, effects)
        self.n = n = len(M)
        self.inverse = np.linalg.inv(M)
        self.size = 2 * n + sum(
            {"hysteresis": 1, "lugre": 1, "sensor_lag": 1, "actuator_lag": 1, "periodic_disturbance": 2}.get(
                e.kind, 0
            )
            for e in effects
        )
        self.A, self.B = np.zeros((self.size, self.size)), np.zeros((self.size, HELD))
        self.A[:n, n : 2 * n] = np.eye(n)
        self.A[n : 2 * n, : 2 * n] = -self.inverse @ np.hstack([K, damping])
        self.start = np.zeros(self.size)
        self.used = 2 * n
        self.ports: list[Port] = []
        self.contacts: list[Contact] = []
        self.impacts: list[Impact] = []

    def state(self) -> int:
        """A further state."""
        self.used += 1
        return self.used - 1

    def push(self, direction: np.ndarray) -> np.ndarray:
        """State's rate under a unit force."""
        rate = np.zeros(self.size)
        rate[self.n : 2 * self.n] = self.inverse @ direction
        return rate

    def across(self, ends: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Direction of a place, its rows of displacement and velocity."""
        e = np.zeros(self.n)
        for end, sign in zip(ends, (-1.0, 1.0), strict=True):
            if end != GROUND:
                e[self.bodies.index(end)] = sign
        d, v = np.zeros(self.size), np.zeros(self.size)
        d[: self.n], v[self.n : 2 * self.n] = e, e
        return e, d, v

    def body(self, name: str) -> np.ndarray:
        """Direction of a force on a body."""
        return np.eye(self.n)[self.bodies.index(name)]

    def add(self, effect: Effect) -> None:
        """One effect that is neither linear in the elements nor of the signals."""
        maker = getattr(self, f"_{effect.kind}", None)
        if maker is not None:
            maker(effect)
        elif effect.kind in FRICTION:
            e, _, v = self.across(effect.ends)
            self.contacts.append(Contact(friction_level(effect), v, -self.push(e), np.zeros(0)))
        elif (law := force_law(effect, spring(self.system, effect.ends))) is not None:
            e, d, v = self.across(effect.ends)
            self.ports.append(Port(law, np.array([d, v]), -self.push(e), np.zeros(0)))

    def _constant_load(self, effect: Effect) -> None:
        self.B[:, 1] += effect.parameters["force"] * self.push(self.body(effect.ends[0]))

    def _random_force(self, effect: Effect) -> None:
        self.B[:, 2] += effect.parameters["rms"] * self.push(self.body(effect.ends[0]))

    def _periodic_disturbance(self, effect: Effect) -> None:
        p = effect.parameters
        w, phase = 2 * np.pi * p["frequency_hz"], p["phase"]
        sine, cosine = self.state(), self.state()
        self.A[sine, cosine], self.A[cosine, sine] = w, -w
        self.start[[sine, cosine]] = np.sin(phase - w * self.before), np.cos(phase - w * self.before)
        self.A[:, sine] += p["amplitude"] * self.push(self.body(effect.ends[0]))

    def _hysteresis(self, effect: Effect) -> None:
        p, (e, _, v), z = effect.parameters, self.across(effect.ends), self.state()
        beta, gamma, n = p["beta"], p["gamma"], p["exponent"]

        def law(t: float, speed: float, z: float) -> float:
            size = abs(z)
            return -(beta * abs(speed) * z * size ** (n - 1) + gamma * speed * size**n)

        self.A[z] += v
        self.A[:, z] -= p["stiffness"] * self.push(e)
        self.ports.append(Port(law, np.array([v, np.eye(self.size)[z]]), np.eye(self.size)[z], np.zeros(0)))

    def _lugre(self, effect: Effect) -> None:
        p, (e, _, v), z = effect.parameters, self.across(effect.ends), self.state()
        stiffness, micro = p["bristle_stiffness"], p["bristle_damping"]

        def law(t: float, speed: float, z: float) -> float:
            level = p["force"] + (p["static_force"] - p["force"]) * np.exp(-((speed / p["velocity"]) ** 2))
            return -stiffness * abs(speed) * z / level

        self.A[z] += v
        self.A[:, z] -= stiffness * self.push(e)
        self.A -= micro * np.outer(self.push(e), v)
        column = np.eye(self.size)[z] - micro * self.push(e)
        self.ports.append(Port(law, np.array([v, np.eye(self.size)[z]]), column, np.zeros(0)))

    def _impacts(self, effect: Effect) -> None:
        p, (e, d, v) = effect.parameters, self.across(effect.ends)
        push = self.push(e)
        column = push / (v @ push)
        shift = np.zeros(self.size)
        shift[: self.n] = column[self.n : 2 * self.n]
        self.impacts.append(Impact(p["gap"], p["restitution"], np.array([d, v]), column, shift))


def plant(system: System, effects: tuple[Effect, ...], before: float) -> Plant:
    """Of a system with effects; delays, gains, clipping and offsets of signals are left to `truth`.

    Args:
        system: true elements, one input.
        effects: any number.
        before: s of motion ahead of the record's start.
    """
    grown = _Builder(system, effects, before)
    for effect in effects:
        grown.add(effect)
    drive = grown.push(grown.body(system.inputs[0].body))
    for effect in (x for x in effects if x.kind == "actuator_lag"):
        lag, constant = grown.state(), effect.parameters["time_constant"]
        grown.A[:, lag] += drive
        grown.A[lag, lag] = -1 / constant
        drive = np.eye(grown.size)[lag] / constant
    grown.B[:, 0] = drive
    return _with_sensors(grown, system, effects)


def _with_sensors(grown: _Builder, system: System, effects: tuple[Effect, ...]) -> Plant:
    """Rows of the readings; a lag makes one a state."""
    n, count = grown.n, len(system.sensors)
    C, D = np.zeros((count, grown.size)), np.zeros((count, HELD))
    takes = np.zeros((count, grown.size))  # how the rate of the state enters an acceleration
    for i, sensor in enumerate(system.sensors):
        at = grown.bodies.index(sensor.body)
        if sensor.kind == "acceleration":
            takes[i, n + at] = 1
            C[i], D[i] = grown.A[n + at], grown.B[n + at]
        else:
            C[i, at + n * (sensor.kind == "velocity")] = 1
    through = lambda x: takes @ x.column  # noqa: E731
    ports = [x._replace(through=through(x)) for x in grown.ports]
    contacts = [x._replace(through=through(x)) for x in grown.contacts]
    for effect in (x for x in effects if x.kind == "sensor_lag"):
        lag, constant = grown.state(), effect.parameters["time_constant"]
        at = [s.name for s in system.sensors].index(effect.ends[0])
        grown.A[lag], grown.B[lag] = C[at] / constant, D[at] / constant
        grown.A[lag, lag] -= 1 / constant
        C[at], D[at] = np.eye(grown.size)[lag], 0.0
        for each in (*ports, *contacts):
            each.column[lag] += each.through[at] / constant
            each.through[at] = 0.0
    impacts = tuple(grown.impacts)
    return Plant(grown.A, grown.B, C, D, tuple(ports), tuple(contacts), impacts, grown.start)
