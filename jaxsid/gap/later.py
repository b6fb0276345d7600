"""Whether the held-out end of a record holds what nothing before it did: a sweep at a resonance, a gap that closes."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxsid.gap.closure import Closure, Left, left_before, left_of, substantial
from jaxsid.gap.examine import Examination
from jaxsid.gap.held_out import later_ends
from jaxsid.gap.measure import is_free_or_unstable
from jaxsid.gap.refit import Bench, Hypothesis, Refit, bench_of, refitted
from jaxsid.mechanics.lumped import LumpedModel
from jaxsid.records import Record


def best_linear(bench: Bench, changes: Float[np.ndarray, " e"]) -> Refit:
    """The best linear model: all of its numbers may be far off.

    Args:
        bench: records.
        changes: of the elements, to begin with.
    """
    return refitted(bench, Hypothesis(wrong=tuple(range(len(bench.tolerance)))), changes=changes)


def changes_found(found: Examination) -> Float[np.ndarray, " e"]:
    """Relative changes of the elements of the best linear model, on the lines of the records.

    Args:
        found: the examination.
    """
    values, nominal = np.asarray(found.elements.values), np.asarray(found.elements.nominal)
    return np.where(nominal != 0, values / np.where(nominal != 0, nominal, 1.0) - 1, 0.0)


def later_than_agreed(
    model: LumpedModel, seen: Sequence[Record], whole: Sequence[Record], found: Examination
) -> tuple[int, ...]:
    """How many samples of each record must be seen for all that it holds, where those seen agree with a linear model.

    Args:
        model: nominal; its effects are left out.
        seen: records without their held-out ends.
        whole: records as they are.
        found: examination of the former.
    """
    bench, ends = bench_of(model, seen, found.noises, found.fit), tuple(len(r.y) for r in seen)
    linear = best_linear(bench, changes_found(found))
    after = left_of(linear, bench, whole, ends, windowed=is_free_or_unstable(model))
    return later_than_linear(found, linear, bench, whole, ends, after)


def later_than_linear(
    found: Examination,
    linear: Refit,
    bench: Bench,
    whole: Sequence[Record],
    ends: tuple[int, ...],
    after: Left,
) -> tuple[int, ...]:
    """Likewise, where no effect explains what the best linear model leaves.

    Args:
        found: examination of the samples seen.
        linear: the best linear model.
        bench: that it was fitted to.
        whole: records as they are.
        ends: samples of each that were seen.
        after: what it leaves of the others.
    """
    # a model that drifts away leaves most where nothing else is the matter
    windowed = is_free_or_unstable(bench.model)
    before = left_before(linear, bench).left if windowed else [x.refit - x.measured for x in found.beside]
    return later_ends(whole, ends, before, after.left)


def later_than_effects(
    chosen: Refit, bench: Bench, whole: Sequence[Record], ends: tuple[int, ...], closure: Closure
) -> tuple[int, ...]:
    """Likewise, where the effects found leave more than noise, window by window.

    Args:
        chosen: with the effects.
        bench: that it was fitted to.
        whole: records as they are.
        ends: samples of each that were seen.
        closure: what is left of the others.
    """
    if not substantial(closure.after, closure.noise_floor):
        return ends
    after = left_of(chosen, bench, whole, ends, windowed=True)
    return later_ends(whole, ends, left_before(chosen, bench).left, after.left)
