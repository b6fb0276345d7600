"""State-space model to mass, damping and stiffness: CBSI, then the fit to the lines."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array

from jaxsid.checks import JaxsidError
from jaxsid.mechanics.lumped import LumpedModel, second_order
from jaxsid.physical.cbsi import cbsi
from jaxsid.physical.elements import ElementValues, element_matrices
from jaxsid.physical.inband_fit import MatrixFit, Target, fit_matrices, fit_target
from jaxsid.physical.parameterization import PositiveMatrices, SymmetricMatrices, Triple, entry_sizes
from jaxsid.physical.widened import widened_start
from jaxsid.pipeline.setting import Setting
from jaxsid.pipeline.state_space import StateSpace
from jaxsid.pipeline.structure import (
    ElementFit,
    as_good,
    fit_elements,
    fitted_values,
    uncontradicted,
    undetermined,
)
from jaxsid.records import CbsiDiagnostics, SecondOrderModel, as_array

GOOD = 1.5  # mean square residual, in units of the noise, that leaves nothing to look for
AT_THE_EDGE = (
    "The damping or stiffness that fits best is not that of a passive system: it was held at the edge of what is "
    "possible, and the standard deviations do not cover that. Look for a sensor or input whose gain, sign, delay or "
    "place is wrong, or for dynamics that the bodies do not have."
)
POOR = 3.0  # one that the user must hear of
UNREFINED = (
    "Nothing was refined, as asked for: no mass, damping and stiffness were fitted to the records, and matrices have "
    "no standard deviations."
)
BY_CBSI = (
    "Mass, damping and stiffness are those of CBSI alone, as they come: less exact than those of a fit, and symmetric "
    "only as far as noise lets them; the model file holds their symmetric parts. Modes are of the state-space model."
)
NO_STRUCTURE = "Only the fit that was left out could make up for missing sensors, by the model's structure."


class Found(NamedTuple):
    """Matrices by CBSI and by the fit, values of the model's elements if these fit, None where impossible, and why."""

    cbsi: SecondOrderModel | None
    fit: MatrixFit | None
    model: SecondOrderModel | None
    elements: ElementValues | None
    warnings: tuple[str, ...]


def explained(found: Found) -> bool:
    """Whether fitted matrices say all that the state-space model says.

    Args:
        found: matrices.
    """
    return found.fit is not None and float(found.fit.misfit) < POOR


def find_matrices(
    model: LumpedModel, system: Setting, space: StateSpace, structure: str, *, refine: bool = True
) -> Found:
    """Mass, damping and stiffness: free symmetric matrices, or the values of the model's elements.

    Args:
        model: nominal; where CBSI fails its numbers are one place to start from.
        system: sensors and places.
        space: the state-space model.
        structure: "free" for symmetric matrices, "model" for its elements, "auto" for these if they fit as well.
        refine: fit to the lines; otherwise CBSI has the last word.
    """
    sensed = sensed_rows(model, system)
    if not refine:
        return _cbsi_alone(model, system, space, sensed)
    target = fit_target(space.lines, space.polished.noise, space.polished.realization, space.model)
    if system.one_a_body is None:
        return _by_elements_alone(model, system, space, target, sensed, structure)
    structured, trouble = _cbsi(system, space)
    elements, free = _elements_and_free(model, system, space, target, sensed, structured, structure)
    if elements is not None:
        # a free fit was made because the elements were doubted: asked for, they are given, but not in silence
        doubted = free is not None and not as_good(elements.fit, free)
        forced = (_forced(elements.fit, free),) if doubted and free is not None else ()
        notes = (*trouble, *_notes(elements.fit, structured), *forced)
        return _found(sensed, structured, elements.fit, fitted_values(elements), notes)
    contradicted = () if structure == "free" or free is None else (_contradicted(free),)
    fit, held = _positive_fit(system, space, target, sensed, free)
    notes = (*trouble, *_notes(fit, structured), *contradicted, *((AT_THE_EDGE,) if held else ()))
    return _found(sensed, structured, fit, None, notes)


