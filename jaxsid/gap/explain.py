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

from jaxsid.gap.nested import nested
from jaxsid.gap.phases import in_phase
from jaxsid.gap.ranking import (
    CLOSE,
    ERRORS,
    WORTH,
    Explanation,
    Key,
    Ranking,
    Whole,
    density,
    ends_of,
    gauge,
    key_of,
    left_in,
    loud,
    numbers_of,
    others_in,
    parsimonious,
    ranked,
    still_due,
    value,
    volume,
)
from jaxsid.gap.refit import (
    Bench,
    Hypothesis,
    Refit,
    as_guessed,
    changes_of,
    refitted,
    resolved,
    tied,
    weighed_anew,
)
from jaxsid.gap.roughly import FINE, alone, label, loudest, roughly, start_from
from jaxsid.gap.screen import Candidate
from jaxsid.gap.sliding import sliding
from jaxsid.mechanics.lumped import GROUND, Effect, LumpedModel
from jaxsid.parallel import side_by_side
from jaxsid.physical.elements import Element, element_matrices

TEMPERATURE = 5.0  # of effects: what no law has decides more than noise
MILD = 2.0  # of the model's numbers, whose equations are known
ELSEWHERE = 3  # other places that the best law is fitted thoroughly at, where it leaves more than noise
PLAINER = 2  # laws of fewer numbers that are tried where the best one acts and leaves more than noise
LINKED = 30  # most steps where each window leads to the next: the search goes along a curved valley
MORE = 3  # further ones that are fitted thoroughly as those before them turn out worse than they seemed
SECOND = 8  # further ones that are fitted thoroughly where none of those is worth anything
SCREENED = 3  # likewise beside what was found, from where the screening begins
SPRING = "missing_connection"


class Effort(NamedTuple):
    """How many candidates are fitted roughly, how many thoroughly, in how many steps at most, at which temperature.

    None thoroughly that is so far behind.
    """

    tried: int
    refined: int
    steps: int
    temperature: float
    behind: float = CLOSE


# with two effects a step costs several times as much
FIRST, FURTHER = Effort(14, 4, 25, TEMPERATURE), Effort(16, 3, 16, TEMPERATURE)
NUMBERS = Effort(12, 6, 25, MILD)
ALONE = NUMBERS._replace(behind=math.inf)  # in noise guessed too low what colours it may be far ahead


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


def nothing(model: LumpedModel, rows: Sequence[int]) -> bool:
    """Whether numbers of a model are nothing nominally, so that no factor tells of them.

    Args:
        model: its elements.
        rows: of the numbers; none are not nothing.
    """
    return bool(rows) and not np.asarray(element_matrices(model).nominal)[list(rows)].any()


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
    candidates = [*candidates, *_connections(bench.model, candidates[: effort.tried])]
    every = [
        (c, extended(base, c, errors), _changes(before, bench, c.changes))
        for c in _distinct(candidates, base, errors)
        if not nothing(bench.model, errors.get(key_of(c.kind, c.place), ()))
    ]
    return _round(bench, every, without, effort, progress or (lambda text: None))


def _connections(model: LumpedModel, candidates: Sequence[Candidate]) -> list[Candidate]:
    """Springs where candidates act between bodies that a model of connections does not join."""
    if model.matrices is not None:
        return []
    joined = {tuple(sorted(c.between)) for c in model.connections}
    places = {ends_of(c.place): c for c in candidates if "between" in c.place}
    return [
        Candidate(SPRING, c.place, {}, c.changes, 0.0, math.nan, "", {})
        for (_, *ends), c in places.items()
        if tuple(ends) not in joined
    ]


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
    known = _Known(own, Whole(bench, found), begin)
    effort = effort._replace(tried=len(every))
    return _round(as_guessed(bench), every, without, effort, progress or (lambda text: None), known)


def elsewhere(
    ranking: Ranking,
    candidates: Sequence[Candidate],
    before: Refit | None,
    effort: Effort,
    progress: Callable[[str], None] | None = None,
) -> Ranking:
    """A round whose best law is fitted thoroughly at other places, too, from where the screening would begin.

    Rough fits to a part of the records, in noise that was only guessed, may tell the law but not its place.

    Args:
        ranking: the round.
        candidates: from the screening, most promising first.
        before: what was found before.
        effort: how much is fitted.
        progress: called with a line of text before each fit.
    """
    best, say, errors = (
        ranking.ranked[0],
        progress or (lambda text: None),
        elements_by_key(ranking.bench.model),
    )
    base = before.hypothesis if before is not None else Hypothesis()
    others = [c for c in _distinct(candidates, base, errors) if c.kind == best.kind]
    others = [c for c in others if key_of(c.kind, c.place) != best.key][:ELSEWHERE]
    bench = ranking.bench._replace(jump=ranking.bench.loose)

    def thorough(c: Candidate) -> Whole:
        say(f"{c.kind} at {label(c.place)}, thoroughly")
        return _whole(
            bench, extended(base, c, errors), {"changes": _changes(before, bench, c.changes)}, effort
        )

    new = {
        key_of(c.kind, c.place): (c, w) for c, w in zip(others, side_by_side(thorough, others), strict=True)
    }
    top = max(new.values(), key=lambda x: density(*x[1]), default=None)
    if top is None or density(*top[1]) <= best.evidence + volume(ranking.bench):
        return ranking
    at = top[1].bench
    every = [(c, w.refit, density(*w) - volume(at), left_in(at, w)) for c, w in new.values()]
    every = [*every, *others_in(at, ranking, new)]
    without = refitted(at, ranking.without.hypothesis, **start_from(ranking.without, bench))
    return ranked(every, without, at, effort.temperature)


