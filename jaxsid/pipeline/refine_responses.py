"""Refinement against impulse responses and frequency responses."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from jaxsid.checks import JaxsidError, require
from jaxsid.impulse.spectra import FrequencyResponse
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.hold import continuous, discretise
from jaxsid.mechanics.lumped import LumpedModel, free_bodies, loose_bodies, second_order
from jaxsid.mechanics.simulate import markov_parameters
from jaxsid.physical.bounded import BoundedFit
from jaxsid.physical.cbsi import visible_states
from jaxsid.physical.elements import ElementValues, with_values
from jaxsid.physical.measured import every_other, frequency_term, response_term, response_weights
from jaxsid.physical.posterior import Solver, most_probable
from jaxsid.physical.restrictions import Restricted
from jaxsid.physical.terms import ResponseTerm
from jaxsid.physical.widened import widened_start
from jaxsid.pipeline.refining import (
    Manner,
    Problem,
    concluded,
    fitted_model,
    nominal_unknowns,
    relative_error,
    solved,
)
from jaxsid.realization.era import era
from jaxsid.records import ImpulseResponse, SecondOrderModel, as_array
from jaxsid.refinement import Refinement, Validation
from jaxsid.uncertainty.noise import CorrelatedNoise, ResponseNoise


def refine_traced(
    model: LumpedModel,
    known: Restricted,
    ir: ImpulseResponse,
    noise: ResponseNoise | None,
    solver: Solver | None,
) -> Refinement:
    """The fit alone, for use under transformations."""
    term = response_term(ir, second_order(model), response_weights(ir, noise))
    unknowns, prior = known.unknowns, known.prior
    found = most_probable((term,), unknowns, prior, nominal_unknowns(known), solver)
    free = max(known.unknowns.mix.shape[1], 1)
    misfit = found.squares / jnp.maximum(found.equations - free, 1)
    precision = jnp.diag(jnp.asarray(prior.weight) ** 2)
    inverse = jnp.linalg.inv(found.information / jnp.maximum(misfit, 1.0) + precision)
    mix = jnp.asarray(unknowns.mix) * unknowns.scale
    covariance = mix @ inverse @ mix.T
    spread = jnp.sqrt(jnp.maximum(jnp.diag(covariance), 0.0))
    values = unknowns.values(found.theta)
    safe = jnp.where(spread > 0, spread, jnp.nan)
    share = jnp.where(precision.diagonal() > 0, 1 - inverse.diagonal() * precision.diagonal(), 1.0)
    nothing = jnp.full(len(model.sensors), jnp.nan)
    return Refinement(
        nominal=model,
        model=with_values(model, values),
        elements=ElementValues(
            unknowns.listed, values, spread, covariance / safe / safe[:, None], jnp.asarray(unknowns.nominal)
        ),
        covariance=covariance,
        data_share=share[jnp.abs(mix).argmax(axis=1)],
        misfit=misfit,
        outputs=tuple(s.name for s in model.sensors),
        before=nothing,
        after=nothing,
        validation=None,
        residuals=None,
        profiles=(),
        at_bound=(),
        open_combinations=(),
        converged=found.converged,
        warnings=(),
    )


def refine_response(
    model: LumpedModel,
    known: Restricted,
    ir: ImpulseResponse,
    noise: ResponseNoise | None,
    how: Manner,
) -> Refinement:
    sensed = second_order(model)
    how.say("a start from the response")
    starts = (*_realized_start(model, known, ir, sensed), nominal_unknowns(known))
    used = every_other(len(ir.h))
    train = lambda w: (response_term(ir, sensed, w, used if how.validate else None),)  # noqa: E731
    weights = response_weights(ir, noise)
    if noise is None:
        how.say("the level of the noise")
        first = Problem(known, train(weights), None, starts, weighed=False, solver=how.solver)
        rough, _ = solved(first._replace(scattered=how.scattered))
        starts = (rough.posterior.theta,)
        left = ir.h - _response_of(fitted_model(model, rough), ir)
        weights = response_weights(ir, None, left)
    how.say("mass, damping and stiffness")
    every = (response_term(ir, sensed, weights),)
    problem = Problem(
        known,
        every,
        train(weights) if how.validate else None,
        starts,
        solver=how.solver,
        profiled=how.profiled,
        scattered=None if noise is None else how.scattered,
    )
    fit, before = solved(problem)
    outputs = tuple(s.name for s in model.sensors)

    def errors(m: LumpedModel, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        left = np.asarray(ir.h - _response_of(m, ir))[rows]
        return relative_error(left, np.asarray(ir.h)[rows])

    validation = None
    if before is not None:
        trained = fitted_model(model, before)
        validation = Validation(
            as_array(errors(model, ~used)), as_array(errors(trained, ~used)), "every fourth sample"
        )
    spread = (lambda found: _spread(every[0], found, noise)) if isinstance(noise, CorrelatedNoise) else None
    return concluded(problem, model, fit, spread, outputs, errors, validation)


def _spread(term: ResponseTerm, fit: BoundedFit, noise: CorrelatedNoise) -> np.ndarray:
    """Covariance of J'r of a fit whose weights are not those of its noise."""
    unknowns = fit.unknowns
    left = term.left(unknowns.matrices(fit.posterior.theta), unknowns.slopes)
    return np.asarray(noise.covariance(left[1:] * term.weight))


