"""Unknowns in proportion to which mass, damping and stiffness change: masses, springs and dampers of a model."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsid.mechanics.lumped import (
    GROUND,
    Effect,
    LumpedModel,
    Matrices,
    incidence,
    lumped_model,
    second_order,
)
from jaxsid.physical.parameterization import BLIND, Matrix, Slopes, Triple
from jaxsid.records import as_array

QUANTITIES = ("mass", "damping", "stiffness")
TRACE = 1e-4  # part of an unknown in such combinations from which on it is not determined
ROUNDING = 1e-9  # sum of a row, next to its entries, that is none


class Element(NamedTuple):
    """One number of a lumped model, such as the "stiffness" of "gearbox"; for matrices, of "b1, b2" or "ground, b1".

    That of an effect is one such as the "force" of "coulomb_friction(ground, motor)", of this `kind`.
    """

    element: str
    quantity: str
    kind: str = ""

    @property
    def name(self) -> str:
        return f"{self.element}.{self.quantity}"


class ElementValues(eqx.Module):
    """Numbers of a lumped model, as identified.

    Attributes:
        listed: which ones.
        values: (p,) SI units.
        deviation: (p,) standard deviations; infinite where the records do not tell, 0 where a bound held the value.
        correlation: (p, p) of their errors; NaN where there is no deviation.
        nominal: (p,) of the model that the user gave.
    """

    listed: tuple[Element, ...] = eqx.field(static=True)
    values: Float[Array, " p"]
    deviation: Float[Array, " p"]
    correlation: Float[Array, "p p"]
    nominal: Float[Array, " p"]


class LinearMatrices(eqx.Module):
    """M, D and K as sums of the values of elements times fixed symmetric matrices.

    The values follow from fewer unknowns: values = base + mix (theta * scale), so that some may be held, others tied.

    Attributes:
        directions: (e, N, N) of M, of D and of K: what one unit of each value adds.
        inverse: (e, 3 N N) values of least squares from the entries of M, D, K.
        base: (e,) what does not vary.
        mix: (e, p) how much of each unknown goes into each value.
        scale: (p,) size of each unknown, so that theta is of order one.
        nominal: (e,) values of the model.
        listed: what each value is.
    """

    directions: tuple[Matrix, Matrix, Matrix]
    inverse: Matrix
    base: Matrix
    mix: Matrix
    scale: Matrix
    nominal: Matrix
    listed: tuple[Element, ...] = eqx.field(static=True)

    def matrices(self, theta: Array) -> Triple:
        """M, D, K."""
        values = self.values(theta)
        M, D, K = (jnp.einsum("e,eij->ij", values, jnp.asarray(x)) for x in self.directions)
        return M, D, K

    @property
    def slopes(self) -> Slopes:
        """(p, N, N) changes of M, D, K with each unknown."""
        mix = jnp.asarray(self.mix) * self.scale
        M, D, K = (jnp.einsum("ep,eij->pij", mix, jnp.asarray(x)) for x in self.directions)
        return M, D, K

    def values(self, theta: Array) -> Float[Array, " e"]:
        """Of all elements, SI units."""
        return jnp.asarray(self.base) + self.mix @ (theta * self.scale)

    def unknowns(self, matrices: Triple) -> Array:
        """Those of least squares."""
        entries = jnp.concatenate([jnp.asarray(x).ravel() for x in matrices])
        return self.of_values(jnp.asarray(self.inverse) @ entries)

    def of_values(self, values: Float[Array, " e"]) -> Array:
        """Unknowns of values, of least squares where these contradict what is held or tied."""
        mix = jnp.asarray(self.mix)
        square = (mix**2).sum(axis=0)  # no two unknowns share an element
        return (values - self.base) @ mix / jnp.where(square > 0, square, 1.0) / self.scale

    def held(self, which: np.ndarray, values: np.ndarray) -> "LinearMatrices":
        """The same with some unknowns, (p,) of bool, held at values (p,) from now on.

        Args:
            which: the unknowns.
            values: SI units; those of other unknowns are not used.
        """
        base = np.asarray(self.base) + np.asarray(self.mix) @ np.where(which, values, 0.0)
        return eqx.tree_at(
            lambda x: (x.base, x.mix), self, (base, np.where(which, 0.0, np.asarray(self.mix)))
        )


def element_matrices(model: LumpedModel, *, effects: bool = False) -> LinearMatrices:
    """The unknowns that a model has: masses, dampings, stiffnesses of its elements, in this order.

    A spring may damp, also where the model gives it none; a connection without stiffness stays so, since what no
    spring holds is a matter of structure. Matrices are taken apart into masses, and springs and dampers between bodies
    and to the ground: those that their entries show, or all, if the matrices are full, but to the ground where nothing
    holds any body there.

    Args:
        model: says which there are; its numbers give their sizes.
        effects: whether the parameters of effects, as far as the model gives them, are unknowns too, after the others.
    """
    shapes, names, values = _entries(model) if model.matrices is not None else _elements(model)
    full = model.matrices is not None and model.matrices.full
    counts = np.cumsum([0, *(len(x) for x in shapes)])
    directions = [
        np.pad(x, ((counts[i], counts[3] - counts[i + 1]), (0, 0), (0, 0))) for i, x in enumerate(shapes)
    ]
    whole = np.concatenate([x.reshape(counts[3], -1) for x in directions], axis=1)
    linear = LinearMatrices(
        (directions[0], directions[1], directions[2]),
        inverse=np.linalg.pinv(whole.T),
        base=np.zeros(counts[3]),
        mix=np.diag(np.concatenate([np.ones(counts[2]), 1.0 * ((values[2] != 0) | full)])),
        scale=np.concatenate([_sizes(x) for x in values]),
        nominal=np.concatenate(values),
        listed=tuple(Element(e, q) for q, elements in zip(QUANTITIES, names, strict=True) for e in elements),
    )
    return _with_effects(linear, model) if effects and model.effects else linear


def _with_effects(linear: LinearMatrices, model: LumpedModel) -> LinearMatrices:
    """Unknowns of which M, D, K do not depend, after the others."""
    values = np.concatenate(
        [np.ravel(np.asarray(e.parameters[k])) for e in model.effects for k in e.parameters]
    )
    more = len(values)
    directions = [np.pad(x, ((0, more), (0, 0), (0, 0))) for x in linear.directions]
    return LinearMatrices(
        (directions[0], directions[1], directions[2]),
        inverse=np.pad(linear.inverse, ((0, more), (0, 0))),
        base=np.pad(linear.base, (0, more)),
        mix=np.pad(linear.mix, ((0, more), (0, more)))
        + np.diag(np.pad(np.ones(more), (len(linear.listed), 0))),
        scale=np.concatenate([linear.scale, np.where(values == 0, 1.0, np.abs(values))]),
        nominal=np.concatenate([linear.nominal, values]),
        listed=linear.listed + effect_numbers(model),
    )


def effect_numbers(model: LumpedModel) -> tuple[Element, ...]:
    """The parameters of a model's effects that it gives, in order; those with one a record as "phase[0]", ...

    Args:
        model: with effects.
    """
    labels = [_label(effect) for effect in model.effects]
    found = []
    for number, (effect, label) in enumerate(zip(model.effects, labels, strict=True)):
        before = labels[:number].count(label)
        unique = label if before == 0 else f"{label} #{before + 1}"
        for name, value in effect.parameters.items():
            of = [name] if np.ndim(value) == 0 else [f"{name}[{i}]" for i in range(len(value))]
            found += [Element(unique, x, effect.kind) for x in of]
    return tuple(found)


def _label(effect: Effect) -> str:
    ((_, place),) = effect.place
    return f"{effect.kind}({place if isinstance(place, str) else ', '.join(place)})"


def _effects_with(model: LumpedModel, values: Float[Array, " p"]) -> list[Effect]:
    """Effects with other parameters, in the order of `effect_numbers`."""
    found, at = [], 0
    for effect in model.effects:
        parameters = {}
        for name, old in effect.parameters.items():
            size = np.size(np.asarray(old))
            parameters[name] = values[at : at + size].reshape(np.shape(old))
            at += size
        found.append(Effect(effect.kind, effect.place, parameters))
    return found


def unit_diagonal(information: Float[np.ndarray, "p p"]) -> tuple[np.ndarray, np.ndarray]:
    """Information in units in which its diagonal is one, and these, (p,), 1 where there is none.

    Args:
        information: J'J.
    """
    root = np.sqrt(np.diag(information))
    safe = np.where(root > 0, root, 1.0)
    return information / safe / safe[:, None], safe


def blind_elements(unknowns: LinearMatrices, information: Float[np.ndarray, "p p"]) -> np.ndarray:
    """(e,) which elements are part of a combination of unknowns of which nothing is known.

    Args:
        unknowns: those of the fit.
        information: inverse of their covariance, singular where nothing is known.
    """
    scaled, _ = unit_diagonal(information)
    values, vectors = np.linalg.eigh(scaled)
    lost = np.linalg.norm(vectors[:, values < BLIND * values[-1]], axis=1)
    return (np.asarray(unknowns.mix) != 0) @ ((lost > TRACE) | (np.diag(information) == 0))


def element_values(
    unknowns: LinearMatrices, theta: Array, covariance: Float[np.ndarray, "p p"], blind: np.ndarray
) -> ElementValues:
    """Values, standard deviations and correlation of the elements.

    Args:
        unknowns: those of the fit.
        theta: found.
        covariance: of theta.
        blind: (e,) elements that are not determined.
    """
    mix = np.asarray(unknowns.mix) * np.asarray(unknowns.scale)
    moved = mix @ covariance @ mix.T
    spread = np.sqrt(np.maximum(np.diag(moved), 0.0))
    safe = np.where(~blind & (spread > 0), spread, np.nan)
    return ElementValues(
        unknowns.listed,
        values=as_array(np.asarray(unknowns.values(theta))),
        deviation=as_array(np.where(blind, np.inf, spread)),
        correlation=as_array(moved / safe / safe[:, None]),
        nominal=as_array(np.asarray(unknowns.nominal)),
    )


Parts = tuple[list[np.ndarray], list[list[str]], list[np.ndarray]]


def _elements(model: LumpedModel) -> Parts:
    """For M, D and K what each unknown adds, (count, N, N), their names, their nominal values."""
    bodies, joints = np.eye(len(model.bodies)), incidence(model).T
    shapes = [np.einsum("pi,pj->pij", x, x) for x in (bodies, joints, joints)]
    connections = [c.name for c in model.connections]
    values = [np.asarray(getattr(model, quantity)) for quantity in QUANTITIES]
    return shapes, [list(model.bodies), connections, connections], values


def _entries(model: LumpedModel) -> Parts:
    """Springs and dampers that matrices are made of: between two bodies where their entry is not zero, to the ground
    where the sum of a row is not zero; masses and what couples them."""
    names = [GROUND, *model.bodies]
    mass, damping, stiffness = (np.asarray(getattr(model.matrices, quantity)) for quantity in QUANTITIES)
    springs, heavy = _joined(stiffness), mass != 0
    if model.matrices is not None and model.matrices.full:
        # where nothing is held to the ground that is a matter of structure too
        held = np.diag(springs).any()
        springs, heavy = ~np.diag(np.full(len(mass), not held)), np.ones_like(heavy)
    found = [_masses(mass, heavy), _joints(damping, springs | _joined(damping)), _joints(stiffness, springs)]
    listed = [[pair_name(names[i], names[j]) for i, j, _, _ in one] for one in found]
    shapes = [np.array([x for *_, x in one]).reshape(-1, *[len(model.bodies)] * 2) for one in found]
    return shapes, listed, [np.array([value for _, _, value, _ in one]) for one in found]


def pair_name(one: str, other: str) -> str:
    """Name of what joins two ends, or of a body's own.

    Args:
        one, other: names of the ends.
    """
    return one if one == other else f"{one}, {other}"


Couplings = list[tuple[int, int, float, np.ndarray]]


def _masses(matrix: np.ndarray, which: np.ndarray) -> Couplings:
    """Ends (from 1), value and shape of entries, (N, N) of bool."""
    every, at = np.eye(len(matrix)), np.argwhere(np.triu(which))
    shapes = [np.outer(every[i], every[j]) for i, j in at]
    found = zip(at.tolist(), shapes, strict=True)
    return [(i + 1, j + 1, float(matrix[i, j]), np.maximum(x, x.T)) for (i, j), x in found]


def _joined(matrix: np.ndarray) -> np.ndarray:
    """Which bodies a matrix joins, (N, N) of bool, the diagonal for those that it joins to the ground."""
    return np.where(np.eye(len(matrix), dtype=bool), _to_ground(matrix)[:, None], matrix) != 0


def _to_ground(matrix: np.ndarray) -> np.ndarray:
    """Sums of rows; what rounding leaves is none."""
    sums = matrix.sum(axis=1)
    return np.where(np.abs(sums) > ROUNDING * np.abs(matrix).sum(axis=1), sums, 0.0)


def _joints(matrix: np.ndarray, which: np.ndarray) -> Couplings:
    """Ends (0 the ground), value and shape of springs or dampers, as `_joined` names them."""
    found, every = [], np.eye(len(matrix))
    for i, j in np.argwhere(np.triu(which)).tolist():
        joint = every[i] if i == j else every[i] - every[j]
        value = _to_ground(matrix)[i] if i == j else -matrix[i, j]
        found.append((0 if i == j else i + 1, j + 1, value, np.outer(joint, joint)))
    return found


def _sizes(values: np.ndarray) -> np.ndarray:
    """Their own, or where zero that of the others."""
    sizes = np.abs(values)
    usual = np.median(sizes[sizes > 0]) if (sizes > 0).any() else 1.0
    return np.where(sizes > 0, sizes, usual)


def as_full(model: LumpedModel) -> LumpedModel:
    """The same model as symmetric matrices of which every entry may vary.

    Args:
        model: elements or matrices.
    """
    linear = second_order(model)
    return lumped_model(
        model.bodies,
        matrices=Matrices(linear.mass, linear.damping, linear.stiffness, full=True),
        inputs=model.inputs,
        sensors=model.sensors,
        tolerance=model.tolerance,
        effects=model.effects,
        name=model.name,
    )


def with_values(model: LumpedModel, values: Float[Array, " p"]) -> LumpedModel:
    """The model with other values of its `element_matrices`, in their order.

    Args:
        model: whose unknowns they are.
        values: of all of them, SI units; without those of effects, effects are left out.
    """
    linear = len(element_matrices(model).listed)
    places = {
        "inputs": model.inputs,
        "sensors": model.sensors,
        "tolerance": model.tolerance,
        "name": model.name,
        "effects": _effects_with(model, values[linear:]) if len(values) > linear else (),
    }
    values = values[:linear]
    if model.matrices is not None:
        directions = element_matrices(model).directions
        mass, damping, stiffness = (jnp.einsum("p,pij->ij", values, jnp.asarray(x)) for x in directions)
        matrices = Matrices(mass, damping, stiffness, full=model.matrices.full)
        return lumped_model(model.bodies, matrices=matrices, **places)
    bodies, joints = len(model.bodies), len(model.connections)
    mass, damping, stiffness = jnp.split(values, [bodies, bodies + joints])
    return lumped_model(model.bodies, mass, stiffness, damping, connections=model.connections, **places)
