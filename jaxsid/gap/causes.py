"""Why a model and records part: effects found one after another, how far the gap shrinks, and what is left."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxsid.gap.closure import Closure, Left, closure_of, left_of
from jaxsid.gap.examine import NEGLIGIBLE, SIGNIFICANT, Examination
from jaxsid.gap.explain import TEMPERATURE, Explanation, Ranking, rank
from jaxsid.gap.free_run import free_run
from jaxsid.gap.locate import Scored, scored
from jaxsid.gap.measure import is_free_or_unstable
from jaxsid.gap.noise import Noise
from jaxsid.gap.null import Null, null_test
from jaxsid.gap.places import places_of
from jaxsid.gap.recalibrate import Recalibrated, recalibrated
from jaxsid.gap.refit import FIXED, Bench, Hypothesis, Refit, bench_of, plain_shot, refitted
from jaxsid.gap.screen import Candidate, screen
from jaxsid.mechanics.lumped import LumpedModel
from jaxsid.mechanics.simulate import ordered_inputs
from jaxsid.physical.elements import element_matrices, with_values
from jaxsid.records import Record

MOST_EFFECTS = 2
SLIGHT = 0.3  # of what is left: a part that tests find but that is of no matter
WORTH = 3.0  # tempered gain of evidence from which on a further effect is taken
LESS = 0.1  # part of what is left above the noise that a further effect must remove
LEAST = 0.02  # and of all that is left


class Causes(NamedTuple):
    """What explains records.

    Attributes:
        rounds: candidates of each round, the last of which may have been refused.
        chosen: the best explanation.
        selected: what it adds to the nominal model, in the order in which it was found.
        nominal, recalibrated: the model as it is, and the best linear one, fitted the same way.
        closures: of every selected effect together with those before it, on held-out samples; of the model within
            its tolerance where none was selected.
        left: what the chosen model leaves of these.
        before: what the nominal model and the best linear one leave of these.
        noises: of each record, from what the chosen model leaves where tests find nothing in it.
        remaining: tests of what is left of the other samples.
        places: where that would arise; None where nothing is left.
    """

    rounds: tuple[Ranking, ...]
    chosen: Refit
    selected: tuple[Explanation, ...]
    nominal: Refit
    recalibrated: Refit
    closures: tuple[Closure, ...]
    left: Left
    noises: tuple[Noise, ...]
    remaining: Null
    places: Scored | None
    before: tuple[Left, Left]


class _Look(NamedTuple):
    """What is left of records once effects found are taken out."""

    fit: Recalibrated
    null: Null
    scored: Scored | None

    @property
    def clear(self) -> bool:
        return self.null.p_value >= SIGNIFICANT or self.null.share <= NEGLIGIBLE


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
    noises = found.noises
    say("kinds of effects")
    bench = bench_of(model, seen, noises, found.fit)
    look = _Look(found.fit, found.null, found.scored)
    rounds: list[Ranking] = []
    selected: list[Explanation] = []
    before: Refit | None = None
    first = candidates = _candidates(look)
    while len(selected) < MOST_EFFECTS:
        ranking = rank(bench, candidates, before, say)
        rounds.append(ranking)
        bench, noises = ranking.bench, ranking.bench.noises
        if not ranking.ranked or not _worth(ranking):
            break
        best = ranking.ranked[0]
        selected.append(best)
        before = best.refit
        say("what is left")
        look = _looked(model, seen, noises, bench, before)
        if look.clear or look.scored is None:
            break
        # what came next to the first effect, in turn with what now comes first
        candidates = tuple(c for pair in zip(_candidates(look), first[1:], strict=False) for c in pair)
    chosen = before if before is not None else rounds[0].without
    linear = refitted(bench, Hypothesis(wrong=tuple(range(len(bench.tolerance)))))
    if found.finding == "parameters" and _beyond(linear, chosen, rounds[-1].scale):
        chosen, selected, look = linear, [], _Look(found.fit, found.null, None)
    say("how far the gap shrinks")
    # what is left is noise where tests find nothing in it; else it may be less
    floor = noises if look.clear else found.noises
    lefts = partial(left_of, bench=bench, records=whole, windowed=is_free_or_unstable(model))
    frozen = bench._replace(tolerance=np.full_like(bench.tolerance, FIXED))
    ends = lefts(refitted(frozen, Hypothesis())), lefts(linear)
    steps = [lefts(x.refit) for x in selected] or [lefts(chosen)]
    names = [s.name for s in model.sensors]
    return Causes(
        tuple(rounds),
        chosen,
        tuple(selected),
        rounds[0].without,
        linear,
        tuple(closure_of(*ends, x, floor, names) for x in steps),
        steps[-1],
        floor,
        look.null,
        None if look.clear else look.scored,
        ends,
    )


def _beyond(linear: Refit, chosen: Refit, scale: float) -> bool:
    """Whether all of the model's numbers together explain more than the few that were singled out.

    Not tempered: where they leave noise there is nothing that no hypothesis has.
    """
    return (linear.fit.evidence - chosen.fit.evidence) / scale > WORTH


def _worth(ranking: Ranking) -> bool:
    """Whether the best further candidate explains much of what was left."""
    best, without = ranking.ranked[0], ranking.without.fit
    gain = (best.evidence - without.evidence) / ranking.scale / TEMPERATURE
    above = without.squares - without.equations
    less = without.squares - best.refit.fit.squares
    return gain > WORTH and less > max(LESS * above, LEAST * without.squares)


def _candidates(look: _Look) -> tuple[Candidate, ...]:
    """From the longest record, and those that hold sensors which it lacks: programs are compiled for each length."""
    if look.scored is None:
        return ()
    of, rows = (
        look.scored,
        _telling([np.asarray(s.spectra.present) for s in look.scored.settings], look.scored),
    )
    motions = {
        "force at the place": [of.found.explained[i].motion for i in rows],
        "refitted model": [look.fit.linear[i].motion for i in rows],
    }
    left = [np.abs(np.asarray(look.fit.linear[i].left)) for i in rows]
    return screen(of.model, [of.settings[i] for i in rows], of.places, motions, of.tolerance, left)


def _telling(present: Sequence[np.ndarray], of: Scored) -> list[int]:
    """Numbers of the longest records that together hold all sensors, and of those as long as one of them."""
    lengths = [s.spectra.samples for s in of.settings]
    order = sorted(range(len(lengths)), key=lambda i: -lengths[i])
    chosen, seen = [], np.zeros_like(present[0])
    for i in order:
        if (present[i] > seen).any():
            chosen.append(i)
            seen = np.maximum(seen, present[i])
    return [i for i in range(len(lengths)) if lengths[i] in {lengths[j] for j in chosen}]


def _looked(
    model: LumpedModel, seen: Sequence[Record], noises: Sequence[Noise], bench: Bench, before: Refit
) -> _Look:
    """Records without what effects found do to them, beside the model with its wrong numbers put right."""
    nominal = np.asarray(element_matrices(bench.model).nominal)
    change = np.zeros(len(nominal))
    wrong = list(before.hypothesis.wrong)
    change[wrong] = before.fit.theta[wrong]
    base = with_values(bench.model, jnp.asarray(nominal * (1 + change)))
    records = [_deflated(r, i, bench, before) for i, r in enumerate(seen)]
    fit = recalibrated(base, records, noises, wide=True, given=True)
    look = _Look(fit, null_test(fit, places_of(base)), None)
    return look if look.clear else look._replace(scored=scored(base, records, noises=noises))


def _deflated(record: Record, number: int, bench: Bench, before: Refit) -> Record:
    """A record less what effects do to it: y - (y with effects - y without), both from the fitted initial state."""
    if not before.hypothesis.effects:
        return record
    blocks = [i for i, b in enumerate(bench.blocks) if int(b.record[0]) == number]
    block, state = bench.blocks[blocks[0]], before.fit.states[blocks[0]][0]
    u = np.asarray(ordered_inputs(bench.model, record)[0])
    begin = int(block.first[0])
    given = {"record": number, "first": begin, "substeps": bench.substeps}
    size, elements = 2 * len(bench.model.bodies), len(bench.tolerance)
    plain = plain_shot(bench)
    theta = np.zeros(
        elements + plain.coordinates.centre.size + (bench.records - 1) * len(plain.slots.parameters)
    )
    theta[:elements] = before.fit.theta[:elements]
    start = np.pad(state[:size], (0, 2 * plain.slots.count))
    common = u, block.ramps, float(record.dt)
    change = free_run(before.shot, before.fit.theta, *common, state, **given).outputs
    change = (change - free_run(plain, theta, *common, start, **given).outputs)[-begin:]
    names = [s.name for s in bench.model.sensors]
    columns = [change[:, names.index(n)] if n in names else 0.0 * change[:, 0] for n in record.outputs]
    return Record(
        record.u,
        np.asarray(record.y) - np.stack(columns, axis=1),
        record.dt,
        inputs=record.inputs,
        outputs=record.outputs,
        hold=record.hold,
        name=record.name,
    )
