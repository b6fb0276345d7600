"""How far the gap shrinks on samples that nothing was chosen or fitted with."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float

from jaxsid.gap.fit import STEPS, Prior, fitted
from jaxsid.gap.free_run import Run, free_run
from jaxsid.gap.hypothesis import FIXED
from jaxsid.gap.noise import Noise
from jaxsid.gap.refit import FINER, FINEST, JUMP, UNRESOLVED, Bench, Refit, noise_part
from jaxsid.gap.resume import step
from jaxsid.gap.setting import LARGE
from jaxsid.gap.shooting import products_of
from jaxsid.gap.windows import Block, blocks_of
from jaxsid.mechanics.simulate import ordered_inputs
from jaxsid.records import Record

PIECES = 40  # that what is left is cut into for the interval
DRAWS = 2000  # of pieces
SPREAD = 16  # draws of a model's numbers
MIDDLE = 0.6745  # of what is normally distributed half lies within so many deviations
ROUNDS = 8  # of the search for initial states
CLEAR = 1.5  # a gap over the noise floor from which on more than noise is left
UNSURE = 2.0  # deviations of a run over unseen samples, for what is not known of the numbers
LOUDER = 1.03  # noise of those, next to that of the samples seen, that tells nothing against a law
SHOWN = 0.25  # power of a gap next to that of noise, from which on samples show it


class Left(NamedTuple):
    """What a model leaves of held-out samples.

    Attributes:
        left: (samples, outputs) of every record, NaN for absent sensors.
        measured: likewise.
        windows: of every record the seconds after which the model begins anew, from the state that suits it; none where
            it runs on.
    """

    left: tuple[Float[np.ndarray, "samples outputs"], ...]
    measured: tuple[Float[np.ndarray, "samples outputs"], ...]
    windows: tuple[float, ...] = ()


class Closure(NamedTuple):
    """How far the gap shrinks, all of it on held-out samples.

    Attributes:
        before, recalibrated, after: NRMSE of the nominal model, of the best linear one, of the chosen one.
        noise_floor: that of noise alone.
        fraction: of the nominal model's gap that is gone, 1 - sqrt((a^2 - n^2) / (b^2 - n^2)).
        ci95: interval of that.
        against_recalibrated: the fraction of the best linear model's gap.
        by_sensor: NRMSE of the chosen model.
        noise_by_sensor: that of noise alone.
        unsure: NRMSE that the deviations of the chosen model's numbers alone would give; 0 where nobody asked.
    """

    before: float
    recalibrated: float
    after: float
    noise_floor: float
    fraction: float
    ci95: tuple[float, float]
    against_recalibrated: float
    by_sensor: dict[str, float]
    noise_by_sensor: dict[str, float]
    unsure: float = 0.0

    @property
    def accounted(self) -> float:
        """What noise and numbers as far off as they may be leave together."""
        return math.hypot(LOUDER * self.noise_floor, UNSURE * self.unsure)

    def as_dict(self) -> dict[str, Any]:
        """As in diagnosis.json."""
        return {
            "heldout_before": self.before,
            "heldout_recalibrated": self.recalibrated,
            "heldout_after": self.after,
            "noise_floor": self.noise_floor,
            "fraction": self.fraction,
            "ci95": list(self.ci95),
            "against_recalibrated": self.against_recalibrated,
            "by_sensor": self.by_sensor,
            "noise_by_sensor": self.noise_by_sensor,
        }


def substantial(gap: float, floor: float) -> bool:
    """Whether a gap is clearly more than noise.

    Args:
        gap: NRMSE.
        floor: that of noise alone.
    """
    return gap > CLEAR * floor


def shown(closure: Closure) -> bool:
    """Whether held-out samples show the nominal model's gap at all, so that they can tell how much of it is gone.

    A sweep may end where a law does nothing, or noise may be louder than what it does there.

    Args:
        closure: on those samples.
    """
    return closure.before**2 > (1 + SHOWN) * closure.noise_floor**2


@step
def left_of(
    found: Refit,
    bench: Bench,
    records: Sequence[Record],
    ends: Sequence[int],
    *,
    windowed: bool,
    motions: Sequence[Float[np.ndarray, "samples n"]] | None = None,
) -> Left:
    """What a fitted model leaves of held-out samples, running on from the last state that was fitted before them.

    Args:
        found: model.
        bench: that it was fitted to.
        records: whole.
        ends: samples of each that were seen.
        windowed: whether every window begins anew from the state that suits it, for models that drift away.
        motions: of whole records, that windows of a few samples are searched from, each leading to the next as far as
            noise lets it.
    """
    blocks = blocks_of(bench.model, records, bench.noises, _length(bench), ends)
    left, measured = [], []
    for number, (record, first) in enumerate(zip(records, ends, strict=True)):
        own = [b for b in blocks if int(b.record[0]) == number]
        count = len(record.y) - first
        y = np.concatenate([_judged(b, b.y) for b in own])[:count]
        seen = np.concatenate([_judged(b, b.weight) for b in own])[:count] > 0
        motion = None if motions is None else motions[number]
        rest = _resolved(found, bench, _Held(record, number, y, own, windowed, motion))
        mask = np.where(seen, 0.0, np.nan)
        left.append(rest + mask)
        measured.append(y + mask)
    windows = tuple(_length(bench) * float(r.dt) for r in records) if windowed else ()
    return Left(tuple(left), tuple(measured), windows)


def left_before(found: Refit, bench: Bench) -> Left:
    """Likewise of the samples that a model was fitted to, window by window.

    Args:
        found: model.
        bench: that it was fitted to.
    """
    left: list[list[np.ndarray]] = [[] for _ in range(bench.records)]
    measured: list[list[np.ndarray]] = [[] for _ in range(bench.records)]
    for b, x in zip(bench.blocks, _left(found, bench, bench.blocks, found.fit.states), strict=True):
        mask = np.where(_judged(b, b.weight) > 0, 0.0, np.nan)
        left[int(b.record[0])].append(_judged(b, x) + mask)
        measured[int(b.record[0])].append(_judged(b, b.y) + mask)
    windows = tuple(_length(bench) * m.dt for m in bench.moved)
    return Left(tuple(map(np.concatenate, left)), tuple(map(np.concatenate, measured)), windows)


def spread_of(found: Refit, bench: Bench, records: Sequence[Record], left: Left, seed: int = 0) -> Left:
    """How far runs over held-out samples part for numbers that are known no better: a deviation at each sample.

    Args:
        found: model.
        bench: that it was fitted to.
        records: whole.
        left: what the model leaves of the samples, running on.
        seed: of the numbers drawn, from the normal distribution of the fit.
    """
    size, turned = np.linalg.eigh(found.fit.covariance)
    drawn = np.random.default_rng(seed).standard_normal((SPREAD, len(size)))
    every = found.fit.theta + drawn * np.sqrt(np.maximum(size, 0.0)) @ turned.T

    def run(theta: np.ndarray, number: int) -> np.ndarray:
        drawn = found._replace(fit=found.fit._replace(theta=theta))
        return _run_on(drawn, bench, records[number], number)[0].outputs[-len(left.left[number]) :]

    spread = []
    for number, rest in enumerate(left.left):
        own = run(found.fit.theta, number)
        parted = np.abs([run(theta, number) - own for theta in every])
        # by the middle one, since a number drawn may make a run grow without bound; where most do nothing is known
        middle = np.median(np.where(np.isfinite(parted), parted, np.inf), axis=0) / MIDDLE
        spread.append(np.where(np.isfinite(middle), middle, 0.0) + 0 * rest)
    return left._replace(left=tuple(spread))


class _Held(NamedTuple):
    """A record's held-out samples: their readings, their windows, whether these begin anew, and from which motion."""

    record: Record
    number: int
    y: Float[np.ndarray, "samples outputs"]
    blocks: Sequence[Block]
    windowed: bool
    motion: Float[np.ndarray, "samples n"] | None