def _elements_and_free(
    model: LumpedModel,
    system: Setting,
    space: StateSpace,
    target: Target,
    sensed: SecondOrderModel,
    structured: SecondOrderModel | None,
    structure: str,
) -> tuple[ElementFit | None, MatrixFit | None]:
    """The fit of the elements, unless the lines contradict it, and that of free matrices where it was needed."""
    nominal: Triple = (sensed.mass, sensed.damping, sensed.stiffness)
    if structure != "free":
        start = nominal if structured is None else (structured.mass, structured.damping, structured.stiffness)
        elements = _if_positive(fit_elements(model, target, start, sensed))
        if elements is not None and float(elements.fit.misfit) < GOOD and uncontradicted(elements.fit):
            return elements, None
    free = _free_fit(system, space, target, sensed, structured)
    if structure == "free":
        return None, free
    start = nominal if free is None else free.matrices
    elements = _if_positive(fit_elements(model, target, start, sensed))
    wanted = structure == "model" or free is None or (elements is not None and as_good(elements.fit, free))
    return (elements if wanted else None), free


def _if_positive(elements: ElementFit | None) -> ElementFit | None:
    return elements if elements is not None and _positive(elements.fit.matrices) else None


def _found(
    sensed: SecondOrderModel,
    structured: SecondOrderModel | None,
    fit: MatrixFit | None,
    elements: ElementValues | None,
    notes: tuple[str, ...],
) -> Found:
    if fit is None:
        return Found(structured, None, None, None, notes)
    diagnostics = None if structured is None else structured.diagnostics
    return Found(structured, fit, with_matrices(sensed, fit.matrices, diagnostics), elements, notes)


def with_matrices(
    sensed: SecondOrderModel, matrices: Triple, diagnostics: CbsiDiagnostics | None = None
) -> SecondOrderModel:
    """The same inputs and sensors with other M, D, K.

    Args:
        sensed: gives the input matrix and the sensors.
        matrices: M, D, K.
        diagnostics: what CBSI noticed.
    """
    mass, damping, stiffness = matrices
    return SecondOrderModel(
        mass,
        damping,
        stiffness,
        sensed.input_matrix,
        sensed.displacement_sensors,
        sensed.velocity_sensors,
        sensed.acceleration_sensors,
        diagnostics,
    )


def _cbsi_alone(model: LumpedModel, system: Setting, space: StateSpace, sensed: SecondOrderModel) -> Found:
    """What there is without any fit: CBSI's matrices as they come, or none."""
    if system.one_a_body is None:
        return Found(None, None, None, None, (_too_few(model, system), NO_STRUCTURE, UNREFINED))
    structured, trouble = _cbsi(system, space)
    if structured is None:
        return Found(None, None, None, None, (*trouble, UNREFINED))
    matrices = structured.mass, structured.damping, structured.stiffness
    found = with_matrices(sensed, matrices, structured.diagnostics)
    return Found(structured, None, found, None, (*_negative_scales(structured), UNREFINED, BY_CBSI))


def _by_elements_alone(
    model: LumpedModel,
    system: Setting,
    space: StateSpace,
    target: Target,
    sensed: SecondOrderModel,
    structure: str,
) -> Found:
    """Where bodies have no sensor only the model's structure can tell their part."""
    nothing = Found(None, None, None, None, (_too_few(model, system),))
    if structure == "free":
        return nothing
    highest = 2 * np.pi * float(np.asarray(space.lines.band)[1])
    start = widened_start(element_matrices(model), space.model, sensed, highest)
    elements = fit_elements(model, target, start, sensed)
    if elements is None or not _positive(elements.fit.matrices) or float(elements.fit.misfit) > POOR:
        return nothing
    if (blind := undetermined(elements)).any():
        names = ", ".join(x.name for x, lost in zip(elements.unknowns.listed, blind, strict=True) if lost)
        return nothing._replace(
            warnings=(*nothing.warnings, f"Not even with the model's structure: {names}.")
        )
    bare = ", ".join(b for i, b in enumerate(model.bodies) if i not in system.places)
    note = f"No sensor on {bare}: mass, damping and stiffness there follow from the model's structure."
    return _found(sensed, None, elements.fit, fitted_values(elements), (note, *_notes(elements.fit, None)))


def _forced(elements: MatrixFit, free: MatrixFit) -> str:
    return (
        "The records contradict the structure of the model, which was asked for: its elements leave "
        f"{float(elements.misfit):.4g} times the noise, free symmetric matrices {float(free.misfit):.4g}. The standard "
        "deviations do not cover that."
    )


