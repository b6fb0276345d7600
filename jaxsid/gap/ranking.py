"""How explanations are compared: by the evidence of their fits, as densities of the records in any noise."""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxsid.gap.refit import Bench, Refit, as_guessed
from jaxsid.gap.screen import Candidate
from jaxsid.mechanics.effects.catalogue import CATALOGUE, law_of
from jaxsid.mechanics.lumped import GROUND

WORTH = 6.0  # tempered gain of evidence from which on effects are taken
LESS = 0.1  # part of what is left above the noise that an effect must remove
SAME = 3.0  # tempered difference of evidence below which two are hardly told apart
STRAIGHT = 3.0  # log odds of springs and dampers over laws that hardly differ from them as they are
CLOSE = 40.0  # tempered difference of rough evidence beyond which a candidate is not fitted thoroughly
LOUD = 2.0  # rms in noise from which on what is left is none, whatever share of it tests find
PIECES = 30.0  # independent ones that what is left counts as, where it is no noise
NUMBER = 3.0  # log odds against each number of a law there
FEWER = 2  # laws of fewer numbers that are tried thoroughly where the best one acts
NEAR = 4.0  # times what the best one leaves, from which on none is
TOLD = 3.0  # deviations from zero from which on a number is known; right ones of the second test set have 11
# kinds that are a wrong number of the model
ERRORS = {"mass": "mass_error", "damping": "damping_error", "stiffness": "stiffness_error"}
RINGING = "periodic_disturbance"  # what a part that swings does if nothing damps it
Key = tuple[str, str, tuple[str, ...]]


class Explanation(NamedTuple):
    """One fitted candidate.

    Attributes:
        kind: of effect.
        place: as of an `Effect`.
        refit: fitted, with the effects found before.
        evidence: its logarithm, with noise of its own, up to what all of a round share.
        probability: of all that were tried.
        left: rms in the noise that the best one leaves.
    """

    kind: str
    place: dict[str, Any]
    refit: Refit
    evidence: float
    probability: float
    left: float

    @property
    def key(self) -> Key:
        return key_of(self.kind, self.place)

    @property
    def told(self) -> bool:
        """Whether any number of its law is told from zero; true of numbers of the model.

        A law of many numbers may take up what it does not describe: then none of them is known.
        """
        for effect, deviations in zip(self.refit.hypothesis.effects, self.refit.deviations, strict=True):
            if key_of(effect.kind, dict(effect.place)) == self.key:
                sizes = ((np.max(np.abs(v)), deviations[n]) for n, v in effect.parameters.items())
                return any(size > TOLD * deviation for size, deviation in sizes)
        return True


class Ranking(NamedTuple):
    """All candidates of a round, most probable first, and what the records say without any of them.

    Attributes:
        ranked: fitted ones.
        without: the model with what was found before, its numbers within their tolerance.
        scale: mean square in noise that the best one leaves.
        temperature: that differences of evidence are divided by, after the scale.
        bench: that they were fitted to, the noise that of the best one where nothing else tells of it.
    """

    ranked: tuple[Explanation, ...]
    without: Refit
    scale: float
    temperature: float
    bench: Bench

    @property
    def gain(self) -> float:
        """Tempered evidence of the best one over that of none of them; 0 where there is none whose fit holds."""
        best = self.ranked[0].evidence if self.ranked else -math.inf
        if not math.isfinite(best):
            return 0.0
        return (best - self.without.fit.evidence) / self.scale / self.temperature


def alike(x: Explanation, y: Explanation, of: Ranking) -> bool:
    """Whether records hardly tell two explanations apart.

    Args:
        x, y: explanations.
        of: the ranking that they are in.
    """
    return bool(abs(x.evidence - y.evidence) / of.scale / of.temperature < SAME)


