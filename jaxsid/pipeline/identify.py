"""The whole chain: records to impulse response, order, state-space model, modes, mass, damping and stiffness."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Array

from jaxsid.checks import InsufficientDataError, check_excitation, require
from jaxsid.compilation import release_programs
from jaxsid.identification import Identification, MatrixDeviation
from jaxsid.impulse.lines import Lines, record_lines
from jaxsid.impulse.protocol import ImpulseMethod
from jaxsid.mechanics.lumped import LumpedModel, Matrices, lumped_model
from jaxsid.mechanics.simulate import markov_parameters
from jaxsid.physical.elements import ElementValues, with_values
from jaxsid.pipeline.before_after import before_after
from jaxsid.pipeline.entries import fitted_entries
from jaxsid.pipeline.fit import TimeFit, frequency_fits, no_time_fit, residuals_of, time_fit
from jaxsid.pipeline.matrices import Found, explained, find_matrices
from jaxsid.pipeline.misses import input_warning
from jaxsid.pipeline.modes import FinalModes, final_modes
from jaxsid.pipeline.setting import Setting, setting
from jaxsid.pipeline.state_space import StateSpace, state_space
from jaxsid.records import Record, Residuals, SecondOrderModel, as_array

LONGEST_RESPONSE = 8192  # samples of the impulse response that is reported
STRUCTURES = ("auto", "free", "model")
Progress = Callable[[str], None]


def identify(
    model: LumpedModel,
    records: Record | Sequence[Record],
    *,
    order: int | None = None,
    band: tuple[float, float] | None = None,
    method: ImpulseMethod | None = None,
    realization: str = "era",
    initial: str = "estimate",
    structure: str = "auto",
    refine: bool = True,
    progress: Progress | None = None,
) -> Identification:
    """Impulse response, state-space model, modes and M, D, K of a system, from records of its inputs and outputs.

    M q'' + D q' + K q = B u, from Y(k) = G(z_k) U(k) + transient on the lines k that the inputs excite: observer
    Markov parameters, ERA or ERA/DC, maximum-likelihood poles, CBSI, and the M, D, K that fit the lines best, made of
    the model's own elements or free symmetric ones. The model's numbers are compared with, never weighed; where CBSI
    fails they are a starting point.

    Args:
        model: bodies, connections, inputs and sensors; SI units.
        records: one or more; they may differ in length, rate and in which sensors they hold.
        order: number of states; None takes what bodies and sensors promise.
        band: frequencies (Hz) to use; None finds what the inputs excite.
        method: estimator of the impulse response, such as `InBand()` (the default) or `Wavelet()`.
        realization: "era" or "era_dc".
        initial: "estimate" each record's initial state, or take it to be at "rest", for the comparison in time.
        structure: "free" for symmetric mass, damping and stiffness; "model" for those that the model's elements can
            make; "auto" for the latter unless the records contradict them (chi-squared test at 1 %).
        refine: fit mass, damping and stiffness to the lines; False leaves those of CBSI alone, without standard
            deviations, and none where a body has no sensor.
        progress: called with a line of text as each stage begins.

    Returns:
        Identification.

    Raises:
        InputError: records, names or options that cannot be used.
        InsufficientDataError: the records cannot support an answer.

    Source: thesis ch. 2-5; R. Pintelon and J. Schoukens, System Identification, 2nd ed. (lines and weights).
    """
    say = progress or (lambda text: None)
    records = (records,) if isinstance(records, Record) else tuple(records)
    release_programs()  # those of systems of other sizes, should there be very many
    require(initial in ("estimate", "rest"), f"initial '{initial}' is unknown; choose estimate or rest.")
    require(structure in STRUCTURES, f"structure '{structure}' is unknown; choose {' or '.join(STRUCTURES)}.")
    require(
        refine or structure != "model",
        "structure 'model' asks for a fit of the model's elements, which refine=False leaves out: choose one of both.",
    )
    system = setting(model, records)
    _check_records(model, records, order or system.visible)
    say("impulse response in the excited band")
    lines = record_lines(records, outputs=system.outputs, band=band)
    space = state_space(
        records, lines, order=order, expected=system.visible, realization=realization, method=method
    )
    say("mass, damping and stiffness")
    if len(space.raw.A) != system.visible:
        found = _not_this_order(system)
    else:
        found = (
            find_matrices(model, system, space, structure, refine=refine)
            if space.stable
            else Found(None, None, None, None, ())
        )
    say("modes, fit")
    final = final_modes(space, *((found.model, found.fit) if explained(found) else (None, None)))
    return _collect(model, records, system, space, found, final, refine, initial == "rest")


def _collect(
    model: LumpedModel,
    records: tuple[Record, ...],
    system: Setting,
    space: StateSpace,
    found: Found,
    final: FinalModes,
    refine: bool,
    at_rest: bool,
) -> Identification:
    """The stages' results in one value, with the comparison in time and in frequency."""
    lines = space.lines
    times = (
        time_fit(final.continuous, records, system.outputs, lines, space.polished.noise, at_rest)
        if space.stable
        else no_time_fit(records, system.outputs)
    )
    errors = before_after(model, records, system, found, times, at_rest)
    residuals = residuals_of(records, system.outputs, times.predictions) if space.stable else ()
    return Identification(
        nominal=model,
        records=records,
        outputs=system.outputs,
        response=space.response,
        time_response=markov_parameters(final.realization, samples=_response_samples(records)),
        realization=final.realization,
        continuous=final.continuous,
        order=len(space.raw.A),
        order_reason=space.order_reason,
        stabilization=space.stabilization,
        modal=final.modal,
        frequency_std=final.frequency_std,
        damping_ratio_std=final.damping_ratio_std,
        pole_std=final.pole_std,
        shape_std=final.shape_std,
        cbsi=found.cbsi,
        refined=refine,
        matrices=found.model,
        matrices_std=None if found.fit is None else _deviation(found),
        elements=found.elements,
        entries=fitted_entries(found.fit, model)
        if found.fit is not None and found.elements is None
        else None,
        identified=_identified(model, found),
        predictions=times.predictions,
        train_nrmse=as_array(times.nrmse),
        noise_floor=as_array(times.floor),
        nominal_nrmse=errors.nominal,
        cbsi_nrmse=errors.cbsi,
        matrices_nrmse=errors.matrices,
        residuals=residuals,
        frequency_fit=frequency_fits(
            records, system.outputs, final.continuous, found.model, np.asarray(lines.band).tolist()
        ),
        warnings=(
            *_about_records(records, lines),
            *(*space.warnings, *_left_out(model), *found.warnings, *_missing(model, system)),
            *_inputs_left(residuals, records, system, times),
        ),
    )


