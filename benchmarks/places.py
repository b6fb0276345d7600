"""Whether the place of one hidden effect is found, in records of an integrator that knows nothing of the library.

    .venv/bin/python benchmarks/places.py OUT.jsonl [CASES] [tuning]

A chain of three with random numbers, 1 % noise, an effect of 5 to 60 % of the response; all three sensors, then one.
Numbers were chosen on the seeds of `tuning`, others count. A second run goes on where the first stopped.
"""

import json
import sys
import time
from collections import defaultdict
from pathlib import Path

import jax
import numpy as np
import scipy.linalg

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from effects_truth import GROUND, Chain, Truth  # pyright: ignore[reportMissingImports]

from jaxsid.compilation import default_folder, keep_programs, release_programs
from jaxsid.gap.locate import Locations, locate
from jaxsid.gap.places import Place
from jaxsid.mechanics.lumped import Connection, Input, LumpedModel, Sensor, lumped_model
from jaxsid.records import Record

CASES, TUNING, TESTING = 60, 1000, 50_000
DT, SAMPLES, NOISE = 0.01, 1024, 0.01
LEAST, MOST = 0.05, 0.6  # of the response
SIZES = (-2.0, -0.25)  # common logarithms of an effect's force next to the spring's
BODIES = ("b1", "b2", "b3")
PAIRS = ((GROUND, 0), (0, 1), (1, 2))
CHEAP = 30  # substeps of a sample, where friction is stepped
KINDS = (
    "cubic_stiffness",
    "quadratic_damping",
    "coulomb_friction",
    "bilinear_stiffness",
    "backlash",
    "end_stop",
    "hysteresis",
    "actuator_saturation",
    "actuator_lag",
    "input_delay",
    "sensor_delay",
    "sensor_lag",
)


def drive(rng: np.random.Generator) -> np.ndarray:
    """A random-phase multisine up to 15 Hz, 10 N rms.

    Args:
        rng: draws the phases.
    """
    f = np.fft.rfftfreq(SAMPLES, DT)
    u = np.fft.irfft(np.where((f > 0.5) & (f < 15), np.exp(2j * np.pi * rng.random(len(f))), 0), SAMPLES)
    return 10 * u / u.std()


def rubbing(chain: Chain, u: np.ndarray, ends: tuple[int, int], level: float) -> np.ndarray:
    """Accelerations under Coulomb friction, implicit in its impulse so that rest is rest.

    Args:
        chain: linear part.
        u: force.
        ends: bodies.
        level: friction force.

    Source: J. Moreau, Comput. Methods Appl. Mech. Engrg. 177 (1999).
    """
    n, h = len(chain.mass), DT / CHEAP
    inverse = np.linalg.inv(chain.mass)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ chain.stiffness, -inverse @ chain.damping]])
    joint = np.zeros(n)
    for end, sign in zip(ends, (-1.0, 1.0), strict=True):
        if end != GROUND:
            joint[end] = sign
    B = np.concatenate([np.zeros((n, 2)), inverse @ np.stack([np.eye(n)[chain.driven], joint], axis=1)])
    step = scipy.linalg.expm(np.block([[A, B], [np.zeros((2, 2 * n + 2))]]) * h)
    F, G = step[: 2 * n, : 2 * n], step[: 2 * n, 2 * n :]
    slide = np.concatenate([np.zeros(n), joint])
    gain, x, found, rub = slide @ G[:, 1], np.zeros(2 * n), [], 0.0
    for push in u:
        free = F @ x + G[:, 0] * push
        rub = -np.clip(slide @ free / gain, -level, level)
        found.append(A[n:] @ x + B[n:] @ np.array([push, rub]))
        for _ in range(CHEAP):
            free = F @ x + G[:, 0] * push
            x = free - G[:, 1] * np.clip(slide @ free / gain, -level, level)
    return np.array(found)


def law(kind: str, size: float, moved: float, speed: float, spring: float) -> dict[str, float]:
    """Parameters of an effect whose force is about a part of the spring's.

    Args:
        kind: of effect.
        size: that part.
        moved: rms of the relative displacement.
        speed: of the relative velocity.
        spring: stiffness.
    """
    force = size * spring * moved
    return {
        "cubic_stiffness": {"coefficient": force / moved**3 / 2},
        "quadratic_damping": {"coefficient": force / speed**2},
        "coulomb_friction": {"force": force},
        "bilinear_stiffness": {"stiffness": 2 * size * spring},
        "backlash": {"half_gap": size * moved},
        "end_stop": {"stiffness": 20 * size * spring, "clearance": 1.2 * moved},
        "hysteresis": {
            "stiffness": size * spring,
            "beta": 0.6 / moved,
            "gamma": 0.4 / moved,
            "exponent": 1.0,
        },
        "actuator_saturation": {"limit": 10 * 3 * (1 - size) + 2},
        "actuator_lag": {"time_constant": 0.03 * size},
        "input_delay": {"delay": 0.03 * size},
        "sensor_delay": {"delay": 0.03 * size},
        "sensor_lag": {"time_constant": 0.03 * size},
    }[kind]


def readings(
    chain: Chain, u: np.ndarray, kind: str, place: object, parameters: dict[str, float]
) -> np.ndarray:
    """Of an effect, by the integrator for its kind."""
    if kind == "coulomb_friction" and isinstance(place, tuple):
        return rubbing(chain, u, place, parameters["force"])
    return Truth(chain, kind, place, parameters, DT).run(u)


