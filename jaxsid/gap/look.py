"""What is left of records once effects that were found are taken out, and what may be the matter with it."""

from collections import Counter
from collections.abc import Sequence
from itertools import zip_longest
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxsid.gap.deflate import deflated
from jaxsid.gap.examine import NEGLIGIBLE, Examination
from jaxsid.gap.locate import Scored, likeliest, scored
from jaxsid.gap.null import SIGNIFICANT, Null, left_share, null_test, told_at
from jaxsid.gap.places import places_of
from jaxsid.gap.ranking import LOUD, Explanation, ends_of
from jaxsid.gap.recalibrate import Recalibrated, recalibrated
from jaxsid.gap.refit import Bench, Refit
from jaxsid.gap.screen import Candidate, screen
from jaxsid.mechanics.effects.catalogue import CATALOGUE
from jaxsid.mechanics.lumped import LumpedModel
from jaxsid.physical.elements import element_matrices, with_values
from jaxsid.records import Record

SLIGHT = 0.3  # of what is left: a part that tests find but that is of no matter
PLACES = 4  # of one kind that are tried before other kinds, where something was found already


class Look(NamedTuple):
    """What is left of records once effects found are taken out.

    Attributes:
        fit: the best linear model beside that.
        null: tests of what it leaves.
        scored: places where that may arise; None where tests find nothing, or nobody asked.
    """

    fit: Recalibrated
    null: Null
    scored: Scored | None

    @property
    def clear(self) -> bool:
        return bool(self.null.p_value >= SIGNIFICANT or self.null.share <= NEGLIGIBLE)


def slight(found: Examination) -> bool:
    """Whether what tests find is small beside the noise, so that no law could be told from it.

    Noise is what is left where it is not loud, or each sensor's own and steady, however low its level was guessed.

    Args:
        found: where the structure is in doubt.
    """
    noisy = found.fit.squares < LOUD**2 * found.fit.equations or found.null.own
    return bool(noisy and found.null.share < SLIGHT * left_share(found.fit))


def candidates_of(look: Look) -> tuple[Candidate, ...]:
    """From the longest record, and those that hold sensors which it lacks: programs are compiled for each length.

    Args:
        look: none come of a clear one.
    """
    return () if look.clear else _screened(look, None)


def candidates_elsewhere(look: Look, selected: Sequence[Explanation]) -> tuple[Candidate, ...]:
    """Likewise, of a clear look too, where tests find a law but nothing was found yet.

    Args:
        look: at places.
        selected: what was found.
    """
    if look.scored is None:
        return ()
    told = {ends_of(p.as_dict()) for p in told_at(look.null, look.scored.places)}
    told -= {ends_of(x.place) for x in selected}
    return tuple(c for c in _screened(look, None) if ends_of(c.place) in told)


def attached_candidates(look: Look) -> tuple[Candidate, ...]:
    """Likewise of springs, dampers and masses that the model lacks, which its own numbers may stand for.

    Args:
        look: may be clear.
    """
    lacking = [n for n, kind in CATALOGUE.items() if kind.needs == "apart" or kind.vibrates is not None]
    return _screened(look, tuple(lacking))


def _screened(look: Look, kinds: tuple[str, ...] | None) -> tuple[Candidate, ...]:
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
    return screen(
        of.model, [of.settings[i] for i in rows], of.places, motions, of.tolerance, left, kinds=kinds
    )


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


def at_likeliest(look: Look, candidates: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """Those that act where what is left most probably arises.

    Args:
        look: tells where.
        candidates: of it.
    """
    if look.scored is None:
        return ()
    place = ends_of(likeliest(look.scored).as_dict())
    return tuple(c for c in candidates if ends_of(c.place) == place)


def to_try(look: Look, first: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """What now comes first, in turn with what does where it most probably arises, and what came next to the first.

    Nothing where nothing is left.

    Args:
        look: of what is left now.
        first: candidates of the first look.
    """
    now = varied(candidates_of(look))
    streams = (now[::2], at_likeliest(look, now), now[1::2], varied(first)) if now else ()
    return tuple(c for four in zip_longest(*streams) for c in four if c is not None)


def varied(candidates: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """The same, but those of a kind that has had its turn at several places come after all others.

    Args:
        candidates: most promising first.
    """
    had: Counter[str] = Counter()
    turns = []
    for c in candidates:
        had[c.kind] += 1
        turns.append(had[c.kind] > PLACES)
    order = sorted(range(len(candidates)), key=lambda i: turns[i])
    return tuple(candidates[i] for i in order)


def looked(
    model: LumpedModel, seen: Sequence[Record], bench: Bench, found: Refit, *, little: bool = False
) -> Look:
    """Records without what effects found do to them, beside the model with its wrong numbers put right.

    Args:
        model: nominal.
        seen: records that may be looked at.
        bench: that the fit is of.
        found: the fit.
        little: places are asked for though the look is clear.
    """
    nominal = np.asarray(element_matrices(bench.model).nominal)
    change = np.zeros(len(nominal))
    wrong = list(found.hypothesis.wrong)
    change[wrong] = found.fit.theta[wrong]
    base = with_values(bench.model, jnp.asarray(nominal * (1 + change)))
    records = deflated(seen, bench, found)
    fit = recalibrated(base, records, bench.noises, wide=True, given=True)
    look = Look(fit, null_test(fit, places_of(base), deflated=True), None)
    return (
        look
        if look.clear and not little
        else look._replace(scored=scored(base, records, noises=bench.noises))
    )