def _contradicted(free: MatrixFit) -> str:
    return (
        "The records contradict the structure of the model: no values of its own elements fit them as well as free "
        f"symmetric matrices do (misfit {float(free.misfit):.3g}). These are given; their entries that the model does "
        "not have tell what it lacks."
    )


def _too_few(model: LumpedModel, system: Setting) -> str:
    bare = [b for i, b in enumerate(model.bodies) if i not in system.places]
    blind = not set(system.collocated) & set(system.places)
    return (
        f"No sensor on {', '.join(bare)}: with fewer sensed bodies than bodies the mass, damping and stiffness "
        "matrices are not determined. Poles, damping ratios, shapes at the sensors and the state-space model are."
        + (" No input acts on a sensed body either, so that shapes have no mass scale." if blind else "")
    )


def sensed_rows(model: LumpedModel, system: Setting) -> SecondOrderModel:
    """The nominal model with the rows of the measured sensors only.

    Args:
        model: nominal.
        system: which sensors were measured.
    """
    whole = second_order(model)
    rows = np.array([[s.name for s in model.sensors].index(n) for n in system.outputs])
    return SecondOrderModel(
        whole.mass,
        whole.damping,
        whole.stiffness,
        whole.input_matrix,
        _rows(whole.displacement_sensors, rows),
        _rows(whole.velocity_sensors, rows),
        _rows(whole.acceleration_sensors, rows),
        None,
    )


def _rows(x: Array, rows: np.ndarray) -> Array:
    return as_array(np.asarray(x)[rows])


def _cbsi(system: Setting, space: StateSpace) -> tuple[SecondOrderModel | None, tuple[str, ...]]:
    assert system.one_a_body is not None
    chosen = np.array(system.one_a_body)
    model = space.model
    seen = type(model)(model.A, model.B, _rows(model.C, chosen), _rows(model.D, chosen))
    rigid = system.rigid if system.rigid.shape[1] else None
    loose = system.loose if system.loose.shape[1] else None
    kinds = tuple(system.kinds[i] for i in chosen)
    try:
        found = cbsi(seen, sensors=kinds, collocated=system.collocated, rigid=rigid, loose=loose)
    except JaxsidError as trouble:
        return None, (f"CBSI was left out: {trouble}",)
    if not all(np.isfinite(x).all() for x in (found.mass, found.damping, found.stiffness)):
        return None, ("CBSI found no scale for a mode that the inputs hardly drive.",)
    return found, ()


def _free_fit(
    system: Setting,
    space: StateSpace,
    target: Target,
    sensed: SecondOrderModel,
    structured: SecondOrderModel | None,
) -> MatrixFit | None:
    """The fit of symmetric matrices with the smallest misfit over the starts, tried in turn until one is good."""
    complements, best = _complements(system), None
    for start in _starts(space, sensed, structured):
        parameters = SymmetricMatrices(entry_sizes(start, complements, _rate(space)), complements)
        fit = fit_matrices(target, parameters, start, sensed)
        if np.isfinite(fit.misfit) and (best is None or fit.misfit < best.misfit):
            best = fit
        if best is not None and float(best.misfit) < GOOD:
            break
    return best


def _positive_fit(
    system: Setting, space: StateSpace, target: Target, sensed: SecondOrderModel, free: MatrixFit | None
) -> tuple[MatrixFit | None, bool]:
    """The free fit if its matrices are positive, else the best positive one near it; whether the edge held it."""
    if free is None or _positive(free.matrices):
        return free, False
    mass, damping, stiffness = (np.asarray(x) for x in free.matrices)
    complements = _complements(system)
    sizes = entry_sizes((mass, damping, stiffness), complements, _rate(space))
    best = fit_matrices(target, PositiveMatrices(sizes, complements), free.matrices, sensed)
    if not (np.isfinite(best.misfit) and _positive(best.matrices)):
        return None, False
    return best, float(best.misfit) > GOOD  # below that noise explains it


