"""What is known of the elements of a model beforehand: fixed values, ties, bounds, priors."""

import difflib
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsid.checks import bad_input, require
from jaxsid.mechanics.effects.catalogue import law_of
from jaxsid.mechanics.lumped import LumpedModel
from jaxsid.physical.elements import Element, LinearMatrices, element_matrices
from jaxsid.physical.interior import Cone, positive_cone
from jaxsid.physical.parameterization import Matrix

SMALLEST = 1e-9  # of a mass that the model has: it must stay positive
SCATTER = 0.3  # of the model's numbers: how far random starts lie from them
Pair = tuple[float, float]


class Prior(eqx.Module):
    """Independent normal distributions of unknowns before the data: (theta - mean) * weight has unit variance.

    Attributes:
        mean: (p,) in units of the unknowns' scale.
        weight: (p,) one over the standard deviation in these units, 0 where nothing is known.
    """

    mean: Matrix
    weight: Matrix

    def rows(self, theta: Array) -> tuple[Float[Array, " p"], Float[Array, "p p"]]:
        """Residual and Jacobian."""
        weight = jnp.asarray(self.weight)
        return weight * (theta - self.mean), jnp.diag(weight)


class Restricted(NamedTuple):
    """The unknowns that are left, and what is known of them.

    Attributes:
        unknowns: which values vary, and how.
        names: of each unknown.
        lower, upper: (p,) bounds, SI units.
        prior: of each unknown.
        cone: where mass, damping and stiffness are positive, if that is more than bounds.
    """

    unknowns: LinearMatrices
    names: tuple[str, ...]
    lower: Float[np.ndarray, " p"]
    upper: Float[np.ndarray, " p"]
    prior: Prior
    cone: Cone | None = None


def restricted(
    model: LumpedModel,
    *,
    fixed: Sequence[str] = (),
    tied: Sequence[Sequence[str]] = (),
    bounds: Mapping[str, Pair] | None = None,
    priors: Mapping[str, Pair] | None = None,
) -> Restricted:
    """The unknowns of a model with what is known of them.

    Names are "body.mass", "connection.damping", "connection.stiffness"; "*.mass" stands for all that match.

    Args:
        model: its elements, and the values that fixed ones keep.
        fixed: keep the model's values.
        tied: groups that keep the ratios that the model gives them.
        bounds: lowest and highest value, SI units; masses, springs and dampers of elements are not negative anyway.
        priors: mean and standard deviation, SI units.

    Raises:
        InputError: unknown names, contradictions, nothing left to refine.
    """
    every = element_matrices(model, effects=True)
    names = [x.name for x in every.listed]
    still = np.zeros(len(names), bool)
    for text in fixed:
        still[_matching(text, names, "fixed")] = True
    still |= ~np.asarray(every.mix).any(axis=1)
    groups = _groups(every, names, still, tied)
    require(bool(groups), f"{model.name}: every value is fixed, so that there is nothing to refine.")
    mix = np.zeros((len(names), len(groups)))
    for column, group in enumerate(groups):
        mix[group, column] = (
            np.asarray(every.nominal)[group] / every.nominal[group[0]] if len(group) > 1 else 1.0
        )
    leaders = np.array([group[0] for group in groups])
    lower, upper, mean, weight = _known(model, every, names, still, mix, bounds or {}, priors or {})
    scale = np.asarray(every.scale)[leaders]
    unknowns = eqx.tree_at(
        lambda x: (x.base, x.mix, x.scale),
        every,
        (np.where(still, np.asarray(every.nominal), 0.0), mix, scale),
    )
    labels = tuple(" = ".join(names[i] for i in group) for group in groups)
    # elements are positive each, so that their matrices are; entries may have either sign
    cone = positive_cone(unknowns) if model.matrices is not None else None
    return Restricted(unknowns, labels, lower, upper, Prior(mean / scale, weight * scale), cone)


def unknown_number(known: Restricted, text: str, where: str) -> int:
    """Which unknown a value follows.

    Args:
        known: the unknowns.
        text: name of the value.
        where: for the message.

    Raises:
        InputError: no such value, several, or one that is fixed.
    """
    names = [x.name for x in known.unknowns.listed]
    found = _matching(text, names, where)
    require(len(found) == 1, f"{where}: '{text}' stands for several values; name one.")
    columns = np.flatnonzero(np.asarray(known.unknowns.mix)[found[0]])
    require(columns.size == 1, f"{where}: '{text}' is fixed, or a connection without stiffness.")
    return int(columns[0])


def scattered(known: Restricted, count: int, seed: int) -> Float[np.ndarray, "count p"]:
    """Unknowns drawn evenly from within 30 % of the model's, and within their bounds.

    Args:
        known: the unknowns.
        count: how many sets.
        seed: of the random numbers.
    """
    scale = np.asarray(known.unknowns.scale)
    nominal = np.asarray(known.unknowns.of_values(jnp.asarray(known.unknowns.nominal)))
    size = np.where(nominal == 0, 1.0, np.abs(nominal))
    drawn = nominal + SCATTER * size * np.random.default_rng(seed).uniform(-1, 1, (count, len(nominal)))
    return np.clip(drawn, known.lower / scale, known.upper / scale)


