"""Three simpler ways to the same answer, on the same cases.

    .venv/bin/python benchmarks/blind/baselines.py OUT [--shard i/n]

Recalibration fits the linear model alone. Stepwise BIC adds forces by laws of the recalibrated model's own motion, one
after another, as long as the information criterion falls. The restoring-force surface fits a polynomial of
displacement and velocity at each place, takes the place that explains most, and names the law that is most like it.
All choose on the first record and are judged on the second; they see no label.
"""

import argparse
import json
import sys
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

sys.path.insert(0, str(Path(__file__).parent))
from generate import written
from plant import plant
from recalibrate import Fit, fitted_start, recalibrated
from systems import GROUND, Connection, Input, Sensor, System, joint

MOST_TERMS, POWERS = 4, 3


class Term(NamedTuple):
    """A column: the readings that a law of unit coefficient brings."""

    kind: str
    place: dict[str, Any]
    column: np.ndarray


def read(folder: Path) -> tuple[System, list[tuple[np.ndarray, np.ndarray]]]:
    """Model and records (u, y) of a case.

    Args:
        folder: of the case.
    """
    model = tomllib.loads((folder / "model.toml").read_text())
    joined = tuple(
        Connection(c["name"], (c["between"][0], c["between"][1]), c["stiffness"], c["damping"])
        for c in model["connections"]
    )
    records = [np.loadtxt(folder / f"run{i}.csv", delimiter=",", skiprows=1) for i in (1, 2)]
    system = System(
        model["name"],
        tuple(model["bodies"]),
        tuple(model["bodies"].values()),
        joined,
        tuple(Input(i["name"], i["body"]) for i in model["inputs"]),
        tuple(Sensor(s["name"], s["body"], s["kind"]) for s in model["sensors"]),
        float(records[0][1, 0] - records[0][0, 0]),
    )
    return system, [(r[:, 1], r[:, 2:]) for r in records]


def motion(fit: Fit, u: np.ndarray) -> np.ndarray:
    """States (samples, 2 bodies) of a fitted model.

    Args:
        fit: model and initial state.
        u: input.
    """
    made = plant(fit.system, (), 0.0)
    n = len(made.A)
    step = scipy.linalg.expm(np.block([[made.A, made.B[:, :1]], [np.zeros((1, n + 1))]]) * fit.system.dt)
    x, states = fit.start, np.empty((len(u), n))
    for k, push in enumerate(u):
        states[k] = x
        x = step[:n, :n] @ x + step[:n, n] * push
    return states


def forced(system: System, directions: np.ndarray, forces: np.ndarray) -> np.ndarray:
    """Readings (columns, samples, sensors) under forces on bodies, linear between samples on average.

    Args:
        system: linear.
        directions: (columns, bodies).
        forces: (columns, samples).
    """
    made = plant(system, (), 0.0)
    n, bodies = len(made.A), len(system.bodies)
    B = np.concatenate([np.zeros((bodies, bodies)), np.diag(1 / np.array(system.mass))])
    big = np.block([[made.A, B], [np.zeros((bodies, n + bodies))]]) * system.dt
    step = scipy.linalg.expm(big)[:n]
    held = 0.5 * (forces + np.roll(forces, -1, axis=1))
    held[:, -1] = forces[:, -1]
    push = directions @ step[:, n:].T
    x, states = np.zeros((len(forces), n)), np.empty((forces.shape[1], len(forces), n))
    for k in range(forces.shape[1]):
        states[k] = x
        x = x @ step[:, :n].T + held[:, k, None] * push
    y = np.einsum("sn,tcn->cts", made.C, states)
    for i, sensor in enumerate(system.sensors):
        if sensor.kind == "acceleration":
            at = system.bodies.index(sensor.body)
            y[:, :, i] += directions[:, at, None] * forces / system.mass[at]
    return y


