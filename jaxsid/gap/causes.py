"""Why a model and records part: effects found one after another, how far the gap shrinks, and what is left."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from jaxsid.gap.closely import PARTED, begun_near, closely, motions_to_begin, parting, tightened
from jaxsid.gap.closure import Closure, Left, closure_of, left_of
from jaxsid.gap.examine import Examination
from jaxsid.gap.explain import (
    FIRST,
    FURTHER,
    NUMBERS,
    Effort,
    again,
    elements_by_key,
    elsewhere,
    extended,
    plainer,
    rank,
    rank_again,
)
from jaxsid.gap.hypothesis import FIXED
from jaxsid.gap.later import best_linear, changes_found, later_than_effects, later_than_linear
from jaxsid.gap.locate import Scored, likeliest
from jaxsid.gap.look import Look, at_likeliest, attached_candidates, candidates_of, looked, to_try, varied
from jaxsid.gap.measure import is_free_or_unstable
from jaxsid.gap.noise import Noise, no_louder, quieter
from jaxsid.gap.null import Null, found_part
from jaxsid.gap.numbers_off import hint, numbers_off
from jaxsid.gap.ranking import WORTH, Explanation, Ranking, alike, key_of, loud, notable, parsimonious, worth
from jaxsid.gap.refit import (
    Bench,
    Hypothesis,
    Refit,
    bench_of,
    changes_of,
    refitted,
    states_without,
    tied,
    weighed_anew,
)
from jaxsid.gap.screen import Candidate, unseen
from jaxsid.mechanics.lumped import LumpedModel
from jaxsid.records import Record

MOST_EFFECTS = 2
SLIGHT = 0.3  # of what is left: a part that tests find but that is of no matter
TELLING = 4.0  # tempered gain of evidence from which on numbers are taken beside effects
LACKING = 4  # springs, dampers, masses that are tried beside them
POLISHED = 60  # most steps of the fit of what is chosen
LEAST = 0.01  # part of all that is left that an effect must remove, or a first one MOSTLY what tests find
MOSTLY = 0.5
MOST_TURNS = 5  # of asking again
CLOSELY = 6  # laws of the most probable place that are tried where none leaves little
AGAIN = 6  # others that an effect is compared with when it is asked again, of each sort
FAR = 4.0  # times what an effect left when it was found, that others which left more are not asked again


class Causes(NamedTuple):
    """What explains records.

    Attributes:
        rounds: candidates of each round, the last of which may have been refused.
        chosen: the best explanation.
        selected: what it adds to the nominal model, in the order in which it was found.
        nominal, recalibrated: the model as it is, and the best linear one, fitted the same way.
        closures: of every selected effect together with those before it, on held-out samples; of the model within
            its tolerance where none was selected.
        lefts: what each of these leaves of these samples.
        linear: how far the gap shrinks with the best linear model alone.
        before: what the nominal model and the best linear one leave of these samples.
        later: how many samples of each record must be seen for all that it holds; as many as were where what was
            chosen leaves no more of the others.
        noises: of each record; where it is guessed, what the chosen model leaves if tests find nothing in it, else no
            more than that.
        remaining: tests of what is left of the other samples.
        places: where that would arise; None where nothing is left.
    """

    rounds: tuple[Ranking, ...]
    chosen: Refit
    selected: tuple[Explanation, ...]
    nominal: Refit
    recalibrated: Refit
    closures: tuple[Closure, ...]
    lefts: tuple[Left, ...]
    linear: Closure
    noises: tuple[Noise, ...]
    remaining: Null
    places: Scored | None
    before: tuple[Left, Left]
    later: tuple[int, ...]

    @property
    def bounded(self) -> bool:
        """Whether the noise is guessed and tests find more than noise in what is left: it is no more than that."""
        return self.places is not None and any(n.degrees <= 0 for n in self.noises)

    @property
    def most(self) -> str:
        """Words before a figure of the noise."""
        return "at most " if self.bounded else ""

    def first(self, count: int) -> "Causes":
        """The same with the first effects only; with the best linear model where there are none.

        Args:
            count: how many.
        """
        if count == len(self.selected):
            return self
        selected, closures, lefts = self.selected[:count], self.closures[:count], self.lefts[:count]
        return self._replace(
            selected=selected,
            chosen=selected[-1].refit if selected else self.recalibrated,
            closures=closures or (self.linear,),
            lefts=lefts or self.before[1:],
        )


def causes_of(
    model: LumpedModel,
    seen: Sequence[Record],
    whole: Sequence[Record],
    found: Examination,
    *,
    progress: Callable[[str], None] | None = None,
) -> Causes:
    """Effects that explain records, one after another, as long as each explains much of what is left.

    Args:
        model: nominal; its effects are left out.
        seen: records without their held-out ends, that everything is chosen and fitted with.
        whole: records as they are.
        found: examination of the former.
        progress: called with a line of text as each stage begins.
    """
    say = progress or (lambda text: None)
    at = _searched(model, seen, found, say)
    bench, look, rounds, selected = at.bench, at.look, at.rounds, list(at.selected)
    plain = rounds[0].without if rounds else refitted(bench, Hypothesis())
    chosen = plain if at.before is None else at.before
    linear = best_linear(bench, changes_of(chosen, bench))
    if found.finding == "parameters" and (not selected or _beyond(linear, chosen, rounds[-1].scale)):
        chosen, selected = linear, []
    say("how far the gap shrinks")
    ends = tuple(len(r.y) for r in seen)
    motions = motions_to_begin(bench, whole, found.noises, found.scored)
    windowed = is_free_or_unstable(model) or motions is not None
    lefts = partial(left_of, bench=bench, records=whole, ends=ends, windowed=windowed, motions=motions)
    frozen = bench._replace(tolerance=np.full_like(bench.tolerance, FIXED))
    before = lefts(refitted(frozen, Hypothesis())), lefts(linear)
    steps = [lefts(x.refit) for x in selected] or [lefts(chosen)]
    names = [s.name for s in model.sensors]
    # what is left is noise where tests find nothing in it, else more than that
    less = partial(quieter, found=found_part(look.null, look.fit))
    told = bench.noises if look.clear else tuple(map(less, found.noises, bench.noises))
    floor = tuple(map(no_louder, told, steps[-1].left))
    *each, alone = (closure_of(*before, x, floor, names) for x in (*steps, before[1]))
    if motions is not None:
        later = ends  # no run tells what comes later
    elif selected:
        later = later_than_effects(chosen, bench, whole, ends, each[-1])
    else:
        later = later_than_linear(found, linear, bench, whole, ends, before[1])
    return Causes(
        rounds,
        chosen,
        tuple(selected),
        plain,
        linear,
        tuple(each),
        tuple(steps),
        alone,
        floor,
        look.null,
        None if look.clear else look.scored,
        before,
        later,
    )


def _searched(
    model: LumpedModel, seen: Sequence[Record], found: Examination, say: Callable[[str], None]
) -> "_Found":
    """All that is found: effects where the structure is in doubt, then numbers of the model."""
    say("kinds of effects")
    start = _Found(
        bench_of(model, seen, found.noises, found.fit),
        Look(found.fit, found.null, found.scored),
        (),
        (),
        None,
    )
    if found.finding == "structure":
        at, lacking = _effects(start, model, seen, say), ()
    else:
        within = refitted(start.bench, Hypothesis(), changes=changes_found(found))
        at = start._replace(before=within, look=start.look._replace(scored=None))
        lacking = attached_candidates(start.look)[:LACKING]
    return _numbers(at, lacking, model, seen, say)


class _Found(NamedTuple):
    """How far the search has come: what is there, the rounds in which it was found, the fit; None before the first."""

    bench: Bench
    look: Look
    rounds: tuple[Ranking, ...]
    selected: tuple[Explanation, ...]
    before: Refit | None

    @property
    def holds(self) -> bool:
        """Whether the last fit is one: under what was found last the motion may grow without bound."""
        return self.before is not None and bool(np.isfinite(self.before.fit.evidence))

    def taken(self, ranking: Ranking) -> "_Found":
        """With the best of a round, fitted to the very bottom, its noise what is left there."""
        best, bench, last = ranking.ranked[0], ranking.bench, ranking.ranked[0].refit
        for anew in (False, True):
            bench = weighed_anew(bench, last) if anew else bench
            begin = {"changes": changes_of(last, bench), "states": last.fit.states}
            last = refitted(bench, last.hypothesis, steps=POLISHED, **begin)
            bench, last = tied(bench, last, steps=POLISHED)
        bench, last = tightened(bench, last)
        bench = bench._replace(states=last.fit.states)
        rounds = (*self.rounds[: len(self.selected)], ranking)
        return _Found(bench, self.look, rounds, (*self.selected, best._replace(refit=last)), last)

    def refused(self, ranking: Ranking) -> "_Found":
        """Without; what a refused effect leaves is no noise, and its round of interest only where there is no other."""
        return self if self.selected else self._replace(bench=ranking.bench, rounds=(ranking,))


def _effects(at: _Found, model: LumpedModel, seen: Sequence[Record], say: Callable[[str], None]) -> _Found:
    """Effects one after another, those found before asked again after each."""
    assert at.look.scored is not None
    # on a free axis lines do not show what is steady, and little is right without it
    steady = unseen(at.bench.model, at.look.scored.places)
    with_steady = _further(at, steady, FIRST, model, seen, say) if steady else at
    at = with_steady if with_steady.selected else at
    origin, first = at, candidates_of(at.look)
    begun = len(at.selected)
    most, candidates = MOST_EFFECTS + begun, first
    for effort in (FIRST, *[FURTHER] * MOST_EFFECTS):
        known = len(at.selected)
        if not candidates:
            break
        at = _further(at, candidates, effort, model, seen, say)
        if not origin.selected and effort is FIRST and not at.look.clear and loud(at.rounds[-1]):
            at, origin = _followed(origin, candidates, model, seen, say) or (at, origin)
        if len(at.selected) == known == begun + 1 and not at.look.clear:
            at = _elsewhere(at, origin, first, model, seen, say)
            at = _otherwise(at, origin, first, model, seen, say)
        if len(at.selected) == known:
            break
        if steady and known == 0:
            # beside what was far larger it was not worth it
            at = _further(at, steady, FURTHER, model, seen, say)
            most += len(at.selected) - 1
        at = _reconsidered(at, model, seen, say)
        if len(at.selected) >= most:
            break
        candidates = to_try(at.look, first)
    return at


def _followed(
    origin: _Found,
    candidates: Sequence[Candidate],
    model: LumpedModel,
    seen: Sequence[Record],
    say: Callable[[str], None],
) -> tuple[_Found, _Found] | None:
    """The first effect as windows of a few samples tell it, with it and without; None where none explains.

    Where its neighbouring motions hardly part usual windows do, from the motion and the law that were so found.
    """
    look, here = origin.look, at_likeliest(origin.look, candidates)[:CLOSELY]
    if look.scored is None or not here or "between" not in likeliest(look.scored).as_dict():
        return None
    say("in windows of a few samples")
    begin = origin._replace(bench=closely(model, seen, origin.bench.guesses, look.fit, look.scored))
    at = _further(begin, here, FIRST, model, seen, say)
    if not at.selected or loud(at.rounds[-1]):
        return None
    law = at.selected[-1]
    if parting(at.bench, law.refit) > PARTED:
        return at, begin
    begin = origin._replace(bench=begun_near(origin.bench, look.scored))
    own = again(law, law.refit)._replace(changes=changes_of(law.refit, at.bench))
    at = _further(begin, (own, *candidates), FIRST, model, seen, say)
    return (at, begin) if at.selected and not loud(at.rounds[-1]) else None


def _elsewhere(
    at: _Found,
    origin: _Found,
    first: Sequence[Candidate],
    model: LumpedModel,
    seen: Sequence[Record],
    say: Callable[[str], None],
) -> _Found:
    """Where nothing more explains what an effect leaves: the same law, if it explains more at another place."""
    once = at.rounds[-1]
    anew = elsewhere(once, first, origin.before, FIRST, say)
    if anew is once:
        return at
    new = origin.taken(anew)
    new = _left(new, model, seen) if new.holds else at
    if new is at or new.look.clear:
        return new
    return _further(new, to_try(at.look, first), FURTHER, model, seen, say)


def _otherwise(
    at: _Found,
    origin: _Found,
    first: Sequence[Candidate],
    model: LumpedModel,
    seen: Sequence[Record],
    say: Callable[[str], None],
) -> _Found:
    """Likewise: one hardly told from the effect, if something does beside that."""
    ranking = at.rounds[-1]
    best, whole = ranking.ranked[0], len(ranking.bench.blocks)
    close = (y for y in ranking.ranked[1:] if alike(y, best, ranking) and len(y.refit.fit.states) == whole)
    y = None if at.look.clear or len(at.selected) > len(origin.selected) + 1 else next(close, None)
    if y is None:
        return at
    say(f"{y.kind} in place of {best.kind}")
    other = origin.taken(ranking._replace(ranked=(y, *(x for x in ranking.ranked if x is not y))))
    if not other.holds:
        return at
    other = _left(other, model, seen)
    further = _further(other, to_try(other.look, first), FURTHER, model, seen, say)
    return further if len(further.selected) > len(at.selected) else at


def _further(
    at: _Found,
    candidates: tuple[Candidate, ...],
    effort: Effort,
    model: LumpedModel,
    seen: Sequence[Record],
    say: Callable[[str], None],
) -> _Found:
    """With one effect more, if any is worth it, and what is left then."""
    ranking = rank(at.bench, candidates, at.before, effort, say)
    if not ranking.ranked or not worth(ranking, LEAST if at.selected else _least(at.look)):
        return at.refused(ranking)
    found = at.taken(ranking)
    if not (found.holds and found.selected[-1].told):
        return at.refused(ranking)
    say("what is left")
    found = _left(found, model, seen)
    if found.look.clear:
        return found
    plain = plainer(ranking, at.before, effort, say)
    if at.selected and not notable(plain):
        return at.refused(ranking)
    if plain.ranked[0].key == ranking.ranked[0].key:
        last = found.selected[-1]._replace(probability=plain.ranked[0].probability)
        return found._replace(rounds=(*found.rounds[:-1], plain), selected=(*found.selected[:-1], last))
    say("what is left")
    other = at.taken(plain)
    return _left(other, model, seen) if other.holds else found


def _left(at: _Found, model: LumpedModel, seen: Sequence[Record]) -> _Found:
    """With a look at what is left."""
    assert at.before is not None
    return at._replace(look=looked(model, seen, at.bench, at.before))


def _reconsidered(
    at: _Found, model: LumpedModel, seen: Sequence[Record], say: Callable[[str], None]
) -> _Found:
    """Every effect but the last beside those found later: left out, or another that explains more in its place.

    While a later effect was still to be found others may have come first for what they took of it. Where one has
    changed, those beside it are asked again.
    """
    due, before = [x.key for x in at.selected[:-1]], at.selected
    for _ in range(MOST_TURNS):
        if not due:
            break
        asked, keys = due.pop(0), {x.key for x in at.selected}
        at, changed = _turn(at, [x.key for x in at.selected].index(asked), model, seen, say)
        if changed:
            # what has just come in has been compared; one alone has nothing beside it
            due = [x.key for x in at.selected if x.key in keys] if len(at.selected) > 1 else []
    same = [x.key for x in before] == [x.key for x in at.selected]
    return at if same else _left(at, model, seen)


def _turn(
    at: _Found, i: int, model: LumpedModel, seen: Sequence[Record], say: Callable[[str], None]
) -> tuple[_Found, bool]:
    """One effect asked again beside all others, and whether that changes anything."""
    x = at.selected[i]
    say(f"{x.kind} beside the others")
    without, states = _without(at, x, model)
    assert at.before is not None
    # what came next to it once, what comes first beside the others, and other laws of the place
    once = [again(y, y.refit) for y in at.rounds[i].ranked if y.key != x.key and y.left < FAR * x.left]
    # where nothing holds the motion without it there is nothing to look at
    told = np.isfinite(without.fit.evidence)
    now = candidates_of(looked(model, seen, at.bench, without)) if told else ()
    here = [c for c in now if key_of(x.kind, c.place) == x.key]
    others = [*once[:AGAIN], *varied(now)[:AGAIN], *here[:AGAIN]]
    ranking = rank_again(at.bench._replace(states=states), at.before, x, others, without, FURTHER, say)
    ranking = ranking if at.look.clear else parsimonious(ranking)
    rounds, selected = list(at.rounds), list(at.selected)
    if ranking.gain <= WORTH or not x._replace(refit=at.before).told:
        del rounds[i], selected[i]
        selected[-1] = selected[-1]._replace(refit=without)
        return at._replace(rounds=tuple(rounds), selected=tuple(selected), before=without), True
    if ranking.ranked[0].key == x.key:
        rounds[i] = ranking
        selected[i] = x._replace(probability=ranking.ranked[0].probability)
        return at._replace(rounds=tuple(rounds), selected=tuple(selected)), False
    new = _in_place(at, i, ranking)
    return (new, True) if new.holds else (at, False)


def _without(at: _Found, x: Explanation, model: LumpedModel) -> tuple[Refit, tuple[np.ndarray, ...]]:
    """What was found, less one effect; and the states of windows where it is there, to begin from with another."""
    assert at.before is not None
    of = at.before.hypothesis
    gone = [i for i, e in enumerate(of.effects) if key_of(e.kind, dict(e.place)) == x.key]
    states = states_without(at.before, gone[0]) if gone else at.before.fit.states
    effects = tuple(e for i, e in enumerate(of.effects) if i not in gone)
    wrong = tuple(i for i in of.wrong if i not in elements_by_key(model).get(x.key, ()))
    start = {"changes": changes_of(at.before, at.bench), "states": states}
    return refitted(at.bench, Hypothesis(effects, wrong), **start), states


def _in_place(at: _Found, i: int, ranking: Ranking) -> _Found:
    """With the best of a round in the place of the effect that was found i-th."""
    new = _Found(ranking.bench, at.look, (), (), None).taken(ranking)
    assert new.before is not None
    rounds, selected = list(at.rounds), list(at.selected)
    rounds[i], selected[i] = ranking, new.selected[0]
    hypothesis, errors = Hypothesis(), elements_by_key(new.bench.model)
    for j, x in enumerate(selected):
        hypothesis = extended(hypothesis, again(x, new.before), errors)
        last = j == len(selected) - 1
        fit = (
            new.before if last else refitted(new.bench, hypothesis, changes=changes_of(new.before, new.bench))
        )
        selected[j] = x._replace(refit=fit)
    return new._replace(rounds=tuple(rounds), selected=tuple(selected))


def _numbers(
    at: _Found,
    lacking: tuple[Candidate, ...],
    model: LumpedModel,
    seen: Sequence[Record],
    say: Callable[[str], None],
) -> _Found:
    """Numbers off by more than they may be, and what looks like them; the first where tests doubt numbers alone."""
    begun = len(at.selected)
    while len(at.selected) < MOST_EFFECTS and at.before is not None:
        off = numbers_off(at.bench, at.before)
        least = TELLING if at.selected or at.look.scored is not None else 0.0
        if not off or (
            least and not any(hint(at.bench, at.before, x, NUMBERS) > least / 2 for x in (*off, *lacking))
        ):
            return at
        # the number farthest off, what the model lacks, the others
        candidates = (*off[:1], *lacking, *off[1:])
        ranking = rank(at.bench, candidates, at.before, NUMBERS, say)
        found = at.taken(ranking) if ranking.gain > least else at
        if found is at or not found.holds:
            at = at.refused(ranking)
            break
        at = found
    if begun and len(at.selected) > begun:
        say("what is left")
        at = _reconsidered(_left(at, model, seen), model, seen, say)
    return at


def _beyond(linear: Refit, chosen: Refit, scale: float) -> bool:
    """Whether all of the model's numbers together explain more than the few that were singled out.

    Not tempered: where they leave noise there is nothing that no hypothesis has.
    """
    return (linear.fit.evidence - chosen.fit.evidence) / scale > WORTH


def _least(look: Look) -> float:
    """Part of all that is left that a first effect must remove: tests may be certain of little, too."""
    return min(LEAST, MOSTLY * found_part(look.null, look.fit))
