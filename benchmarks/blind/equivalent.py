"""Explanations that no record of a case can tell from the true one, for exact reasons only.

What is merely hard to tell apart is wrong if it is called wrong.
"""

from typing import Any

import numpy as np
from systems import Connection, Input, Sensor, System, joint, matrices

# (kind, "between" | "body" | "sensor" | "input", names in any order)
Answer = tuple[str, str, frozenset[str]]
SWAPPED = {
    "input_gain": "sensor_gain",
    "input_delay": "sensor_delay",
    "actuator_lag": "sensor_lag",
}
PARALLEL = 1e-6
LINES = 0.2, 0.7, 1.9  # of a typical frequency of the system, at which responses are compared


def answer(kind: str, place: dict[str, Any]) -> Answer:
    """A kind at a place, so that two of them compare.

    Args:
        kind: of effect.
        place: as in diagnosis.json.
    """
    ((where, names),) = place.items()
    return kind, where, frozenset([names] if isinstance(names, str) else names)


def system_of(stored: dict[str, Any]) -> System:
    """From a label.

    Args:
        stored: what `System._asdict` became in JSON.
    """
    return System(
        stored["name"],
        tuple(stored["bodies"]),
        tuple(stored["mass"]),
        tuple(Connection(name, (pair[0], pair[1]), k, c) for name, pair, k, c in stored["connections"]),
        tuple(Input(*x) for x in stored["inputs"]),
        tuple(Sensor(*x) for x in stored["sensors"]),
        stored["dt"],
    )


def right_answers(label: dict[str, Any], number: int) -> set[Answer]:
    """All that count as the effect of that number of a case.

    Args:
        label: of the case.
        number: of the effect.
    """
    effect = label["effects"][number]
    own = {answer(kind, effect["place"]) for kind in effect["kinds_right"]}
    return own | _not_told(label, effect["kind"], own, alone=len(label["effects"]) == 1)


def as_good(label: dict[str, Any], said: list[dict[str, Any]], first: dict[str, Any]) -> set[Answer]:
    """An answer with all that no record tells from it, whatever is true.

    Args:
        label: of the case, for its system and sensors alone.
        said: effects that were named together.
        first: the answer.
    """
    own = {answer(first["kind"], first["place"])}
    return own | _not_told(label, first["kind"], own, alone=len(said) <= 1)


def _not_told(label: dict[str, Any], kind: str, own: set[Answer], *, alone: bool) -> set[Answer]:
    system, found = system_of(label["true"]), set()
    if label["one_sensor"] and alone:
        found |= _in_series(kind, system)
    if kind == "periodic_disturbance" and alone:
        found |= _same_lines(own, system)
    if kind in ("constant_load", "sensor_bias"):
        found |= _same_offsets(own, system)
    return found


def _in_series(kind: str, system: System) -> set[Answer]:
    """One input, one sensor, all linear: what acts on the one acts on the other."""
    back = {v: k for k, v in SWAPPED.items()}
    if kind in SWAPPED:
        return {answer(SWAPPED[kind], {"sensor": system.sensors[0].name})}
    return {answer(back[kind], {"input": system.inputs[0].name})} if kind in back else set()


def _same_lines(own: set[Answer], system: System) -> set[Answer]:
    """Sinusoids, of free amplitude and phase, whose readings are in the same proportions at any frequency.

    One on any body, where one sensor reads it; one on any body that lies on the far side of all sensors, in a chain.
    """
    M, damping, K = matrices(system)
    typical = np.sqrt(np.trace(K) / np.trace(M))
    rows = [system.bodies.index(s.body) for s in system.sensors]
    each = [np.linalg.inv(K - w**2 * M + 1j * w * damping)[rows] for w in np.multiply(LINES, typical)]
    found = set()
    for _, _, (mine,) in own:
        at = system.bodies.index(mine)
        for i, body in enumerate(system.bodies):
            pairs = [
                (np.abs(np.vdot(h[:, at], h[:, i])), np.linalg.norm(h[:, at]) * np.linalg.norm(h[:, i]))
                for h in each
            ]
            if all(size and abs(along / size - 1) < PARALLEL for along, size in pairs):
                found.add(answer("periodic_disturbance", {"body": body}))
    return found


def _same_offsets(own: set[Answer], system: System) -> set[Answer]:
    """Constant forces and offsets whose constant readings are in the same proportions; the start is free anyway."""
    offsets = {answer("constant_load", {"body": b}): _reading(system, b) for b in system.bodies}
    for i, sensor in enumerate(system.sensors):
        offsets[answer("sensor_bias", {"sensor": sensor.name})] = np.eye(2 * len(system.sensors))[i]
    found = set()
    for mine in own:
        a = offsets[mine]
        for other, b in offsets.items():
            size = np.linalg.norm(a) * np.linalg.norm(b)
            if size and abs(abs(a @ b) / size - 1) < PARALLEL:
                found.add(other)
    return found


def _reading(system: System, body: str) -> np.ndarray:
    """What sensors show of a constant unit force in the end: constants, then slopes where the system is free.

    The solution q = q0 + q1 t + q2 t^2 / 2 with the lowest powers that the equations allow; what of the constants the
    initial state may add is left out.
    """
    M, damping, K = matrices(system)
    n = len(M)
    free = np.abs(np.linalg.eigvalsh(K)).min() < 1e-9 * np.abs(K).max()
    drag = np.ones(n) @ damping @ np.ones(n)
    force = joint(system, ("ground", body))
    speed, gain = np.zeros(n), np.zeros(n)
    if not free:
        place = np.linalg.solve(K, force)
    else:  # rigid motion: a final speed where something drags, else a final acceleration
        dragged = drag > 1e-9 * np.abs(damping).max()
        speed = np.ones(n) / drag if dragged else speed
        gain = gain if dragged else np.ones(n) / np.trace(M)
        place = np.zeros(n)
    rows = [system.bodies.index(s.body) for s in system.sensors]
    first = {"displacement": place, "velocity": speed, "acceleration": gain}
    slope = {"displacement": speed, "velocity": gain, "acceleration": 0 * gain}
    pairs = list(zip(system.sensors, rows, strict=True))
    return np.array([*(first[s.kind][i] for s, i in pairs), *(slope[s.kind][i] for s, i in pairs)])


def same_place(label: dict[str, Any], number: int, place: dict[str, Any]) -> bool:
    """Whether a place that is reported for an unknown effect is its own.

    A force on a body is one between the ground and that body, and one on the driven body cannot be told from an error
    of the input.

    Args:
        label: of the case.
        number: of the effect.
        place: as in diagnosis.json.
    """
    system = system_of(label["true"])

    def named(x: dict[str, Any]) -> frozenset[str]:
        _, where, names = answer("", x)
        if where == "input":
            return frozenset(["ground", next(i.body for i in system.inputs if i.name in names)])
        return names | {"ground"} if where == "body" else names

    return named(label["effects"][number]["place"]) == named(place)
