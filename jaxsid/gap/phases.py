"""What each record has of its own of an effect, as the phase of a force that goes on: begun where it fits best.

A part of the records tells it of one of them. The phase of another may then be half a turn off, where no small change
of it brings anything and a search ends with a force that is too small in all of them.
"""

from typing import Any

import numpy as np

from jaxsid.gap.hypothesis import own_of_records, with_parameters
from jaxsid.gap.refit import Bench, Hypothesis, Refit, refitted
from jaxsid.parallel import side_by_side

TURNS = np.arange(4) * np.pi / 2
SEARCH = {"steps": 4, "gain": 2.0}  # from each of them, and the gain below which it has come to an end


def in_phase(bench: Bench, hypothesis: Hypothesis, start: dict[str, Any]) -> Hypothesis:
    """A hypothesis whose last effect begins with those phases, a quarter turn apart, that a short search fits best.

    Args:
        bench: all records.
        hypothesis: as a part of them tells it.
        start: changes of elements and states to begin with.
    """
    names = own_of_records(hypothesis.effects[-1]) if hypothesis.effects else []
    if not names or bench.records < 2:
        return hypothesis
    for record in range(bench.records):

        def turned(angle: float, of: Hypothesis = hypothesis, record: int = record) -> Refit:
            return refitted(bench, _turned(of, names, record, angle, bench.records), **start, **SEARCH)

        found = max(side_by_side(turned, TURNS), key=lambda x: x.fit.evidence)
        hypothesis = found.hypothesis if np.isfinite(found.fit.evidence) else hypothesis
    return hypothesis


def _turned(of: Hypothesis, names: list[str], record: int, angle: float, records: int) -> Hypothesis:
    """With the phase of one record so far on."""
    *others, effect = of.effects
    on = angle * (np.arange(records) == record)
    new = {n: np.broadcast_to(np.asarray(effect.parameters[n], float), records) + on for n in names}
    return of._replace(effects=(*others, with_parameters(effect, {**effect.parameters, **new})))