def _resolved(found: Refit, bench: Bench, held: _Held) -> Float[np.ndarray, "samples outputs"]:
    """What is left of held-out samples, with steps so short that none of it is theirs: motion may be quicker there."""
    while True:
        rest, again = _held_out(found, bench, held)
        finer = bench._replace(substeps=min(FINER * bench.substeps, FINEST))
        if found.hypothesis.linear or finer.substeps == bench.substeps:
            return rest
        if (_rms(again(finer) - rest) <= UNRESOLVED * _rms(rest)).all():
            return rest
        bench = finer


def _held_out(
    found: Refit, bench: Bench, held: _Held
) -> tuple[Float[np.ndarray, "samples outputs"], Callable[[Bench], Float[np.ndarray, "samples outputs"]]]:
    """What is left, and what is with steps of another length and all else the same."""

    def run_on(at: Bench) -> tuple[Run, int]:
        return _run_on(found, at, held.record, held.number)

    def beyond(run: Run) -> np.ndarray:
        return run.outputs[len(run.outputs) - len(held.y) :] - held.y

    if not held.windowed:
        return beyond(run_on(bench)[0]), lambda at: beyond(run_on(at)[0])
    run, start = run_on(bench)
    near = (run.states, start) if held.motion is None else (held.motion, 0)
    states = _states(found, bench, held.blocks, *near)

    def in_windows(at: Bench) -> np.ndarray:
        each = zip(held.blocks, _left(found, at, held.blocks, states), strict=True)
        return np.concatenate([_judged(b, x) for b, x in each])[: len(held.y)]

    return in_windows(bench), in_windows


def _rms(x: Float[np.ndarray, "samples outputs"]) -> Float[np.ndarray, " outputs"]:
    return np.sqrt((x**2).mean(axis=0))


def _length(bench: Bench) -> int:
    return bench.blocks[0].y.shape[1] - bench.blocks[0].lead


def _judged(block: Block, x: Array | np.ndarray) -> np.ndarray:
    return np.asarray(x)[:, block.lead :].reshape(-1, x.shape[2])


