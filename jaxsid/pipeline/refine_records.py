"""Refinement against raw records, through the Fourier lines that their inputs excite."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxsid.checks import InsufficientDataError
from jaxsid.impulse.lines import NOISE_LOSS, Lines, record_lines
from jaxsid.mechanics.lumped import LumpedModel
from jaxsid.mechanics.simulate import ordered_inputs, simulate
from jaxsid.physical.bounded import within_bounds
from jaxsid.physical.inband_fit import fit_target
from jaxsid.physical.parameterization import Triple
from jaxsid.physical.restrictions import Restricted
from jaxsid.physical.sampled_lines import with_sampling
from jaxsid.physical.terms import LineTerm
from jaxsid.physical.widened import widened_start
from jaxsid.pipeline.correlations import correlations
from jaxsid.pipeline.matrices import sensed_rows
from jaxsid.pipeline.refining import (
    Manner,
    Problem,
    concluded,
    fitted_model,
    nominal_unknowns,
    solved,
    with_input_warning,
)
from jaxsid.pipeline.setting import setting
from jaxsid.pipeline.state_space import StateSpace, state_space
from jaxsid.records import Record, Residuals, SecondOrderModel, as_array
from jaxsid.refinement import Refinement, Validation

HELD_OUT = 0.25  # part of the end of every record that is kept for validation
Pair = tuple[float, float]


def refine_records(
    model: LumpedModel,
    known: Restricted,
    records: tuple[Record, ...],
    band: Pair | None,
    how: Manner,
) -> Refinement:
    system, say = setting(model, records), how.say
    say("poles and noise in the excited band")
    lines = record_lines(records, outputs=system.outputs, band=band)
    space = state_space(records, lines, order=None, expected=system.visible)
    if not space.stable:
        raise InsufficientDataError(
            "the records show an unstable system: a model of masses, springs and dampers cannot follow it."
        )
    sensed = sensed_rows(model, system)
    say("a start from the poles")
    highest = 2 * np.pi * float(np.asarray(space.lines.band)[1])
    near = known.unknowns.unknowns(widened_start(known.unknowns, space.model, sensed, highest))
    begun = known.unknowns.matrices(nominal_unknowns(known))
    every = _term(space, space.lines, np.asarray(space.polished.noise), sensed, begun, False)
    early, late = zip(*(_split(r) for r in records), strict=True)
    train = None
    if how.validate:
        low, high = np.asarray(space.lines.band).tolist()
        first = _padded(record_lines(early, outputs=system.outputs, band=(low, high)), len(space.lines.z))
        train = (_term(space, first, _noise_on(first, space), sensed, begun, False),)
    say("mass, damping and stiffness")
    nuisances = len(records) * (2 * len(model.bodies) + 1) * len(system.outputs)
    problem = Problem(
        known,
        (every,),
        train,
        (near, nominal_unknowns(known)),
        nuisances,
        solver=how.solver,
        profiled=how.profiled,
        scattered=how.scattered,
        loss=NOISE_LOSS,
    )
    fit, before = solved(problem)
    if "band" not in lines.hold:
        matrices = known.unknowns.matrices(fit.posterior.theta)
        own = _term(space, space.lines, np.asarray(space.polished.noise), sensed, matrices, True)
        problem = problem._replace(every=(own,))
        fit = within_bounds(problem.every, known, fit.posterior.theta, how.solver)
    say("validation")

    def errors(m: LumpedModel, given: Sequence[Record] = records) -> np.ndarray:
        return _time_errors(m, given, system.outputs)

    validation = None
    if before is not None:
        trained = fitted_model(model, before)
        validation = Validation(
            as_array(errors(model, late)), as_array(errors(trained, late)), "the last quarter of every record"
        )
    residuals = lambda m: _residuals(m, records, system.outputs)  # noqa: E731
    found = concluded(problem, model, fit, None, system.outputs, errors, validation, residuals)
    return with_input_warning(found)


def _term(
    space: StateSpace,
    lines: Lines,
    noise: np.ndarray,
    sensed: SecondOrderModel,
    matrices: Triple,
    fitted: bool,
) -> LineTerm:
    """Lines to fit to, with what sampling adds as the state-space model has it, or matrices that were fitted to it."""
    target = fit_target(lines, as_array(noise), space.polished.realization, space.model)
    if "band" not in lines.hold:
        target = with_sampling(target, lines, matrices, sensed, jnp.asarray(fitted))
    return LineTerm(target, sensed)


def _split(record: Record) -> tuple[Record, Record]:
    """What is fitted, and what comes after it."""
    cut = len(record.y) - int(HELD_OUT * len(record.y))
    parts = [
        Record(
            np.asarray(record.u)[rows],
            np.asarray(record.y)[rows],
            record.dt,
            inputs=record.inputs,
            outputs=record.outputs,
            hold=record.hold,
            name=f"{record.name}, {which}",
        )
        for rows, which in ((slice(None, cut), "first part"), (slice(cut, None), "last part"))
    ]
    return parts[0], parts[1]


def _padded(lines: Lines, count: int) -> Lines:
    """As many lines as another set has, so that both share compiled programs; those that are added weigh nothing."""
    more = max(count - len(lines.z), 0)

    def grown(x: np.ndarray, fill: np.ndarray) -> np.ndarray:
        return np.concatenate([np.asarray(x), np.broadcast_to(fill, (more, *np.shape(x)[1:]))])

    at = [np.asarray(lines.z)[0], np.asarray(lines.omega)[0], 0.0, 0.0, 0.0, 0.0]
    fields = lines.z, lines.omega, lines.u, lines.y, lines.weight, lines.record
    new = tuple(as_array(grown(np.asarray(x), np.asarray(f))) for x, f in zip(fields, at, strict=True))
    return eqx.tree_at(lambda x: (x.z, x.omega, x.u, x.y, x.weight, x.record), lines, new)


def _noise_on(lines: Lines, space: StateSpace) -> np.ndarray:
    """Noise of lines of a part of the records, from that of the whole, between neighbouring frequencies."""
    given, level = space.lines, np.log(np.asarray(space.polished.noise))
    owner, wanted = (
        np.where(np.asarray(x.weight).any(axis=1), np.asarray(x.record).argmax(axis=1), -1)
        for x in (given, lines)
    )
    found = np.zeros(lines.y.shape)
    for record in range(given.record.shape[1]):
        known, sought = owner == record, wanted == record
        points, at = np.asarray(given.omega)[known], np.asarray(lines.omega)[sought]
        for output in range(found.shape[1]):
            found[sought, output] = np.interp(at, points, level[known, output])
    return np.exp(found)


def _time_errors(model: LumpedModel, records: Sequence[Record], outputs: Sequence[str]) -> np.ndarray:
    """rms(y - yhat) / rms(y) of each output over records, each from its own initial state."""
    left, size = np.zeros(len(outputs)), np.zeros(len(outputs))
    for record in records:
        rows = [outputs.index(n) for n in record.outputs]
        error = _left(model, record)
        left[rows] += (error**2).sum(axis=0)
        size[rows] += (np.asarray(record.y) ** 2).sum(axis=0)
    return np.sqrt(left / np.where(size > 0, size, 1.0))


def _left(model: LumpedModel, record: Record) -> np.ndarray:
    order = [s.name for s in model.sensors]
    columns = [order.index(n) for n in record.outputs]
    return np.asarray(record.y) - np.asarray(simulate(model, record, initial="estimate"))[:, columns]


def _residuals(model: LumpedModel, records: Sequence[Record], outputs: Sequence[str]) -> Residuals:
    """Correlations of what the model leaves of the longest record that has all outputs, else of the longest."""
    record = max(records, key=lambda r: (len(r.outputs), len(r.y)))
    error = np.full((len(record.y), len(outputs)), np.nan)
    error[:, [outputs.index(n) for n in record.outputs]] = _left(model, record)
    return correlations(error, np.asarray(ordered_inputs(model, record)[0]), float(record.dt))