def plainer(
    ranking: Ranking,
    before: Refit | None,
    effort: Effort,
    progress: Callable[[str], None] | None = None,
) -> Ranking:
    """A round whose best law is loud, next to laws of fewer numbers where it acts; see `parsimonious`.

    Args:
        ranking: the round.
        before: what was found before.
        effort: how much is fitted.
        progress: called with a line of text before each fit.
    """
    if not loud(ranking):
        return ranking
    best, say = ranking.ranked[0], progress or (lambda text: None)
    bench, whole = ranking.bench._replace(jump=ranking.bench.loose), len(ranking.bench.blocks)
    fewer = [
        y
        for y in ranking.ranked[1:]
        if ends_of(y.place) == ends_of(best.place)
        and numbers_of(y.kind) < numbers_of(best.kind)
        and math.isfinite(y.evidence)
    ][:PLAINER]

    def thorough(y: Explanation) -> Whole:
        say(f"{y.kind} at {label(y.place)}, thoroughly")
        return _whole(bench, y.refit.hypothesis, {"changes": _changes(before, bench)}, effort)

    due = [y for y in fewer if len(y.refit.fit.states) != whole]
    new = dict(zip([y.key for y in due], side_by_side(thorough, due), strict=True))
    every = []
    for y in ranking.ranked:
        w, at = new.get(y.key), ranking.bench
        fitted = (
            (y.refit, y.evidence, y.left)
            if w is None
            else (w.refit, density(*w) - volume(at), left_in(at, w))
        )
        every.append((y, *fitted))
    return parsimonious(ranked(every, ranking.without, ranking.bench, ranking.temperature))


def again(x: Explanation, found: Refit) -> Candidate:
    """An explanation to begin anew from, with its parameters in a fit.

    Args:
        x: the explanation.
        found: the fit.
    """
    own = [e for e in found.hypothesis.effects if key_of(e.kind, dict(e.place)) == x.key]
    parameters = {n: np.asarray(v, float) for e in own for n, v in e.parameters.items()}
    return Candidate(x.kind, x.place, parameters, np.zeros(0), x.evidence, math.nan, "", {})


class _Known(NamedTuple):
    """One candidate of a round that is fitted already, and the changes of elements with which all others begin."""

    candidate: Candidate
    whole: Whole
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
    rough = roughly(part, every, without, effort.tried, say)
    first, done, scale = 0, {}, min((r.fit.squares / r.fit.equations for _, r in rough), default=1.0)
    if known is not None:
        first = next(i for i, (c, _) in enumerate(rough) if c is known.candidate)
        fit = known.whole.refit.fit
        done, scale = {first: known.whole}, fit.squares / max(fit.equations, 1)
    top = value(rough[first][1], bench) if rough else 0.0

    def thorough(i: int) -> Whole:
        c, r = rough[i]
        say(f"{c.kind} at {label(c.place)}, thoroughly")
        changes = changes_of(r, bench) if known is None else known.begin
        return _whole(bench, r.hypothesis, {"changes": changes}, effort)

    def as_screened(i: int) -> Whole:
        c, hypothesis, changes = next(x for x in every if x[0] is rough[i][0])
        say(f"{c.kind} at {label(c.place)}, as it was screened")
        return _whole(bench, hypothesis, {"changes": changes}, effort)

    first_one = without.hypothesis == Hypothesis()
    laws = [c for c, *_ in every if c.kind not in ERRORS.values()][:SCREENED]
    screened = [i for i, (c, _) in enumerate(rough) if any(c is x for x in laws)]
    close = [(top - value(r, bench)) / scale / effort.temperature < effort.behind for _, r in rough]
    most = effort.refined + len(done)
    nothing = value(alone(part, without), part) if rough and known is None else -math.inf
    best = _promising(rough, [c for c, *_ in every], nothing, bench)[:most]
    due = [i for i in best if i not in done and (close[i] or (i == 0 and known is None))]
    done |= dict(zip(due, side_by_side(thorough, due), strict=True))
    near = CLOSE * scale * effort.temperature
    while due := still_due(rough, values := _values(rough, done, bench, part), done, near):
        if sum(math.isfinite(values[i]) for i in done) >= most + MORE:
            values = _below(values, done, near)
            break
        done |= dict(zip(due, side_by_side(thorough, due), strict=True))
    compared = _compared(rough, values, done, bench, without, effort)
    # a part of the records judges badly what is slow or slight, and all else hangs on a first effect; beside one it may
    # have led a law away that shows elsewhere, too, where all lines together would begin
    further, fit = (range(len(rough)), thorough) if first_one else (screened, as_screened)
    due = [i for i in further if i not in done][:SECOND]
    if due and known is None and not (compared.gain > WORTH or (first_one and loud(compared))):
        done |= dict(zip(due, side_by_side(fit, due), strict=True))
        values = _values(rough, done, bench, part)
        # what a rough fit led away tells nothing of what others lack to it
        values = values if first_one else _below(values, done, near)
        compared = _compared(rough, values, done, bench, without, effort)
    return sliding(nested(compared, effort.steps, say), say)


