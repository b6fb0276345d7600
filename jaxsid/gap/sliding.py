"""A loop that slides through its limit is dry friction whose surfaces give first: that law, begun where the loop ended.

Bouc's and Wen's loop holds a force k / (beta + gamma)^(1/n) as long as the motion goes on one way, and gives by so much
as stretches k to it. Where the motion goes much further than that it rubs. Friction that falls with speed, which a
loop's does not, is told by the evidence of both.
"""

from collections.abc import Callable, Mapping

import numpy as np

from jaxsid.gap.hypothesis import amplitudes_of, effect_slots
from jaxsid.gap.ranking import Ranking, Whole, key_of, left_in, ranked, value
from jaxsid.gap.refit import FINEST, Bench, Hypothesis, changes_of, refitted
from jaxsid.mechanics.lumped import Effect, second_order
from jaxsid.parallel import side_by_side

LOOP, FRICTION = "hysteresis", "stribeck_friction"
FAR = 3.0  # times the limit of a loop, in displacement, from which rms on it slides more than it gives
OVER = 1.0, 1.5  # times the level of sliding that the level at rest begins with
SLOW = 0.3  # of the rms velocity, at which friction begins to have fallen
STEPS, GAIN = 40, 2.0  # of the search, and the gain below which it has come to an end


def sliding(ranking: Ranking, say: Callable[[str], None], polished: Whole | None = None) -> Ranking:
    """A round in which friction that gives is tried in the place of a loop that comes first, if that slides.

    Args:
        ranking: the round.
        say: called with a line of text before the fits.
        polished: a fit of the first one that has gone further than the round's, if there is one.
    """
    best = ranking.ranked[0] if ranking.ranked else None
    if best is None or best.kind != LOOP or len(best.refit.fit.states) != len(ranking.bench.blocks):
        return ranking
    bench, last = polished or Whole(ranking.bench, best.refit)
    of, friction = last.hypothesis, key_of(FRICTION, best.place)
    keys = [key_of(e.kind, dict(e.place)) for e in of.effects]
    row = keys.index(best.key)
    begun = [] if friction in keys else _begun(bench, of.effects[row])
    if not begun:
        return ranking
    say(f"{FRICTION} that gives, from where {LOOP} ends")
    start = {"changes": changes_of(last, bench), "states": last.fit.states}
    search = {"steps": STEPS, "gain": GAIN}
    if polished is not None:
        # what hardly gives follows at once, which steps that suffice for the rest of the motion do not show
        bench = bench._replace(substeps=FINEST)
        last = refitted(bench, of, **start, **search)
        begun = _begun(bench, last.hypothesis.effects[row]) or begun

    def fitted(parameters: Mapping[str, float]) -> Whole:
        law = Effect(FRICTION, of.effects[row].place, dict(parameters))
        new = Hypothesis((*of.effects[:row], law, *of.effects[row + 1 :]), of.wrong)
        return Whole(bench, refitted(bench, new, **start, **search))

    found = max(side_by_side(fitted, begun), key=lambda x: value(x.refit, bench))
    gained = value(found.refit, bench) - last.fit.evidence
    if not gained > 0:
        return ranking
    every = [(y, y.refit, y.evidence, y.left) for y in ranking.ranked if y.key != friction]
    new = (best._replace(kind=FRICTION), found.refit, best.evidence + gained, left_in(ranking.bench, found))
    at = ranking.bench._replace(substeps=bench.substeps)
    return ranked([*every, new], ranking.without, at, ranking.temperature)


def _begun(bench: Bench, loop: Effect) -> list[dict[str, float]]:
    """Parameters of friction to begin with; none where a loop does not slide."""
    stiffness, beta, gamma, exponent = (
        float(np.ravel(np.asarray(loop.parameters.get(n, 1.0)))[0])
        for n in ("stiffness", "beta", "gamma", "exponent")
    )
    if not (stiffness > 0 and beta + gamma > 0):
        return []
    limit = (beta + gamma) ** (-1 / exponent)
    at = amplitudes_of(second_order(bench.model), effect_slots(bench.model, [loop]), bench.moved)
    moved, speed = float(np.asarray(at.displacement)[0]), float(np.asarray(at.velocity)[0])
    if moved < FAR * limit:
        return []
    level = stiffness * limit
    return [
        {"force": level, "static_force": over * level, "velocity": SLOW * speed, "stiffness": stiffness}
        for over in OVER
    ]