def clearly(of: Ranking, other: Ranking) -> bool:
    """Whether the best one of a round explains more than the best one of another, each in noise of its own.

    Args:
        of: the round.
        other: of the same records, in windows as long.
    """
    if not other.ranked or not math.isfinite(other.ranked[0].evidence):
        return True
    mine, its = (r.ranked[0].evidence + volume(r.bench) for r in (of, other))
    return bool((mine - its) / of.scale / of.temperature > WORTH)


def key_of(kind: str, place: Mapping[str, Any]) -> Key:
    """Kind and place as one value to be compared; the order of two ends does not count."""
    ((where, ends),) = place.items()
    named = tuple(sorted(ends)) if where == "between" else (str(ends),)
    return kind, where, named


def ends_of(place: Mapping[str, Any]) -> tuple[str, ...]:
    """Where a place acts, as one value: a body's motion is that against the ground, and the order of ends is none.

    Args:
        place: as of an `Effect`.
    """
    ((where, ends),) = place.items()
    named = (GROUND, str(ends)) if where == "body" else (ends,) if isinstance(ends, str) else tuple(ends)
    return ("between" if where == "body" else where, *sorted(named))


class Whole(NamedTuple):
    """A fit to all records, and the bench of its own that it was fitted to."""

    bench: Bench
    refit: Refit


def density(bench: Bench, found: Refit) -> float:
    """Evidence as a density of the records, whatever the noise: log p(y) up to a constant.

    Args:
        bench: that the fit is of.
        found: the fit.
    """
    return value(found, bench) + volume(bench)


def volume(bench: Bench) -> float:
    """Logarithm of how densely values in units of the noise lie next to values in those of the sensors.

    Args:
        bench: records and their noise.
    """
    return float(sum(np.log(w).sum() for w in _weights(bench)))


def gauge(bench: Bench) -> float:
    """Mean logarithm of one over the noise.

    Args:
        bench: records and their noise.
    """
    every = np.concatenate([np.zeros(0), *(np.log(w) for w in _weights(bench))])
    return float(every.mean()) if every.size else 0.0


def _weights(bench: Bench) -> list[np.ndarray]:
    """Of what is judged, block by block."""
    each = (np.asarray(b.weight)[:, b.lead :] for b in bench.blocks)
    return [w[w > 0] for w in each]


def value(found: Refit, bench: Bench) -> float:
    """Evidence; none of what makes no sense.

    Args:
        found: a fit.
        bench: that it is of.
    """
    return found.fit.evidence if sensible(found, bench) else -math.inf


def sensible(found: Refit, bench: Bench) -> bool:
    """Whether each law has parameters that it is meant for, and that windows can tell.

    A mode that is slower than a window is a force of its own in each, which explains anything; a disturbance that is
    slower than the longest record is a drift.

    Args:
        found: a fit.
        bench: that it is of.
    """
    block = bench.blocks[0] if bench.blocks else None
    for effect in found.hypothesis.effects:
        kind = law_of(effect.kind, effect.parameters)
        values = {p.name: float(np.ravel(np.asarray(effect.parameters[p.name]))[0]) for p in kind.parameters}
        if kind.sensible is not None and not kind.sensible(*values.values()):
            return False
        longest = max((len(m.y) * m.dt for m in bench.moved), default=math.inf)
        if any(p.unit[0] == "Hz" and values[p.name] * longest < 1 for p in kind.parameters):
            return False
        if kind.vibrates is None or block is None:
            continue
        lasts = float(block.dt) * (block.y.shape[1] - block.lead)
        if kind.vibrates(*values.values()) * lasts < 2 * math.pi:
            return False
    return True


def left_in(bench: Bench, whole: Whole) -> float:
    """What a fit leaves, rms, in the noise of a bench, which need not be the fit's own.

    Args:
        bench: tells the noise.
        whole: the fit.
    """
    fit = whole.refit.fit
    return math.sqrt(fit.squares / max(fit.equations, 1)) * math.exp(gauge(bench) - gauge(whole.bench))


def straight(kind: str) -> bool:
    """Whether a kind of effect is a spring or a damper between bodies.

    Args:
        kind: its name.
    """
    return CATALOGUE[kind].changes is not None and bool(CATALOGUE[kind].needs)


