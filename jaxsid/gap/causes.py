"""Why a model and records part: effects found one after another, how far the gap shrinks, and what is left."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from jaxsid.gap.any_law import any_law, smooth_places
from jaxsid.gap.closely import motions_to_begin
from jaxsid.gap.closure import Closure, Left, closure_of, left_before, left_of, shown, spread_of
from jaxsid.gap.examine import Examination
from jaxsid.gap.hypothesis import FIXED
from jaxsid.gap.later import best_linear, later_than_effects, later_than_linear
from jaxsid.gap.locate import Scored, located
from jaxsid.gap.look import Look
from jaxsid.gap.measure import is_free_or_unstable
from jaxsid.gap.noise import REFUTED, Noise, no_louder, quieter
from jaxsid.gap.null import SIGNIFICANT, Null, found_part
from jaxsid.gap.places import Place
from jaxsid.gap.ranking import ERRORS, WORTH, Explanation, Ranking, ends_of
from jaxsid.gap.refit import Bench, Hypothesis, Refit, changes_of, refitted
from jaxsid.gap.search import Found, searched, small_beside
from jaxsid.mechanics.lumped import LumpedModel
from jaxsid.records import Record

SURELY = 1e-9  # probability by chance below which a law of another shape is there


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
        seen: how far the gap shrinks with all of them on the samples that they were fitted to, window by window.
        linear: how far the gap shrinks with the best linear model alone.
        before: what the nominal model and the best linear one leave of these samples.
        later: how many samples of each record must be seen for all that it holds; as many as were where what was
            chosen leaves no more of the others.
        noises: of each record; where it is guessed, what the chosen model leaves if tests find nothing in it, else no
            more than that.
        remaining: tests of what is left of the other samples.
        places: where that would arise; None where nothing is left.
        unlisted: places where laws were found and one of another shape explains what these leave.
    """

    rounds: tuple[Ranking, ...]
    chosen: Refit
    selected: tuple[Explanation, ...]
    nominal: Refit
    recalibrated: Refit
    closures: tuple[Closure, ...]
    lefts: tuple[Left, ...]
    seen: Closure
    linear: Closure
    noises: tuple[Noise, ...]
    remaining: Null
    places: Scored | None
    before: tuple[Left, Left]
    later: tuple[int, ...]
    unlisted: tuple[Place, ...] = ()

    @property
    def bounded(self) -> bool:
        """Whether the noise is guessed and tests find more than noise in what is left: it is no more than that."""
        return self.places is not None and any(n.degrees <= 0 for n in self.noises)

    @property
    def telling(self) -> Closure:
        """The last one on held-out samples, or where those do not show the gap on the samples seen."""
        return self.closures[-1] if not self.selected or shown(self.closures[-1]) else self.seen

    @property
    def outrun(self) -> bool:
        """Whether tests find nothing in what is left of the samples seen, but more than that is left of the others.

        A drift that the numbers take up as long as they are fitted to it is missed only then.
        """
        last = self.closures[-1]
        return bool(self.selected) and self.places is None and last.unsure > 0 and last.after > last.accounted

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
    at = searched(model, seen, found, say)
    unlisted = _unlisted(at, found, say)
    asked = bool(unlisted) and at.look.clear
    if asked:
        # what another effect leaves is shown by laws of any shape, too, wherever they are asked
        at = small_beside(at, model, seen, say)
        unlisted = _unlisted(at, found, say)
    causes = _concluded(at, unlisted, seen, whole, found, say)
    if asked or not causes.outrun:
        return causes
    more = small_beside(at, model, seen, say)
    if len(more.selected) == len(at.selected):
        return causes
    return _concluded(more, _unlisted(more, found, say), seen, whole, found, say)


def _concluded(
    at: Found,
    unlisted: tuple[Place, ...],
    seen: Sequence[Record],
    whole: Sequence[Record],
    found: Examination,
    say: Callable[[str], None],
) -> Causes:
    """What was found, and how far the gap shrinks."""
    bench, look, rounds, selected = at.bench, at.look, at.rounds, list(at.selected)
    plain = rounds[0].without if rounds else refitted(bench, Hypothesis())
    chosen = plain if at.before is None else at.before
    linear = best_linear(bench, changes_of(chosen, bench))
    if found.finding == "parameters" and (not selected or _beyond(linear, chosen, rounds[-1].scale)):
        chosen, selected = linear, []
    unlisted = unlisted if selected else ()
    say("how far the gap shrinks")
    ends = tuple(len(r.y) for r in seen)
    tried = _Tried(found, bench, look, linear, chosen, [x.refit for x in selected])
    gone = _shrunk(tried, whole, ends)
    if gone.followed:
        later = ends  # no run tells what comes later
    elif selected:
        later = later_than_effects(chosen, bench, whole, ends, gone.closures[-1])
    else:
        later = later_than_linear(found, linear, bench, whole, ends, gone.before[1])
    return Causes(
        rounds,
        chosen,
        tuple(selected),
        plain,
        linear,
        gone.closures,
        gone.lefts,
        gone.seen,
        gone.linear,
        gone.noises,
        look.null,
        None if look.clear else look.scored,
        gone.before,
        later,
        unlisted,
    )


