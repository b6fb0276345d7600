"""Numbers of a model that its fit holds for off by more than they may be, and what looks like them."""

import numpy as np

from jaxsid.gap.explain import ERRORS, FINE, Effort, element_place, elements_by_key, extended, nothing
from jaxsid.gap.refit import Bench, Refit, changes_of, refitted
from jaxsid.gap.screen import Candidate
from jaxsid.physical.elements import element_matrices

OFF = 2.5  # tolerances from which on a number may be wrong


def numbers_off(bench: Bench, found: Refit) -> tuple[Candidate, ...]:
    """The model's numbers that a fit holds for off, farthest first, and gains; none where no number is.

    Args:
        bench: that it was fitted to.
        found: the fit.
    """
    wrong, model = found.hypothesis.wrong, bench.model
    listed = element_matrices(model).listed
    far = np.abs(found.fit.theta[: len(listed)]) / bench.tolerance
    begin = changes_of(found, bench)
    new = lambda kind, place, parameters: Candidate(kind, place, parameters, begin, 0.0, np.nan, "", {})  # noqa: E731
    rows = sorted(elements_by_key(model).values(), key=lambda x: -far[list(x)].max())
    off = [x for x in rows if far[list(x)].max() > OFF and not nothing(model, x) and not {*x} <= {*wrong}]
    candidates = [new(ERRORS[listed[i].quantity], element_place(model, listed[i]), {}) for i, *_ in off]
    candidates[1:1] = [new("input_gain", {"input": x.name}, {"factor": 1.0}) for x in model.inputs]
    candidates += [new("sensor_gain", {"sensor": x.name}, {"factor": 1.0}) for x in model.sensors]
    return tuple(candidates) if off else ()


def hint(bench: Bench, found: Refit, candidate: Candidate, effort: Effort) -> float:
    """Tempered gain of evidence by one candidate beside what was found, in the noise that this left: one quick fit.

    Args:
        bench: that it was fitted to.
        found: the fit.
        candidate: from `numbers_off`.
        effort: steps and temperature.
    """
    more = extended(found.hypothesis, candidate, elements_by_key(bench.model))
    begin = {"changes": changes_of(found, bench), "states": found.fit.states}
    with_it = refitted(bench, more, **begin, steps=effort.steps, gain=FINE)
    scale = found.fit.squares / max(found.fit.equations, 1)
    return (with_it.fit.evidence - found.fit.evidence) / scale / effort.temperature