def laws_of(d: np.ndarray, v: np.ndarray, t: np.ndarray) -> dict[str, np.ndarray]:
    """Forces of unit coefficient that a motion brings, by kind; several of a kind by a number after it.

    Args:
        d: relative displacement.
        v: relative velocity.
        t: time.
    """
    found = {
        "coulomb_friction": np.sign(v),
        "quadratic_damping": np.abs(v) * v,
        "cubic_stiffness": d**3,
        "quadratic_stiffness": d**2,
        "bilinear_stiffness": np.maximum(d, 0),
        "time_varying_stiffness": t * d,
    }
    for i, part in enumerate((0.3, 0.7)):
        found[f"backlash:{i}"] = np.clip(d, -part * d.std(), part * d.std())
    for i, part in enumerate((1.0, 1.5, 2.0)):
        found[f"end_stop:{i}"] = d - np.clip(d, -part * d.std(), part * d.std())
    return found


def places(system: System) -> list[tuple[str, str]]:
    """All connections, and the ground with every body that it has none with.

    Args:
        system: nominal.
    """
    joined = [c.between for c in system.connections]
    return joined + [(GROUND, b) for b in system.bodies if not any({GROUND, b} == set(x) for x in joined)]


def dictionary(fit: Fit, u: np.ndarray) -> list[Term]:
    """All laws at all places, errors of signals to first order.

    Args:
        fit: recalibrated model.
        u: input.
    """
    system, states = fit.system, motion(fit, u)
    n, t = len(system.bodies), np.arange(len(u)) * system.dt
    labels, directions, forces = [], [], []
    for ends in places(system):
        e = joint(system, ends)
        for kind, force in laws_of(states[:, :n] @ e, states[:, n:] @ e, t).items():
            labels.append((kind.split(":")[0], {"between": list(ends)}))
            directions.append(-e)
            forces.append(force)
    for body in system.bodies:
        labels.append(("constant_load", {"body": body}))
        directions.append(joint(system, (GROUND, body)))
        forces.append(np.ones(len(u)))
    columns = forced(system, np.array(directions), np.array(forces))
    found = [Term(kind, place, c) for (kind, place), c in zip(labels, columns, strict=True)]
    shown = forced(system, joint(system, (GROUND, system.inputs[0].body))[None], u[None])[0]
    for i, sensor in enumerate(system.sensors):
        only = np.eye(len(system.sensors))[i]
        place = {"sensor": sensor.name}
        found.append(Term("sensor_gain", place, shown * only))
        found.append(Term("sensor_bias", place, np.ones_like(shown) * only))
        found.append(Term("sensor_delay", place, -np.gradient(shown, axis=0) * only))
    found.append(Term("input_delay", {"input": system.inputs[0].name}, -np.gradient(shown, axis=0)))
    return found


def _flat(columns: list[np.ndarray], std: np.ndarray) -> np.ndarray:
    return np.array([(c / std).ravel() for c in columns]).T


def stepwise(terms: list[Term], residual: np.ndarray) -> tuple[list[int], np.ndarray]:
    """Terms that lower the criterion n log(mean square) + k log n most, one after another, and their coefficients.

    Args:
        terms: dictionary.
        residual: of the recalibrated model.
    """
    std = residual.std(axis=0)
    target, chosen, best, last = (residual / std).ravel(), [], np.inf, np.zeros(0)
    every = _flat([x.column for x in terms], std)
    every = every / np.maximum(np.linalg.norm(every, axis=0), 1e-300)
    count = len(target)
    best, left = count * np.log(np.mean(target**2)), target
    while len(chosen) < MOST_TERMS:
        at = int(np.argmax(np.abs(every.T @ left)))
        basis = _flat([terms[i].column for i in [*chosen, at]], std)
        found = np.linalg.lstsq(basis, target, rcond=1e-12)[0]
        rest = target - basis @ found
        value = count * np.log(np.mean(rest**2)) + (len(chosen) + 1) * np.log(count)
        if at in chosen or not value < best:
            break
        chosen, best, left, last = [*chosen, at], value, rest, found
    return chosen, last