def _run_on(found: Refit, bench: Bench, record: Record, number: int) -> tuple[Run, int]:
    """The motion from the last window that was fitted to the record's end, and the number of its first sample."""
    shares = {
        (i, row): float(share)
        for i, b in enumerate(bench.blocks)
        if int(b.record[0]) == number
        for row, share in enumerate((np.asarray(b.weight)[:, b.lead :] > 0).any(axis=2).mean(axis=1))
    }
    # of a last window with few samples the state is hardly known
    i, last = max(at for at, share in shares.items() if share >= 0.5 * max(shares.values()))
    block = bench.blocks[i]
    u, first = np.asarray(ordered_inputs(bench.model, record)[0]), int(block.first[last])
    given = {"record": number, "first": first, "substeps": bench.substeps}
    state = found.fit.states[i][last]
    return free_run(found.shot, found.fit.theta, u, block.ramps, float(record.dt), state, **given), first


def _states(
    found: Refit, bench: Bench, blocks: Sequence[Block], motion: np.ndarray, start: int
) -> tuple[np.ndarray, ...]:
    """Initial states of windows near a motion that is given from a sample on, all else as it is."""
    theta, followed = found.fit.theta, np.isfinite(bench.loose)
    same = np.full(len(theta), FIXED)
    states = bench.state_deviations(found.hypothesis.effects)
    least, most = np.full(len(theta), -np.inf), np.ones(len(theta))
    jump = JUMP * noise_part(bench) * states / LARGE if followed else np.full(len(states), np.inf)
    prior = Prior(same, theta, least, most, states, states, jump)
    begin = [motion[np.clip(np.asarray(b.first) - start, 0, len(motion) - 1)] for b in blocks]
    begin = [np.pad(x, ((0, 0), (0, len(states) - x.shape[1]))) for x in begin]
    steps = STEPS if followed else ROUNDS
    fit = fitted(found.shot, blocks, prior, theta, begin, substeps=bench.substeps, steps=steps)
    return fit.states


def _left(
    found: Refit, bench: Bench, blocks: Sequence[Block], states: Sequence[np.ndarray]
) -> list[np.ndarray]:
    shot, theta = found.shot, found.fit.theta
    return [np.asarray(x.left) for x in products_of(shot, blocks, theta, states, bench.substeps)]


def closure_of(
    nominal: Left,
    recalibrated: Left,
    after: Left,
    noises: Sequence[Noise],
    names: Sequence[str],
    seed: int = 0,
    spread: Left | None = None,
) -> Closure:
    """The closure and its interval, by drawing pieces of the held-out samples.

    Args:
        nominal, recalibrated, after: what the three models leave.
        noises: of each record.
        names: of the sensors.
        seed: of the draws.
        spread: how far runs part for numbers that are known no better.

    Source: H. Kunsch, Ann. Statist. 17 (1989), for drawing pieces rather than samples.
    """
    parts = [_by_piece(x) for x in (nominal, recalibrated, after)]
    size = _by_piece(Left(nominal.measured, nominal.measured), centred=True)
    counts = _by_piece(Left(tuple(1.0 + 0 * x for x in nominal.measured), nominal.measured))
    level = np.concatenate([np.tile(n.rms() ** 2, (PIECES, 1)) for n in noises])
    floor = np.where(counts > 0, counts * np.nan_to_num(level), 0.0)
    every = np.arange(len(size))

    def relative(x: np.ndarray, rows: np.ndarray) -> np.ndarray:
        whole = size[rows].sum(axis=0)
        return np.sqrt(x[rows].sum(axis=0) / np.where(whole > 0, whole, np.nan))

    pooled = lambda x, rows: float(np.sqrt(np.nanmean(relative(x, rows) ** 2)))  # noqa: E731
    b, r, a = (pooled(x, every) for x in parts)
    n = pooled(floor, every)
    rng = np.random.default_rng(seed)
    draws = []
    for _ in range(DRAWS):
        rows = rng.integers(0, len(every), len(every))
        draws.append(fraction(pooled(parts[0], rows), pooled(parts[2], rows), pooled(floor, rows)))
    low, high = np.quantile(draws, [0.025, 0.975])
    return Closure(
        b,
        r,
        a,
        n,
        fraction(b, a, n),
        (float(low), float(high)),
        fraction(r, a, n),
        dict(zip(names, relative(parts[2], every).tolist(), strict=True)),
        dict(zip(names, relative(floor, every).tolist(), strict=True)),
        0.0 if spread is None else pooled(_by_piece(spread), every),
    )


def fraction(before: float, after: float, floor: float) -> float:
    """Part of a gap that is gone, 1 - sqrt((a^2 - n^2) / (b^2 - n^2)), from 0 to 1; 0 where there was none."""
    whole = before**2 - floor**2
    if whole <= 0:
        return 0.0
    return float(np.clip(1 - np.sqrt(max(after**2 - floor**2, 0.0) / whole), 0.0, 1.0))


def _by_piece(x: Left, *, centred: bool = False) -> np.ndarray:
    """(records * pieces, outputs) sums of squares."""
    found = []
    for left in x.left:
        mean = np.nansum(left, axis=0) / np.maximum(np.isfinite(left).sum(axis=0), 1)
        values = left - mean if centred else left
        found += [np.nansum(part**2, axis=0) for part in np.array_split(values, PIECES)]
    return np.array(found)
