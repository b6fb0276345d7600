"""Which effects explain records: candidates from the screening, fitted by simulation, compared by their evidence.

One effect after another: what those found so far do is taken out of the records, what is left is examined and screened
anew, and the best further candidates are fitted together with them. The evidence of a fit is that of Laplace, tempered,
since what no candidate has decides more than noise: p_i ~ exp(log Z_i / (s^2 T)), with s^2 the mean square that the
best one leaves.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsid.gap.refit import (
    Bench,
    Hypothesis,
    Refit,
    as_guessed,
    changes_of,
    loudest,
    refitted,
    tied,
    weighed_anew,
)
from jaxsid.gap.screen import Candidate
from jaxsid.mechanics.effects.catalogue import CATALOGUE
from jaxsid.mechanics.lumped import GROUND, Effect, LumpedModel
from jaxsid.parallel import side_by_side
from jaxsid.physical.elements import Element, element_matrices

TEMPERATURE = 5.0  # of effects: what no law has decides more than noise
MILD = 2.0  # of the model's numbers, whose equations are known
ROUGH_STEPS, STEPS_A_NUMBER = 6, 3  # laws of many numbers take longer to be found
LONGER = (5, 10), (3, 20)  # so many of the best go on for so many steps, if they are still on their way
HOPELESS = 10.0  # times the squares that the best one leaves, from which on none goes on
LINKED = 30  # most steps where each window leads to the next: the search goes along a curved valley
FINE = 2.0  # gain of the search below which a candidate is fitted well enough to be compared
SAME = 3.0  # tempered difference of evidence below which two are hardly told apart
CLOSE = 40.0  # tempered difference of rough evidence beyond which a candidate is not fitted thoroughly
ERRORS = {"mass": "mass_error", "damping": "damping_error", "stiffness": "stiffness_error"}
Key = tuple[str, str, tuple[str, ...]]


class Effort(NamedTuple):
    """How many candidates are fitted roughly, how many thoroughly, in how many steps at most; the temperature."""

    tried: int
    refined: int
    steps: int
    temperature: float


# with two effects a step costs several times as much
FIRST, FURTHER = Effort(10, 4, 25, TEMPERATURE), Effort(15, 3, 16, TEMPERATURE)
NUMBERS = Effort(12, 6, 25, MILD)


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
        """Tempered evidence of the best one over that of none of them; 0 where there is none."""
        if not self.ranked:
            return 0.0
        return (self.ranked[0].evidence - self.without.fit.evidence) / self.scale / self.temperature


def alike(x: Explanation, y: Explanation, of: Ranking) -> bool:
    """Whether records hardly tell two explanations apart.

    Args:
        x, y: explanations.
        of: the ranking that they are in.
    """
    return abs(x.evidence - y.evidence) / of.scale / of.temperature < SAME


def key_of(kind: str, place: Mapping[str, Any]) -> Key:
    """Kind and place as one value to be compared; the order of two ends does not count."""
    ((where, ends),) = place.items()
    named = tuple(sorted(ends)) if where == "between" else (str(ends),)
    return kind, where, named


def element_place(model: LumpedModel, element: Element) -> dict[str, Any]:
    """Where a number of a model acts, as in diagnosis.json.

    Args:
        model: elements, or matrices, whose numbers bear the names of the bodies that they join.
        element: one of its numbers.
    """
    for connection in model.connections:
        if element.quantity != "mass" and element.element == connection.name:
            return {"between": list(connection.between)}
    ends = element.element.split(", ") if model.matrices is not None else [element.element]
    if len(ends) > 1:
        return {"between": ends}
    return {"body": ends[0]} if element.quantity == "mass" else {"between": [GROUND, *ends]}


def elements_by_key(model: LumpedModel) -> dict[Key, tuple[int, ...]]:
    """The numbers of a model whose error is a kind of effect; several of connections side by side.

    Args:
        model: its elements.
    """
    found: dict[Key, tuple[int, ...]] = {}
    for i, element in enumerate(element_matrices(model).listed):
        key = key_of(ERRORS[element.quantity], element_place(model, element))
        found[key] = (*found.get(key, ()), i)
    return found


def rank(
    bench: Bench,
    candidates: Sequence[Candidate],
    before: Refit | None,
    effort: Effort,
    progress: Callable[[str], None] | None = None,
) -> Ranking:
    """The most promising candidates fitted, with the effects found before.

    Args:
        bench: records.
        candidates: from the screening, most promising first.
        before: what was found so far; None where each candidate brings changes of the model's numbers of its own.
        effort: how much is fitted.
        progress: called with a line of text before each fit.
    """
    errors = elements_by_key(bench.model)
    base = before.hypothesis if before is not None else Hypothesis()
    bench = as_guessed(bench)
    without = refitted(bench, base, changes=_changes(before, bench)) if before is None else before
    every = [
        (c, extended(base, c, errors), _changes(before, bench, c.changes))
        for c in _distinct(candidates, base, errors)[: effort.tried]
    ]
    return _round(bench, every, without, effort, progress or (lambda text: None))


def rank_again(
    bench: Bench,
    found: Refit,
    x: Explanation,
    others: Sequence[Candidate],
    without: Refit,
    effort: Effort,
    progress: Callable[[str], None] | None = None,
) -> Ranking:
    """An effect that was found next to others in its place, beside all that is there now.

    Args:
        bench: records; the states to begin with are those of the fit, without what is the effect's own.
        found: the fit with the effect.
        x: the effect.
        others: what may be there in its place.
        without: the fit without it.
        effort: how much is fitted.
        progress: called with a line of text before each fit.
    """
    errors, begin = elements_by_key(bench.model), changes_of(found, bench)
    own = again(x, found)
    candidates = [own, *_distinct(others, found.hypothesis, errors)]
    every = [(c, extended(without.hypothesis, c, errors), begin) for c in candidates]
    known = _Known(own, _Whole(bench, found), begin)
    return _round(as_guessed(bench), every, without, effort, progress or (lambda text: None), known)


def again(x: Explanation, found: Refit) -> Candidate:
    """An explanation to begin anew from, with its parameters in a fit.

    Args:
        x: the explanation.
        found: the fit.
    """
    own = [e for e in found.hypothesis.effects if key_of(e.kind, dict(e.place)) == x.key]
    parameters = {n: float(np.ravel(np.asarray(v))[0]) for e in own for n, v in e.parameters.items()}
    return Candidate(x.kind, x.place, parameters, np.zeros(0), x.evidence, math.nan, "", {})


class _Whole(NamedTuple):
    """A fit to all records, and the bench of its own that it was fitted to."""

    bench: Bench
    refit: Refit


class _Known(NamedTuple):
    """One candidate of a round that is fitted already, and the changes of elements with which all others begin."""

    candidate: Candidate
    whole: _Whole
    begin: Float[np.ndarray, " e"]


def _round(
    bench: Bench,
    every: Sequence[tuple[Candidate, Hypothesis, Any]],
    without: Refit,
    effort: Effort,
    say: Callable[[str], None],
    known: _Known | None = None,
) -> Ranking:
    """Candidates fitted to a part of the records, the best of them to all, and compared."""
    part = loudest(bench, without)
    rough = _roughly(part, every, say)
    first, done, scale = 0, {}, min((r.fit.squares / r.fit.equations for _, r in rough), default=1.0)
    if known is not None:
        first = next(i for i, (c, _) in enumerate(rough) if c is known.candidate)
        fit = known.whole.refit.fit
        done, scale = {first: known.whole}, fit.squares / max(fit.equations, 1)
    top = _value(rough[first][1], bench) if rough else 0.0

    def thorough(i: int) -> _Whole:
        c, r = rough[i]
        say(f"{c.kind} at {_label(c.place)}, thoroughly")
        changes = changes_of(r, bench) if known is None else known.begin
        return _whole(bench, r.hypothesis, {"changes": changes}, effort)

    close = [(top - _value(r, bench)) / scale / effort.temperature < CLOSE for _, r in rough]
    best = range(min(effort.refined + len(done), len(rough)))
    due = [i for i in best if i not in done and (close[i] or (i == 0 and known is None))]
    done |= dict(zip(due, side_by_side(thorough, due), strict=True))
    while (values := _values(rough, done, bench, part)) and (i := int(np.argmax(values))) not in done:
        if not math.isfinite(values[i]):
            break
        done[i] = thorough(i)
    return _compared(rough, values, done, bench, without, effort)


def _roughly(
    part: Bench, every: Sequence[tuple[Candidate, Hypothesis, Any]], say: Callable[[str], None]
) -> list[tuple[Candidate, Refit]]:
    """Candidates fitted to a part of the records, best first: some steps for each, more for the best."""

    def begun(one: tuple[Candidate, Hypothesis, Any]) -> tuple[Candidate, Refit]:
        c, hypothesis, changes = one
        say(f"{c.kind} at {_label(c.place)}")
        steps = ROUGH_STEPS + STEPS_A_NUMBER * len(c.parameters)
        return c, refitted(part, hypothesis, changes=changes, steps=steps, gain=FINE)

    rough = side_by_side(begun, every)
    for few, more in LONGER:
        rough.sort(key=lambda x: -_value(x[1], part))
        most = HOPELESS * rough[0][1].fit.squares if rough else 0.0
        due = [i for i, (_, r) in enumerate(rough[:few]) if not r.fit.settled and r.fit.squares < most]
        on = partial(_longer, part=part, steps=more)
        for i, r in zip(due, side_by_side(on, [rough[i][1] for i in due]), strict=True):
            rough[i] = rough[i][0], r
    return sorted(rough, key=lambda x: -_value(x[1], part))


def _longer(found: Refit, *, part: Bench, steps: int) -> Refit:
    return refitted(part, found.hypothesis, **_from(found, part), steps=steps, gain=FINE)


def _whole(bench: Bench, hypothesis: Hypothesis, start: dict[str, Any], effort: Effort) -> _Whole:
    """A hypothesis with the noise that it leaves, where nothing else tells of it, and windows tied if that suits it.

    What drifts away with one law need not with another, nor is what one leaves the noise of another.
    """
    search, linked = {"steps": effort.steps, "gain": FINE}, {"steps": LINKED, "gain": FINE}
    found = refitted(bench, hypothesis, **start, **search)
    bench, found = tied(bench, found, **linked)
    if any(n.degrees <= 0 for n in bench.noises) and math.isfinite(found.fit.evidence):
        bench = weighed_anew(bench, found)
        found = refitted(bench, found.hypothesis, **_from(found, bench), **search)
        bench, found = tied(bench, found, **linked)
    return _Whole(bench, found)


def _density(bench: Bench, found: Refit) -> float:
    """Evidence as a density of the records, whatever the noise: log p(y) up to a constant."""
    return _value(found, bench) + _volume(bench)


def _volume(bench: Bench) -> float:
    """Logarithm of how densely values in units of the noise lie next to values in those of the sensors."""
    return sum(float(np.log(w).sum()) for w in _weights(bench))


def _gauge(bench: Bench) -> float:
    """Mean logarithm of one over the noise."""
    every = np.concatenate([np.log(w) for w in _weights(bench)])
    return float(every.mean()) if every.size else 0.0


def _weights(bench: Bench) -> list[np.ndarray]:
    """Of what is judged, block by block."""
    each = (np.asarray(b.weight)[:, b.lead :] for b in bench.blocks)
    return [w[w > 0] for w in each]


def _from(found: Refit, bench: Bench) -> dict[str, Any]:
    """Where a further fit begins."""
    return {"changes": changes_of(found, bench), "states": found.fit.states}


def _values(
    rough: list[tuple[Candidate, Refit]], done: Mapping[int, _Whole], bench: Bench, part: Bench
) -> list[float]:
    """Densities of thorough fits; of the others what their rough ones lack to the best of those."""
    if not rough:
        return []
    own = {i: _density(*x) for i, x in done.items()}
    best = max(own, key=lambda i: own[i], default=0)
    top, level, gain = _value(rough[best][1], bench), own.get(best, 0.0), 0.0
    if math.isfinite(level) and best in done:
        gain = 2 * (_gauge(done[best].bench) - _gauge(bench))
    else:
        top, level = max(_value(r, bench) for _, r in rough), 0.0
    ratio = _ratio(bench, part) * math.exp(gain)
    every = (own.get(i, level - ratio * (top - _value(r, bench))) for i, (_, r) in enumerate(rough))
    return [x if math.isfinite(x) else -math.inf for x in every]


def _compared(
    rough: list[tuple[Candidate, Refit]],
    values: list[float],
    done: Mapping[int, _Whole],
    bench: Bench,
    without: Refit,
    effort: Effort,
) -> Ranking:
    """The round, in the noise that the best one leaves."""
    if not rough:
        return _ranked([], without, bench, effort.temperature)
    at = done.get(int(np.argmax(values)), _Whole(bench, rough[0][1]))
    without = refitted(at.bench, without.hypothesis, **_from(without, bench))
    volume, gauge = _volume(at.bench), _gauge(at.bench)
    every = []
    for i, ((c, r), value) in enumerate(zip(rough, values, strict=True)):
        own = done.get(i, _Whole(bench, r))
        mean = own.refit.fit.squares / max(own.refit.fit.equations, 1)
        every.append((c, own.refit, value - volume, math.sqrt(mean) * math.exp(gauge - _gauge(own.bench))))
    return _ranked(every, without, at.bench, effort.temperature)


def _value(found: Refit, bench: Bench) -> float:
    """Evidence; none of what makes no sense."""
    return found.fit.evidence if _sensible(found, bench) else -math.inf


def _sensible(found: Refit, bench: Bench) -> bool:
    """Whether each law has parameters that it is meant for, and that windows can tell.

    A mode that is slower than a window is a force of its own in each, which explains anything.
    """
    block = bench.blocks[0] if bench.blocks else None
    for effect in found.hypothesis.effects:
        kind = CATALOGUE[effect.kind]
        values = {p.name: float(np.ravel(np.asarray(effect.parameters[p.name]))[0]) for p in kind.parameters}
        if kind.sensible is not None and not kind.sensible(*values.values()):
            return False
        if kind.vibrates is None or block is None:
            continue
        lasts = float(block.dt) * (block.y.shape[1] - block.lead)
        if kind.vibrates(*values.values()) * lasts < 2 * math.pi:
            return False
    return True


def _ranked(
    every: list[tuple[Candidate, Refit, float, float]], without: Refit, bench: Bench, temperature: float
) -> Ranking:
    every = sorted(every, key=lambda x: -x[2])
    first = every[0][1].fit if every else without.fit
    scale = max(first.squares / max(first.equations, 1), np.finfo(float).tiny)
    values = np.array([x[2] for x in every] + [without.fit.evidence]) / scale / temperature
    weights = np.exp(values - values.max())
    weights = weights / weights.sum()
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


def _ratio(whole: Bench, part: Bench) -> float:
    count = lambda b: sum(float((np.asarray(x.weight) > 0).sum()) for x in b.blocks)  # noqa: E731
    return count(whole) / max(count(part), 1.0)


def _changes(
    before: Refit | None, bench: Bench, wished: Float[np.ndarray, " e"] | None = None
) -> Float[np.ndarray, " e"] | None:
    if before is not None:
        return changes_of(before, bench)
    return None if wished is None else np.asarray(wished)


def _distinct(
    candidates: Sequence[Candidate], base: Hypothesis, errors: Mapping[Key, tuple[int, ...]]
) -> list[Candidate]:
    """Candidates that the hypothesis does not have yet."""
    there = {key_of(e.kind, dict(e.place)) for e in base.effects}
    there |= {key for key, rows in errors.items() if set(rows) <= set(base.wrong)}
    found: dict[Key, Candidate] = {}
    for c in candidates:
        if (key := key_of(c.kind, c.place)) not in there:
            found.setdefault(key, c)
    return list(found.values())


def extended(base: Hypothesis, c: Candidate, errors: Mapping[Key, tuple[int, ...]]) -> Hypothesis:
    """A hypothesis with one candidate more: a wrong number of the model, or an effect.

    Args:
        base: what there is.
        c: the candidate.
        errors: from `elements_by_key`.
    """
    rows = errors.get(key_of(c.kind, c.place))
    if rows is not None:
        return base._replace(wrong=tuple(sorted({*base.wrong, *rows})))
    effect = Effect(c.kind, tuple(c.place.items()), dict(c.parameters))
    return base._replace(effects=(*base.effects, effect))


def _label(place: Mapping[str, Any]) -> str:
    ((_, ends),) = place.items()
    return " - ".join(ends) if isinstance(ends, tuple | list) else str(ends)
