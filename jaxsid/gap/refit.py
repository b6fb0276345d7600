"""Hypotheses of what a model lacks, fitted to records by simulation: effects, wrong numbers, or neither."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxsid.gap.fit import GAIN, STEPS, Fit, Prior, fitted, newton_step
from jaxsid.gap.hypothesis import (
    FIXED,
    Moved,
    amplitudes_of,
    coordinates_of,
    effect_slots,
    parameter_rows,
    shifts_of,
    upright,
    with_parameters,
)
from jaxsid.gap.noise import Noise, residual_noise
from jaxsid.gap.numbers import LEAST_CHANGE
from jaxsid.gap.recalibrate import WIDE, Recalibrated
from jaxsid.gap.resume import step
from jaxsid.gap.setting import LARGE, element_directions, slowest_rate
from jaxsid.gap.shooting import Products, Shot, products_of, told_parameters
from jaxsid.gap.spectra import in_time
from jaxsid.gap.windows import SHORTEST, Block, blocks_of, window_length
from jaxsid.mechanics.effects.catalogue import law_of, sort_of
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.lumped import Effect, LumpedModel, free_bodies, second_order, with_effects
from jaxsid.mechanics.simulate import ordered_inputs
from jaxsid.physical.elements import element_matrices, with_values
from jaxsid.records import Record

MOST_ELEMENT = 0.3  # largest relative change of an element in a step
MOST_UNKNOWN = 2.0  # of an unknown of an effect
FARTHEST = 4.0  # deviations of its prior that the size of a law lies off
BEFORE = 3.0  # times what states usually are, of those before a record's start
JUMP = 0.02  # of the noise next to the signal: far less than a window tells of its states
STEPS_A_PERIOD = 20.0  # of the quickest vibration
MOST_SUBSTEPS = 8
FINER, FINEST = 4, 32  # times as many where a law needs them, and the most there are
UNRESOLVED = (
    0.05  # rms of what shorter steps change, in noise or next to what is left, from which on they are needed
)


class Bench(NamedTuple):
    """Records, cut and weighed, that hypotheses are fitted to.

    Attributes:
        model: nominal, without effects.
        blocks: of windows.
        states: of every block (windows, 2 N, then those of effects found), to begin with: at first those of the best
            linear model.
        moved: how the bodies move in every record.
        tolerance: (e,) standard deviations of the elements' relative changes.
        wide: (e,) likewise, of elements that are wrong.
        still: (2 N,) standard deviations of initial states, far above what they are.
        records: how many there are.
        substeps: steps for each sampling interval; see `resolved`.
        noises: of each record, that the blocks are weighed by.
        guesses: what they were to begin with.
        jump: of a state from where a window ends to where the next begins, next to how large states are; infinite where
            each stands alone.
        loose: with which a search begins; finite only where windows are too short to stand alone, see `closely`.
    """

    model: LumpedModel
    blocks: tuple[Block, ...]
    states: tuple[Float[np.ndarray, "windows n"], ...]
    moved: tuple[Moved, ...]
    tolerance: Float[np.ndarray, " e"]
    wide: Float[np.ndarray, " e"]
    still: Float[np.ndarray, " n"]
    records: int
    substeps: int
    noises: tuple[Noise, ...]
    guesses: tuple[Noise, ...]
    jump: float = np.inf
    loose: float = np.inf

    def state_deviations(self, effects: Sequence[Effect]) -> Float[np.ndarray, " m"]:
        """Of all states at the start of a window; an effect's own is about as large as what moves, or is read, there.

        Args:
            effects: each with a displacement and a velocity of its own, or with what its signal was; one where there
                is none.
        """
        size = len(self.still) // 2
        bodies = [self.still[:size].max(), self.still[size:].max()]
        own = np.array([self._signal_deviation(e) or bodies for e in effects] or [bodies])
        return np.concatenate([self.still, own.T.ravel()])

    def _signal_deviation(self, effect: Effect) -> list[float]:
        """Of the state of a late signal; nothing of what acts on bodies."""
        ((where, name),) = effect.place
        listed = {"input": self.model.inputs, "sensor": self.model.sensors}.get(where, ())
        column = [x.name for x in listed].index(name) if listed else 0
        of = [m.u if where == "input" else m.y for m in self.moved]
        values = np.concatenate([x[:, column] for x in of])
        level = float(np.sqrt(np.mean(values[np.isfinite(values)] ** 2)))
        return [LARGE * max(level, np.finfo(float).tiny)] * 2 if listed else []


class Hypothesis(NamedTuple):
    """What may be the matter.

    Attributes:
        effects: that the model lacks, with parameters to begin with.
        wrong: numbers of elements that may be far off.
    """

    effects: tuple[Effect, ...] = ()
    wrong: tuple[int, ...] = ()

    @property
    def linear(self) -> bool:
        """Whether no effect is more than a change of the linear model or of what enters and leaves it."""
        return all(sort_of(law_of(e.kind, e.parameters)) == "linear" for e in self.effects)


class Refit(NamedTuple):
    """A fitted hypothesis.

    Attributes:
        hypothesis: its effects with fitted parameters, those of the first record.
        fit: unknowns and how well they fit.
        model: with the fitted numbers and effects.
        deviations: of each effect's parameters, by name.
        shot: as it was simulated.
    """

    hypothesis: Hypothesis
    fit: Fit
    model: LumpedModel
    deviations: tuple[dict[str, float], ...]
    shot: Shot


def changes_of(found: Refit, bench: Bench) -> Float[np.ndarray, " e"]:
    """Relative changes of the elements.

    Args:
        found: a fit.
        bench: that it was fitted to.
    """
    return found.fit.theta[: len(bench.tolerance)]


def bench_of(
    model: LumpedModel,
    records: Sequence[Record],
    noises: Sequence[Noise],
    refit: Recalibrated,
    *,
    length: int | None = None,
) -> Bench:
    """Records ready for fits.

    Args:
        model: nominal; its effects are left out.
        records: with some of its sensors each.
        noises: of each.
        refit: the best linear model beside the records.
        length: samples that a window judges; a few periods of the slowest vibration where left out.
    """
    model = with_effects(model, ())
    dt = min(float(r.dt) for r in records)
    longest = max(len(r.y) for r in records)
    # small disturbing forces drive a free axis away from any long simulation
    free = free_bodies(model).shape[1] > 0
    usual = SHORTEST if free else window_length(slowest_rate(model), dt, longest)
    length = usual if length is None else length
    blocks = blocks_of(model, records, noises, length)
    motions = [
        np.asarray(in_time(s.spectra, x.motion.states))
        for s, x in zip(refit.settings, refit.linear, strict=True)
    ]
    size = len(model.bodies)
    moved = []
    for record, motion, setting in zip(records, motions, refit.settings, strict=True):
        present = np.asarray(setting.spectra.present) > 0
        y = np.where(present, np.asarray(in_time(setting.spectra, setting.spectra.y)), np.nan)
        u = np.asarray(ordered_inputs(model, record)[0])
        moved.append(Moved(motion[:, :size], motion[:, size:], u, y, float(record.dt)))
    listed = element_matrices(model).listed
    nominal = np.asarray(element_matrices(model).nominal)
    near, far = (
        np.where(nominal != 0, [of[x.quantity] for x in listed], FIXED)
        for of in (model.tolerance._asdict(), WIDE)
    )
    still = np.sqrt(np.mean([(m**2).mean(axis=0) for m in motions], axis=0))
    half = np.repeat([still[:size].max(), still[size:].max()], size)
    return Bench(
        model,
        blocks,
        states_at(blocks, motions),
        tuple(moved),
        np.maximum(near, FIXED),
        far,
        LARGE * np.maximum(half, np.finfo(float).tiny),
        len(records),
        _substeps(model, max(float(r.dt) for r in records)),
        tuple(noises),
        tuple(noises),
    )


def _substeps(model: LumpedModel, dt: float) -> int:
    """Enough for a law that acts as quickly as the model vibrates where it can be seen to."""
    plain = physical_displacement_velocity(second_order(model))
    rates = np.abs(np.linalg.eigvals(np.asarray(plain.A)).imag)
    quickest = min(float(rates.max(initial=0.0)), np.pi / dt)
    return int(np.clip(np.ceil(STEPS_A_PERIOD * quickest * dt / (2 * np.pi)), 1, MOST_SUBSTEPS))


def weighed_anew(bench: Bench, found: Refit) -> Bench:
    """The bench with level and colour of the noise from what a fit leaves, where nothing else tells of it.

    Windows of few samples take up part of the noise themselves and tell nothing of it, nor does a motion that grows
    without bound.

    Args:
        bench: records.
        found: a fit to all of it.
    """
    if np.isfinite(bench.loose) or not np.isfinite(found.fit.evidence):
        return bench
    lefts = [np.asarray(x.left) for x in in_windows(bench, found)]
    noises = list(bench.noises)
    for number, noise in enumerate(bench.noises):
        own = [i for i, b in enumerate(bench.blocks) if int(b.record[0]) == number]
        seen = np.concatenate([_seen(bench.blocks[i]) for i in own])
        left = np.concatenate([lefts[i][:, bench.blocks[i].lead :] for i in own])
        whole = np.all(seen.any(axis=2), -1)
        if noise.degrees <= 0 and whole.sum() > 0:
            noises[number] = residual_noise(np.where(seen.any(axis=(0, 1)), left, np.nan)[whole])
    return _weighed(bench, noises)


def as_guessed(bench: Bench) -> Bench:
    """The bench with the noise as it was guessed to begin with, where nothing else tells of it, and windows loose.

    What a fit leaves may be more than noise; a search that begins there does not find what that is.

    Args:
        bench: records.
    """
    if all(n.degrees > 0 for n in bench.noises):
        return bench._replace(jump=bench.loose) if np.isfinite(bench.loose) else bench
    return _weighed(bench, bench.guesses)._replace(jump=bench.loose)


def _seen(block: Block) -> Bool[np.ndarray, "windows length outputs"]:
    return np.asarray(block.weight)[:, block.lead :] > 0


def _weighed(bench: Bench, noises: Sequence[Noise]) -> Bench:
    blocks = []
    for b in bench.blocks:
        noise = noises[int(b.record[0])]
        known = np.isfinite(noise.level) & (noise.level > 0)
        inverse = jnp.asarray(np.where(known, 1 / np.where(known, noise.level, 1.0), 0.0))
        taps = jnp.broadcast_to(jnp.asarray(noise.taps), (*b.taps.shape[:2], noise.taps.shape[1]))
        blocks.append(eqx.tree_at(lambda x: (x.weight, x.taps), b, ((b.weight > 0) * inverse, taps)))
    return bench._replace(blocks=tuple(blocks), noises=tuple(noises))


def noise_part(bench: Bench) -> float:
    """How large the noise is next to the signals, geometric mean over sensors.

    Args:
        bench: records.
    """
    shown = np.concatenate(
        [(np.asarray(b.y) * np.asarray(b.weight)).reshape(-1, b.y.shape[2]) for b in bench.blocks]
    )
    seen = (shown != 0).any(axis=0)
    shown = np.where(shown != 0, shown, np.nan)[:, seen]
    return float(1 / np.exp(np.log(np.nanstd(shown, axis=0)).mean()))


def tied(bench: Bench, found: Refit, *, steps: int, gain: float = GAIN) -> tuple[Bench, Refit]:
    """Each window leading to the next, if the evidence of a fit is the larger for it; else both as they are.

    Windows that stand alone forgive what a model gets wrong slowly, near a resonance above all. Where the model drifts
    away from records, on a free axis or with an effect still to be found, they are all that can be compared.

    Args:
        bench: records.
        found: a fit to all of it.
        steps: most evaluations.
        gain: of the search, below which it has come to an end.
    """
    if np.isfinite(bench.jump):
        return bench, found
    chained = bench._replace(jump=JUMP * noise_part(bench))
    begin = {"changes": changes_of(found, bench), "states": found.fit.states}
    new = refitted(chained, found.hypothesis, **begin, steps=steps, gain=gain)
    return (chained, new) if new.fit.evidence > found.fit.evidence else (bench, found)


def in_windows(bench: Bench, found: Refit) -> list[Products]:
    """What a fit leaves of every block, and the forces there.

    Args:
        bench: that it was fitted to.
        found: the fit.
    """
    return products_of(found.shot, bench.blocks, found.fit.theta, found.fit.states, bench.substeps)


def resolved(bench: Bench, found: Refit, *, shift: float = np.inf) -> Bench:
    """The bench with steps so short that the kinks of a law are not missed by more than hides in what is left.

    Many samples together tell more than each: what no sample shows may be far more than the deviation of a number.

    Args:
        bench: records.
        found: a fit to all of it.
        shift: of an unknown, in its deviations, from which on shorter steps are needed too.
    """
    left = _in_noise(bench, found)
    while bench.substeps < FINEST and np.isfinite(left).all():
        finer = bench._replace(substeps=min(FINER * bench.substeps, FINEST))
        now = _in_noise(finer, found)
        missed = np.sqrt(((now - left) ** 2).mean()) > UNRESOLVED * max(1.0, np.sqrt((left**2).mean()))
        if not missed and not (np.isfinite(shift) and _shift(bench, finer, found) > shift):
            return bench
        bench, left = finer, now
    return bench


def _shift(bench: Bench, finer: Bench, found: Refit) -> float:
    """How far an unknown of a fit lies off for the length of its steps, in deviations; of the one farthest off."""
    prior, fit = prior_of(bench, found.hypothesis, found.shot), found.fit
    at = found.shot, bench.blocks, prior, fit.theta, fit.states
    own, other = (newton_step(*at, substeps=b.substeps) for b in (bench, finer))
    return float((np.abs(other - own) / np.sqrt(np.diag(fit.covariance))).max())


def _in_noise(bench: Bench, found: Refit) -> Float[np.ndarray, " values"]:
    """What a fit leaves of all that is judged."""
    parts = zip(bench.blocks, in_windows(bench, found), strict=True)
    each = [(np.asarray(x.left) * np.asarray(b.weight))[:, b.lead :][_seen(b)] for b, x in parts]
    return np.concatenate([np.zeros(0), *each])


def states_without(found: Refit, row: int) -> tuple[Float[np.ndarray, "windows n"], ...]:
    """States of every block of a fit, without those of one effect.

    Args:
        found: the fit.
        row: number of the effect.
    """
    slots = found.shot.slots.count
    kept = [i for i in range(slots) if i != row]
    parts = ((s[:, : -2 * slots], s[:, -2 * slots :].reshape(len(s), 2, slots)) for s in found.fit.states)
    return tuple(
        np.concatenate([plain, own[:, :, kept].reshape(len(own), -1)], axis=1) for plain, own in parts
    )


def _with_own(states: np.ndarray, plain: int, slots: int) -> np.ndarray:
    """States with room for those of so many effects, displacements then velocities; further ones begin at rest."""
    own = states[:, plain:].reshape(len(states), 2, -1)[:, :, :slots]
    own = np.pad(own, ((0, 0), (0, 0), (0, slots - own.shape[2])))
    return np.concatenate([states[:, :plain], own.reshape(len(states), -1)], axis=1)


def states_at(
    blocks: Sequence[Block], motions: Sequence[Float[np.ndarray, "samples n"]]
) -> tuple[Float[np.ndarray, "windows n"], ...]:
    """States where windows begin, zero before a record does.

    Args:
        blocks: of windows.
        motions: displacements and velocities in every record.
    """
    found = []
    for block in blocks:
        motion, at = motions[int(block.record[0])], np.asarray(block.first)
        found.append(np.where((at >= 0)[:, None], motion[np.clip(at, 0, len(motion) - 1)], 0.0))
    return tuple(found)


@step
def refitted(
    bench: Bench,
    hypothesis: Hypothesis,
    *,
    changes: Float[np.ndarray, " e"] | None = None,
    states: Sequence[np.ndarray] | None = None,
    steps: int = STEPS,
    gain: float = GAIN,
) -> Refit:
    """A hypothesis fitted to a bench.

    Args:
        bench: records.
        hypothesis: effects with parameters to begin with.
        changes: of elements to begin with; none where left out.
        states: of every block, hidden ones too, to begin with; else those of the bench.
        steps: most evaluations.
        gain: of the search, below which it has come to an end.
    """
    effects = hypothesis.effects
    shot = shot_of(bench, effects)
    slots = shot.slots
    z = shot.coordinates.unknowns(parameter_rows(effects))
    prior = prior_of(bench, hypothesis, shot)
    start = np.zeros(len(bench.tolerance)) if changes is None else np.asarray(changes)
    theta = np.concatenate([start, z.ravel(), shifts_of(effects, bench.records)])
    plain = 2 * len(bench.model.bodies)
    given = [_with_own(s, plain, slots.count) for s in (bench.states if states is None else states)]
    # all but laws and what comes late between two samples is integrated exactly
    exact = hypothesis.linear and all(e.kind != "input_delay" for e in effects)
    count = 1 if exact else bench.substeps
    # what was there before holds; the last effect is what is new
    end = len(start) + z.size
    last = slice(end - z.shape[1], end)
    search = {"substeps": count, "steps": steps, "gain": gain, "eased": last}
    fit = fitted(shot, bench.blocks, prior, np.maximum(theta, prior.least), given, **search)
    return _concluded(bench, hypothesis, shot, fit)


def shot_of(bench: Bench, effects: tuple[Effect, ...]) -> Shot:
    """The model with effects, ready to be simulated.

    Args:
        bench: its records tell how the bodies move.
        effects: kinds and places.
    """
    linear, slots = second_order(bench.model), effect_slots(bench.model, effects)
    coordinates = coordinates_of(effects, amplitudes_of(linear, slots, bench.moved))
    return Shot(linear, element_directions(bench.model), slots, coordinates)


def prior_of(bench: Bench, hypothesis: Hypothesis, shot: Shot) -> Prior:
    """Normal priors; of the size of a law so wide that the one to begin with is no more than `FARTHEST` deviations off.

    What lies so far beyond what was likely beforehand tells of a scale that was wrong: it would be drawn back to it.
    """
    elements = bench.tolerance.copy()
    elements[list(hypothesis.wrong)] = bench.wide[list(hypothesis.wrong)]
    of = shot.coordinates
    begun = np.abs(of.unknowns(parameter_rows(hypothesis.effects)))
    sizes = (np.asarray(of.deviation) == 1.0) & ~np.asarray(of.logarithmic)
    large = np.where(sizes, np.maximum(begun / FARTHEST, 1.0), 1.0).ravel()
    own = np.asarray(of.deviation).ravel() * large
    each = np.asarray(shot.coordinates.per_record).any(axis=1)
    shifts = np.tile(np.where(each, np.pi, FIXED), bench.records - 1)
    deviation = np.concatenate([elements, own, shifts])
    least = np.concatenate(
        [
            np.full(len(elements), LEAST_CHANGE),
            shot.coordinates.least().ravel(),
            np.full(len(shifts), -np.inf),
        ]
    )
    most = np.full(len(deviation), MOST_UNKNOWN)
    most[: len(elements)] = MOST_ELEMENT
    most[len(elements) : len(elements) + len(large)] *= large
    states = bench.state_deviations(hypothesis.effects)
    usual = states / LARGE
    return Prior(deviation, np.zeros(len(deviation)), least, most, states, BEFORE * usual, bench.jump * usual)


def _concluded(bench: Bench, hypothesis: Hypothesis, shot: Shot, fit: Fit) -> Refit:
    elements, effects = len(bench.tolerance), hypothesis.effects
    theta = jnp.asarray(fit.theta)
    every, slopes = map(np.asarray, told_parameters(shot, theta, bench.records))
    rows = every[0]
    covariance = slopes @ fit.covariance @ slopes.T
    deviation = np.sqrt(np.maximum(np.diag(covariance), 0.0)).reshape(rows.shape)
    found, deviations = [], []
    for row, effect in enumerate(effects):
        kind = law_of(effect.kind, effect.parameters)
        names = [p.name for p in kind.parameters]
        own = np.asarray(shot.coordinates.per_record)[row]
        values = {
            n: every[:, row, i] if own[i] and bench.records > 1 else float(rows[row, i])
            for i, n in enumerate(names)
        }
        found.append(with_parameters(effect, upright(kind, values)))
        deviations.append({n: float(deviation[row, i]) for i, n in enumerate(names)})
    nominal = np.asarray(element_matrices(bench.model).nominal)
    model = with_values(bench.model, jnp.asarray(nominal * (1 + fit.theta[:elements])))
    model = with_effects(model, found)
    return Refit(Hypothesis(tuple(found), hypothesis.wrong), fit, model, tuple(deviations), shot)
