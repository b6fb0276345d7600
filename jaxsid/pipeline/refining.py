"""What every refinement does, whatever the data: fit from several starts, covariance, validation, warnings."""

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsid.checks import bad_input, require
from jaxsid.mechanics.lumped import LumpedModel
from jaxsid.physical.bounded import BoundedFit, within_bounds
from jaxsid.physical.elements import (
    ElementValues,
    LinearMatrices,
    blind_elements,
    element_values,
    unit_diagonal,
    with_values,
)
from jaxsid.physical.parameterization import BLIND
from jaxsid.physical.posterior import Data, Solver, from_each, gradient_at, squares_at
from jaxsid.physical.profile import Profile, profile
from jaxsid.physical.restrictions import Restricted
from jaxsid.pipeline.matrices import GOOD, POOR
from jaxsid.pipeline.misses import input_warning
from jaxsid.records import as_array
from jaxsid.refinement import Refinement, Residuals, Validation

LOST = (
    "The fit ran away to where nothing in the data depends on {} any more: do not use these values. Start from better "
    "ones, set bounds, or ask for more `starts`."
)
BETTER = -1.0  # rise of a profile that shows a better optimum
FAINT = 0.01  # part of a combination, next to its largest, that is not named
Errors = Callable[[LumpedModel], np.ndarray]  # of the outputs, relative
Spread = Callable[[BoundedFit], np.ndarray]  # covariance of J'r, where it is not J'J


class Manner(NamedTuple):
    """How a refinement goes about it.

    Attributes:
        validate: whether a part of the data is kept from a first fit.
        say: called with a line of text as each stage begins.
        solver: of optimistix; None for this library's own.
        profiled: numbers of the unknowns whose profile likelihood is asked for.
        scattered: (starts, p) further unknowns to begin with, None for none.
    """

    validate: bool
    say: Callable[[str], None]
    solver: Solver | None = None
    profiled: tuple[int, ...] = ()
    scattered: Array | None = None


class Problem(NamedTuple):
    """What is fitted.

    Attributes:
        known: unknowns, bounds, priors.
        every: all of the data.
        train: the part for the fit before validation, None without.
        starts: unknowns to begin with, the most promising first.
        nuisances: number of unknowns, such as those of transients, that the terms project out.
        weighed: whether the level of the noise is known, so that a fit can be told to be good.
        solver, profiled, scattered: as in `Manner`.
        loss: by how much variances exceed those of weights that are known.
    """

    known: Restricted
    every: tuple[Data, ...]
    train: tuple[Data, ...] | None
    starts: tuple[Array, ...]
    nuisances: int = 0
    weighed: bool = True
    solver: Solver | None = None
    profiled: tuple[int, ...] = ()
    scattered: Array | None = None
    loss: float = 1.0


def solved(problem: Problem) -> tuple[BoundedFit, BoundedFit | None]:
    """Fits to all and to a part of the data, from the start that leads to the least misfit."""
    known, first = problem.known, problem.train or problem.every
    best, least, starts, asked = None, np.inf, problem.starts, 0
    if problem.scattered is not None and known.cone is not None:
        # from where each begins: its free mode may lie far from all positive matrices, and the way back leads elsewhere
        starts, asked = (*problem.scattered, *starts), len(problem.scattered)
    elif problem.scattered is not None:
        every = from_each(first, known.unknowns, known.prior, problem.scattered, problem.solver)
        squares = np.where(np.isfinite(every.squares), every.squares, np.inf)
        starts = (every.theta[int(squares.argmin())], *starts)
    for number, start in enumerate(starts, 1):
        if len(starts) > 1 and not np.isfinite(float(squares_at(first, known.unknowns, start))):
            continue
        fit = within_bounds(first, known, start, problem.solver)
        squares = float(fit.posterior.squares)
        if not np.isfinite(squares):
            continue
        if squares < least:
            best, least = fit, squares
        if problem.weighed and number >= asked and _good(least, float(fit.posterior.equations)):
            break
    if best is None:
        bad_input(
            "the model's numbers lead to a response that is not finite, so that no fit can start from them. Check that "
            "masses are positive and that springs and dampers are not negative."
        )
    _check_told(problem, best)
    if problem.train is None:
        return best, None
    return within_bounds(problem.every, known, best.posterior.theta, problem.solver), best