def _matching(text: str, names: list[str], where: str) -> np.ndarray:
    found = [i for i, name in enumerate(names) if name == text] or [
        i for i, name in enumerate(names) if fnmatchcase(name, text)
    ]
    if not found:
        near = difflib.get_close_matches(text, names, 1)
        hint = f"did you mean '{near[0]}'?" if near else f"choose from {', '.join(names)}."
        bad_input(f"{where}: '{text}' is no value of the model; {hint}")
    return np.array(found)


def _groups(
    every: LinearMatrices, names: list[str], still: np.ndarray, tied: Sequence[Sequence[str]]
) -> list[np.ndarray]:
    """Indices of the elements of each unknown."""
    owner = np.full(len(names), -1)
    for number, members in enumerate(tied):
        which = np.unique(np.concatenate([_matching(text, names, "tied") for text in members]))
        said = ", ".join(names[i] for i in which)
        require(len(which) > 1, f"tied: '{said}' stands alone; name at least two.")
        quantities = {every.listed[i].quantity for i in which}
        require(len(quantities) == 1, f"tied: {said} are of different quantities.")
        require(not still[which].any(), f"tied: {said}: one of these is fixed. Fix all of them, or none.")
        require(bool((owner[which] < 0).all()), f"tied: one of {said} is in two groups; make them one.")
        zero = [names[i] for i in which if every.nominal[i] == 0]
        require(not zero, f"tied: {', '.join(zero)} is zero in the model, so that no ratio is known.")
        owner[which] = number
    free = [np.array([i]) for i in np.flatnonzero((owner < 0) & ~still)]
    groups = free + [np.flatnonzero(owner == number) for number in range(len(tied))]
    return sorted(groups, key=lambda group: int(group[0]))


def _known(
    model: LumpedModel,
    every: LinearMatrices,
    names: list[str],
    still: np.ndarray,
    mix: np.ndarray,
    bounds: Mapping[str, Pair],
    priors: Mapping[str, Pair],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Bounds, prior means and weights of the unknowns."""
    low, high = _natural_bounds(model, every)
    for text, pair in bounds.items():
        least, most = _pair(text, pair, "bounds")
        require(least < most, f"bounds: '{text}' lies between {least:g} and {most:g}: lowest first, please.")
        which = _matching(text, names, "bounds")
        _not_fixed(which, still, names, "bounds")
        low[which], high[which] = np.maximum(low[which], least), np.minimum(high[which], most)
    mean, weight = np.zeros(mix.shape[1]), np.zeros(mix.shape[1])
    for text, pair in priors.items():
        centre, spread = _pair(text, pair, "priors")
        require(
            spread > 0,
            f"priors: '{text}' has the standard deviation {spread:g}. It must be positive; a value that is certain "
            "belongs among `fixed`.",
        )
        which = _matching(text, names, "priors")
        _not_fixed(which, still, names, "priors")
        for i in which:  # of the unknown, precisions add
            column = int(np.flatnonzero(mix[i])[0])
            share, about = (mix[i, column] / spread) ** 2, centre / mix[i, column]
            mean[column] = (mean[column] * weight[column] + about * share) / (weight[column] + share)
            weight[column] += share
    lower, upper = np.full(mix.shape[1], -np.inf), np.full(mix.shape[1], np.inf)
    for i, column in np.argwhere(mix):
        ends = low[i] / mix[i, column], high[i] / mix[i, column]
        least, most = ends if mix[i, column] > 0 else ends[::-1]
        lower[column], upper[column] = max(lower[column], least), min(upper[column], most)
        require(
            bool(lower[column] < upper[column]),
            f"bounds: those of '{names[i]}' contradict each other or those of what it is tied to.",
        )
    return lower, upper, mean, np.sqrt(weight)


def _natural_bounds(model: LumpedModel, every: LinearMatrices) -> tuple[np.ndarray, np.ndarray]:
    """Masses are positive, springs and dampers of elements not negative, effects' parameters as their kinds say."""
    low = np.array([
        _lowest(model, x, float(size)) for x, size in zip(every.listed, every.nominal, strict=True)
    ])  # fmt: skip
    return low, np.full(len(low), np.inf)


def _lowest(model: LumpedModel, x: Element, size: float) -> float:
    if x.kind:
        name = x.quantity.partition("[")[0]
        return next(p.lowest for p in law_of(x.kind, [name]).parameters if p.name == name)
    if model.matrices is not None and not _diagonal(x):
        return -np.inf
    return SMALLEST * abs(size) if x.quantity == "mass" else 0.0


def _diagonal(x: Element) -> bool:
    return x.quantity == "mass" and ", " not in x.element


def _pair(text: str, pair: Pair, where: str) -> Pair:
    good = len(pair) == 2 and not any(np.isnan(x) for x in pair)
    require(good, f"{where}: '{text}' needs two numbers, not {pair}.")
    return float(pair[0]), float(pair[1])


def _not_fixed(which: np.ndarray, still: np.ndarray, names: list[str], where: str) -> None:
    both = [names[i] for i in which if still[i]]
    require(not both, f"{where}: '{', '.join(both)}' is fixed, or a connection without stiffness.")