def _response_of(model: LumpedModel, ir: ImpulseResponse) -> Array:
    sampled = discretise(physical_displacement_velocity(second_order(model)), ir.dt, hold=ir.hold)
    return markov_parameters(sampled, samples=len(ir.h))


def _realized_start(
    model: LumpedModel, known: Restricted, ir: ImpulseResponse, sensed: SecondOrderModel
) -> tuple[Array, ...]:
    """Unknowns whose response is like that of a realization of the data; none where there is no realization."""
    kinds = [s.kind for s in model.sensors]
    rigid, loose = free_bodies(model), loose_bodies(model)
    loose_rigid = loose.shape[1] if rigid.shape[1] else 0
    order = visible_states(len(model.bodies), kinds, rigid.shape[1], min(loose_rigid, rigid.shape[1]))
    try:
        found = continuous(era(ir, order=order))
    except JaxsidError:
        return ()
    if not np.isfinite(np.asarray(found.A)).all():
        return ()
    highest = 1.5 * float(np.abs(np.linalg.eigvals(np.asarray(found.A))).max())
    start = widened_start(known.unknowns, found, sensed, min(highest, np.pi / float(ir.dt)))
    theta = known.unknowns.unknowns(start)
    return (theta,) if np.isfinite(np.asarray(theta)).all() else ()


def refine_frequencies(
    model: LumpedModel,
    known: Restricted,
    response: FrequencyResponse,
    dt: ArrayLike | None,
    how: Manner,
) -> Refinement:
    sensed, hold = second_order(model), tuple(i.hold for i in model.inputs)
    require(
        response.H.shape[1:] == (len(model.sensors), len(model.inputs)),
        f"the frequency response has {response.H.shape[1]} outputs and {response.H.shape[2]} inputs, the model "
        f"{len(model.sensors)} sensors and {len(model.inputs)} inputs.",
    )
    interval = None if "band" in hold else dt
    used = every_other(len(response.frequencies))
    every = frequency_term(response, sensed, interval, hold)
    train = (frequency_term(response, sensed, interval, hold, used),) if how.validate else None
    how.say("mass, damping and stiffness")
    problem = Problem(
        known,
        (every,),
        train,
        (nominal_unknowns(known),),
        solver=how.solver,
        profiled=how.profiled,
        scattered=how.scattered,
    )
    fit, before = solved(problem)
    H = np.asarray(response.H)

    def errors(m: LumpedModel, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        return relative_error((H - _frequencies_of(m, response, interval, hold))[rows], H[rows])

    validation = None
    if before is not None:
        trained = fitted_model(model, before)
        validation = Validation(
            as_array(errors(model, ~used)), as_array(errors(trained, ~used)), "every fourth line"
        )
    outputs = tuple(s.name for s in model.sensors)
    return concluded(problem, model, fit, None, outputs, errors, validation)


def _frequencies_of(
    model: LumpedModel, response: FrequencyResponse, dt: ArrayLike | None, hold: tuple[str, ...]
) -> np.ndarray:
    plain = physical_displacement_velocity(second_order(model))
    s = 2j * np.pi * np.asarray(response.frequencies)
    found, points = (plain, s) if dt is None else (discretise(plain, dt, hold=hold), np.exp(s * float(dt)))  # type: ignore[arg-type]
    A, B, C, D = (np.asarray(getattr(found, name)) for name in "ABCD")
    return C @ np.linalg.solve(points[:, None, None] * np.eye(len(A)) - A, B[None]) + D