def surfaces(fit: Fit, u: np.ndarray) -> list[tuple[tuple[str, str], np.ndarray, np.ndarray]]:
    """By place: ends, forces (terms, samples) of the powers of d and v, their readings.

    Args:
        fit: recalibrated model.
        u: input.
    """
    n, states, found = len(fit.system.bodies), motion(fit, u), []
    for ends in places(fit.system):
        e = joint(fit.system, ends)
        d, v = (x @ e / max(float((x @ e).std()), 1e-300) for x in (states[:, :n], states[:, n:]))
        powers = [(i, j) for i in range(POWERS + 1) for j in range(POWERS + 1 - i) if i + j > 0]
        forces = np.array([d**i * v**j for i, j in powers])
        found.append((ends, forces, forced(fit.system, np.tile(-e, (len(forces), 1)), forces)))
    return found


def surface(fit: Fit, u: np.ndarray, residual: np.ndarray) -> tuple[int, np.ndarray, str]:
    """Place, coefficients of its polynomial, and the law that it is most like.

    Args:
        fit: recalibrated model.
        u: input.
        residual: what it leaves.
    """
    std = residual.std(axis=0)
    target, best = (residual / std).ravel(), (np.inf, 0, np.zeros(0), "")
    n, states, t = len(fit.system.bodies), motion(fit, u), np.arange(len(u)) * fit.system.dt
    for i, (ends, forces, columns) in enumerate(surfaces(fit, u)):
        basis = _flat(list(columns), std)
        found = np.linalg.lstsq(basis, target, rcond=1e-8)[0]
        left = float(np.sum((target - basis @ found) ** 2))
        if left < best[0]:
            e, force = joint(fit.system, ends), found @ forces
            alike = {
                kind: abs(np.corrcoef(x, force)[0, 1])
                for kind, x in laws_of(states[:, :n] @ e, states[:, n:] @ e, t).items()
            }
            best = left, i, found, max(alike, key=lambda k: alike[k]).split(":")[0]
    return best[1:]


def examined(folder: Path) -> dict[str, Any]:
    """What each baseline names, and what it leaves of the second record, rms by sensor.

    Args:
        folder: of the case.
    """
    system, ((u1, y1), (u2, y2)) = read(folder)
    fit = recalibrated(system, u1, y1)
    held = fitted_start(fit.system, u2, y2)
    rms = lambda x: np.sqrt(np.mean(x**2, axis=0)).tolist()  # noqa: E731
    before = rms(fitted_start(system, u2, y2).residual)
    terms, terms2 = dictionary(fit, u1), dictionary(held, u2)
    chosen, c = stepwise(terms, fit.residual)
    left = held.residual - sum(
        (a * terms2[i].column for a, i in zip(c, chosen, strict=True)), np.zeros_like(y2)
    )
    at, powers, kind = surface(fit, u1, fit.residual)
    ends, _, columns = surfaces(held, u2)[at]
    return {
        "recalibration": {"before": before, "after": rms(held.residual)},
        "stepwise BIC": {
            "effects": [{"kind": terms[i].kind, "place": terms[i].place} for i in chosen],
            "before": before,
            "after": rms(left),
        },
        "restoring-force surface": {
            "effects": [{"kind": kind, "place": {"between": list(ends)}}],
            "before": before,
            "after": rms(held.residual - np.einsum("c,cts->ts", powers, columns)),
        },
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--shard", default="0/1")
    asked = parser.parse_args()
    part, parts = map(int, asked.shard.split("/"))
    for folder in sorted((asked.out / "cases").iterdir())[part::parts]:
        path = asked.out / "baselines" / f"{folder.name}.json"
        if not path.exists():
            try:
                found = examined(folder)
            except (np.linalg.LinAlgError, ValueError) as error:
                found = {"failure": {"error": repr(error)}}
            written(path, json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
