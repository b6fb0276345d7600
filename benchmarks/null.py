"""How often a diagnosis claims an effect, or an error of parameters, where there is none.

    .venv/bin/python benchmarks/null.py OUT.jsonl [CASES]

simulates random systems by scipy, their numbers drawn from within the tolerance, with white or coloured noise whose
level nobody tells, a third of them with noise of the measured input too, and writes a line a case. A second run goes on
where the first stopped; it prints a summary.
"""

import json
import sys
import time
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import scipy.linalg
import scipy.signal

from jaxsid.compilation import default_folder, keep_programs, release_programs
from jaxsid.gap.examine import examine
from jaxsid.mechanics.lumped import Connection, Input, LumpedModel, Sensor, lumped_model, second_order
from jaxsid.records import Record

CASES = 400
SEED = 20_000
KINDS = ("displacement", "velocity", "acceleration")


class Shape(NamedTuple):
    """Sizes that programs are compiled for: bodies, sensors, samples."""

    bodies: int
    sensors: int
    samples: int


SHAPES = (
    Shape(1, 1, 1000),
    Shape(1, 1, 4096),
    Shape(2, 1, 2048),
    Shape(2, 2, 1500),
    Shape(3, 1, 4000),
    Shape(3, 2, 2048),
    Shape(3, 3, 1024),
    Shape(3, 3, 6000),
    Shape(4, 2, 3000),
)


class Case(NamedTuple):
    """A nominal model, a record of a system like it, and what was drawn."""

    model: LumpedModel
    record: Record
    drawn: dict[str, object]


