"""Whether deviations are those of the errors, and how near the errors come to the Cramer-Rao bound, from raw records.

    OPENBLAS_NUM_THREADS=1 .venv/bin/python benchmarks/calibration.py

`jaxsid.refine` on many noisy records of one motion, `jaxsid.identify` on records of nine systems. Prints its rows and
puts them into README.md between their markers.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from bounds import LOW, WHITE, Colour, System, band_noise, bound, matrices, noise, outputs

import jaxsid
from jaxsid.compilation import default_folder, keep_programs
from jaxsid.mechanics.lumped import Connection, Effect, Input, Sensor

jax.config.update("jax_enable_x64", True)
keep_programs(default_folder())
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
README = Path(__file__).with_name("README.md")
BEGIN, END = "<!-- calibration: begin -->", "<!-- calibration: end -->"
SEEDS, FRICTION_SEEDS, RECORDS = 1000, 100, 6
WRONG = 0.3  # how far the numbers that the models begin with are off
RUBBING = 3.0
KINDS = {"d": "displacement", "v": "velocity", "a": "acceleration"}
THREE = System([1.2, 0.9, 0.7], [3000, 2500, 2000], [1.5, 1.2, 1.0])
SEVEN = System(
    [1, 1.1, 0.9, 1, 1.2, 0.8, 1.0],
    [9000, 8000, 9000, 7000, 8000, 9000, 7000],
    [3, 3, 2, 3, 2, 3, 2],
    kinds="d" * 7,
)


class Row(NamedTuple):
    """A system and the noise on its sensors, in parts of their rms."""

    system: System
    level: float = 0.01
    colour: Colour = WHITE


ROWS = {
    "three masses": Row(THREE),
    "three forces": Row(THREE._replace(driven=(0, 1, 2))),
    "two-inertia drive": Row(System([0.0053, 0.18], [0, 600, 0], [0.05, 0.05, 0.1], kinds="vv")),
    "free-free": Row(System([1.2, 0.9, 0.7], [0, 2500, 2000], [0, 1.2, 1.0], kinds="vvv")),
    "mixed sensors": Row(THREE._replace(kinds="dva")),
    "one mode overdamped": Row(System([1.2, 0.9], [3000, 2500], [1.5, 200.0])),
    "10 % noise": Row(THREE, 0.10),
    "3 % coloured noise": Row(THREE, 0.03, LOW),
    "seven masses, 0.3 % noise": Row(SEVEN, 0.003),
}


def model_of(system: System, wrong: float, seed: int = 0, effects=()):
    """Its model, every number off by up to a part."""
    rng = np.random.default_rng(seed)
    off = lambda x: np.asarray(x, float) * (1 + wrong * rng.uniform(-1, 1, len(x)))  # noqa: E731
    bodies = [f"b{i + 1}" for i in range(len(system.mass))]
    ends = ["ground", *bodies, "ground"]
    return jaxsid.lumped_model(
        bodies,
        off(system.mass),
        off(system.stiffness),
        off(system.damping),
        connections=[Connection(f"c{i + 1}", (ends[i], ends[i + 1])) for i in range(len(system.stiffness))],
        inputs=[Input(f"f{j + 1}", bodies[j]) for j in system.driven],
        sensors=[Sensor(f"s{b}", b, KINDS[kind]) for b, kind in zip(bodies, system.sensors, strict=True)],
        effects=effects,
    )


def record_of(model, u, y, dt: float):
    return jaxsid.Record(
        u, y, dt, inputs=[i.name for i in model.inputs], outputs=[s.name for s in model.sensors]
    )


def elements_of(system: System) -> tuple[np.ndarray, Callable]:
    """Masses, dampings, stiffnesses, and M, D, K of them."""
    parts = [np.asarray(x, float) for x in (system.mass, system.damping, system.stiffness)]
    cuts = np.cumsum([len(x) for x in parts])[:-1]

    def of(values: np.ndarray):
        mass, damping, stiffness = np.split(values, cuts)
        return matrices(system._replace(mass=mass, damping=damping, stiffness=stiffness))

    return np.concatenate(parts), of


def pulls(
    model, exact, u, dt: float, deviation, colour: Colour, truth, seeds: int
) -> tuple[np.ndarray, np.ndarray]:
    """Errors of `refine`, and these over their reported deviations, (seeds, values)."""
    errors, spreads = [], []
    for seed in range(seeds):
        e = noise(np.random.default_rng(1000 + seed), exact.shape, colour)
        found = jaxsid.refine(model, record_of(model, u, exact + deviation * e, dt), validate=False)
        errors.append(np.asarray(found.elements.values) - truth)
        spreads.append(np.asarray(found.elements.deviation))
    return np.array(errors), np.array(errors) / np.array(spreads)


def covered(pull: np.ndarray) -> str:
    inside = np.abs(pull) < 1.96
    each = 100 * inside.mean(axis=0)
    return f"{each.min():.1f} to {each.max():.1f} | {100 * inside.mean():.1f}"


def refined(colour: Colour, name: str) -> str:
    """Coverage and efficiency of `refine` on 16 s at 250 Hz, three masses, 1 % noise."""
    dt, model = 1 / 250, model_of(THREE, 0.2)
    u = band_noise(np.random.default_rng(7), 4000, 1, dt)
    exact = outputs(THREE, [matrices(THREE)], np.zeros((1, 6)), u, dt)[0]
    deviation, (truth, of) = 0.01 * exact.std(axis=0), elements_of(THREE)
    least = np.sqrt(np.diag(bound(THREE, of, truth, truth, u, dt, deviation, colour)))
    errors, pull = pulls(model, exact, u, dt, deviation, colour, truth, SEEDS)
    spread = errors.std(axis=0, ddof=1) / least
    bias = np.abs(errors.mean(axis=0)) / errors.std(axis=0) * np.sqrt(SEEDS)
    return (
        f"| linear, {name} noise | {SEEDS} | {covered(pull)} | {spread.min():.2f} to {spread.max():.2f} "
        f"| {bias.max():.1f} |"
    )


def rubbing() -> str:
    """The same of two masses with dry friction, refined too, on 1.6 s at 500 Hz from an independent simulation."""
    from effects_truth import Chain, Truth  # of the tests

    dt, samples, system = 2e-3, 800, System([1.0, 1.2], [900, 700], [3, 2], kinds="ad")
    u = band_noise(np.random.default_rng(1), samples, 1, dt, 0.5, 20.0)
    u = 12 * u / u.std()
    sensors = tuple((i, KINDS[kind]) for i, kind in enumerate(system.sensors))
    M, D, K = matrices(system)
    friction = {"force": RUBBING}
    exact = Truth(Chain(M, D, K, 0, sensors), "coulomb_friction", (-1, 0), friction, dt).run(u[:, 0])
    place = (("between", ("ground", "b1")),)
    model = model_of(system, 0.1, effects=[Effect("coulomb_friction", place, {"force": 0.8 * RUBBING})])
    truth = np.append(elements_of(system)[0], RUBBING)
    deviation = 0.01 * exact.std(axis=0)
    errors, pull = pulls(model, exact, u, dt, deviation, WHITE, truth, FRICTION_SEEDS)
    bias = np.abs(errors.mean(axis=0)) / errors.std(axis=0) * np.sqrt(FRICTION_SEEDS)
    return f"| dry friction, white noise | {FRICTION_SEEDS} | {covered(pull)} | | {bias.max():.1f} |"


def free_of(system: System) -> tuple[np.ndarray, np.ndarray, Callable]:
    """Entries of symmetric matrices, their sizes, and M, D, K; what nothing holds to the ground stays so."""
    bases, parts, sizes = [], [], []
    for x in matrices(system):
        n = len(x)
        loose = np.abs(x.sum(axis=1)).max() <= 1e-12 * np.abs(x).max()
        # coordinates in which a common motion of all bodies is left out
        bases.append(np.linalg.svd(np.ones((n, 1)))[0][:, 1:] if loose else np.eye(n))
        inner = bases[-1].T @ x @ bases[-1]
        upper = np.triu_indices(len(inner))
        root = np.sqrt(np.diag(inner))
        parts.append(inner[upper])
        sizes.append((root * root[:, None])[upper])
    cuts = np.cumsum([len(x) for x in parts])[:-1]

    def of(values: np.ndarray):
        found = []
        for part, basis in zip(np.split(values, cuts), bases, strict=True):
            inner = np.zeros((basis.shape[1],) * 2)
            inner[np.triu_indices(len(inner))] = part
            found.append(basis @ (inner + np.triu(inner, 1).T) @ basis.T)
        return tuple(found)

    return np.concatenate(parts), np.concatenate(sizes), of


def elements_told(system: System) -> tuple[np.ndarray, np.ndarray, Callable]:
    """Values of the elements that `identify` fits, their sizes, and M, D, K: all but springs that are not there."""
    values, whole = elements_of(system)
    parts = [np.asarray(x, float) for x in (system.mass, system.damping, system.stiffness)]
    usual = np.concatenate([np.full(len(x), np.median(x[x > 0])) for x in parts])
    free = (values != 0) | (np.arange(len(values)) < len(values) - len(system.stiffness))

    def of(some: np.ndarray):
        every = values.copy()
        every[free] = some
        return whole(every)

    return values[free], np.where(values != 0, values, usual)[free], of


def least_of_entries(row: Row, structure: str, u, dt: float, deviation) -> np.ndarray:
    """The bound of every entry of M, D, K, (3, N, N), 0 where the structure makes it exact."""
    truth, scale, of = free_of(row.system) if structure == "free" else elements_told(row.system)
    covariance = bound(row.system, of, truth, scale, u, dt, deviation, row.colour)
    moved = np.stack([np.stack(of(truth + x)) for x in np.diag(scale)])
    slopes = (moved - np.stack(of(truth))) / scale[:, None, None, None]
    return np.sqrt(np.einsum("pmij,pq,qmij->mij", slopes, covariance, slopes))


def identified(name: str, structure: str) -> str:
    """Errors of `identify` over their bound: 20 s at 1 kHz, force from 1 to 60 Hz."""
    row, dt = ROWS[name], 1e-3
    u = band_noise(np.random.default_rng(1), 20000, len(row.system.driven), dt)
    n = len(row.system.mass)
    exact = outputs(row.system, [matrices(row.system)], np.zeros((1, 2 * n)), u, dt)[0]
    deviation = row.level * exact.std(axis=0)
    least = least_of_entries(row, structure, u, dt, deviation)
    told = (
        least > 1e-9 * np.stack([np.abs(x).max() * np.ones_like(x) for x in matrices(row.system)])
    ) & np.triu(np.ones((n, n), bool))
    ratios, reported = [], []
    for seed in range(RECORDS):
        model = model_of(row.system, WRONG, seed)
        e = noise(np.random.default_rng(2000 + seed), exact.shape, row.colour)
        found = jaxsid.identify(model, record_of(model, u, exact + deviation * e, dt), structure=structure)
        if found.matrices is None:
            continue
        three = [
            np.stack([np.asarray(getattr(x, m)) for m in ("mass", "damping", "stiffness")])
            for x in (found.matrices, found.matrices_std)
        ]
        ratios.append((three[0] - np.stack(matrices(row.system)))[told] / least[told])
        reported.append(three[1][told] / least[told])
    ratios, reported = np.array(ratios), np.array(reported)
    size = np.sqrt((ratios**2).mean(axis=0))
    return (
        f"| {name} | {structure} | {len(ratios)} of {RECORDS} | {told.sum()} | {np.sqrt((ratios**2).mean()):.2f} "
        f"| {size.max():.2f} | {np.abs(ratios).max():.1f} | {np.median(reported):.2f} "
        f"({reported.min():.2f} to {reported.max():.2f}) |"
    )


def main() -> None:
    found = [
        "| `refine` | records | intervals of 95 % that cover, each, % | together, % | spread over the bound "
        "| largest bias, in its standard error |",
        "|---|---|---|---|---|---|",
    ]
    for colour, name in ((WHITE, "white"), (LOW, "coloured (pole 0.95)")):
        found.append(_told(refined(colour, name)))
    found += [
        _told(rubbing()),
        "",
        "| `identify` | structure | matrices found | entries | rms error over the bound | worst entry, rms "
        "| worst of all | reported deviation over the bound |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in ROWS:
        found += [_told(identified(name, structure)) for structure in ("auto", "free")]
    text = README.read_text()
    before, rest = text.split(BEGIN)
    README.write_text(before + BEGIN + "\n\n" + "\n".join(found) + "\n\n" + END + rest.split(END)[1])


def _told(row: str) -> str:
    print(row, flush=True)
    return row


if __name__ == "__main__":
    main()
