"""How far the gap shrinks on samples that nothing was chosen or fitted with."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsid.gap.free_run import free_run
from jaxsid.gap.noise import Noise
from jaxsid.gap.refit import FIXED, Bench, Refit
from jaxsid.gap.shooting import Prior, fitted, products
from jaxsid.gap.windows import Block, blocks_of
from jaxsid.mechanics.simulate import ordered_inputs
from jaxsid.records import Record

HELD_OUT = 0.25  # part of the end of every record that nothing is fitted to
PIECES = 40  # that what is left is cut into for the interval
DRAWS = 2000  # of pieces
ROUNDS = 8  # of the search for initial states


class Left(NamedTuple):
    """What a model leaves of held-out samples.

    Attributes:
        left: (samples, outputs) of every record, NaN for absent sensors.
        measured: likewise.
    """

    left: tuple[Float[np.ndarray, "samples outputs"], ...]
    measured: tuple[Float[np.ndarray, "samples outputs"], ...]


class Closure(NamedTuple):
    """How far the gap shrinks, all of it on held-out samples.

    Attributes:
        before, recalibrated, after: NRMSE of the nominal model, of the best linear one, of the chosen one.
        noise_floor: that of noise alone.
        fraction: of the nominal model's gap that is gone, 1 - sqrt((a^2 - n^2) / (b^2 - n^2)).
        ci95: interval of that.
        against_recalibrated: the fraction of the best linear model's gap.
        by_sensor: NRMSE of the chosen model.
    """

    before: float
    recalibrated: float
    after: float
    noise_floor: float
    fraction: float
    ci95: tuple[float, float]
    against_recalibrated: float
    by_sensor: dict[str, float]

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
        }


def held_out_begin(record: Record) -> int:
    """The first sample of a record that is held out."""
    return round((1 - HELD_OUT) * len(record.y))


def seen_part(record: Record) -> Record:
    """A record without its held-out end."""
    end = held_out_begin(record)
    return Record(
        record.u[:end],
        record.y[:end],
        record.dt,
        inputs=record.inputs,
        outputs=record.outputs,
        hold=record.hold,
        name=record.name,
    )


def left_of(
    found: Refit, bench: Bench, records: Sequence[Record], noises: Sequence[Noise], *, windowed: bool
) -> Left:
    """What a fitted model leaves of held-out samples, its initial state there found from their beginning.

    Args:
        found: model.
        bench: that it was fitted to.
        records: whole.
        noises: of each.
        windowed: whether every window begins anew, for models that drift away.
    """
    begin = [held_out_begin(r) for r in records]
    length = bench.blocks[0].y.shape[1] - bench.blocks[0].lead
    blocks = blocks_of(bench.model, records, noises, length, begin)
    states = _states(found, bench, blocks)
    left, measured = [], []
    for number, (record, first) in enumerate(zip(records, begin, strict=True)):
        own = [i for i, b in enumerate(blocks) if int(b.record[0]) == number]
        y = np.concatenate([_judged(blocks[i], np.asarray(blocks[i].y)) for i in own])
        seen = np.concatenate([_judged(blocks[i], np.asarray(blocks[i].weight)) for i in own]) > 0
        if windowed:
            rest = np.concatenate(
                [_judged(blocks[i], _left(found, blocks[i], states[i], bench.substeps)) for i in own]
            )
        else:
            rest = (
                _run(found, bench, blocks[own[0]], states[own[0]][0], record, number, first)
                - y[: len(record.y) - first]
            )
        count = len(record.y) - first
        mask = np.where(seen[:count], 0.0, np.nan)
        left.append(rest[:count] + mask)
        measured.append(y[:count] + mask)
    return Left(tuple(left), tuple(measured))


def _states(found: Refit, bench: Bench, blocks: Sequence[Block]) -> list[np.ndarray]:
    """Initial states of windows, all else as it is."""
    theta = found.fit.theta
    n = found.fit.states[0].shape[1]
    size = len(bench.still) // 2
    hidden = np.repeat([bench.still[:size].max(), bench.still[size:].max()], found.shot.slots.count)
    same = np.full(len(theta), FIXED)
    prior = Prior(
        same, theta, np.full(len(theta), -np.inf), np.ones(len(theta)), np.concatenate([bench.still, hidden])
    )
    nothing = [np.zeros((len(b.y), n)) for b in blocks]
    fit = fitted(found.shot, blocks, prior, theta, nothing, substeps=bench.substeps, steps=ROUNDS)
    return list(fit.states)


def _left(found: Refit, block: Block, states: np.ndarray, substeps: int) -> np.ndarray:
    import jax.numpy as jnp

    given = jnp.asarray(found.fit.theta), jnp.asarray(states), jnp.asarray(substeps)
    return np.asarray(products(found.shot, block, *given).left)


def _judged(block: Block, x: np.ndarray) -> np.ndarray:
    return x[:, block.lead :].reshape(-1, x.shape[2])


def _run(
    found: Refit, bench: Bench, block: Block, state: np.ndarray, record: Record, number: int, first: int
) -> np.ndarray:
    u = np.asarray(ordered_inputs(bench.model, record)[0])
    begin = int(block.first[0])
    given = {"record": number, "first": begin, "substeps": bench.substeps}
    outputs = free_run(found.shot, found.fit.theta, u, block.ramps, float(record.dt), state, **given)
    return outputs[first - begin :]


def closure_of(
    nominal: Left,
    recalibrated: Left,
    after: Left,
    noises: Sequence[Noise],
    names: Sequence[str],
    seed: int = 0,
) -> Closure:
    """The closure and its interval, by drawing pieces of the held-out samples.

    Args:
        nominal, recalibrated, after: what the three models leave.
        noises: of each record.
        names: of the sensors.
        seed: of the draws.

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
    each = relative(parts[2], every)
    return Closure(
        b,
        r,
        a,
        n,
        fraction(b, a, n),
        (float(low), float(high)),
        fraction(r, a, n),
        dict(zip(names, each.tolist(), strict=True)),
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
