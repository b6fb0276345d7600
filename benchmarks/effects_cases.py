"""One case of every kind of effect on a chain of three masses, and its true motion, kept between runs.

    python benchmarks/effects_cases.py TRUTH.npz

The truth is that of the tests, which is written from the effects' definitions and imports nothing of the library.
"""

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from effects_truth import GROUND, Chain, Truth

DT, SAMPLES = 1e-3, 10_000
MASS, STIFFNESS, DAMPING = (1.0, 1.2, 0.8), (2000.0, 1500.0, 1000.0), (8.0, 6.0, 5.0)
SENSED = ((0, "acceleration"), (1, "displacement"), (2, "velocity"))
SMOOTH, CONTACT = 1e-4, 1e-3  # relative rms error that is asked for


class Case(NamedTuple):
    kind: str
    place: int | tuple[int, int]
    parameters: dict[str, float]
    limit: float = SMOOTH


JOINT, WALL = (0, 1), (GROUND, 0)
CASES = (
    Case("mass_error", 1, {"factor": 1.3}),
    Case("stiffness_error", JOINT, {"factor": 0.7}),
    Case("damping_error", JOINT, {"factor": 3.0}),
    Case("missing_connection", (0, 2), {"stiffness": 300.0, "damping": 2.0}),
    Case("missing_mode", 1, {"mass": 0.2, "stiffness": 300.0, "damping": 0.5}),
    Case("coulomb_friction", WALL, {"force": 3.0}, CONTACT),
    Case("stribeck_friction", WALL, {"force": 2.0, "static_force": 3.0, "velocity": 0.1}, CONTACT),
    Case("quadratic_damping", JOINT, {"coefficient": 15.0}),
    Case("cubic_stiffness", JOINT, {"coefficient": 3e6}),
    Case("quadratic_stiffness", JOINT, {"coefficient": 1e4}),
    Case("bilinear_stiffness", JOINT, {"stiffness": 600.0}),
    Case("backlash", JOINT, {"half_gap": 0.002}, CONTACT),
    Case("end_stop", JOINT, {"stiffness": 4000.0, "clearance": 0.01}, CONTACT),
    Case("hysteresis", JOINT, {"stiffness": 800.0, "beta": 60.0, "gamma": 40.0, "exponent": 1.3}),
    Case("cogging_ripple", JOINT, {"amplitude": 3.0, "wavenumber": 300.0, "phase": 0.4}),
    Case("constant_load", 2, {"force": 4.0}),
    Case("periodic_disturbance", 2, {"amplitude": 4.0, "frequency_hz": 7.3, "phase": 0.3}),
    Case("time_varying_stiffness", JOINT, {"rate": 80.0}),
    Case("sensor_gain", 1, {"factor": 1.2}),
    Case("sensor_bias", 0, {"offset": 2.0}),
    Case("sensor_delay", 0, {"delay": 0.0034}),
    Case("sensor_lag", 0, {"time_constant": 0.004}),
    Case("input_gain", 0, {"factor": 0.8}),
    Case("input_delay", 0, {"delay": 0.0034}),
    Case("actuator_lag", 0, {"time_constant": 0.004}),
    Case("actuator_saturation", 0, {"limit": 15.0}),
)


def drive(samples: int = SAMPLES) -> np.ndarray:
    """A random force from 0.5 to 20 Hz, 15 N rms, held between samples."""
    f = np.fft.rfftfreq(samples, DT)
    phase = np.exp(2j * np.pi * np.random.default_rng(0).random(len(f)))
    u = np.fft.irfft(np.where((f > 0.5) & (f < 20), phase, 0), samples)
    return 15 * u / u.std()


def truth_of(case: Case) -> Truth:
    """The chain with the effect of a case, not yet run."""
    ends = [np.eye(3)[i] - (np.eye(3)[i - 1] if i else 0) for i in range(3)]
    D, K = (sum(x * np.outer(e, e) for x, e in zip(of, ends, strict=True)) for of in (DAMPING, STIFFNESS))
    chain = Chain(np.diag(MASS), D, K, 0, SENSED)
    return Truth(chain, case.kind, case.place, dict(case.parameters), DT)


def error(y: np.ndarray, truth: np.ndarray) -> float:
    """Worst relative rms error of the sensors."""
    return float((np.sqrt(((y - truth) ** 2).mean(axis=0)) / np.sqrt((truth**2).mean(axis=0))).max())


def truths(file: Path) -> dict[str, np.ndarray]:
    """True readings by kind; what the file does not have, or has of other parameters, is run and put there."""
    known = dict(np.load(file)) if file.exists() else {}
    wanted = {case.kind: f"{case} {SAMPLES}" for case in CASES}
    for case in CASES:
        if wanted[case.kind] not in known:
            print(f"truth of {case.kind}", file=sys.stderr)
            known[wanted[case.kind]] = truth_of(case).run(drive())
            file.parent.mkdir(parents=True, exist_ok=True)
            np.savez(file, **known)
    return {kind: known[key] for kind, key in wanted.items()}


if __name__ == "__main__":
    truths(Path(sys.argv[1]))