def drive(rng: np.random.Generator, samples: int, dt: float, band: float) -> tuple[np.ndarray, str, int]:
    """Force, its name, and the number of its periods.

    Args:
        rng: draws it.
        samples: of the record.
        dt: sampling interval, s.
        band: highest frequency, Hz.
    """
    kind = str(rng.choice(["multisine", "periods", "random", "chirp", "steps"]))
    t, periods = np.arange(samples) * dt, 1
    if kind in ("multisine", "periods"):
        periods = int(rng.integers(2, 6)) if kind == "periods" else 1
        length = samples // periods
        f = np.fft.rfftfreq(length, dt)
        lines = np.where((f > 0) & (f < band), np.exp(2j * np.pi * rng.random(len(f))), 0)
        u = np.resize(np.fft.irfft(lines, length), samples)
    elif kind == "random":
        low = scipy.signal.butter(2, min(2 * band * dt, 0.95), output="sos")
        u = np.asarray(scipy.signal.sosfilt(low, rng.standard_normal(samples)))
    elif kind == "chirp":
        u = scipy.signal.chirp(t, band / 50, t[-1], band)
    else:
        every = max(int(1 / (2 * band * dt)), 1)
        u = np.repeat(rng.standard_normal(samples // every + 1), every)[:samples]
    return u / u.std() * 10 ** rng.uniform(-1, 2), kind, periods


def matrices(model: LumpedModel) -> tuple[np.ndarray, ...]:
    """A, B, C, D in continuous time, written from M, D, K.

    Args:
        model: its linear part.
    """
    plain = second_order(model)
    M, damp, K, force = (
        np.asarray(x) for x in (plain.mass, plain.damping, plain.stiffness, plain.input_matrix)
    )
    size = len(M)
    inverse = np.linalg.inv(M)
    A = np.block([[np.zeros((size, size)), np.eye(size)], [-inverse @ K, -inverse @ damp]])
    B = np.concatenate([np.zeros_like(force), inverse @ force])
    rows = {
        "displacement": np.eye(size, 2 * size),
        "velocity": np.eye(size, 2 * size, size),
        "acceleration": A[size:],
    }
    through = {"displacement": 0 * force, "velocity": 0 * force, "acceleration": inverse @ force}
    at = [(s.kind, model.bodies.index(s.body)) for s in model.sensors]
    return A, B, np.array([rows[k][i] for k, i in at]), np.array([through[k][i] for k, i in at])


def simulated(model: LumpedModel, u: np.ndarray, dt: float, hold: str, start: np.ndarray) -> np.ndarray:
    """Readings at every sample, by scipy's discretization.

    Args:
        model: its linear part.
        u: (samples, inputs).
        dt: sampling interval, s.
        hold: "zero" or "first".
        start: state.
    """
    A, B, C, D = matrices(model)
    F, G, H, through = _sampled(A, B, dt, hold)
    x = np.linalg.solve(H, start - through @ u[0])
    states = np.empty((len(u), len(A)))
    for k, push in enumerate(u):
        states[k] = H @ x + through @ push
        x = F @ x + G @ push
    return states @ C.T + u @ D.T


def case(number: int) -> Case:
    """One case, always the same for its number.

    Args:
        number: of the case.
    """
    rng = np.random.default_rng(SEED + number)
    shape = SHAPES[number % len(SHAPES)]
    n = shape.bodies
    bodies = [f"b{i + 1}" for i in range(n)]
    ends = ["ground", *bodies]
    mass, stiffness = 10 ** rng.uniform(-0.5, 0.5, n), 10 ** rng.uniform(2.7, 3.7, n)
    rates = np.sqrt(scipy.linalg.eigvalsh(*_chain(mass, stiffness)))
    damping = stiffness * rng.uniform(0.003, 0.03) * 2 / rates[0] * rng.uniform(0.5, 2, n)
    sensed = rng.choice(n, shape.sensors, replace=False)
    sensors = [Sensor(f"s{i}", bodies[i], str(rng.choice(KINDS))) for i in sensed]
    inputs = [Input("f", bodies[int(rng.integers(n))])]
    joints = [Connection(f"c{i}", (ends[i], ends[i + 1])) for i in range(n)]

    def built(spread: float) -> LumpedModel:
        off = lambda x, std: x * (1 + spread * std * rng.standard_normal(n))  # noqa: E731
        values = off(mass, 0.005), off(stiffness, 0.005), off(damping, 0.05)
        return lumped_model(bodies, *values, connections=joints, inputs=inputs, sensors=sensors)

    model, true = built(0.0), built(1.0)
    dt = 2 * np.pi / rates[-1] / rng.uniform(4, 12)
    hold = str(rng.choice(["zero", "first"]))
    force, kind, periods = drive(rng, shape.samples, dt, rng.uniform(1.1, 1.6) * rates[-1] / 2 / np.pi)
    u = force[:, None]
    still = simulated(true, u, dt, hold, np.zeros(2 * n))
    start = rng.choice([0.0, 1.0]) * rng.standard_normal(2 * n) * _spread(true, u, dt, hold)
    y = simulated(true, u, dt, hold, start) if start.any() else still
    part, pole = 10 ** rng.uniform(-3, -1.3), float(rng.choice([0.0, 0.5, 0.9, -0.5]))
    white = rng.standard_normal((shape.samples + 300, shape.sensors))
    noise = scipy.signal.lfilter([1], [1, -pole], white, axis=0)[300:] * np.sqrt(1 - pole**2)
    y = y + part * still.std(axis=0) * noise
    names = tuple(s.name for s in sensors)
    # a third of the inputs are measured, by sensors with noise of their own
    felt = float(rng.choice([0.0, 0.0, 1.0])) * 10 ** rng.uniform(-3, -2)
    u = u + felt * u.std() * rng.standard_normal(u.shape)
    record = Record(u, y, dt, inputs=("f",), outputs=names, hold=(hold,), name=f"case {number}")
    drawn = {
        "shape": list(shape),
        "drive": kind,
        "periods": periods,
        "hold": hold,
        "moving": bool(start.any()),
        "noise": part,
        "pole": pole,
        "input_noise": felt,
        "sensors": [s.kind for s in sensors],
    }
    return Case(model, record, drawn)


def _chain(mass: np.ndarray, stiffness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    across = np.eye(len(mass)) - np.eye(len(mass), k=-1)
    return across.T @ np.diag(stiffness) @ across, np.diag(mass)


def _sampled(A: np.ndarray, B: np.ndarray, dt: float, hold: str) -> tuple[np.ndarray, ...]:
    """The states sampled, as outputs, since those of a first-order hold are shifted."""
    own = (A, B, np.eye(len(A)), np.zeros_like(B))
    found = list(scipy.signal.cont2discrete(own, dt, method={"zero": "zoh", "first": "foh"}[hold]))  # pyright: ignore
    return tuple(np.asarray(x) for x in found[:4])


def _spread(model: LumpedModel, u: np.ndarray, dt: float, hold: str) -> np.ndarray:
    """Rms of each state under the force."""
    A, B, _, _ = matrices(model)
    F, G, H, through = _sampled(A, B, dt, hold)
    x, power = np.zeros(len(A)), np.zeros(len(A))
    for push in u:
        power += (H @ x + through @ push) ** 2
        x = F @ x + G @ push
    return np.sqrt(power / len(u))


def examined(number: int) -> dict[str, object]:
    """The line of a case.

    Args:
        number: of the case.
    """
    made = case(number)
    began = time.perf_counter()
    found = examine(made.model, made.record)
    return {
        "case": number,
        **made.drawn,
        "finding": found.finding,
        "nominal": float(found.nominal_p_value),
        "structural": float(found.structural_p_value),
        "share": float(found.null.share),
        "tests": {t.name: [float(t.p_value), float(t.share)] for t in found.null.tests},
        "source": found.noises[0].source,
        "seconds": round(time.perf_counter() - began, 2),
    }


def main() -> None:
    path, cases = Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else CASES
    lines = [json.loads(x) for x in path.read_text().splitlines()] if path.exists() else []
    done = {x["case"] for x in lines}
    # one shape after another, so that its programs serve all of its cases
    for number in sorted(set(range(cases)) - done, key=lambda i: (i // 45, i % len(SHAPES), i)):
        lines.append(examined(number))
        release_programs()
        with path.open("a") as file:
            file.write(json.dumps(lines[-1]) + "\n")
    print(Counter(x["finding"] for x in lines), f"of {len(lines)}")
    for x in lines:
        if x["finding"] != "agreement":
            print(x)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    keep_programs(default_folder())
    main()