def still_due(
    rough: Sequence[tuple[Candidate, Refit]], values: Sequence[float], done: Mapping[int, Whole], near: float
) -> list[int]:
    """What must still be fitted thoroughly: the best one, then what it may stand for.

    Springs and dampers where it acts, or nearly as good; a periodic force in the place of a part that swings, whose
    own motion, free in every window, is one; other laws of fewer numbers where it acts, since a richer one, as a stop
    beside a spring that may be softer is for play, comes close from further away.

    Args:
        rough: candidates, fitted to a part of the records.
        values: evidence of each.
        done: those that are fitted thoroughly.
        near: difference of evidence beyond which springs and dampers are not.
    """
    if not rough or not math.isfinite(max(values)):
        return []
    best = int(np.argmax(values))
    if best not in done:
        return [best]
    at, top = rough[best][0], values[best]
    if straight(at.kind):
        return []
    left = [(i, c) for i, (c, _) in enumerate(rough) if i not in done]
    here = {i for i, c in left if ends_of(c.place) == ends_of(at.place)}
    swings = CATALOGUE[at.kind].vibrates is not None
    due = [i for i, c in left if swings and i in here and c.kind == RINGING]
    due += _simpler(rough, best, done)
    reach = {i: near if i in here else STRAIGHT / CLOSE * near for i, c in left if straight(c.kind)}
    return due + [i for i in reach if top - values[i] < reach[i]]


def _simpler(rough: Sequence[tuple[Candidate, Refit]], best: int, done: Mapping[int, Whole]) -> list[int]:
    """The first laws of fewer numbers where the best one acts that do not leave far more, but those that are done."""
    at, squares = rough[best][0], rough[best][1].fit.squares
    fewer = [
        i
        for i, (c, r) in enumerate(rough)
        if ends_of(c.place) == ends_of(at.place)
        and CATALOGUE[c.kind].where == CATALOGUE[at.kind].where
        and not straight(c.kind)
        and numbers_of(c.kind) < numbers_of(at.kind)
        and r.fit.squares < NEAR**2 * squares
    ]
    return [i for i in fewer[:FEWER] if i not in done]


def numbers_of(kind: str) -> int:
    """How many numbers a kind of effect has; a wrong number of the model is one, whichever way it is told.

    Args:
        kind: its name.
    """
    return 1 if kind in ERRORS.values() else len(CATALOGUE[kind].parameters)


def loud(ranking: Ranking) -> bool:
    """Whether even the best one leaves far more than noise, or than the least that was guessed.

    Args:
        ranking: the round.
    """
    return bool(ranking.ranked) and ranking.ranked[0].left > LOUD * _floor(ranking.bench)


def parsimonious(ranking: Ranking) -> Ranking:
    """A round whose laws at the place of the best one are compared by how much they leave, where that is loud.

    Such a misfit says the same in every sample of a swing or a stroke, so that evidence, which counts samples, is as
    good as certain of any difference. Counted as n pieces of misfit, log p = -n log(left above the noise) - c k for a
    law of k numbers: one with more must leave clearly less. What has not been fitted to all records stays as it is.

    Args:
        ranking: the round.
    """
    if not loud(ranking):
        return ranking
    whole, place = len(ranking.bench.blocks), ends_of(ranking.ranked[0].place)
    here = [i for i, x in enumerate(ranking.ranked) if _comparable(x, place, whole)]
    if len(here) < 2:
        return ranking
    own = [ranking.ranked[i] for i in here]
    odds = np.array(
        [-PIECES * math.log(_excess(ranking.bench, x.left)) - NUMBER * numbers_of(x.kind) for x in own]
    )
    best = own[int(odds.argmax())].refit.fit
    unit = best.squares / max(best.equations, 1) * ranking.temperature
    top = max(x.evidence for x in own)
    values = dict(zip(here, top + unit * (odds - odds.max()), strict=True))
    every = [(x, x.refit, values.get(i, x.evidence), x.left) for i, x in enumerate(ranking.ranked)]
    return ranked(every, ranking.without, ranking.bench, ranking.temperature)


