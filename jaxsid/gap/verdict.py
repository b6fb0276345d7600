"""What is concluded from explanations that were fitted: whether they explain enough, and which cannot be told apart."""

import math
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from jaxsid.gap.causes import Causes
from jaxsid.gap.closure import CLEAR, UNSURE, Closure, fraction, substantial
from jaxsid.gap.examine import Examination
from jaxsid.gap.locate import located
from jaxsid.gap.look import slight
from jaxsid.gap.ranking import ERRORS, Explanation, ends_of
from jaxsid.mechanics.effects.catalogue import CATALOGUE

LIKELY = 0.9  # probability that the explanations named have together
ENOUGH = 0.6  # part of the best linear model's gap, on held-out samples, below which nothing explains it
MORE = 0.88  # likewise, where more than noise is left and no dry friction or hysteresis was found
SURE = 1.1  # what is left over the noise floor from which on that is so
STEEP = 8.0  # how fast the probability of "unknown" grows about that
MOST = 0.5  # part of what was left that an effect beside an unknown one explains
IMITATED = 0.6  # probability that two such springs at one place stand for one that is not in the catalogue
TWOFOLD = 0.4  # likewise of any two laws at one place: that they stand for another, or one of them for what it lacks
POLYNOMIAL = {"quadratic_stiffness", "cubic_stiffness"}  # two that are one law, of a curve that is not even
LAPSE = 0.02  # share of cases of the fifth test set in which what explains all, far ahead of all else, is not the truth
# likewise where tests find more than noise in what it leaves, and that is over so much of what the linear model does
SHRUNK, REMAINDER = 0.25, 0.35
HARDLY, USELESS = 0.9, 0.75  # 3 of 4 cases, all whose noise was guessed
SPARED = 0.5  # of what tests found in the samples seen: an effect that leaves them less was of use there
OTHER = (
    0.9  # likewise of laws that one of another shape surely adds to, 19 of 22, one of the others found since
)
MISSED = 0.08  # of cases of the second test set where nothing explains enough: the catalogue holds the truth


class Verdict(NamedTuple):
    """The conclusion.

    Attributes:
        name: "none", "effect", "ambiguous" or "unknown".
        probability: of none, of an effect of the catalogue, of one that is not in it.
        likely: for each effect that was found, the explanations that are not told apart, most probable first.
        imitating: effects of the catalogue that look like one that is not in it.
        paired: two laws at one place, where that is the most likely reason why none of the catalogue would be right.
        outrun: whether those that look like it explain the samples that they were fitted to, but not the others.
    """

    name: str
    probability: dict[str, float]
    likely: tuple[tuple[Explanation, ...], ...]
    imitating: tuple[Explanation, ...] = ()
    paired: tuple[Explanation, ...] = ()
    outrun: bool = False


def concluded(found: Examination, causes: Causes | None) -> tuple[Causes | None, Verdict]:
    """The verdict, and what of the causes it leaves standing: a stand-in for an unknown law is no effect found.

    Args:
        found: the examination of the gap.
        causes: what explains it; None where it agrees with noise.
    """
    verdict = verdict_of(found, causes)
    if causes is None or verdict.name != "unknown":
        return causes, verdict
    kept = _beside(causes)
    return causes.first(kept), verdict._replace(likely=verdict.likely[:kept])


def verdict_of(found: Examination, causes: Causes | None) -> Verdict:
    """What records and fits say.

    Args:
        found: the examination of the gap.
        causes: what explains it; None where it agrees with noise.
    """
    doubt = float(min(found.nominal_p_value, found.structural_p_value))
    if causes is None:
        some = 0.5 * math.exp(-doubt / 0.05)
        return Verdict("none", {"none": 1 - some, "effect": some, "unknown": 0.0}, ())
    if found.finding == "structure" and not causes.selected and slight(found):
        some = float(sum(x.probability for r in causes.rounds[:1] for x in r.ranked))
        return Verdict("none", {"none": 1 - some, "effect": some, "unknown": 0.0}, ())
    pairs = _at_one_place(causes.selected)
    imitating = _imitating(pairs)
    unexplained, twofold = _unexplained(causes, found), IMITATED if imitating else TWOFOLD
    paired = pairs[0] if pairs and twofold > unexplained else ()
    unexplained = twofold if paired else unexplained
    if other := _instead_of_another(causes):
        unexplained, imitating, paired = max(unexplained, OTHER), other, ()
    probability = {"none": 0.0, "effect": 1 - unexplained, "unknown": unexplained}
    likely = tuple(_set(r.ranked) for r in causes.rounds[: len(causes.selected)])
    if unexplained > 0.5:
        asked = bool(causes.selected) and causes.places is None and causes.telling.unsure > 0
        outrun = asked and not imitating and causes.seen.against_recalibrated > ENOUGH
        return Verdict(
            "unknown", probability, likely, causes.selected if outrun else imitating, outrun=outrun
        )
    open_ones = any(len(x) > 1 for x in likely)
    return Verdict("ambiguous" if open_ones else "effect", probability, likely, paired=paired)


