"""The experiment that would best separate two explanations which records at hand do not tell apart.

What one explanation predicts for an input is fitted by the other, its numbers free within the model's tolerance. What
it cannot follow, D(a | b) = min over b of 1/2 sum ((y_a - y_b) / noise)^2, is the difference of log evidence to be
expected of that input. Sensors are compared by how far the two part there under the inputs that were used.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsid.gap.free_run import Run, free_run
from jaxsid.gap.ranking import Explanation
from jaxsid.gap.refit import Bench, Refit, changes_of, refitted
from jaxsid.gap.resume import step
from jaxsid.gap.setting import slowest_rate
from jaxsid.gap.windows import blocks_of
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.lumped import second_order
from jaxsid.mechanics.simulate import ordered_inputs
from jaxsid.records import Record

LEVELS = {"the same input at a third of its level": 1 / 3, "the same input at three times its level": 3.0}
SLOWER = 4  # times
LONGEST = 4096  # samples of an input
STEPS = 12  # of a fit
ABOVE = 1.5  # rate up to which a multisine reaches, over the fastest mode's
EDGE = 0.4  # of the sampling rate, which it does not reach beyond


class Experiment(NamedTuple):
    """What to measure next.

    Attributes:
        name: of the input, in words.
        record: its inputs, with what the most probable explanation predicts for the sensors.
        told: log evidence by which it would tell the two explanations apart.
        compared: the same of every input that was tried, by name.
        sensor: the body whose displacement no sensor reads where the two part most, and by what part of its motion;
            None where all are read.
    """

    name: str
    record: Record
    told: float
    compared: dict[str, float]
    sensor: tuple[str, float] | None


@step
def experiment_between(
    one: Explanation, other: Explanation, bench: Bench, records: Sequence[Record]
) -> Experiment:
    """The input, of some that are like those used, that best tells two explanations apart.

    Args:
        one: the more probable explanation.
        other: its rival.
        bench: that both were fitted to.
        records: as measured.
    """
    number = int(np.argmax([len(r.u) for r in records]))
    found: dict[str, tuple[float, Record]] = {}
    for name, u in _menu(bench, records[number]).items():
        run = _run(one.refit, bench, u, records[number], number)
        predicted = Record(
            u,
            run.outputs[: len(u)],
            records[number].dt,
            inputs=tuple(i.name for i in bench.model.inputs),
            outputs=tuple(s.name for s in bench.model.sensors),
            hold=ordered_inputs(bench.model, records[number])[1],
            name="next",
        )
        found[name] = _told(other.refit, bench, predicted, run, number), predicted
    best = max(found, key=lambda name: found[name][0])
    return Experiment(
        best,
        found[best][1],
        found[best][0],
        {name: told for name, (told, _) in found.items()},
        _sensor(one.refit, other.refit, bench, records[number], number),
    )


def _menu(bench: Bench, record: Record) -> dict[str, Float[np.ndarray, "samples inputs"]]:
    """Inputs by name, none longer than need be."""
    dt, used = float(record.dt), np.asarray(ordered_inputs(bench.model, record)[0])[:LONGEST]
    at = np.arange(len(used))
    found = {name: level * used for name, level in LEVELS.items()}
    slow = [np.interp(at / SLOWER, at, column) for column in used.T]
    found[f"the same input {SLOWER} times slower"] = np.stack(slow, axis=1)
    rms = np.sqrt((used**2).mean(axis=0))
    rates = np.abs(np.linalg.eigvals(np.asarray(physical_displacement_velocity(second_order(bench.model)).A)))
    top = min(ABOVE * rates.max(), EDGE * 2 * np.pi / dt)
    omega = 2 * np.pi * np.fft.rfftfreq(len(used), dt)
    band = (omega > 0) & (omega <= top)
    if band.any():
        rng = np.random.default_rng(0)
        phases = np.exp(2j * np.pi * rng.random((len(omega), used.shape[1])))
        many = np.fft.irfft(np.where(band[:, None], phases, 0), len(used), axis=0)
        found[f"a random-phase multisine up to {top / 2 / np.pi:.3g} Hz"] = rms * many / many.std(axis=0)
    rate = slowest_rate(bench.model) / SLOWER
    sine = np.sin(rate * dt * at)[:, None] * rms * np.sqrt(2)
    found[f"a sine of {rate / 2 / np.pi:.3g} Hz, slow beside all modes"] = sine
    return found


def _run(found: Refit, bench: Bench, u: np.ndarray, record: Record, number: int) -> Run:
    state = np.zeros(found.fit.states[0].shape[1])
    given = {"record": number, "first": 0, "substeps": bench.substeps}
    return free_run(found.shot, found.fit.theta, u, bench.blocks[0].ramps, float(record.dt), state, **given)


def _told(rival: Refit, bench: Bench, predicted: Record, run: Run, number: int) -> float:
    length = bench.blocks[0].y.shape[1] - bench.blocks[0].lead
    blocks = blocks_of(bench.model, [predicted], [bench.noises[number]], length)
    own = len(bench.still)
    starts = [np.clip(np.asarray(b.first), 0, len(run.states) - 1) for b in blocks]
    states = tuple(
        np.where((np.asarray(b.first) >= 0)[:, None], run.states[at, :own], 0.0)
        for b, at in zip(blocks, starts, strict=True)
    )
    shown = bench._replace(
        blocks=blocks, states=states, records=1, noises=(bench.noises[number],), moved=(bench.moved[number],)
    )
    fit = refitted(shown, rival.hypothesis, changes=changes_of(rival, bench), steps=STEPS).fit
    return 0.5 * fit.squares


def _sensor(one: Refit, other: Refit, bench: Bench, record: Record, number: int) -> tuple[str, float] | None:
    model = bench.model
    read = {s.body for s in model.sensors if s.kind == "displacement"}
    bare = [i for i, b in enumerate(model.bodies) if b not in read]
    if not bare:
        return None
    u = np.asarray(ordered_inputs(model, record)[0])
    first, second = (_run(x, bench, u, record, number).states[:, bare] for x in (one, other))
    part = np.sqrt(((first - second) ** 2).mean(axis=0) / np.maximum((first**2).mean(axis=0), 1e-300))
    best = int(np.argmax(part))
    return model.bodies[bare[best]], float(part[best])