def notable(ranking: Ranking) -> bool:
    """Whether the best one leaves noise, or clearly less than there was without it, by the count of `parsimonious`.

    Args:
        ranking: the round.
    """
    best, without = ranking.ranked[0], ranking.without.fit
    before = math.sqrt(without.squares / max(without.equations, 1))
    less = math.log(_excess(ranking.bench, before) / _excess(ranking.bench, best.left))
    return not loud(ranking) or PIECES * less > NUMBER * numbers_of(best.kind)


def _comparable(x: Explanation, place: tuple[str, ...], whole: int) -> bool:
    fitted = len(x.refit.fit.states) == whole and math.isfinite(x.evidence) and math.isfinite(x.left)
    return fitted and ends_of(x.place) == place


def _floor(bench: Bench) -> float:
    """The noise, or the least that it was guessed to be, in that of a bench."""
    return math.exp(gauge(bench) - gauge(as_guessed(bench)))


def _excess(bench: Bench, left: float) -> float:
    """What is left above the noise."""
    return math.sqrt(max(left**2 - _floor(bench) ** 2, 1e-4 * left**2, np.finfo(float).tiny))


def ranked(
    every: Sequence[tuple[Candidate | Explanation, Refit, float, float]],
    without: Refit,
    bench: Bench,
    temperature: float,
) -> Ranking:
    """Fits in order.

    Args:
        every: what it is, its fit, evidence, and rms that it leaves, all in the noise of the bench.
        without: the fit without any of them.
        bench: of the best one.
        temperature: of the round.
    """
    # motions that grow without bound leave nothing to compare by
    held = [x for x in every if math.isfinite(x[2])]
    first = max(held, key=lambda x: x[2])[1].fit if held else without.fit
    scale = max(first.squares / max(first.equations, 1), np.finfo(float).tiny)
    scale = scale if math.isfinite(scale) else 1.0
    values = np.array([x[2] for x in every] + [without.fit.evidence]) / scale / temperature
    # what was fitted to a part of the records alone is no better than what was fitted to all
    whole = len(bench.blocks)
    values[:-1] += [STRAIGHT * (straight(c.kind) and len(r.fit.states) == whole) for c, r, *_ in every]
    order = np.argsort(-values[:-1], kind="stable")
    every = [every[i] for i in order]
    weights = np.exp(values - values.max()) if np.isfinite(values.max()) else np.ones_like(values)
    weights = weights[[*order, -1]] / weights.sum()
    return Ranking(
        tuple(
            Explanation(c.kind, dict(c.place), r, e, float(w), left)
            for (c, r, e, left), w in zip(every, weights[:-1], strict=True)
        ),
        without,
        scale,
        temperature,
        bench,
    )


def others_in(
    bench: Bench, of: Ranking, but: Collection[Key]
) -> list[tuple[Explanation, Refit, float, float]]:
    """What a round has beside some, in the noise of another bench, for `ranked`.

    Args:
        bench: tells the noise.
        of: the round.
        but: what is left out.
    """
    shift, louder = volume(of.bench) - volume(bench), math.exp(gauge(bench) - gauge(of.bench))
    return [(y, y.refit, y.evidence + shift, y.left * louder) for y in of.ranked if y.key not in but]


def worth(ranking: Ranking, least: float) -> bool:
    """Whether the best candidate explains much of what was left, and at least a part of all of it.

    Args:
        ranking: of a round.
        least: that part.
    """
    best, without = ranking.ranked[0], ranking.without.fit
    above = without.squares - without.equations
    # of windows that lead to one another what is missed shows where they meet, too
    less = 2 * (best.evidence - without.evidence)
    return ranking.gain > WORTH and less > max(LESS * above, least * without.squares)