def _complements(system: Setting) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coordinates that M, D and K act on."""
    return np.eye(len(system.rigid)), _complement(system.loose), _complement(system.rigid)


def _complement(patterns: np.ndarray) -> np.ndarray:
    """Orthonormal coordinates in which the patterns are zero; the bodies themselves where there are none."""
    if patterns.shape[1] == 0:
        return np.eye(len(patterns))
    return np.linalg.svd(patterns)[0][:, patterns.shape[1] :]


def _rate(space: StateSpace) -> float:
    sizes = np.abs(np.linalg.eigvals(np.asarray(space.model.A)))
    return float(np.median(sizes[sizes > 1e-3 * sizes.max()]))


def _starts(space: StateSpace, sensed: SecondOrderModel, structured: SecondOrderModel | None) -> list[tuple]:
    """CBSI as it is, CBSI with the damping ratios of the poles alone, and the nominal numbers."""
    starts = []
    if structured is not None:
        mass, damping, stiffness = (
            np.asarray(x) for x in (structured.mass, structured.damping, structured.stiffness)
        )
        mass, damping, stiffness = _lifted(mass, 1e-3), _lifted(damping, 0.0), _lifted(stiffness, 0.0)
        starts += [(mass, damping, stiffness), (mass, _proportional(mass, stiffness, space), stiffness)]
    starts.append(tuple(np.asarray(x) for x in (sensed.mass, sensed.damping, sensed.stiffness)))
    return starts


def _lifted(matrix: np.ndarray, floor: float) -> np.ndarray:
    """Symmetric part with eigenvalues not below floor * the largest."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    return (vectors * np.maximum(values, floor * np.abs(values).max())) @ vectors.T


def _proportional(mass: np.ndarray, stiffness: np.ndarray, space: StateSpace) -> np.ndarray:
    """Damping with the median damping ratio of the oscillating poles in every mode of M and K."""
    poles = np.linalg.eigvals(np.asarray(space.model.A))
    swinging = poles[np.abs(poles.imag) > 1e-6 * np.abs(poles)]
    ratio = np.clip(np.median(-swinging.real / np.abs(swinging)), 1e-3, 0.5) if len(swinging) else 0.1
    lower = np.linalg.cholesky(mass)
    inner = np.linalg.solve(lower, np.linalg.solve(lower, stiffness).T)
    values, vectors = np.linalg.eigh(0.5 * (inner + inner.T))
    root = lower @ vectors
    return (root * (2 * ratio * np.sqrt(np.maximum(values, 0.0)))) @ root.T


def _positive(matrices: Triple) -> bool:
    """Mass positive; damping and stiffness not negative beyond rounding, so that a model file can hold them."""
    mass, damping, stiffness = (np.linalg.eigvalsh(np.asarray(x)) for x in matrices)
    return bool(mass[0] > 0 and all(x[0] >= -1e-9 * abs(x[-1]) for x in (damping, stiffness)))


def _vague(fit: MatrixFit) -> list[str]:
    """Matrices whose standard deviation is larger than they are, or is no number."""
    names = ("mass", "damping", "stiffness")
    sizes = [
        (float(np.linalg.norm(d)), float(np.linalg.norm(x)))
        for d, x in zip(fit.deviation, fit.matrices, strict=True)
    ]
    return [name for name, (spread, size) in zip(names, sizes, strict=True) if not spread < size]


def _negative_scales(structured: SecondOrderModel | None) -> tuple[str, ...]:
    diagnostics = None if structured is None else structured.diagnostics
    if diagnostics is None or int(diagnostics.negative_scales) == 0:
        return ()
    return (
        f"CBSI met {int(diagnostics.negative_scales)} mode(s) with a negative scale: shape and driving point "
        "contradict each other. Check polarity, place and gain of sensors and inputs.",
    )


def _notes(fit: MatrixFit | None, structured: SecondOrderModel | None) -> tuple[str, ...]:
    notes = list(_negative_scales(structured))
    if fit is not None and (vague := _vague(fit)):
        notes.append(
            f"The records hardly determine the {' and '.join(vague)}: standard deviations exceed the values. Excite a "
            "wider band that covers all modes, or record longer."
        )
    if fit is None:
        notes.append("No symmetric positive mass, damping and stiffness could be fitted to the records.")
    elif float(fit.misfit) > POOR:
        notes.append(
            f"Mass, damping and stiffness leave {float(fit.misfit):.3g} times the residual of the state-space model: "
            "the structure (bodies, places, kinds or gains of sensors) or the hold of the inputs ('band' for forces "
            "that were measured while they varied, not set step by step) does not match the system in this band."
        )
    return tuple(notes)
