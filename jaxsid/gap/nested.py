"""Laws of fewer numbers begun where the best law at their place ended.

A fit of friction or contact has many valleys, in which the states of windows are wrong as much as the law is. A law
that the best one holds as a special case lies in the same valley as it; from a start of its own it may not get there.
"""

import math
from collections.abc import Callable

import numpy as np

from jaxsid.gap.hypothesis import with_parameters
from jaxsid.gap.ranking import (
    FEWER,
    NEAR,
    Explanation,
    Ranking,
    Whole,
    ends_of,
    key_of,
    left_in,
    numbers_of,
    ranked,
    value,
)
from jaxsid.gap.refit import Hypothesis, Refit, changes_of, refitted, states_without
from jaxsid.parallel import side_by_side

PARTS = 1.0, 0.5, 0.25, 0.125, 0.0625  # of its number that one begins with
GAIN = 2.0  # of the search, below which it has come to an end


def nested(ranking: Ranking, steps: int, say: Callable[[str], None]) -> Ranking:
    """A round in which laws of fewer numbers at the place of the best one begin from its states, if that is better.

    Args:
        ranking: the round.
        steps: most evaluations of a fit.
        say: called with a line of text before each fit.
    """
    row = _row(ranking.ranked[0]) if ranking.ranked else None
    if row is None:
        return ranking
    best, others = ranking.ranked[0], ranking.ranked[1:]
    due = [y for y in others if _within(y, best)][:FEWER]

    def begun(y: Explanation) -> Refit:
        say(f"{y.kind} from where {best.kind} ends")
        start = {"changes": changes_of(best.refit, ranking.bench), "states": states_without(best.refit, row)}
        sizes = [refitted(ranking.bench, h, **start, steps=1) for h in _of_sizes(y)]
        # what another valley made of its number may be far from what this one needs
        first = min(sizes, key=lambda x: x.fit.squares).hypothesis
        return refitted(ranking.bench, first, **start, steps=steps, gain=GAIN)

    new = dict(zip([y.key for y in due], side_by_side(begun, due), strict=True))
    better = {y.key for y in due if value(new[y.key], ranking.bench) > y.evidence}
    if not better:
        return ranking
    every = []
    for y in ranking.ranked:
        if y.key in better:
            found = new[y.key]
            left = left_in(ranking.bench, Whole(ranking.bench, found))
            every.append((y, found, value(found, ranking.bench), left))
        else:
            every.append((y, y.refit, y.evidence, y.left))
    return ranked(every, ranking.without, ranking.bench, ranking.temperature)


def _of_sizes(y: Explanation) -> list[Hypothesis]:
    """Its hypothesis, and with parts of its number where it has but one."""
    of, row = y.refit.hypothesis, _row(y)
    if row is None or numbers_of(y.kind) > 1:
        return [of]
    effect = of.effects[row]
    parts = [{n: part * np.asarray(v) for n, v in effect.parameters.items()} for part in PARTS]
    return [
        of._replace(effects=(*of.effects[:row], with_parameters(effect, x), *of.effects[row + 1 :]))
        for x in parts
    ]


def _row(x: Explanation) -> int | None:
    """Which effect of its fit a law is; None where it is a wrong number of the model, which holds no other."""
    rows = [i for i, e in enumerate(x.refit.hypothesis.effects) if key_of(e.kind, dict(e.place)) == x.key]
    return rows[0] if rows else None


def _within(y: Explanation, best: Explanation) -> bool:
    """Whether a law of fewer numbers acts where the best one does, and hardly leaves more."""
    return (
        ends_of(y.place) == ends_of(best.place)
        and numbers_of(y.kind) < numbers_of(best.kind)
        and math.isfinite(y.evidence)
        and y.left < NEAR * best.left
    )