def _unexplained(causes: Causes, found: Examination) -> float:
    """Probability that the law is not among those tried: by how much of the gap the best one leaves.

    Beside the best linear model only where tests find more than it explains: what that leaves of other samples, near a
    resonance of which those seen tell little, is its own error.
    """
    last = causes.telling
    if not causes.selected and causes.chosen is not causes.recalibrated:
        return 1 - MISSED
    # what comes nearest to a law that is not there explains most of its gap, but not to the noise
    structure = found.finding == "structure"
    # where tests find nothing in what was seen, numbers a little off show in a run over what was not
    bare = bool(causes.selected) and causes.places is None
    allowed = _allowed(last, bare)
    more = structure and last.after > allowed
    beyond = more or (found.finding != "parameters" and substantial(last.recalibrated, last.noise_floor))
    # real friction and hysteresis are richer than any law of theirs, which counts where it explains most
    rough = any(CATALOGUE[x.kind].rubs and _acts_there(x, found) for x in causes.selected)
    gone = last.against_recalibrated if beyond else last.fraction
    if last.unsure > 0 and more:
        gone = fraction(last.recalibrated, last.after, allowed)
    # which, as long as they are little, tell nothing against a law that explains those
    little = not substantial(last.after, math.hypot(last.noise_floor, UNSURE * last.unsure))
    if bare and little and (rough or not more):
        gone = max(gone, causes.seen.against_recalibrated if beyond else causes.seen.fraction)
    enough = MORE if more and not rough else ENOUGH
    lapse = LAPSE
    if structure and not more and causes.places is not None and last.after > SHRUNK * last.recalibrated:
        # noise whose level is guessed takes up what no law explains, so that nearly all seems gone
        idle = causes.bounded and last.after > HARDLY * last.recalibrated
        lapse = USELESS if idle and causes.remaining.share > SPARED * found.null.share else REMAINDER
    return float(lapse + (1 - lapse - MISSED) / (1 + np.exp(STEEP * (gone - enough) / (1 - enough))))


def _acts_there(law: Explanation, found: Examination) -> bool:
    """Whether a law acts where the force on the model most likely does; a loop elsewhere may take any form, too."""
    where = found.locations
    return where is None or ends_of(law.place) in {ends_of(p.as_dict()) for p in where.likely}


def _allowed(last: Closure, bare: bool) -> float:
    """What a law of the catalogue may leave of other samples: what noise does, and numbers as far off as they may be.

    One that is not quite the true one leaves more, however well it fits the samples that it was fitted to.
    """
    if not bare:
        return SURE * last.noise_floor
    if last.unsure == 0:
        return CLEAR * last.noise_floor
    return last.accounted


def _at_one_place(selected: tuple[Explanation, ...]) -> list[tuple[Explanation, Explanation]]:
    """Two laws at one place that are not one polynomial; numbers of the model that are off there are no law."""
    laws = [x for x in selected if x.kind not in ERRORS.values()]
    return [
        (x, y)
        for x, y in combinations(laws, 2)
        if ends_of(x.place) == ends_of(y.place) and {x.kind, y.kind} != POLYNOMIAL
    ]


def _imitating(pairs: list[tuple[Explanation, Explanation]]) -> tuple[Explanation, ...]:
    """Two springs that are not straight, neither a loop: more often one curve of neither's shape than both at once.

    Args:
        pairs: at one place each.
    """
    of = lambda pair: [CATALOGUE[x.kind] for x in pair]  # noqa: E731
    springs = (p for p in pairs if all(k.restoring and k.states == 0 for k in of(p)))
    return next(springs, ())


def _instead_of_another(causes: Causes) -> tuple[Explanation, ...]:
    """Laws beside which one of another shape explains what they leave."""
    at = {ends_of(p.as_dict()) for p in causes.unlisted}
    return tuple(x for x in causes.selected if ends_of(x.place) in at and x.kind != ERRORS["mass"])


def _beside(causes: Causes) -> int:
    """How many of the first effects act elsewhere than what is left, and took away most of what was there."""
    if not causes.selected or causes.places is None:
        return 0
    left_at = {ends_of(p.as_dict()) for p in located(causes.places).likely}
    gap = causes.linear.after
    for count, (x, closure) in enumerate(zip(causes.selected, causes.closures, strict=True)):
        if ends_of(x.place) in left_at or fraction(gap, closure.after, closure.noise_floor) < MOST:
            return count
        gap = closure.after
    return len(causes.selected)


def _set(ranked: tuple[Explanation, ...]) -> tuple[Explanation, ...]:
    """The fewest that have most of the probability together."""
    total, found = 0.0, []
    whole = sum(x.probability for x in ranked) or 1.0
    for x in ranked:
        found.append(x)
        total += x.probability / whole
        if total >= LIKELY:
            break
    return tuple(found)


def as_pair(x: Explanation) -> dict[str, Any]:
    """Kind and place, as in diagnosis.json."""
    return {"kind": x.kind, "place": plain_place(x.place)}


def plain_place(place: dict[str, Any]) -> dict[str, Any]:
    """A place with lists in the place of tuples."""
    return {where: list(ends) if isinstance(ends, tuple | list) else ends for where, ends in place.items()}