def _not_this_order(system: Setting) -> Found:
    return Found(None, None, None, None, (
        f"The bodies and sensors of the model have {system.visible} visible states: with another order there is no "
        "mass, damping and stiffness.",
    ))  # fmt: skip


def _deviation(found: Found) -> MatrixDeviation:
    assert found.fit is not None
    fit, rows = found.fit, [_row_sums(np.asarray(x)) for x in found.fit.slopes[1:]]
    covariance = np.asarray(fit.covariance)
    sums = [np.sqrt(np.maximum(np.einsum("ip,pq,iq->i", x, covariance, x), 0.0)) for x in rows]
    return MatrixDeviation(*fit.deviation, *(as_array(x) for x in sums))


def _row_sums(slopes: np.ndarray) -> np.ndarray:
    """Slopes (N, N, p) of every row's sum; terms that cancel, as where nothing joins a body to ground, leave zero."""
    total, size = slopes.sum(axis=1), np.abs(slopes).sum(axis=1)
    return np.where(np.abs(total) > 8 * np.finfo(slopes.dtype).eps * size, total, 0.0)


def _identified(model: LumpedModel, found: Found) -> LumpedModel | None:
    """The model file's model; None where CBSI's mass, made symmetric, is none."""
    if found.model is None or np.linalg.eigvalsh(_symmetric(found.model.mass))[0] <= 0:
        return None
    return identified_model(model, found.model, found.elements)


def _symmetric(matrix: Array) -> np.ndarray:
    return 0.5 * (np.asarray(matrix) + np.asarray(matrix).T)


def identified_model(
    nominal: LumpedModel, found: SecondOrderModel, elements: ElementValues | None = None
) -> LumpedModel:
    """The nominal model with its numbers replaced by identified ones: of its elements, or else matrices.

    Args:
        nominal: gives bodies, inputs and sensors.
        found: M, D, K.
        elements: values of the model's elements; None for matrices.
    """
    if elements is not None:
        return with_values(nominal, elements.values)
    mass, damping, stiffness = (_symmetric(x) for x in (found.mass, found.damping, found.stiffness))
    return lumped_model(
        nominal.bodies,
        matrices=Matrices(as_array(mass), as_array(damping), as_array(stiffness)),
        inputs=nominal.inputs,
        sensors=nominal.sensors,
        tolerance=nominal.tolerance,
        name=nominal.name,
    )


def _response_samples(records: Sequence[Record]) -> int:
    return min(max(r.u.shape[0] for r in records), LONGEST_RESPONSE)


def _about_records(records: Sequence[Record], lines: Lines) -> tuple[str, ...]:
    low, high = np.asarray(lines.band).tolist()
    nyquist = min(0.5 / float(r.dt) for r in records)
    if high < 0.5 * nyquist:
        return (
            f"The inputs excite {low:.3g} to {high:.3g} Hz of the {nyquist:.4g} Hz that the sampling rate could show; "
            "all estimates come from that band.",
        )
    return ()


def _inputs_left(
    residuals: Sequence[Residuals], records: Sequence[Record], system: Setting, times: TimeFit
) -> tuple[str, ...]:
    names, inputs = [r.name for r in records], [r.inputs for r in records]
    return input_warning(residuals, names, system.outputs, inputs, times.nrmse) if residuals else ()


def _missing(model: LumpedModel, system: Setting) -> tuple[str, ...]:
    absent = [s.name for s in model.sensors if s.name not in system.outputs]
    return (f"No record holds {', '.join(absent)}.",) if absent else ()


def _check_records(model: LumpedModel, records: Sequence[Record], order: int) -> None:
    """Raise where the records excite nothing, or are shorter than any model of this order needs."""
    for r in records if len(model.inputs) == 1 else ():
        check_excitation(r)
    samples = sum(r.u.shape[0] for r in records)
    needed = 10 * order
    if samples < needed:
        raise InsufficientDataError(
            f"{samples} samples cannot determine a model of {order} states: record at least {needed}."
        )


def _left_out(model: LumpedModel) -> tuple[str, ...]:
    if not model.effects:
        return ()
    kinds = ", ".join(dict.fromkeys(effect.kind for effect in model.effects))
    return (
        f"The model has effects ({kinds}), which a linear model cannot have: they are left out here, and what they do "
        "is spread over mass, damping and stiffness. `jaxsid.refine` fits them.",
    )