def _promising(
    rough: Sequence[tuple[Candidate, Refit]], screened: Sequence[Candidate], nothing: float, bench: Bench
) -> list[int]:
    """Numbers of rough fits, best first; as they were screened where none is better than nothing at all.

    A part of the records that tells of none of them is no judge: all lines together, that were screened, tell more.
    """
    order = list(range(len(rough)))
    if not rough or value(rough[0][1], bench) > nothing:
        return order
    first = [key_of(c.kind, c.place) for c in screened]
    return sorted(order, key=lambda i: first.index(key_of(rough[i][0].kind, rough[i][0].place)))


def _whole(bench: Bench, hypothesis: Hypothesis, start: dict[str, Any], effort: Effort) -> Whole:
    """A hypothesis with the noise that it leaves, where nothing else tells of it, and windows tied if that suits it.

    What drifts away with one law need not with another, nor is what one leaves the noise of another.
    """
    search, linked = {"steps": effort.steps, "gain": FINE}, {"steps": LINKED, "gain": FINE}
    found = refitted(bench, in_phase(bench, hypothesis, start), **start, **search)
    if not math.isfinite(found.fit.evidence):
        return Whole(bench, found)
    bench, found = tied(bench, found, **linked)
    if (finer := resolved(bench, found)) is not bench:
        bench, found = finer, refitted(finer, found.hypothesis, **start_from(found, finer), **search)
    if any(n.degrees <= 0 for n in bench.noises):
        bench = weighed_anew(bench, found)
        found = refitted(bench, found.hypothesis, **start_from(found, bench), **search)
        bench, found = tied(bench, found, **linked)
    return Whole(bench, found)


def _values(
    rough: list[tuple[Candidate, Refit]], done: Mapping[int, Whole], bench: Bench, part: Bench
) -> list[float]:
    """Densities of thorough fits; of the others what their rough ones lack to the best of those."""
    if not rough:
        return []
    own = {i: density(*x) for i, x in done.items()}
    best = max(own, key=lambda i: own[i], default=0)
    top, level, gain = value(rough[best][1], bench), own.get(best, 0.0), 0.0
    if math.isfinite(level) and best in done:
        gain = 2 * (gauge(done[best].bench) - gauge(bench))
    else:
        top, level = max(value(r, bench) for _, r in rough), 0.0
    ratio = _ratio(bench, part) * math.exp(gain)
    every = (own.get(i, level - ratio * (top - value(r, bench))) for i, (_, r) in enumerate(rough))
    return [x if math.isfinite(x) else -math.inf for x in every]


def _below(values: Sequence[float], done: Mapping[int, Whole], near: float) -> list[float]:
    """The same, what is not fitted thoroughly no nearer to the best of what is than that."""
    top = max((values[i] for i in done), default=-math.inf)
    return [x if i in done else min(x, top - near) for i, x in enumerate(values)]


def _compared(
    rough: list[tuple[Candidate, Refit]],
    values: list[float],
    done: Mapping[int, Whole],
    bench: Bench,
    without: Refit,
    effort: Effort,
) -> Ranking:
    """The round, in the noise that the best one leaves."""
    if not rough:
        return ranked([], without, bench, effort.temperature)
    best = int(np.argmax(values))
    at = done.get(best, Whole(bench, rough[0][1]))
    without = refitted(at.bench, without.hypothesis, **start_from(without, bench))
    if best in done:
        at = _no_worse(at, without)
        done, values = {**done, best: at}, [*values[:best], density(*at), *values[best + 1 :]]
    every = []
    for i, ((c, r), x) in enumerate(zip(rough, values, strict=True)):
        own = done.get(i, Whole(bench, r))
        every.append((c, own.refit, x - volume(at.bench), left_in(at.bench, own)))
    return ranked(every, without, at.bench, effort.temperature)


def _no_worse(whole: Whole, without: Refit) -> Whole:
    """A fit, begun again where that without its candidate ended if it leaves more than that: it went astray.

    Args:
        whole: the fit.
        without: to the same bench.
    """
    bench, found = whole
    if found.fit.squares <= without.fit.squares or not math.isfinite(without.fit.evidence):
        return whole
    again = refitted(bench, found.hypothesis, **start_from(without, bench), steps=LINKED, gain=FINE)
    return Whole(bench, again) if value(again, bench) > value(found, bench) else whole


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
