"""State-space model to mass, damping and stiffness: CBSI, then the fit to the lines."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array

from jaxsid.checks import JaxsidError
from jaxsid.mechanics.lumped import LumpedModel, second_order
from jaxsid.physical.cbsi import cbsi
from jaxsid.physical.inband_fit import MatrixFit, fit_matrices, fit_target
from jaxsid.physical.parameterization import PositiveMatrices, SymmetricMatrices, Triple, entry_sizes
from jaxsid.pipeline.setting import Setting
from jaxsid.pipeline.state_space import StateSpace
from jaxsid.records import SecondOrderModel, as_array

GOOD = 1.5  # mean square residual, in units of the noise, that leaves nothing to look for
AT_THE_EDGE = (
    "The damping or stiffness that fits best is not that of a passive system: it was held at the edge of what is "
    "possible, and the standard deviations do not cover that. Look for a sensor or input whose gain, sign, delay or "
    "place is wrong, or for dynamics that the bodies do not have."
)
POOR = 3.0  # one that the user must hear of


class Found(NamedTuple):
    """Mass, damping and stiffness by CBSI and by the fit, None where impossible, and why."""

    cbsi: SecondOrderModel | None
    fit: MatrixFit | None
    model: SecondOrderModel | None
    warnings: tuple[str, ...]


def find_matrices(model: LumpedModel, system: Setting, space: StateSpace) -> Found:
    """Mass, damping and stiffness, where every body has a sensor.

    Args:
        model: nominal; where CBSI fails its numbers are one place to start from.
        system: sensors and places.
        space: the state-space model.
    """
    sensed = _sensed(model, system)
    if system.one_a_body is None:
        return Found(None, None, None, (_too_few(model, system),))
    structured, trouble = _cbsi(system, space)
    fit, held = _best_fit(model, system, space, sensed, structured)
    notes = (*trouble, *_notes(fit, structured), *((AT_THE_EDGE,) if held else ()))
    if fit is None:
        return Found(structured, None, None, notes)
    matrices = dict(zip(("mass", "damping", "stiffness"), fit.matrices, strict=True))
    found = SecondOrderModel(
        **matrices,
        input_matrix=sensed.input_matrix,
        displacement_sensors=sensed.displacement_sensors,
        velocity_sensors=sensed.velocity_sensors,
        acceleration_sensors=sensed.acceleration_sensors,
        diagnostics=None if structured is None else structured.diagnostics,
    )
    return Found(structured, fit, found, notes)


def _too_few(model: LumpedModel, system: Setting) -> str:
    bare = [b for i, b in enumerate(model.bodies) if i not in system.places]
    blind = not set(system.collocated) & set(system.places)
    return (
        f"No sensor on {', '.join(bare)}: with fewer sensed bodies than bodies the mass, damping and stiffness "
        "matrices are not determined. Poles, damping ratios, shapes at the sensors and the state-space model are."
        + (" No input acts on a sensed body either, so that shapes have no mass scale." if blind else "")
    )


def _sensed(model: LumpedModel, system: Setting) -> SecondOrderModel:
    """The nominal model with the rows of the measured sensors only."""
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
        return None, (
            "CBSI found no scale for a mode that the inputs hardly drive; the fit to the lines goes on.",
        )
    return found, ()


def _best_fit(
    model: LumpedModel,
    system: Setting,
    space: StateSpace,
    sensed: SecondOrderModel,
    structured: SecondOrderModel | None,
) -> tuple[MatrixFit | None, bool]:
    """The fit with the smallest misfit over the starts, tried in turn until one is good; whether the edge held it.

    From there it goes on among positive matrices where it left them.
    """
    target = fit_target(space.lines, space.polished.noise, space.polished.realization, space.model)
    every, moving, strained = np.eye(len(model.bodies)), _complement(system.loose), _complement(system.rigid)
    complements = every, moving, strained
    best = None
    for start in _starts(space, sensed, structured):
        parameters = SymmetricMatrices(entry_sizes(start, complements, _rate(space)), complements)
        fit = fit_matrices(target, parameters, start, sensed)
        if np.isfinite(fit.misfit) and (best is None or fit.misfit < best.misfit):
            best = fit
        if best is not None and float(best.misfit) < GOOD:
            break
    if best is None or _positive(best.matrices):
        return best, False
    mass, damping, stiffness = (np.asarray(x) for x in best.matrices)
    sizes = entry_sizes((mass, damping, stiffness), complements, _rate(space))
    parameters = PositiveMatrices(sizes, complements)
    best = fit_matrices(target, parameters, best.matrices, sensed)
    if not (np.isfinite(best.misfit) and _positive(best.matrices)):
        return None, False
    return best, float(best.misfit) > GOOD  # below that noise explains it


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


def _notes(fit: MatrixFit | None, structured: SecondOrderModel | None) -> tuple[str, ...]:
    notes = []
    if (
        structured is not None
        and structured.diagnostics is not None
        and int(structured.diagnostics.negative_scales) > 0
    ):
        notes.append(
            f"CBSI met {int(structured.diagnostics.negative_scales)} mode(s) with a negative scale: shape and driving "
            "point contradict each other. Check polarity, place and gain of sensors and inputs."
        )
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
