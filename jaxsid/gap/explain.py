"""Which effects explain records: candidates from the screening, fitted by simulation, compared by their evidence.

One effect after another: what those found so far do is taken out of the records, what is left is examined and screened
anew, and the best further candidates are fitted together with them. The evidence of a fit is that of Laplace, tempered,
since what no candidate has decides more than noise: p_i ~ exp(log Z_i / (s^2 T)), with s^2 the mean square that the
best one leaves.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsid.gap.refit import Bench, Hypothesis, Refit, changes_of, loudest, refitted, tied, weighed_anew
from jaxsid.gap.screen import Candidate
from jaxsid.mechanics.effects.catalogue import CATALOGUE
from jaxsid.mechanics.lumped import GROUND, Effect, LumpedModel
from jaxsid.physical.elements import Element, element_matrices

TEMPERATURE = 5.0  # of effects: what no law has decides more than noise
MILD = 2.0  # of the model's numbers, whose equations are known
ROUGH_STEPS, STEPS_A_NUMBER = 6, 3  # laws of many numbers take longer to be found
LONGER = (5, 10), (3, 20)  # so many of the best go on for so many steps, if they are still on their way
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
FIRST, FURTHER = Effort(10, 4, 25, TEMPERATURE), Effort(12, 2, 16, TEMPERATURE)
NUMBERS = Effort(12, 6, 25, MILD)


class Explanation(NamedTuple):
    """One fitted candidate.

    Attributes:
        kind: of effect.
        place: as of an `Effect`.
        refit: fitted, with the effects found before.
        evidence: its logarithm, in noise, by the equations of all records.
        probability: of all that were tried.
    """

    kind: str
    place: dict[str, Any]
    refit: Refit
    evidence: float
    probability: float

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
    say = progress or (lambda text: None)
    errors = elements_by_key(bench.model)
    base = before.hypothesis if before is not None else Hypothesis()
    without = refitted(bench, base, changes=_changes(before, bench)) if before is None else before
    part = loudest(bench, without)
    every = [
        (c, extended(base, c, errors), _changes(before, bench, c.changes))
        for c in _distinct(candidates, base, errors)[: effort.tried]
    ]
    rough = _roughly(part, every, say)
    ratio = _ratio(bench, part)
    scale = min((r.fit.squares / r.fit.equations for _, r in rough), default=1.0)
    top = _value(rough[0][1], bench) if rough else 0.0
    done: dict[int, Refit] = {}
    if rough:
        say(f"{rough[0][0].kind} at {_label(rough[0][0].place)}, thoroughly")
        bench, done[0], more = _weighed(bench, rough[0][1], effort)
        ratio = ratio * more
        without = refitted(bench, base, **_from(without, bench))
        without = tied(bench, without, steps=effort.steps, gain=FINE)[1]

    benches = dict.fromkeys(done, bench)

    def thoroughly(i: int) -> None:
        c, r = rough[i]
        say(f"{c.kind} at {_label(c.place)}, thoroughly")
        new = refitted(bench, r.hypothesis, changes=changes_of(r, bench), steps=effort.steps, gain=FINE)
        # what drifts away with one law need not with another
        benches[i], done[i] = tied(bench, new, steps=effort.steps, gain=FINE)

    for i, (_, r) in enumerate(rough[: effort.refined]):
        if i not in done and (top - _value(r, bench)) / scale / effort.temperature < CLOSE:
            thoroughly(i)
    # what was fitted roughly is not to come first
    while (values := _values(rough, done, bench, ratio)) and (i := int(np.argmax(values))) not in done:
        if not math.isfinite(values[i]):
            break
        thoroughly(i)
    last = dict(enumerate(r for _, r in rough)) | done
    every = [(c, last[i], values[i]) for i, (c, _) in enumerate(rough)]
    return _ranked(every, without, benches[int(np.argmax(values))] if done else bench, effort.temperature)


def rank_again(
    bench: Bench,
    found: Refit,
    x: Explanation,
    others: Sequence[Explanation],
    without: Refit,
    effort: Effort,
    progress: Callable[[str], None] | None = None,
) -> Ranking:
    """An effect that was found next to others in its place, beside all that is there now.

    Args:
        bench: records; the states to begin with are those of the fit, without what is the effect's own.
        found: the fit with the effect.
        x: the effect.
        others: explanations that were tried where it was found.
        without: the fit without it.
        effort: how much is fitted.
        progress: called with a line of text before each fit.
    """
    say = progress or (lambda text: None)
    errors, begin = elements_by_key(bench.model), changes_of(found, bench)
    own = again(x, found)
    candidates = [own, *_distinct([again(y, y.refit) for y in others], found.hypothesis, errors)]
    part = loudest(bench, without)
    every = [(c, extended(without.hypothesis, c, errors), begin) for c in candidates]
    rough = _roughly(part, every, say)
    ratio, scale = _ratio(bench, part), found.fit.squares / max(found.fit.equations, 1)
    top = next(_value(r, bench) for c, r in rough if c is own)
    last, values = [], []
    for c, r in rough:
        behind = (top - _value(r, bench)) * ratio
        if c is own:
            fit, value = found, _value(found, bench)
        elif len(last) <= effort.refined and behind / ratio / scale / effort.temperature < CLOSE:
            say(f"{c.kind} at {_label(c.place)}, thoroughly")
            fit = refitted(bench, r.hypothesis, changes=begin, steps=effort.steps, gain=FINE)
            value = _value(fit, bench)
        else:
            fit, value = r, found.fit.evidence - max(behind, 0.0)
        last.append(fit)
        values.append(value)
    ranked = [(c, fit, v) for (c, _), fit, v in zip(rough, last, values, strict=True)]
    return _ranked(ranked, without, bench, effort.temperature)


def again(x: Explanation, found: Refit) -> Candidate:
    """An explanation to begin anew from, with its parameters in a fit.

    Args:
        x: the explanation.
        found: the fit.
    """
    own = [e for e in found.hypothesis.effects if key_of(e.kind, dict(e.place)) == x.key]
    parameters = {n: float(np.ravel(np.asarray(v))[0]) for e in own for n, v in e.parameters.items()}
    return Candidate(x.kind, x.place, parameters, np.zeros(0), x.evidence, math.nan, "", {})


def _roughly(
    part: Bench, every: Sequence[tuple[Candidate, Hypothesis, Any]], say: Callable[[str], None]
) -> list[tuple[Candidate, Refit]]:
    """Candidates fitted to a part of the records, best first: some steps for each, more for the best."""
    rough = []
    for c, hypothesis, changes in every:
        say(f"{c.kind} at {_label(c.place)}")
        steps = ROUGH_STEPS + STEPS_A_NUMBER * len(c.parameters)
        rough.append((c, refitted(part, hypothesis, changes=changes, steps=steps, gain=FINE)))
    for few, more in LONGER:
        rough.sort(key=lambda x: -_value(x[1], part))
        for i, (c, r) in enumerate(rough[:few]):
            if not r.fit.settled:
                rough[i] = c, refitted(part, r.hypothesis, **_from(r, part), steps=more, gain=FINE)
    return sorted(rough, key=lambda x: -_value(x[1], part))


def _weighed(bench: Bench, found: Refit, effort: Effort) -> tuple[Bench, Refit, float]:
    """The bench as a rough fit suggests: its noise, where nothing else tells of it, and whether windows are tied.

    Also that fit done thoroughly, and by what factor squares in noise have changed.
    """
    best = refitted(bench, found.hypothesis, changes=changes_of(found, bench), steps=effort.steps, gain=FINE)
    ratio = 1.0
    if any(n.degrees <= 0 for n in bench.noises):
        # more may be missing than this one, so that noise is no more than was thought
        bench, before = weighed_anew(bench, best, noise=False), best.fit.squares
        best = refitted(bench, best.hypothesis, **_from(best, bench), steps=effort.steps, gain=FINE)
        ratio = best.fit.squares / max(before, np.finfo(float).tiny)
    return *tied(bench, best, steps=effort.steps, gain=FINE), ratio


def _from(found: Refit, bench: Bench) -> dict[str, Any]:
    """Where a further fit begins."""
    return {"changes": changes_of(found, bench), "states": found.fit.states}


def _values(
    rough: list[tuple[Candidate, Refit]], done: Mapping[int, Refit], bench: Bench, ratio: float
) -> list[float]:
    """Evidence of thorough fits; of the others what their rough ones lack to the best of those."""
    if not rough:
        return []
    own = {i: _value(r, bench) for i, r in done.items()}
    best = max(own, key=lambda i: own[i], default=0)
    top, level = _value(rough[best][1], bench), own.get(best, 0.0)
    if not math.isfinite(level):
        top, level = max(_value(r, bench) for _, r in rough), 0.0
    every = (own.get(i, level - ratio * (top - _value(r, bench))) for i, (_, r) in enumerate(rough))
    return [x if math.isfinite(x) else -math.inf for x in every]


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
    every: list[tuple[Candidate, Refit, float]], without: Refit, bench: Bench, temperature: float
) -> Ranking:
    every = sorted(every, key=lambda x: -x[2])
    first = every[0][1].fit if every else without.fit
    scale = max(first.squares / max(first.equations, 1), np.finfo(float).tiny)
    values = np.array([e for _, _, e in every] + [without.fit.evidence]) / scale / temperature
    weights = np.exp(values - values.max())
    weights = weights / weights.sum()
    return Ranking(
        tuple(
            Explanation(c.kind, dict(c.place), r, e, float(w))
            for (c, r, e), w in zip(every, weights[:-1], strict=True)
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
