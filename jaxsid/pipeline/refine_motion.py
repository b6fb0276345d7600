"""Refinement of a model with effects against raw records, by simulation in time."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsid.compilation import compiled
from jaxsid.impulse.whitening import whitening_filter
from jaxsid.mechanics.lumped import LumpedModel
from jaxsid.physical.bounded import BoundedFit
from jaxsid.physical.elements import LinearMatrices, element_matrices, with_values
from jaxsid.physical.motion import Left, MotionTerm, counted
from jaxsid.physical.restrictions import Restricted
from jaxsid.pipeline.correlations import correlations
from jaxsid.pipeline.motion_terms import Windows, lowest_frequency, motion_term, window_length
from jaxsid.pipeline.refining import Manner, Problem, concluded, nominal_unknowns, solved, with_input_warning
from jaxsid.records import Record, Residuals, as_array
from jaxsid.refinement import Refinement, Validation

HELD_OUT = 0.25  # part of the end of every record that is kept for validation
ROUNDS = 2  # fits after which level and colour of the noise, and then the windows, are found anew
SAME = 0.1  # relative change of a window that is none
STATE_ROUNDS = 2  # fits of short windows before their initial states are taken for found
PERIODS = 2  # of the slowest vibration, in a window to start with
CLUSTERS = 30  # groups of windows whose errors are taken for independent
Terms = tuple[MotionTerm, ...]


def refine_motion(
    model: LumpedModel,
    known: Restricted,
    records: tuple[Record, ...],
    window: float | None,
    initial: str,
    how: Manner,
) -> Refinement:
    terms, cuts, theta = _settled(model, known, records, window, initial == "rest", how)
    how.say("values of the model and its effects")
    early = tuple(_held_out(term, late=False) for term in terms) if how.validate else None
    nuisances = sum(len(term.free) * len(term.state) for term in terms)
    problem = Problem(known, terms, early, (theta,), nuisances, solver=how.solver, profiled=how.profiled)
    fit, before = solved(problem)
    how.say("validation")

    def errors(m: LumpedModel, of: Terms = terms, seen: Terms = terms) -> np.ndarray:
        values = jnp.asarray(element_matrices(m, effects=True).nominal)
        return _errors(of, seen, known.unknowns, known.unknowns.of_values(values))

    validation = None
    if before is not None and early is not None:
        late = tuple(_held_out(term, late=True) for term in terms)
        # a whole record goes on from its first part; windows of the last part begin anew
        begun = tuple(e if cut.whole else x for e, x, cut in zip(early, terms, cuts, strict=True))
        validation = Validation(
            as_array(errors(model, late, begun)),
            as_array(_errors(late, begun, before.unknowns, before.posterior.theta)),
            "the last quarter of every record",
        )
    windowed = not all(cut.whole for cut in cuts)
    spread = (lambda found: _spread(terms, found)) if windowed else None
    outputs = tuple(s.name for s in model.sensors)

    def residuals(_: LumpedModel) -> Residuals:
        return _residuals(terms, cuts, fit)

    found = concluded(problem, model, fit, spread, outputs, errors, validation, residuals)
    return with_input_warning(found)


def _settled(
    model: LumpedModel,
    known: Restricted,
    records: tuple[Record, ...],
    window: float | None,
    rest: bool,
    how: Manner,
) -> tuple[Terms, list[Windows], Array]:
    """The records with windows and noise that agree with the model fitted to them, and its unknowns."""
    cuts, theta = window_length(model, records, window), nominal_unknowns(known)
    begun: tuple[Array, ...] = ()
    short = window_length(model, records, PERIODS / lowest_frequency(model))
    if np.isfinite(lowest_frequency(model)) and any(
        cut.length > 2 * x.length for cut, x in zip(cuts, short, strict=True)
    ):
        # a long simulation by wrong values has many misleading minima, a short one none
        how.say("a start from short windows")
        parts = tuple(motion_term(model, records, cut, rest=False) for cut in short)
        for _ in range(STATE_ROUNDS):
            theta = _fitted(known, parts, theta, how)
            how = how._replace(scattered=None)
            parts = tuple(_from_best_states(part, known.unknowns, theta) for part in parts)
        theta = _fitted(known, parts, theta, how)
        begun = tuple(_begun(part, known.unknowns, theta) for part in parts)
    for remaining in reversed(range(ROUNDS)):
        how.say("windows and initial states")
        terms = tuple(motion_term(model, records, cut, rest=rest) for cut in cuts)
        terms = tuple(_from_states(t, x) for t, x in zip(terms, begun, strict=True)) if begun else terms
        for _ in range(ROUNDS):
            how.say("level and colour of the noise")
            theta = _fitted(known, terms, theta, how)
            how = how._replace(scattered=None)  # further starts are for the first fit
            terms = _weighed(terms, cuts, known.unknowns, theta)
        # where the windows follow from the model, those of the fitted one count
        better = window_length(with_values(model, known.unknowns.values(theta)), records, window)
        if not remaining or all(
            abs(x.length - y.length) < SAME * y.length for x, y in zip(better, cuts, strict=True)
        ):
            break
        cuts = better
    return terms, cuts, theta


def _from_best_states(term: MotionTerm, unknowns: LinearMatrices, theta: Array) -> MotionTerm:
    """The term with better initial states to begin with: those found, or rest where that leads to less misfit.

    Of a contact at rest the motion depends on its speed by the square, so that a search from elsewhere creeps there.
    """
    nothing = eqx.tree_at(lambda t: t.state, term, jnp.zeros_like(term.state))
    found, still = (_left(x, unknowns, theta) for x in (term, nothing))
    misfit, misfit_still = (((x.difference * term.weight) ** 2).sum(axis=(1, 2)) for x in (found, still))
    best = jnp.where((misfit_still < misfit)[:, None], still.states, found.states)
    return eqx.tree_at(lambda t: t.state, term, best)


def _begun(term: MotionTerm, unknowns: LinearMatrices, theta: Array) -> Array:
    """Initial states of the records, those of their first windows."""
    return _left(term, unknowns, theta).states[np.asarray(term.first) == 0]


def _from_states(term: MotionTerm, states: Array) -> MotionTerm:
    """The term with other initial states to begin with, where its windows are whole records from any state."""
    return (
        eqx.tree_at(lambda t: t.state, term, states) if term.free and len(states) == len(term.state) else term
    )


def _fitted(known: Restricted, terms: Terms, start: Array, how: Manner) -> Array:
    problem = Problem(known, terms, None, (start,), weighed=False, solver=how.solver)
    fit, _ = solved(problem._replace(scattered=how.scattered))
    return fit.posterior.theta


@compiled
def _left(term: MotionTerm, unknowns: LinearMatrices, theta: Array) -> Left:
    return term.left(unknowns, theta)


@compiled
def _scores(term: MotionTerm, unknowns: LinearMatrices, theta: Array) -> Float[Array, "windows p"]:
    """Slope of half the sum of squares of every window."""
    r, j = term.projected(unknowns, theta)
    return jnp.einsum("wk,wkp->wp", r, j)


def _weighed(terms: Terms, cuts: Sequence[Windows], unknowns: LinearMatrices, theta: Array) -> Terms:
    """Level and colour of the noise of every sensor from what a fit left; the colour of whole records only."""
    found = []
    for term, cut in zip(terms, cuts, strict=True):
        term = _from_best_states(term, unknowns, theta)
        after = _left(term, unknowns, theta)
        left, seen = np.asarray(after.difference), np.asarray(term.weight) > 0
        weight, color = np.zeros(seen.shape), np.array(term.color)
        for output in range(left.shape[2]):
            here = seen[:, :, output]
            if not here.any():
                continue
            error = np.where(here, left[:, :, output], 0.0)
            size = np.abs(np.asarray(term.y)[:, :, output]).max()
            if cut.whole:
                color[output] = whitening_filter(error[here.all(axis=1)] if here.all(axis=1).any() else error)
                error = sum(c * np.roll(error, k, axis=1) for k, c in enumerate(color[output]))
            level = np.sqrt((np.asarray(error)[here] ** 2).mean())
            weight[:, :, output] = here / max(level, 1e-12 * size, np.finfo(float).tiny)
        known = as_array(weight), as_array(color), after.states
        found.append(eqx.tree_at(lambda t: (t.weight, t.color, t.state), term, known))
    return tuple(found)


def _held_out(term: MotionTerm, *, late: bool) -> MotionTerm:
    """The term with the last quarter of every record alone, or without it."""
    weight, first, record = (np.asarray(x) for x in (term.weight, term.first, term.record))
    number = first[:, None] + np.arange(weight.shape[1])
    measured = (weight > 0).any(axis=2)
    ends = np.array([(number * measured)[record == r].max() + 1 for r in range(record.max() + 1)])
    of_end = number >= (1 - HELD_OUT) * ends[record][:, None]
    return eqx.tree_at(lambda t: t.weight, term, as_array(weight * (of_end == late)[:, :, None]))


def _errors(of: Terms, seen: Terms, unknowns: LinearMatrices, theta: Array) -> np.ndarray:
    """rms(y - yhat) / rms(y) of every output, where the first terms count, begun as the second ones tell."""
    left = size = 0.0
    for which, given in zip(of, seen, strict=True):
        weight = np.asarray(counted(which.weight, which.color)) > 0
        difference = np.asarray(_left(given, unknowns, theta).difference)
        left = left + np.where(weight, difference**2, 0.0).sum(axis=(0, 1))
        size = size + np.where(weight, np.asarray(which.y) ** 2, 0.0).sum(axis=(0, 1))
    return np.sqrt(left / np.where(np.asarray(size) > 0, size, 1.0))


def _spread(terms: Terms, fit: BoundedFit) -> np.ndarray:
    """Covariance of J'r from how it differs between groups of windows, whatever correlates the errors within one.

    Source: K.-Y. Liang and S. Zeger, Biometrika 73 (1986).
    """
    total = np.zeros((len(fit.posterior.theta),) * 2)
    for term in terms:
        scores = np.asarray(_scores(term, fit.unknowns, fit.posterior.theta))
        size = max(len(scores) // CLUSTERS, 1)
        groups = np.add.reduceat(scores, np.arange(0, len(scores), size), axis=0)
        total += groups.T @ groups * len(groups) / max(len(groups) - 1, 1)
    return total


def _residuals(terms: Terms, cuts: Sequence[Windows], fit: BoundedFit) -> Residuals:
    """Correlations of what is left of the longest record."""
    lengths = [
        [(np.asarray(t.record) == r).sum() * c.length for r in range(len(t.u))]
        for t, c in zip(terms, cuts, strict=True)
    ]
    which = int(np.argmax([max(x) for x in lengths]))
    term, record = terms[which], int(np.argmax(lengths[which]))
    own = np.asarray(term.record) == record
    left = np.asarray(_left(term, fit.unknowns, fit.posterior.theta).difference)[own]
    seen = np.asarray(term.weight)[own] > 0
    rows = seen.any(axis=2).ravel()
    error = np.where(seen, left, 0.0).reshape(-1, left.shape[2])
    error[:, ~seen.any(axis=(0, 1))] = np.nan
    u = np.asarray(term.u)[record, : len(error)]
    return correlations(error[rows], u[rows], float(term.dt))