class _Tried(NamedTuple):
    """What was looked at, with which records, and the fits whose closures are asked for."""

    found: Examination
    bench: Bench
    look: Look
    linear: Refit
    chosen: Refit
    steps: list[Refit]


class _Shrunk(NamedTuple):
    """Fields of `Causes`, and whether windows of a few samples follow the records."""

    closures: tuple[Closure, ...]
    lefts: tuple[Left, ...]
    seen: Closure
    linear: Closure
    noises: tuple[Noise, ...]
    before: tuple[Left, Left]
    followed: bool


def _shrunk(tried: _Tried, whole: Sequence[Record], ends: tuple[int, ...]) -> _Shrunk:
    """How far the gap shrinks on samples that were not seen, and on those that were."""
    found, bench, look = tried.found, tried.bench, tried.look
    motions = motions_to_begin(bench, whole, found.noises, found.scored)
    windowed = is_free_or_unstable(bench.model) or motions is not None
    lefts = partial(left_of, bench=bench, records=whole, ends=ends, windowed=windowed, motions=motions)
    frozen = bench._replace(tolerance=np.full_like(bench.tolerance, FIXED))
    nominal = refitted(frozen, Hypothesis())
    before = lefts(nominal), lefts(tried.linear)
    steps = tuple(map(lefts, tried.steps or [tried.chosen]))
    # what is left is noise where tests find nothing in it, else more than that
    less = partial(quieter, found=found_part(look.null, look.fit))
    told = bench.noises if look.clear else tuple(map(less, found.noises, bench.noises))
    # windows of a few samples take up noise themselves
    refuted = REFUTED if motions is None else 0.0
    floor = noise_floor(told, steps[-1], before, refuted)
    names = [s.name for s in bench.model.sensors]
    # where each window begins anew what the numbers lack is taken up by states
    spread = None if windowed or not look.clear else spread_of(tried.chosen, bench, whole, steps[-1])
    *each, alone = (closure_of(*before, x, floor, names) for x in (*steps[:-1], before[1]))
    each.append(closure_of(*before, steps[-1], floor, names, spread=spread))
    first, straight, after = (left_before(x, bench) for x in (nominal, tried.linear, tried.chosen))
    least = [no_louder(n, x, refuted) for n, x in zip(told, after.left, strict=True)]
    same = closure_of(first, straight, after, least, names)
    return _Shrunk(tuple(each), steps, same, alone, floor, before, motions is not None)


def noise_floor(
    told: Sequence[Noise], own: Left, others: Sequence[Left], refuted: float
) -> tuple[Noise, ...]:
    """The noise of each record in samples that were not seen: no more than a model leaves, nor far more than others do.

    Under a law that is not the true one the motion may grow without bound there, but noise is in what any model leaves.

    Args:
        told: noise by the samples that were seen.
        own: what the model leaves.
        others: what others leave.
        refuted: part of noise that is no guess, less than which none of it can be left.
    """
    found = tuple(no_louder(n, x, refuted) for n, x in zip(told, own.left, strict=True))
    for other in others:
        found = tuple(no_louder(n, x, refuted, REFUTED) for n, x in zip(found, other.left, strict=True))
    return found


def _doubted(found: Examination, look: Look, selected: Sequence[Explanation]) -> bool:
    """Whether tests find anything left, or had refuted every linear model but nothing else was found than one."""
    linear = all(x.kind in ERRORS.values() for x in selected)
    return look.null.p_value < SIGNIFICANT or (linear and found.finding == "structure")


def _unlisted(at: Found, found: Examination, say: Callable[[str], None]) -> tuple[Place, ...]:
    """Places of laws found at which a law of another shape surely explains more.

    Windows of a few samples forgive what would tell. What more probably arises elsewhere is for another effect.
    """
    if at.before is None or not _doubted(found, at.look, at.selected) or np.isfinite(at.bench.loose):
        return ()
    places, scored = smooth_places(at.selected), at.look.scored
    if scored is not None:
        likely = {ends_of(p.as_dict()) for p in located(scored).likely}
        places = tuple(p for p in places if ends_of(p.as_dict()) in likely)
    if places:
        say("laws of any shape")
    return tuple(p for p in places if any_law(at.bench, at.before, p).p_value < SURELY)


def _beyond(linear: Refit, chosen: Refit, scale: float) -> bool:
    """Whether all of the model's numbers together explain more than the few that were singled out.

    Not tempered: where they leave noise there is nothing that no hypothesis has.
    """
    return (linear.fit.evidence - chosen.fit.evidence) / scale > WORTH