def _good(squares: float, equations: float) -> bool:
    """Whether a misfit leaves nothing to look for: a tenth above the noise, or what chance gives to few data."""
    return squares < min(GOOD, 1 + max(0.1, 3 * math.sqrt(2 / max(equations, 1.0)))) * equations


def _silent(known: Restricted, fit: BoundedFit) -> list[str]:
    """Unknowns on which nothing depends where the fit ended."""
    told = (np.diag(np.asarray(fit.posterior.information)) > 0) | (np.asarray(known.prior.weight) > 0)
    return [name for name, t, held in zip(known.names, told, fit.at_bound, strict=True) if not (t or held)]


def _check_told(problem: Problem, fit: BoundedFit) -> None:
    """Raise where nothing depends on an unknown anywhere; that a fit ran away to where nothing does is no such case."""
    known = problem.known
    silent = _silent(known, fit)
    if not silent:
        return
    slope = np.asarray(gradient_at(problem.every, known.unknowns, known.prior, problem.starts[-1]))
    silent = [name for name in silent if slope[known.names.index(name)] == 0]
    require(
        not silent,
        f"nothing in these data depends on {', '.join(silent)}. Fix it, give it a prior, or measure where it acts.",
    )


class _Uncertain(NamedTuple):
    """Of the unknowns: covariance, share of the data, misfit, information of data and prior."""

    covariance: np.ndarray
    share: np.ndarray
    misfit: float
    information: np.ndarray


def _uncertainty(problem: Problem, fit: BoundedFit, spread: Spread | None) -> _Uncertain:
    """The posterior's covariance near its mode; noise beyond what was assumed widens it."""
    p = fit.posterior
    free = problem.nuisances + int((np.diag(np.asarray(p.information)) > 0).sum())
    misfit = float(p.squares) / max(int(p.equations) - free, 1)
    told = np.asarray(p.information) / max(misfit, 1.0) / problem.loss
    precision = np.diag(np.where(fit.at_bound, 0.0, np.asarray(problem.known.prior.weight)) ** 2)
    both = told + precision
    inverse = _inverse(both)
    if spread is not None:
        inverse = inverse @ (spread(fit) + precision) @ inverse
    prior = np.diag(precision)
    share = np.where(prior > 0, 1 - np.diag(inverse) * prior, 1.0)
    return _Uncertain(inverse, np.where(fit.at_bound, np.nan, share), misfit, both)


def _inverse(information: np.ndarray) -> np.ndarray:
    """Inverse where there is one: combinations of which nothing is known are left out."""
    scaled, safe = unit_diagonal(information)
    values, vectors = np.linalg.eigh(scaled)
    seen = values > 1e-14 * values[-1]
    return (vectors[:, seen] / values[seen]) @ vectors[:, seen].T / safe / safe[:, None]


def _open(unknowns: LinearMatrices, information: np.ndarray, names: tuple[str, ...]) -> tuple[str, ...]:
    """Combinations of unknowns of which nothing is known, each as a sum of changes relative to their sizes."""
    free = (np.diag(information) > 0) & np.asarray(unknowns.mix).any(axis=0)
    if not free.any():
        return ()
    names = tuple(np.array(names)[free].tolist())
    scaled, root = unit_diagonal(information[np.ix_(free, free)])
    values, vectors = np.linalg.eigh(scaled)
    found = []
    for vector in vectors[:, values < BLIND * values[-1]].T:
        parts = vector / root
        parts = parts / parts[np.abs(parts).argmax()]
        kept = np.flatnonzero(np.abs(parts) > FAINT)
        found.append(" ".join(f"{parts[i]:+.2g} {names[i]}" for i in kept.tolist()))
    return tuple(found)


