"""Refinements a second, against a loop over scipy's least squares, and how near they come to the Cramer-Rao bound.

    OPENBLAS_NUM_THREADS=1 .venv/bin/python benchmarks/refinement.py

prints its table, and puts it into README.md between its markers. All in one run on one machine.
"""

import statistics
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

import jaxsid
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.lumped import Connection, Input, Sensor, second_order
from jaxsid.mechanics.simulate import impulse_response_of
from jaxsid.physical.measured import response_term, response_weights
from jaxsid.physical.restrictions import restricted

jax.config.update("jax_enable_x64", True)
README = Path(__file__).with_name("README.md")
BEGIN, END = "<!-- refinement: begin -->", "<!-- refinement: end -->"
KEY = jax.random.key(0)
DT, SAMPLES, NOISE, POLE = 0.05, 400, 0.01, 0.8
FITS, SEEDS, PEERS, SINGLES = 1000, 500, 30, 50
MASS, STIFFNESS, DAMPING = [1.0, 1.0, 1.0], [2.0, 2.0, 2.0, 20.0, 0.5], [0.1, 0.1, 0.1, 1.0, 0.0]
ENDS = [("ground", "b1"), ("b1", "b2"), ("b2", "b3"), ("b3", "ground"), ("b1", "b3")]
FIXED = ["c5.damping"]  # twelve are left: three masses, five springs, four dampers


def chain(wrong: float = 0.0):
    """Three masses, each with a force and an accelerometer; every number off by up to a part."""
    rng = np.random.default_rng(1)
    off = lambda x: np.asarray(x) * (1 + wrong * rng.uniform(-1, 1, len(x)))  # noqa: E731
    bodies = ["b1", "b2", "b3"]
    return jaxsid.lumped_model(
        bodies,
        off(MASS),
        off(STIFFNESS),
        off(DAMPING),
        connections=[Connection(f"c{i + 1}", ends) for i, ends in enumerate(ENDS)],
        inputs=[Input(f"f{b}", b) for b in bodies],
        sensors=[Sensor(f"a{b}", b, "acceleration") for b in bodies],
    )


TRUTH, START = chain(), chain(0.2)
EXACT = impulse_response_of(physical_displacement_velocity(second_order(TRUTH)), DT, samples=SAMPLES)
SIZE = NOISE * float(np.asarray(EXACT.h).std())
WHITE = jaxsid.IndependentNoise(np.full(3, SIZE**2))
COLOURED = jaxsid.StationaryNoise(np.repeat(SIZE**2 * POLE ** np.arange(SAMPLES)[:, None], 3, axis=1))


def disturbed(key, coloured: bool):
    white = jax.random.normal(key, EXACT.h.shape)
    if coloured:
        step = lambda e, w: (POLE * e + np.sqrt(1 - POLE**2) * w,) * 2  # noqa: E731
        white = jnp.concatenate([white[:1], jax.lax.scan(step, white[0], white[1:])[1]])
    return jaxsid.ImpulseResponse(EXACT.h + SIZE * white, DT)


def refined(ir, noise):
    return jaxsid.refine(START, ir, noise=noise, fixed=FIXED).elements.values


def by_cbsi(ir):
    found = jaxsid.cbsi(
        jaxsid.era(ir, order=6, rows=100, cols=100), sensors=("acceleration",) * 3, collocated=(0, 1, 2)
    )
    return found.mass, found.damping, found.stiffness


def matrices(values):
    model = jaxsid.lumped_model(
        TRUTH.bodies, values[:3], values[8:], values[3:8], connections=TRUTH.connections, inputs=TRUTH.inputs
    )
    whole = second_order(model)
    return whole.mass, whole.damping, whole.stiffness


def residual_of(noise):
    """Unknowns, what prepares a response, and the weighted residual that every solver here minimizes."""
    known = restricted(START, fixed=FIXED)
    nothing = tuple(jnp.zeros((0, 3, 3)) for _ in range(3))

    @jax.jit
    def prepared(h):
        ir = jaxsid.ImpulseResponse(h, DT)
        return response_term(ir, second_order(START), response_weights(ir, noise))

    @jax.jit
    def residual(theta, term):
        return term.evaluate(known.unknowns.matrices(theta), nothing)[0]

    return known, prepared, residual


