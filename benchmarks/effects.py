"""Simulation with every kind of effect: error against an independent truth, time, and that of scipy's `solve_ivp`.

    OPENBLAS_NUM_THREADS=1 .venv/bin/python benchmarks/effects.py TRUTH.npz

prints its tables, and puts them into README.md between its markers. All in one run on one machine. The true motions
take minutes and are kept in the file.
"""

import os
import statistics
import sys
import time
import warnings
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from effects_cases import (
    CASES,
    CONTACT,
    DAMPING,
    DT,
    GROUND,
    MASS,
    SAMPLES,
    SENSED,
    STIFFNESS,
    Case,
    drive,
    error,
    truths,
)
from effects_peers import Peer, Trial, trials

import jaxsid
from jaxsid.mechanics.effects.catalogue import CATALOGUE
from jaxsid.mechanics.lumped import Connection, Effect, Input, Sensor, lumped_model

jax.config.update("jax_enable_x64", True)
README = Path(__file__).with_name("README.md")
BEGIN, END = "<!-- effects: begin -->", "<!-- effects: end -->"
ROUNDS, TRIED, PEER_SAMPLES = 3, 500, 2_000
SECONDS = {False: 0.15, True: 0.4}  # that are asked for, without and with friction or contact
TIMES = 20.0
LEAST = 1e-9  # relative error that nobody needs to fall below
BODIES = ("b1", "b2", "b3")


class Row(NamedTuple):
    """Figures of a case; times are processor seconds of 10 000 samples."""

    case: Case
    error: float
    seconds: float
    equal: float
    how: str
    enough: float
    given: "Given"


class Given(NamedTuple):
    """The same with the fewest steps that come as close as is asked for, chosen by the truth, as the peer's setting."""

    substeps: int
    error: float
    seconds: float
    equal: float


def model_of(case: Case) -> jaxsid.LumpedModel:
    where = CATALOGUE[case.kind].where
    name = lambda i: "ground" if i == GROUND else BODIES[i]  # noqa: E731
    if isinstance(case.place, tuple):
        place: object = tuple(name(i) for i in case.place)
    else:
        place = {"body": name(case.place), "sensor": f"s{case.place}", "input": "drive"}[where]
    parameters = {k: jnp.asarray(v) for k, v in case.parameters.items()}
    return lumped_model(
        BODIES,
        MASS,
        STIFFNESS,
        DAMPING,
        connections=[Connection(f"c{i}", (("ground", *BODIES)[i], BODIES[i])) for i in range(3)],
        inputs=[Input("drive", "b1", "zero")],
        sensors=[Sensor(f"s{i}", BODIES[body], kind) for i, (body, kind) in enumerate(SENSED)],
        effects=[Effect(case.kind, ((where, place),), parameters)],
    )


def row_of(case: Case, truth: np.ndarray) -> Row:
    model, u = model_of(case), drive()
    run = lambda substeps=None: np.asarray(  # noqa: E731
        jaxsid.simulate(model, {"drive": u}, dt=DT, substeps=substeps)
    )
    ours = error(run(), truth)
    tries = ((n, error(run(n), truth)) for n in (1, 2, 4, 8, 16, 32, 64))
    substeps, given = next(x for x in tries if x[1] <= case.limit)
    peer, wanted = Peer(case, u), max(ours, LEAST)
    tried = trials(peer, truth[:TRIED], min(wanted, max(given, LEAST)))
    equal, enough, likewise = (quickest(tried, x) for x in (wanted, case.limit, max(given, LEAST)))
    seconds, fixed, theirs, coarse, alike = [], [], [], [], []
    for _ in range(ROUNDS):
        for number, times in ((None, seconds), (substeps, fixed)):
            begin = time.process_time()
            run(number)
            times.append(time.process_time() - begin)
        for of, times in ((equal, theirs), (enough, coarse), (likewise, alike)):
            times.append(peer.run(of.setting, PEER_SAMPLES)[0] if of else np.nan)
    longer = SAMPLES / PEER_SAMPLES
    return Row(
        case,
        ours,
        statistics.median(seconds),
        longer * statistics.median(theirs),
        f"{equal.setting}, error {equal.error:.0e}" if equal else "none reached it",
        longer * statistics.median(coarse),
        Given(substeps, given, statistics.median(fixed), longer * statistics.median(alike)),
    )


def quickest(tried: list[Trial], wanted: float) -> Trial | None:
    return min((x for x in tried if x.error <= wanted), key=lambda x: x.seconds, default=None)


def table(rows: list[Row]) -> list[str]:
    lines = [
        "| kind | relative error | ours, s | solve_ivp at our error, s | how | times faster | "
        "solve_ivp at the error asked for, s | times faster | steps given: number, error | ours, s "
        "| solve_ivp at that error, s | times faster |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        lines.append(
            f"| {row.case.kind} | {row.error:.1e} | {row.seconds:.3f} | {row.equal:.2f} | {row.how} "
            f"| {row.equal / row.seconds:.0f} | {row.enough:.2f} | {row.enough / row.seconds:.0f} "
            f"| {row.given.substeps}, {row.given.error:.0e} | {row.given.seconds:.3f} | {row.given.equal:.2f} "
            f"| {row.given.equal / row.given.seconds:.0f} |"
        )
    return lines


def targets(rows: list[Row]) -> list[str]:
    lines = ["| target | kinds that meet it | those that do not |", "|---|---|---|"]

    def line(text: str, met: list[bool]) -> None:
        missed = ", ".join(row.case.kind for row, good in zip(rows, met, strict=True) if not good)
        lines.append(f"| {text} | {sum(met)} of {len(met)} | {missed} |")

    line("error at most 1e-4, friction and contact 1e-3", [row.error <= row.case.limit for row in rows])
    line(
        "0.15 s, friction and contact 0.4 s",
        [row.seconds <= SECONDS[row.case.limit == CONTACT] for row in rows],
    )
    line("20 times faster than solve_ivp at our error", [row.equal >= TIMES * row.seconds for row in rows])
    line(
        "the same with our steps given, as solve_ivp's tolerance is",
        [row.given.equal >= TIMES * row.given.seconds for row in rows],
    )
    return lines


def main() -> None:
    warnings.simplefilter("error", UserWarning)
    true, rows = truths(Path(sys.argv[1])), []
    before = os.getloadavg()[0]
    for case in CASES:
        rows.append(row_of(case, true[case.kind]))
        print(table(rows)[-1], file=sys.stderr, flush=True)
    assert {row.case.kind for row in rows} == set(CATALOGUE)
    load = f"{os.cpu_count()} cores, load average before {before:.1f}, after {os.getloadavg()[0]:.1f}."
    parts = [load, "", *targets(rows), "", *table(rows)]
    print("\n".join(parts))
    text = README.read_text()
    first, rest = text.split(BEGIN)
    README.write_text(first + BEGIN + "\n\n" + "\n".join(parts) + "\n\n" + END + rest.split(END)[1])


if __name__ == "__main__":
    main()