def case(number: int, seeds: int) -> tuple[LumpedModel, np.ndarray, np.ndarray, Place, dict[str, object]]:
    """Nominal model, force, readings, true place, what was drawn.

    Args:
        number: of the case, which says the kind of the effect.
        seeds: where they begin.
    """
    rng = np.random.default_rng(seeds + number)
    kind = KINDS[number % len(KINDS)]
    mass, k = rng.uniform(0.8, 1.4, 3), rng.uniform(1000, 2200, 3)
    c = k * rng.uniform(0.001, 0.003)
    across = np.eye(3) - np.eye(3, k=1)
    off = lambda x, std: x * (1 + std * rng.standard_normal(3))  # noqa: E731
    M, damping, K = (
        np.diag(off(mass, 0.005)),
        *(across @ np.diag(off(x, s)) @ across.T for x, s in ((c, 0.05), (k, 0.005))),
    )
    chain = Chain(M, damping, K, 0, tuple((i, "acceleration") for i in range(3)))
    u = drive(rng)
    plain = rubbing(chain, u, (GROUND, 0), 0.0)
    at = int(rng.integers(3))
    place: object = PAIRS[at]
    named = Place("between", tuple("ground" if i == GROUND else BODIES[i] for i in PAIRS[at]))
    if kind.startswith("sensor"):
        place, named = at, Place("sensor", (f"s{at}",))
    elif kind in ("actuator_saturation", "actuator_lag", "input_delay"):
        place, named = 0, Place("input", ("drive",))
    moved, speed = _relative(plain, PAIRS[at])
    size, part, y = float(10 ** rng.uniform(*SIZES)), 0.0, plain
    for _ in range(4):
        y = readings(chain, u, kind, place, law(kind, size, moved, speed, float(k[at])))
        part = float(np.sqrt(((y - plain) ** 2).mean() / (plain**2).mean()))
        if LEAST <= part <= MOST:
            break
        size = float(np.clip(size * (2.5 if part < LEAST else 0.4), 0.005, 0.95))
    y = y + NOISE * y.std(axis=0) * rng.standard_normal(y.shape)
    model = _nominal(mass, k, c)
    return model, u, y, named, {"kind": kind, "part": part, "size": size}


def _relative(accelerations: np.ndarray, pair: tuple[int, int]) -> tuple[float, float]:
    """Rms of displacement and velocity across a pair, from accelerations, above 1 Hz."""
    first, second = (0.0 if i == GROUND else accelerations[:, i] for i in pair)
    lines, f = np.fft.rfft(second - first), np.fft.rfftfreq(len(accelerations), DT)
    w = 2 * np.pi * np.where(f > 1, f, np.inf)
    d, v = (np.fft.irfft(lines / w**n, len(accelerations)).std() for n in (2, 1))
    return float(d), float(v)


def _nominal(mass: np.ndarray, k: np.ndarray, c: np.ndarray) -> LumpedModel:
    ends = ("ground", *BODIES)
    return lumped_model(
        BODIES,
        mass,
        k,
        c,
        connections=[Connection(f"c{i + 1}", (ends[i], ends[i + 1])) for i in range(3)],
        inputs=[Input("drive", "b1")],
        sensors=[Sensor(f"s{i}", b, "acceleration") for i, b in enumerate(BODIES)],
    )


def judged(found: Locations, place: Place) -> dict[str, object]:
    """First right, in the set, size of the set, and the evidence that the truth lacks.

    Args:
        found: the answer.
        place: the truth.
    """
    (own,) = [x for x in found.ranked if x.place == place]
    return {
        "first": found.ranked[0].place == place,
        "in_set": place in found.likely,
        "set": len(found.likely),
        "said": [p.label for p in found.likely],
        "probability": found.ranked[0].probability,
        "lacks": -own.evidence,
        "evidence": {x.place.label: x.evidence for x in found.ranked[:6]},
    }


def examined(number: int, seeds: int) -> dict[str, object]:
    """The line of a case.

    Args:
        number: of the case.
        seeds: where they begin.
    """
    model, u, y, place, drawn = case(number, seeds)
    line: dict[str, object] = {"case": number, "place": place.label, **drawn}
    one = int(place.ends[0][1]) if place.where == "sensor" else number // len(KINDS) % 3
    for name, sensors in (("three", [0, 1, 2]), ("one", [one])):
        names = tuple(f"s{i}" for i in sensors)
        fewer = lumped_model(
            BODIES,
            model.mass,
            model.stiffness,
            model.damping,
            connections=model.connections,
            inputs=model.inputs,
            sensors=[model.sensors[i] for i in sensors],
        )
        record = Record(u[:, None], y[:, sensors], DT, inputs=("drive",), outputs=names)
        began = time.perf_counter()
        line[name] = judged(locate(fewer, record), place)
        line[f"seconds_{name}"] = round(time.perf_counter() - began, 2)
    return line


def summary(lines: list[dict]) -> None:
    """Prints shares over all cases, and by kind."""
    for name in ("three", "one"):
        groups = defaultdict(list)
        for x in lines:
            groups["all"].append(x[name])
            groups[x["kind"]].append(x[name])
        print(f"{name} sensor(s): first, in the set, mean size of the set")
        for kind, each in groups.items():
            values = [np.mean([float(x[what]) for x in each]) for what in ("first", "in_set", "set")]
            print(f"  {kind:22s} {len(each):4d}  {values[0]:.2f}  {values[1]:.2f}  {values[2]:.2f}")


def main() -> None:
    path, cases = Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else CASES
    seeds = TUNING if "tuning" in sys.argv[3:] else TESTING
    lines = [json.loads(x) for x in path.read_text().splitlines()] if path.exists() else []
    done = {x["case"] for x in lines}
    for number in sorted(set(range(cases)) - done):
        lines.append(examined(number, seeds))
        release_programs()
        with path.open("a") as file:
            file.write(json.dumps(lines[-1]) + "\n")
    summary(lines)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    keep_programs(default_folder())
    main()
