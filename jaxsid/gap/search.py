"""The search for what explains records: one effect after another, those before it asked again, numbers at the end."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from jaxsid.gap.closely import PARTED, SLOWLY, begun_along, closely, parting, tightened
from jaxsid.gap.examine import Examination
from jaxsid.gap.explain import (
    ALONE,
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
from jaxsid.gap.later import changes_found
from jaxsid.gap.locate import likeliest
from jaxsid.gap.look import (
    Look,
    at_likeliest,
    attached_candidates,
    candidates_elsewhere,
    candidates_of,
    looked,
    slight,
    to_try,
    varied,
)
from jaxsid.gap.null import SIGNIFICANT, found_part
from jaxsid.gap.numbers_off import hint, numbers_off
from jaxsid.gap.ranking import (
    ERRORS,
    WORTH,
    Explanation,
    Ranking,
    Whole,
    alike,
    clearly,
    ends_of,
    key_of,
    loud,
    notable,
    parsimonious,
    worth,
)
from jaxsid.gap.refit import (
    Bench,
    Hypothesis,
    Refit,
    bench_of,
    changes_of,
    refitted,
    resolved,
    states_without,
    tied,
    weighed_anew,
)
from jaxsid.gap.screen import Candidate, unseen
from jaxsid.gap.sliding import sliding
from jaxsid.gap.wider import holding, wider
from jaxsid.gap.windows import SHORTEST
from jaxsid.mechanics.lumped import LumpedModel
from jaxsid.records import Record

MOST_EFFECTS = 2
TELLING = 4.0  # tempered gain of evidence from which on numbers are taken beside effects
LACKING = 4  # springs, dampers, masses that are tried beside them
POLISHED = 60  # most steps of the fit of what is chosen
SHIFT = 0.3  # of its numbers, in their deviations, that steps may be too long by
LEAST = 0.01  # part of all that is left that an effect must remove, or a first one MOSTLY what tests find
MOSTLY = 0.5
MOST_TURNS = 5  # of asking again
CLOSELY = 6  # laws of the most probable place that are tried where none leaves little
AGAIN = 6  # others that an effect is compared with when it is asked again, of each sort
FAR = 4.0  # times what an effect left when it was found, that others which left more are not asked again


class Found(NamedTuple):
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

    def taken(self, ranking: Ranking) -> "Found":
        """With the best of a round, fitted to the very bottom, its noise what is left there."""
        best, bench, last = ranking.ranked[0], ranking.bench, ranking.ranked[0].refit
        for anew in (False, True):
            bench = weighed_anew(resolved(bench, last, shift=SHIFT), last) if anew else bench
            begin = {"changes": changes_of(last, bench), "states": last.fit.states}
            last = refitted(bench, last.hypothesis, steps=POLISHED, **begin)
            bench, last = tied(bench, last, steps=POLISHED)
        bench, last = tightened(bench, last)
        bench = bench._replace(states=last.fit.states)
        rounds = (*self.rounds[: len(self.selected)], ranking)
        return Found(bench, self.look, rounds, (*self.selected, best._replace(refit=last)), last)

    def refused(self, ranking: Ranking) -> "Found":
        """Without; what a refused effect leaves is no noise, and its round of interest only where there is no other."""
        return self if self.selected else self._replace(bench=ranking.bench, rounds=(ranking,))


def searched(
    model: LumpedModel, seen: Sequence[Record], found: Examination, say: Callable[[str], None]
) -> Found:
    """All that is found: effects where the structure is in doubt, then numbers of the model.

    Args:
        model: nominal; its effects are left out.
        seen: records that may be looked at.
        found: examination of them.
        say: called with a line of text as each stage begins.
    """
    say("kinds of effects")
    start = Found(
        bench_of(model, seen, found.noises, found.fit),
        Look(found.fit, found.null, found.scored),
        (),
        (),
        None,
    )
    structure = found.finding == "structure"
    at = _effects(start, model, seen, say) if structure else start
    if structure and (at.selected or not slight(found)):
        return _numbers(at, (), model, seen, say)
    # numbers alone may be off
    within = refitted(start.bench, Hypothesis(), changes=changes_found(found))
    alone = start._replace(before=within, look=start.look._replace(scored=None))
    lacking = attached_candidates(start.look)[:LACKING]
    off = _numbers(alone, lacking, model, seen, say)
    return off if off.selected or not structure else at


def small_beside(at: Found, model: LumpedModel, seen: Sequence[Record], say: Callable[[str], None]) -> Found:
    """With one effect more that acts elsewhere, if one is worth it, however little of the response it is.

    Args:
        at: something was found, which leaves a clear look.
        model: nominal.
        seen: records that may be looked at.
        say: called with a line of text as each stage begins.
    """
    if at.before is None or len(at.selected) >= MOST_EFFECTS:
        return at
    look = looked(model, seen, at.bench, at.before, little=True)
    candidates = candidates_elsewhere(look, at.selected)
    more = _further(at._replace(look=look), candidates, FURTHER, model, seen, say)
    return at if len(more.selected) == len(at.selected) else _reconsidered(more, model, seen, say)


def _effects(at: Found, model: LumpedModel, seen: Sequence[Record], say: Callable[[str], None]) -> Found:
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
            at, origin = _followed(at, origin, candidates, model, seen, say) or (at, origin)
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
    tried: Found,
    origin: Found,
    candidates: Sequence[Candidate],
    model: LumpedModel,
    seen: Sequence[Record],
    say: Callable[[str], None],
) -> tuple[Found, Found] | None:
    """The first effect as windows of a few samples tell it, with it and without; None where that explains no more.

    Where its neighbouring motions hardly part usual windows do, from the motion and the law that were so found.
    """
    look, here = origin.look, at_likeliest(origin.look, candidates)[:CLOSELY]
    if look.scored is None or not here or "between" not in likeliest(look.scored).as_dict():
        return None
    say("in windows of a few samples")
    begin = origin._replace(bench=closely(model, seen, origin.bench.guesses, look.fit, look.scored))
    at = _further(begin, here, FIRST, model, seen, say)
    if not at.selected:
        return None
    law, told = at.selected[-1], not loud(at.rounds[-1])
    # neighbours part under laws that bend alone; short windows forgive a linear one what it lacks
    if told and not law.refit.hypothesis.linear and parting(at.bench, law.refit) > PARTED:
        return (at, begin) if at.look.clear else _longer(at, origin, here, model, seen, say) or (at, begin)
    if not told and law.key in {x.key for x in tried.selected}:
        return None
    usual = origin._replace(bench=begun_along(origin.bench, at.bench, law.refit))
    own = again(law, law.refit)._replace(changes=changes_of(law.refit, at.bench))
    new = _further(usual, (own, *candidates), FIRST, model, seen, say)
    # beside another effect, still to be found, much is left
    if new.selected and (not loud(new.rounds[-1]) or clearly(new.rounds[-1], tried.rounds[-1])):
        return new, usual
    # a law under which the motion may leave for good where it errs is told by short windows alone
    held = any(x.key == law.key and math.isfinite(x.evidence) for x in new.rounds[-1].ranked)
    return (at, begin) if told and not held else None


def _longer(
    at: Found,
    origin: Found,
    here: tuple[Candidate, ...],
    model: LumpedModel,
    seen: Sequence[Record],
    say: Callable[[str], None],
) -> tuple[Found, Found] | None:
    """Windows that stand alone and begin along those of a few samples, if tests find nothing in what they leave.

    Those may be corrected from one to the next, so that a law a little off leaves no more in them than the true one.
    """
    say("in longer windows, along them")
    last, law = at.selected[-1], at.selected[-1].refit
    longer = bench_of(model, seen, origin.bench.guesses, origin.look.fit, length=SHORTEST)
    longer = begun_along(longer, at.bench, law)
    # to the very bottom before noise is weighed anew: it would take up what a law a little off leaves
    along = refitted(longer, law.hypothesis, changes=changes_of(law, at.bench), steps=SLOWLY)
    begin = origin._replace(bench=longer._replace(states=along.fit.states))
    own = again(last, along)._replace(changes=changes_of(along, longer))
    new = _further(begin, (own, *here), FIRST, model, seen, say)
    return (new, begin) if new.selected and new.look.clear else None


def _elsewhere(
    at: Found,
    origin: Found,
    first: Sequence[Candidate],
    model: LumpedModel,
    seen: Sequence[Record],
    say: Callable[[str], None],
) -> Found:
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
    at: Found,
    origin: Found,
    first: Sequence[Candidate],
    model: LumpedModel,
    seen: Sequence[Record],
    say: Callable[[str], None],
) -> Found:
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
    at: Found,
    candidates: tuple[Candidate, ...],
    effort: Effort,
    model: LumpedModel,
    seen: Sequence[Record],
    say: Callable[[str], None],
) -> Found:
    """With one effect more, if any is worth it, and what is left then."""
    ranking = rank(at.bench, candidates, at.before, effort, say)
    if not ranking.ranked or not worth(ranking, 0.0 if at.selected else _least(at.look)):
        return at.refused(ranking)
    little = bool(at.selected) and not worth(ranking, LEAST)
    if little and any(ends_of(x.place) == ends_of(ranking.ranked[0].place) for x in at.selected):
        return at.refused(ranking)
    ranking, found = _slid(at, ranking, at.taken(ranking), say)
    if not (found.holds and found.selected[-1].told):
        return at.refused(ranking)
    say("what is left")
    found = _left(found, model, seen)
    # beside a law that is not quite the true one there is always a little more to explain, and never all of it
    if little and found.look.null.p_value < SIGNIFICANT:
        return at.refused(ranking)
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


def _slid(at: Found, ranking: Ranking, found: Found, say: Callable[[str], None]) -> tuple[Ranking, Found]:
    """A round and what was taken of it, with friction that gives for a loop that slides once fitted to the bottom."""
    if found.before is None or not found.holds:
        return ranking, found
    anew = sliding(ranking, say, Whole(found.bench, found.before))
    other = found if anew is ranking else at.taken(anew)
    return (anew, other) if other.holds else (ranking, found)


def _left(at: Found, model: LumpedModel, seen: Sequence[Record]) -> Found:
    """With a look at what is left."""
    assert at.before is not None
    return at._replace(look=looked(model, seen, at.bench, at.before))


def _reconsidered(at: Found, model: LumpedModel, seen: Sequence[Record], say: Callable[[str], None]) -> Found:
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
    at: Found, i: int, model: LumpedModel, seen: Sequence[Record], say: Callable[[str], None]
) -> tuple[Found, bool]:
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


def _without(at: Found, x: Explanation, model: LumpedModel) -> tuple[Refit, tuple[np.ndarray, ...]]:
    """What was found, less one effect; and the states of windows where it is there, to begin from with another."""
    assert at.before is not None
    of = at.before.hypothesis
    gone = [i for i, e in enumerate(of.effects) if key_of(e.kind, dict(e.place)) == x.key]
    states = states_without(at.before, gone[0]) if gone else at.before.fit.states
    effects = tuple(e for i, e in enumerate(of.effects) if i not in gone)
    wrong = tuple(i for i in of.wrong if i not in elements_by_key(model).get(x.key, ()))
    start = {"changes": changes_of(at.before, at.bench), "states": states}
    return refitted(at.bench, Hypothesis(effects, wrong), **start), states


def _in_place(at: Found, i: int, ranking: Ranking) -> Found:
    """With the best of a round in the place of the effect that was found i-th."""
    new = Found(ranking.bench, at.look, (), (), None).taken(ranking)
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
    at: Found,
    lacking: tuple[Candidate, ...],
    model: LumpedModel,
    seen: Sequence[Record],
    say: Callable[[str], None],
) -> Found:
    """Numbers off by more than they may be, and what looks like them; the first where tests doubt numbers alone."""
    begun = len(at.selected)
    while len(at.selected) < MOST_EFFECTS and at.before is not None:
        off = numbers_off(at.bench, at.before)
        beside = bool(at.selected) or at.look.scored is not None
        least, effort = (TELLING, NUMBERS) if beside else (0.0, ALONE)
        if not off or (
            least and not any(hint(at.bench, at.before, x, NUMBERS) > least / 2 for x in (*off, *lacking))
        ):
            return at
        if (law := _wider(at, off, model, seen, say)) is not at:
            at = law
            continue
        # the number farthest off, what the model lacks, the others
        candidates = (*off[:1], *lacking, *off[1:])
        ranking = rank(at.bench, candidates, at.before, effort, say)
        found = at.taken(ranking) if ranking.gain > least else at
        if found is at or not found.holds:
            at = at.refused(ranking)
            break
        at = found
    if begun and len(at.selected) > begun:
        say("what is left")
        at = _reconsidered(_left(at, model, seen), model, seen, say)
    return at


def _wider(
    at: Found,
    off: Sequence[Candidate],
    model: LumpedModel,
    seen: Sequence[Record],
    say: Callable[[str], None],
) -> Found:
    """With a law in the place of one that it holds, if it alone explains more than a number off there beside that."""
    assert at.before is not None
    errors = [c for c in off if c.kind in ERRORS.values()]
    for i, x in enumerate(at.selected):
        here = [c for c in errors if holding(x.kind) and ends_of(c.place) == ends_of(x.place)]
        without = _without(at, x, model)[0] if here else None
        law = without and wider(at.bench, at.before, x, at.rounds[i], without, NUMBERS.steps)
        if not law or law.ranked[0].key == x.key:
            continue
        say(f"{law.ranked[0].kind} in place of {x.kind}")
        gain = (law.ranked[0].evidence - at.before.fit.evidence) / law.scale / NUMBERS.temperature
        if gain > max(TELLING, *(hint(at.bench, at.before, c, NUMBERS) for c in here)):
            new = _in_place(at, i, law)
            return _left(new, model, seen) if new.holds else at
    return at


def _least(look: Look) -> float:
    """Part of all that is left that a first effect must remove: tests may be certain of little, too."""
    return min(LEAST, MOSTLY * found_part(look.null, look.fit))
