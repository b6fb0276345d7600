"""Refinement of a model's numbers against measurements: records, impulse responses or frequency responses."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, ArrayLike

from jaxsid.checks import JaxsidError, is_concrete, require
from jaxsid.impulse.spectra import FrequencyResponse
from jaxsid.mechanics.lumped import LumpedModel, second_order
from jaxsid.physical.elements import as_full
from jaxsid.physical.measured import check_response
from jaxsid.physical.posterior import Solver
from jaxsid.physical.restrictions import Restricted, restricted, scattered, unknown_number
from jaxsid.pipeline.refine_motion import refine_motion
from jaxsid.pipeline.refine_records import refine_records
from jaxsid.pipeline.refine_responses import refine_frequencies, refine_response, refine_traced
from jaxsid.pipeline.refining import Manner
from jaxsid.records import ImpulseResponse, Record, as_array
from jaxsid.refinement import Refinement
from jaxsid.uncertainty.noise import ResponseNoise

Progress = Callable[[str], None]
Pair = tuple[float, float]
STRUCTURES = ("model", "free")


def refine(
    model: LumpedModel,
    data: Record | Sequence[Record] | ImpulseResponse | FrequencyResponse,
    *,
    fixed: Sequence[str] = (),
    tied: Sequence[Sequence[str]] = (),
    bounds: Mapping[str, Pair] | None = None,
    priors: Mapping[str, Pair] | None = None,
    noise: ResponseNoise | None = None,
    dt: ArrayLike | None = None,
    band: Pair | None = None,
    window: float | None = None,
    initial: str = "estimate",
    structure: str = "model",
    validate: bool = True,
    solver: Solver | None = None,
    starts: int = 0,
    seed: int = 0,
    profile: Sequence[str] = (),
    progress: Progress | None = None,
) -> Refinement:
    """The masses, dampings and stiffnesses of a model that explain measurements best, and how certain each is.

    minimize sum |w (y - y(theta))|^2 + sum ((theta - mean) / std)^2 within bounds, w one over the noise. The model may
    be off by half: fits to widened resonances lead to the right ones. Bodies need no sensor as long as the model's
    structure lets the others tell of them. Of an impulse response that is traced, as under `jax.vmap`, the fit alone is
    done, from the model's numbers.

    Args:
        model: elements or matrices; SI units.
        data: records, each with its own length, rate, sensors and initial state, which is estimated; or an impulse
            response; or a frequency response.
        fixed: names of values that keep the model's number, such as "load.mass" or "*.damping".
        tied: groups of names that keep the ratios that the model gives them.
        bounds: lowest and highest value by name; values of elements are not negative anyway.
        priors: mean and standard deviation by name.
        noise: of an impulse response; estimated where None. That of records always is, with its colour.
        dt: sampling interval (s) of the records that a frequency response came from; None if it is one in continuous
            time.
        band: frequencies (Hz) of records to use; None finds what the inputs excite. Not for fits by simulation.
        window: of records, fit by simulation in windows of this length (s), each from its own initial state; 0: whole
            records. None: lines of the spectrum for models without effects, else whole records, or, on a free axis, a
            tenth of its time constant. In windows, deviations are those of groups of windows, whatever their errors.
        initial: of records, "estimate" fits each initial state, "rest" takes it for zero, which asks for simulation.
        structure: "model" refines the numbers that the model has: of its elements, none negative, or the entries of its
            matrices that are not zero; "free" refines every entry of symmetric matrices. Matrices stay positive: M > 0,
            D >= 0, K >= 0.
        validate: fit first to a part of the data and predict the rest: the first three quarters of every record, three
            of four samples of a response.
        solver: least-squares solver of optimistix, such as `optimistix.LevenbergMarquardt(1e-9, 1e-9)`. None: this
            library's Levenberg and Marquardt, which comes to the same place in a third of the evaluations.
        starts: number of further sets of values to begin with, drawn evenly from within 30 % of the model's; the fit
            that explains the data best counts.
        seed: of these draws.
        profile: names of values whose profile likelihood is wanted, for intervals that hold also where errors are not
            small.
        progress: called with a line of text as each stage begins.

    Returns:
        Refinement.

    Raises:
        InputError: names, bounds, priors or data that cannot be used, a value that nothing in the data depends on.
        InsufficientDataError: the records cannot support an answer.

    Source: R. Pintelon and J. Schoukens, System Identification, 2nd ed., ch. 9; M. Friswell and J. Mottershead, Finite
    Element Model Updating in Structural Dynamics, 1995.
    """
    _check(model, data, initial, window, structure, starts)
    near = None
    if structure == "free":
        if is_concrete(model.mass) and not (model.effects or fixed or tied or bounds or priors):
            options = {"noise": noise, "dt": dt, "band": band, "window": window, "initial": initial}
            near = _nearby(model, data, solver=solver, progress=progress, **options)
        model = as_full(model)
    known = restricted(model, fixed=fixed, tied=tied, bounds=bounds, priors=priors)
    how = Manner(
        validate,
        progress or (lambda text: None),
        solver,
        tuple(unknown_number(known, text, "profile") for text in profile),
        _further(known, starts, seed, near),
    )
    if isinstance(data, ImpulseResponse):
        check_response(data, len(model.sensors), len(model.inputs))
        if not is_concrete(data.h):
            require(not (starts or profile), "a traced response is fitted once: no starts, no profile.")
            return refine_traced(model, known, data, noise, solver)
        return refine_response(model, known, data, noise, how)
    require(noise is None, "noise belongs to an impulse response; that of other data is estimated.")
    if isinstance(data, FrequencyResponse):
        return refine_frequencies(model, known, data, dt, how)
    records = (data,) if isinstance(data, Record) else tuple(data)
    if model.effects or window is not None or initial == "rest":
        require(band is None, "band is for fits to lines of the spectrum; this one is in time.")
        return refine_motion(model, known, records, window, initial, how)
    return refine_records(model, known, records, band, how)


def _check(
    model: LumpedModel,
    data: Record | Sequence[Record] | ImpulseResponse | FrequencyResponse,
    initial: str,
    window: float | None,
    structure: str,
    starts: int,
) -> None:
    require(
        isinstance(data, (Record, Sequence)) or not model.effects,
        f"{model.name}: it has effects, of which an impulse or frequency response cannot tell. Give records.",
    )
    require(initial in ("estimate", "rest"), f"initial '{initial}' is unknown; choose 'estimate' or 'rest'.")
    require(window is None or window >= 0, f"window must not be negative, it is {window} s.")
    require(structure in STRUCTURES, f"structure '{structure}' is unknown; choose 'model' or 'free'.")
    require(starts >= 0, f"starts must not be negative, it is {starts}.")


def _nearby(
    model: LumpedModel,
    data: Record | Sequence[Record] | ImpulseResponse | FrequencyResponse,
    **options: Any,
) -> LumpedModel | None:
    """The model with its own numbers refined: fewer unknowns find the way more surely. None where they do not."""
    if isinstance(data, ImpulseResponse) and not is_concrete(data.h):
        return None
    try:
        return refine(model, data, validate=False, **options).model
    except JaxsidError:  # a value that nothing depends on, say, which free matrices do not have
        return None


def _further(known: Restricted, count: int, seed: int, near: LumpedModel | None) -> Array | None:
    """Unknowns to begin with beside the usual ones: random ones and those of a model."""
    rows = list(scattered(known, count, seed)) if count else []
    if near is not None:
        linear = second_order(near)
        rows.append(np.asarray(known.unknowns.unknowns((linear.mass, linear.damping, linear.stiffness))))
    return as_array(np.stack(rows)) if rows else None
