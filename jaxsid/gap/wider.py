"""A law that holds the one found as a special case, where else a number of the model would be off at its place.

Friction that falls with speed looks much as friction of one level beside a damper that is too strong, and a fit of its
own begins in one of many valleys. From where the plainer law ended, all levels alike, it is a step to either side.
"""

import math

import numpy as np

from jaxsid.gap.grids import quantiles
from jaxsid.gap.ranking import Explanation, Ranking, Whole, key_of, left_in, others_in, ranked, value
from jaxsid.gap.refit import Bench, Refit, changes_of, refitted, shot_of, states_without
from jaxsid.gap.roughly import FINE
from jaxsid.gap.screen import Candidate
from jaxsid.mechanics.effects.catalogue import CATALOGUE
from jaxsid.mechanics.effects.kind import Kind
from jaxsid.mechanics.lumped import Effect
from jaxsid.parallel import side_by_side

STARTS = 6  # of each number that the plainer law lacks
APART = 1.1  # of two numbers that are one there: a little, so that the others count


def holding(kind: str) -> list[Kind]:
    """Kinds of effects that hold one as a special case.

    Args:
        kind: its name.
    """
    return [k for k in CATALOGUE.values() if k.holds == kind]


def wider(
    bench: Bench, found: Refit, x: Explanation, before: Ranking, without: Refit, steps: int
) -> Ranking | None:
    """A law found and those that hold it, with all else that was found; None where none does, or none makes sense.

    Args:
        bench: records.
        found: the fit.
        x: a law in it.
        before: the round in which that was found.
        without: the fit without it.
        steps: most evaluations of a fit.
    """
    effects = found.hypothesis.effects
    row = next((i for i, e in enumerate(effects) if key_of(e.kind, dict(e.place)) == x.key), None)
    kinds = holding(x.kind)
    if row is None or not kinds:
        return None
    begin = {"changes": changes_of(found, bench), "states": states_without(found, row)}

    def fitted(effect: Effect) -> Refit:
        of = found.hypothesis._replace(effects=(*effects[:row], effect, *effects[row + 1 :]))
        return refitted(bench, of, **begin, steps=steps, gain=FINE)

    every: list[tuple[Candidate | Explanation, Refit, float, float]]
    every = [(x, found, value(found, bench), left_in(bench, Whole(bench, found)))]
    for kind in kinds:
        fits = side_by_side(fitted, _starts(kind, effects[row], bench))
        best = max(fits, key=lambda r: value(r, bench))
        if math.isfinite(value(best, bench)):
            at = Candidate(kind.name, x.place, {}, np.zeros(0), 0.0, math.nan, "", {})
            every.append((at, best, value(best, bench), left_in(bench, Whole(bench, best))))
    new = {key_of(c.kind, c.place) for c, *_ in every}
    every += others_in(bench, before, new)
    return ranked(every, without, bench, before.temperature) if len(new) > 1 else None


def _starts(kind: Kind, plain: Effect, bench: Bench) -> list[Effect]:
    """The wider law as the plainer one: numbers of that one's unit are its number, others spread over their prior."""
    (number,) = (float(np.ravel(np.asarray(v))[0]) for v in plain.parameters.values())
    (unit,) = {p.unit for p in CATALOGUE[plain.kind].parameters}
    shared = [p.name for p in kind.parameters if p.unit == unit]
    same = {name: number * APART**i for i, name in enumerate(shared)}
    own = [(i, p) for i, p in enumerate(kind.parameters) if p.unit != unit]
    any_ = Effect(kind.name, plain.place, {**same, **{p.name: p.prior.centre for _, p in own}})
    scale = np.asarray(shot_of(bench, (any_,)).coordinates.scale)[0]
    ratios = np.stack([quantiles(p.prior, STARTS) * scale[i] for i, p in own], axis=1)
    return [
        Effect(kind.name, plain.place, {**same, **dict(zip([p.name for _, p in own], row, strict=True))})
        for row in ratios.tolist()
    ]