def speed() -> list[str]:
    known, prepared, residual = residual_of(WHITE)
    start = np.asarray(known.unknowns.of_values(jnp.asarray(known.unknowns.nominal)))
    draws = [np.asarray(disturbed(jax.random.fold_in(KEY, i), False).h) for i in range(max(PEERS, SINGLES))]
    many = lambda key: refined(disturbed(key, False), WHITE)  # noqa: E731
    jaxsid.ensemble(many, KEY, 32)
    one = jax.jit(lambda h: refined(jaxsid.ImpulseResponse(h, DT), WHITE))
    one(draws[0]).block_until_ready()
    terms = [prepared(h) for h in draws]
    residual(start, terms[0]).block_until_ready()
    rounds = []
    for _ in range(3):
        begin = time.perf_counter()
        jaxsid.ensemble(many, KEY, FITS)
        together = (time.perf_counter() - begin) / FITS
        begin = time.perf_counter()
        for term in terms[:PEERS]:
            peer = scipy.optimize.least_squares(lambda x, term=term: np.asarray(residual(x, term)), start)
        loop = (time.perf_counter() - begin) / PEERS
        begin = time.perf_counter()
        for h in draws[:SINGLES]:
            one(h).block_until_ready()
        rounds.append((together, loop, (time.perf_counter() - begin) / SINGLES))
    ours = np.asarray(one(draws[PEERS - 1]))
    theirs = np.asarray(known.unknowns.values(jnp.asarray(peer.x)))
    together, loop, single = (statistics.median(x) for x in zip(*rounds, strict=True))
    apart = np.abs(ours / np.where(theirs != 0, theirs, 1.0) - 1)[theirs != 0].max()
    return [
        f"| {FITS} refinements in one call | {FITS * together:.2f} s | under 30 s |",
        f"| ensemble against the loop over scipy, {1e3 * loop:.1f} ms a fit | {loop / together:.1f} times | 20 |",
        f"| one fit against scipy | {1e3 * single:.2f} ms, {loop / single:.1f} times | 3 |",
        f"| largest relative difference of the values from scipy's | {apart:.1e} | |",
    ]


def efficiency(coloured: bool) -> list[str]:
    noise = COLOURED if coloured else WHITE
    known, prepared, residual = residual_of(noise)
    truth = np.concatenate([MASS, DAMPING, STIFFNESS])
    slopes = np.asarray(
        jax.jacfwd(residual)(known.unknowns.of_values(jnp.asarray(truth)), prepared(EXACT.h))
    ) / np.asarray(known.unknowns.scale)
    bound = np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))

    def both(key):
        ir = disturbed(key, coloured)
        values = refined(ir, noise)
        return values, matrices(values), by_cbsi(ir)

    values, ours, plain = jaxsid.ensemble(both, KEY, SEEDS)
    free = np.asarray(known.unknowns.mix).any(axis=1)
    spread = values[:, free].std(axis=0, ddof=1) / bound
    bias = np.abs(values[:, free].mean(axis=0) - truth[free]) / bound * np.sqrt(SEEDS)
    gains = [
        p.std(axis=0)[keep] / o.std(axis=0)[keep]
        for p, o in zip(plain, ours, strict=True)
        for keep in [o.std(axis=0) > 0]
    ]
    colour = f"coloured (pole {POLE})" if coloured else "white"
    return [
        f"| {colour} noise: spread over the Cramer-Rao bound, {SEEDS} seeds | {spread.min():.2f} to {spread.max():.2f} "
        "| 0.90 to 1.10 |",
        f"| largest bias, in its standard error | {bias.max():.1f} | |",
        "| spread of ERA and CBSI alone over that of refinement: M, D, K (medians) | "
        + ", ".join(f"{np.median(x):.1f}" for x in gains)
        + " | above 1 |",
    ]


def main() -> None:
    rows = ["| what | figure | target |", "|---|---|---|", *speed(), *efficiency(False), *efficiency(True)]
    print("\n".join(rows))
    text = README.read_text()
    before, rest = text.split(BEGIN)
    README.write_text(before + BEGIN + "\n\n" + "\n".join(rows) + "\n\n" + END + rest.split(END)[1])


if __name__ == "__main__":
    main()