def concluded(
    problem: Problem,
    model: LumpedModel,
    fit: BoundedFit,
    spread: Spread | None,
    outputs: tuple[str, ...],
    errors: Errors,
    validation: Validation | None,
    residuals: Callable[[LumpedModel], Residuals] | None = None,
) -> Refinement:
    """Everything that is reported of a fit."""
    certain = _uncertainty(problem, fit, spread)
    unknowns, theta = fit.unknowns, fit.posterior.theta
    blind = blind_elements(unknowns, certain.information)
    values = element_values(unknowns, theta, certain.covariance, blind)
    mix = np.asarray(unknowns.mix) * np.asarray(unknowns.scale)
    covariance = mix @ certain.covariance @ mix.T
    covariance[blind], covariance[:, blind] = np.nan, np.nan
    owner = np.abs(mix).argmax(axis=1)
    share = np.where(mix.any(axis=1), certain.share[owner], np.nan)
    refined = with_values(model, values.values)
    held = tuple(n for n, at in zip(problem.known.names, fit.at_bound, strict=True) if at)
    held += tuple(f"{matrix} (positive only just)" for matrix in fit.singular)
    profiles = tuple(
        profile(problem.every, problem.known, fit, certain.covariance, certain.misfit, which)
        for which in problem.profiled
    )
    combinations = _open(unknowns, certain.information, problem.known.names)
    lost = _silent(problem.known, fit)
    return Refinement(
        nominal=model,
        model=refined,
        elements=values,
        covariance=as_array(covariance),
        data_share=as_array(share),
        misfit=as_array(np.asarray(certain.misfit)),
        outputs=outputs,
        before=as_array(errors(model)),
        after=as_array(errors(refined)),
        validation=validation,
        residuals=None if residuals is None else residuals(refined),
        profiles=profiles,
        at_bound=held,
        open_combinations=combinations,
        converged=fit.posterior.converged,
        warnings=(
            *((LOST.format(", ".join(lost)),) if lost else ()),
            *_warnings(certain.misfit, values, held, combinations, validation, bool(fit.posterior.converged)),
            *_about_profiles(profiles),
        ),
    )


def _warnings(
    misfit: float,
    values: ElementValues,
    held: tuple[str, ...],
    combinations: tuple[str, ...],
    validation: Validation | None,
    converged: bool,
) -> tuple[str, ...]:
    said = []
    if not converged:
        said.append("The fit had not settled when its steps were used up; these are its last good values.")
    if validation is not None and not validation.better:
        said.append(
            f"On data that were held out ({validation.data}) the refined model is no better than the one it started "
            "from: do not trust the change."
        )
    if misfit > POOR:
        said.append(
            f"The model leaves {misfit:.3g} times the noise: its structure, the places or gains of its sensors, or the "
            "hold of its inputs does not match the system."
        )
    if held:
        said.append(
            f"At a bound: {', '.join(held)}. Its standard deviation, and those of the others, ignore that."
        )
    if combinations:
        said.append(
            "Neither the data nor priors tell of these combinations of relative changes: "
            f"{'; '.join(combinations)}. Fix one of each, or give it a prior."
        )
    vague = [
        x.name
        for x, value, std, nominal in zip(
            values.listed, values.values, values.deviation, values.nominal, strict=True
        )
        if nominal != 0 and np.isfinite(std) and float(std) > abs(float(value)) > 0
    ]
    if vague:
        said.append(f"Hardly determined, with a standard deviation above the value: {', '.join(vague)}.")
    return tuple(said)


def _about_profiles(profiles: tuple[Profile, ...]) -> tuple[str, ...]:
    return tuple(
        f"With {p.name} at {float(p.values[p.rise.argmin()]):.5g} the others fit better than in the refined model: its "
        "fit ended in a lesser optimum. Start from a model with that value, or ask for more `starts`."
        for p in profiles
        if float(p.rise.min()) < BETTER
    )


def nominal_unknowns(known: Restricted) -> Array:
    return known.unknowns.of_values(jnp.asarray(known.unknowns.nominal))


def fitted_model(model: LumpedModel, fit: BoundedFit) -> LumpedModel:
    """The model with the values of a fit.

    Args:
        model: nominal.
        fit: its values.
    """
    return with_values(model, fit.unknowns.values(fit.posterior.theta))


def relative_error(left: np.ndarray, whole: np.ndarray) -> Float[np.ndarray, " outputs"]:
    """rms over time and inputs, relative to that of the data.

    Args:
        left: what is left, (samples, outputs, inputs).
        whole: the data.
    """
    size = np.sqrt((np.abs(whole) ** 2).mean(axis=(0, 2)))
    return np.sqrt((np.abs(left) ** 2).mean(axis=(0, 2))) / np.where(size > 0, size, 1.0)


def with_input_warning(found: Refinement) -> Refinement:
    """The same with a warning more where what is left of its record follows the inputs.

    Args:
        found: a refinement; without residuals it stays as it is.
    """
    if found.residuals is None:
        return found
    names = tuple(i.name for i in found.nominal.inputs)
    said = input_warning((found.residuals,), ("",), found.outputs, (names,), np.asarray(found.after))
    return dataclasses.replace(found, warnings=(*found.warnings, *said))
