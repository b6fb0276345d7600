"""Candidates fitted to a part of the records: which of them deserve a fit to all, and where that begins."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from jaxsid.gap.closely import followed_closely
from jaxsid.gap.hypothesis import with_parameters
from jaxsid.gap.ranking import ends_of, key_of, straight, value
from jaxsid.gap.refit import Bench, Hypothesis, Refit, changes_of, refitted
from jaxsid.gap.screen import Candidate
from jaxsid.mechanics.effects.catalogue import CATALOGUE
from jaxsid.mechanics.lumped import Effect
from jaxsid.parallel import side_by_side

STEPS, STEPS_A_NUMBER = 6, 3  # laws of many numbers take longer to be found
FEW = 10  # steps of a fit to one block alone
ALIKE = 0.8  # part of the most that a block leaves, from which on another leaves as much
LONGER = (5, 10), (3, 20)  # so many of the best go on for so many steps, if they are still on their way
HERE = 6  # other laws that are tried where the best one acts, beside springs and dampers
NEARLY = 3  # places, those of the best ones, where springs and dampers are tried
HOPELESS = 10.0  # times the squares that the best one leaves, from which on none goes on
FINE = 2.0  # gain of the search below which a candidate is fitted well enough to be compared
# times its number that a law begins with, where the one given leads to more than there is without it
SIZES = 2.0, 1.4, 0.7, 0.5, 0.25, 0.125
# times the wavenumber and the amplitude that a wave along the way is screened with, where windows are of a few samples
WAVENUMBERS, AMPLITUDE = np.geomspace(0.35, 7.5, 10), 2.0
AT_FIRST, GO_ON = 3, 3  # steps with each of these waves, and how many of them go on


def loudest(bench: Bench, found: Refit) -> Bench:
    """The one block of which a fit leaves most, in noise, once it is fitted to that alone: what it lacks is there.

    Fitted to all it may leave most where nothing is the matter, its numbers being those that suit the others. Where
    several leave nearly as much that may be chance, and laws show where signals are large.

    Args:
        bench: that it was fitted to.
        found: the fit.
    """

    each = zip(bench.blocks, bench.states, strict=True)
    parts = [bench._replace(blocks=(b,), states=(x,)) for b, x in each]
    left = np.array(side_by_side(lambda part: alone(part, found).fit.squares, parts))
    signal = [((np.asarray(b.y) * np.asarray(b.weight))[:, b.lead :] ** 2).sum() for b in bench.blocks]
    return parts[int(np.argmax(np.where(left >= ALIKE * left.max(), signal, -1.0)))]


def alone(part: Bench, found: Refit) -> Refit:
    """What was found, fitted to a part of the records alone.

    Args:
        part: of the records.
        found: the fit.
    """
    return refitted(part, found.hypothesis, changes=changes_of(found, part), steps=FEW, gain=FINE)


def roughly(
    part: Bench,
    every: Sequence[tuple[Candidate, Hypothesis, Any]],
    without: Refit,
    tried: int,
    say: Callable[[str], None],
) -> list[tuple[Candidate, Refit]]:
    """Candidates fitted to a part of the records, best first: some steps for each, more for the best.

    The first ones, springs and dampers where the best of them act, and further laws of the place where one of them
    fits best, even if it makes no sense there.

    Args:
        part: of the records.
        every: candidates, most promising first, their hypotheses, and the changes of elements to begin with.
        without: the fit to all records without any of them.
        tried: how many of the first ones.
        say: called with a line of text before each fit.
    """
    begin = {"changes": changes_of(without, part), "steps": 1}
    nothing = refitted(part, without.hypothesis, **begin).fit.squares

    def begun(one: tuple[Candidate, Hypothesis, Any]) -> tuple[Candidate, Refit]:
        c, hypothesis, changes = one
        say(f"{c.kind} at {label(c.place)}")
        steps = STEPS + STEPS_A_NUMBER * len(c.parameters)
        search = {"changes": changes, "steps": steps, "gain": FINE}
        found = refitted(part, hypothesis, **search)
        found = max([found, *_from_afar(part, hypothesis, c, found, search)], key=lambda x: value(x, part))
        if found.fit.squares <= nothing or not math.isfinite(nothing):
            return c, found
        # screened on a motion that is not its own; from far off the search ends in another valley
        sizes = [refitted(part, h, changes=changes, steps=1) for h in _of_sizes(hypothesis, c)]
        first = max(sizes, key=lambda x: value(x, part), default=found)
        again = refitted(part, first.hypothesis, **search) if sizes else found
        return c, max(found, again, key=lambda x: x.fit.evidence)

    rough = side_by_side(begun, every[:tried])
    ahead = sorted(rough, key=lambda x: -x[1].fit.evidence)
    places = list(dict.fromkeys(ends_of(c.place) for c, _ in ahead))[:NEARLY]
    further = [x for x in every[tried:] if ends_of(x[0].place) in places]
    # a stop without play, or a stiffening spring that hardly stiffens, is a spring
    bent = [x for x in further if not straight(x[0].kind) and ends_of(x[0].place) == places[0]]
    rough += side_by_side(begun, [x for x in further if straight(x[0].kind)] + bent[:HERE])
    for few, more in LONGER:
        rough.sort(key=lambda x: -value(x[1], part))
        most = HOPELESS * rough[0][1].fit.squares if rough else 0.0
        top = key_of("", rough[0][0].place) if rough else None
        here = [i for i, (c, _) in enumerate(rough) if key_of("", c.place) == top]
        hopeful = [i for i, (_, r) in enumerate(rough[:few]) if r.fit.squares < most]
        due = [i for i in sorted({*hopeful, *here}) if not rough[i][1].fit.settled]
        on = partial(_longer, part=part, steps=more)
        for i, r in zip(due, side_by_side(on, [rough[i][1] for i in due]), strict=True):
            rough[i] = rough[i][0], r
    return sorted(rough, key=lambda x: -value(x[1], part))


def start_from(found: Refit, bench: Bench) -> dict[str, Any]:
    """Where a further fit begins.

    Args:
        found: a fit.
        bench: that the further one is of.
    """
    return {"changes": changes_of(found, bench), "states": found.fit.states}


def label(place: Mapping[str, Any]) -> str:
    """A place in a word or two.

    Args:
        place: as of an `Effect`.
    """
    ((_, ends),) = place.items()
    return " - ".join(ends) if isinstance(ends, tuple | list) else str(ends)


def _from_afar(
    part: Bench, of: Hypothesis, c: Candidate, found: Refit, search: Mapping[str, Any]
) -> list[Refit]:
    """Fits of a candidate from elsewhere, where the motion that it is screened with may be far from its own."""
    # windows of a few samples bend to a wave from far off
    waves = _of_waves(of, c) if followed_closely(part) else []
    short = [refitted(part, h, **{**search, "steps": AT_FIRST}) for h in waves]
    best = sorted(short, key=lambda x: -value(x, part))[:GO_ON]
    bent = [] if found.fit.settled else _hardly_bent(of, c)
    on = [_longer(x, part=part, steps=search["steps"]) for x in best]
    return on + [refitted(part, h, **search) for h in bent]


def _of_sizes(of: Hypothesis, c: Candidate) -> list[Hypothesis]:
    """The hypothesis with multiples of the number of its last effect, if that is the candidate and has but one."""
    effect = _own(of, c)
    if effect is None or len(effect.parameters) != 1:
        return []
    return _with(of, [{n: k * np.asarray(v) for n, v in effect.parameters.items()} for k in SIZES])


def _of_waves(of: Hypothesis, c: Candidate) -> list[Hypothesis]:
    """The hypothesis with waves of other lengths, either way up, if the candidate is one along the way."""
    effect, kind = _own(of, c), CATALOGUE[c.kind]
    if effect is None or kind.wave is None or kind.timed:
        return []
    (amplitude, angle), given = kind.wave, _given(effect)
    lengths = [n for n in given if n not in kind.wave]
    new = [
        {
            **given,
            **{n: k * given[n] for n in lengths},
            amplitude: AMPLITUDE * given[amplitude],
            angle: given[angle] + on,
        }
        for k in WAVENUMBERS
        for on in (0.0, math.pi)
    ]
    return _with(of, new)


def _hardly_bent(of: Hypothesis, c: Candidate) -> list[Hypothesis]:
    """The hypothesis with laws that bend later, if the candidate has such."""
    effect, kind = _own(of, c), CATALOGUE[c.kind]
    if effect is None or kind.hardly_bent is None:
        return []
    given = _given(effect)
    every = kind.hardly_bent(*(float(x) for x in given.values()))
    return _with(of, [dict(zip(given, map(np.asarray, x), strict=True)) for x in every])


def _given(effect: Effect) -> dict[str, np.ndarray]:
    """Its parameters in their order, defaults where they are left out."""
    every = CATALOGUE[effect.kind].parameters
    return {p.name: np.asarray(effect.parameters.get(p.name, p.default), float) for p in every}


def _with(of: Hypothesis, every: Sequence[Mapping[str, Any]]) -> list[Hypothesis]:
    """The hypothesis with other parameters of its last effect."""
    return [of._replace(effects=(*of.effects[:-1], with_parameters(of.effects[-1], x))) for x in every]


def _own(of: Hypothesis, c: Candidate) -> Effect | None:
    """The last effect, if it is the candidate."""
    effect = of.effects[-1] if of.effects else None
    same = effect is not None and key_of(effect.kind, dict(effect.place)) == key_of(c.kind, c.place)
    return effect if same else None


def _longer(found: Refit, *, part: Bench, steps: int) -> Refit:
    return refitted(part, found.hypothesis, **start_from(found, part), steps=steps, gain=FINE)
