"""Lumped mechanical models: bodies, the springs and dampers between them, inputs and sensors."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxsid.checks import bad_input, is_concrete, require, require_finite
from jaxsid.compilation import compiled
from jaxsid.mechanics.effects.catalogue import check_effect
from jaxsid.records import HOLDS, SENSOR_KINDS, SecondOrderModel, as_array, floating

GROUND = "ground"


class Input(NamedTuple):
    """A force or torque on one body.

    Attributes:
        name: of the column of records that holds it.
        body: on which it acts.
        hold: what it does between samples: "zero" keeps its value, "first" goes straight to the next, "band" has
            nothing above half the sampling rate.
    """

    name: str
    body: str
    hold: str = "zero"


class Sensor(NamedTuple):
    """An absolute sensor on one body.

    Attributes:
        name: of the column of records that holds it.
        body: whose motion it reads.
        kind: "displacement", "velocity" or "acceleration".
    """

    name: str
    body: str
    kind: str


class Tolerance(NamedTuple):
    """How well the nominal numbers are known.

    Attributes:
        mass, stiffness, damping: relative standard deviations of all masses, stiffnesses and dampings.
    """

    mass: float = 0.005
    stiffness: float = 0.005
    damping: float = 0.05


NOMINAL = Tolerance()


class Connection(NamedTuple):
    """A spring and viscous damper between two bodies, or between a body and "ground".

    Attributes:
        name: for messages and results.
        between: names of the two ends.
    """

    name: str
    between: tuple[str, str]


def _arrays(numbers: Mapping[str, ArrayLike]) -> dict[str, Array]:
    return {name: floating(value) for name, value in numbers.items()}


class Effect(eqx.Module):
    """A law beyond the linear model, such as friction.

    Attributes:
        kind: name of the law, such as "coulomb_friction".
        place: where it acts, such as (("between", ("ground", "motor")),).
        parameters: its numbers by name, SI units.
    """

    kind: str = eqx.field(static=True)
    place: tuple[tuple[str, Any], ...] = eqx.field(static=True)
    parameters: dict[str, Array] = eqx.field(converter=_arrays)


class Matrices(eqx.Module):
    """Mass, damping and stiffness, given instead of elements.

    Attributes:
        mass: (N, N), kg or kg m^2.
        damping: (N, N), N s/m or N m s.
        stiffness: (N, N), N/m or N m.
        full: whether every body may be joined with every other; else an entry that is zero is known to be.
    """

    # a shape of its own each: `check_lumped` compares them, and says what is wrong in words
    mass: Float[Array, "N N"]
    damping: Float[Array, "P P"]
    stiffness: Float[Array, "Q Q"]
    full: bool = eqx.field(static=True, default=False)


class LumpedModel(eqx.Module):
    """Rigid bodies with one coordinate each, joined by springs and dampers; build it with `lumped_model`.

    Attributes:
        mass: (N,) of the bodies, kg or kg m^2; empty in the matrix form.
        stiffness, damping: (c,) of the connections, N/m and N s/m (N m, N m s); empty in the matrix form.
        matrices: M, D, K given instead of elements, else None.
        bodies, connections, inputs, sensors: what there is, by name and place.
        tolerance: how well the nominal numbers are known.
        effects: laws beyond the linear model.
        name: for messages and reports.
    """

    mass: Float[Array, " N"]
    stiffness: Float[Array, " c"]
    damping: Float[Array, " d"]
    matrices: Matrices | None
    bodies: tuple[str, ...] = eqx.field(static=True)
    connections: tuple[Connection, ...] = eqx.field(static=True)
    inputs: tuple[Input, ...] = eqx.field(static=True)
    sensors: tuple[Sensor, ...] = eqx.field(static=True)
    tolerance: Tolerance = eqx.field(static=True)
    effects: tuple[Effect, ...]
    name: str = eqx.field(static=True)


def lumped_model(
    bodies: Sequence[str],
    mass: ArrayLike | Sequence[float | int] = (),
    stiffness: ArrayLike | Sequence[float | int] = (),
    damping: ArrayLike | Sequence[float | int] = (),
    *,
    connections: Sequence[Connection] = (),
    matrices: Matrices | None = None,
    inputs: Sequence[Input] = (),
    sensors: Sequence[Sensor] = (),
    tolerance: Tolerance | tuple[float, float, float] = NOMINAL,
    effects: Sequence[Effect] = (),
    name: str = "model",
) -> LumpedModel:
    """A checked LumpedModel, from elements or from M, D, K.

    Args:
        bodies: their names; "ground" is reserved.
        mass: (N,) kg or kg m^2, in the order of `bodies`.
        stiffness: (c,) N/m or N m, in the order of `connections`.
        damping: (c,) N s/m or N m s, in the order of `connections`.
        connections: names and ends; two connections may join the same bodies.
        matrices: M, D, K (N, N) instead of mass, stiffness, damping and connections.
        inputs: forces or torques, each on one body.
        sensors: absolute sensors, each on one body.
        tolerance: relative standard deviations of the nominal numbers.
        effects: laws beyond the linear model.
        name: for messages and reports.

    Raises:
        InputError: unknown, reserved or duplicated names, values that no mechanical system has, wrong shapes.
    """
    model = LumpedModel(
        *(floating(x) for x in (mass, stiffness, damping)),
        matrices=matrices,
        bodies=tuple(bodies),
        connections=tuple(Connection(c[0], (c[1][0], c[1][1])) for c in connections),
        inputs=tuple(Input(*i) for i in inputs),
        sensors=tuple(Sensor(*s) for s in sensors),
        tolerance=Tolerance(*tolerance),
        effects=tuple(effects),
        name=name,
    )
    check_lumped(model)
    return model


def with_effects(model: LumpedModel, effects: Sequence[Effect]) -> LumpedModel:
    """A model with these effects in place of its own.

    Args:
        model: all else.
        effects: as of `LumpedModel`.
    """
    return eqx.tree_at(lambda m: m.effects, model, tuple(effects), is_leaf=lambda x: x is model.effects)


def check_lumped(model: LumpedModel) -> None:
    """Raise InputError where the names, shapes or values of a model cannot be used."""
    _check_names(model)
    _check_places(model)
    _check_effects(model)
    if model.matrices is None:
        _check_elements(model)
    else:
        _check_matrices(model, model.matrices)
    for what, value in model.tolerance._asdict().items():
        require(value >= 0, f"{model.name}: tolerance '{what}' must not be negative, it is {value}.")


def _no_duplicates(names: Iterable[str], where: str) -> None:
    twice = [name for name, count in Counter(names).items() if count > 1]
    require(
        not twice, f"{where}: the name '{twice[0] if twice else ''}' is used twice. Give each its own name."
    )


def _check_names(model: LumpedModel) -> None:
    require(len(model.bodies) > 0, f"{model.name}: needs at least one body.")
    require(
        GROUND not in model.bodies,
        f"{model.name}: 'ground' is reserved for the fixed frame; rename that body.",
    )
    _no_duplicates(model.bodies, f"{model.name}, bodies")
    _no_duplicates((c.name for c in model.connections), f"{model.name}, connections")
    channels = [c.name for c in (*model.inputs, *model.sensors)]
    _no_duplicates(channels, f"{model.name}, inputs and sensors (each is a column of the record)")
    require("time" not in channels, f"{model.name}: 'time' is the record's time column; rename that channel.")


def _known(name: str, choices: Sequence[str], where: str, what: str = "body") -> None:
    require(name in choices, f"{where}: {what} '{name}' is unknown; choose from {', '.join(choices)}.")


def _check_between(model: LumpedModel, ends: Sequence[str], where: str) -> None:
    require(len(ends) == 2, f"{where}: 'between' names two bodies, or a body and 'ground', not {len(ends)}.")
    for end in ends:
        _known(end, (*model.bodies, GROUND), where)
    require(
        ends[0] != ends[1],
        f"{where}: it joins '{ends[0]}' to itself and does nothing. Name two different ends.",
    )


def _check_places(model: LumpedModel) -> None:
    for c in model.connections:
        _check_between(model, c.between, f"{model.name}, connection '{c.name}'")
    for i in model.inputs:
        _known(i.body, model.bodies, f"{model.name}, input '{i.name}'")
        _known(i.hold, HOLDS, f"{model.name}, input '{i.name}'", "hold")
    for s in model.sensors:
        _known(s.body, model.bodies, f"{model.name}, sensor '{s.name}'")
        _known(s.kind, SENSOR_KINDS, f"{model.name}, sensor '{s.name}'", "kind")


def _check_effects(model: LumpedModel) -> None:
    choices = {
        "body": model.bodies,
        "sensor": tuple(s.name for s in model.sensors),
        "input": tuple(i.name for i in model.inputs),
    }
    for effect in model.effects:
        where = f"{model.name}, effect '{effect.kind}'"
        require(len(effect.place) == 1, f"{where}: it needs one place, not {len(effect.place)}.")
        ((key, value),) = effect.place
        if key == "between":
            _check_between(model, value, where)
        else:
            _known(key, ("between", *choices), where, "place")
            _known(value, choices[key], where, key)
        check_effect(effect.kind, key, effect.parameters, where)


def _check_elements(model: LumpedModel) -> None:
    require(
        model.mass.shape == (len(model.bodies),),
        f"{model.name}: {len(model.bodies)} bodies need as many masses, not shape {model.mass.shape}.",
    )
    connections = tuple(c.name for c in model.connections)
    for what, names, limit in (
        ("mass", model.bodies, "positive"),
        ("stiffness", connections, "zero or positive"),
        ("damping", connections, "zero or positive"),
    ):
        values: Array = getattr(model, what)
        require(
            values.shape == (len(names),),
            f"{model.name}: {len(names)} connections need as many of {what}, not shape {values.shape}.",
        )
        if is_concrete(values):
            require_finite(values, f"{model.name}, {what}", names)
            bad = np.flatnonzero(np.asarray(values) <= 0 if what == "mass" else np.asarray(values) < 0)
            if bad.size:
                value = float(values[bad[0]])
                bad_input(
                    f"{model.name}: {what} of '{names[bad[0]]}' must be {limit}, not {value:g}. Check it."
                )


def _check_matrices(model: LumpedModel, matrices: Matrices) -> None:
    size = len(model.bodies)
    require(
        not model.connections and not model.mass.size,
        f"{model.name}: give either matrices or masses and connections, not both.",
    )
    for what in ("mass", "damping", "stiffness"):
        values: Array = getattr(matrices, what)
        where = f"{model.name}, matrix '{what}'"
        require(
            values.shape == (size, size), f"{where}: {size} bodies need {size} x {size}, not {values.shape}."
        )
        if is_concrete(values):
            require_finite(values, where)
            x = np.asarray(values)
            tolerance = 100 * np.finfo(x.dtype).eps * np.abs(x).max()
            i, j = np.unravel_index(np.argmax(np.abs(x - x.T)), x.shape)
            require(
                abs(x[i, j] - x[j, i]) <= tolerance,
                f"{where}: not symmetric: ({i + 1}, {j + 1}) is {x[i, j]:g}, its mirror is {x[j, i]:g}.",
            )
    if is_concrete(matrices.mass):
        smallest = np.linalg.eigvalsh(np.asarray(matrices.mass))[0]
        require(
            smallest > 0,
            f"{model.name}, matrix 'mass': not positive definite, its smallest eigenvalue is {smallest:g}.",
        )


def incidence(model: LumpedModel) -> np.ndarray:
    """(N, c): +1 where a connection ends, -1 where it begins, so that d = incidence' x is x_b - x_a."""
    result = np.zeros((len(model.bodies), len(model.connections)))
    for column, connection in enumerate(model.connections):
        for end, sign in zip(connection.between, (-1.0, 1.0), strict=True):
            if end != GROUND:
                result[model.bodies.index(end), column] += sign
    return result


def _selector(bodies: tuple[str, ...], chosen: Sequence[str | None]) -> np.ndarray:
    """(len(chosen), N): row i is 1 at the body chosen[i], zero where that is None."""
    return np.array([[float(body == name) for body in bodies] for name in chosen]).reshape(
        len(chosen), len(bodies)
    )


@compiled
def _assemble(mass: Array, damping: Array, stiffness: Array, joints: Array) -> tuple[Array, Array, Array]:
    return jnp.diag(mass), (joints * damping) @ joints.T, (joints * stiffness) @ joints.T


def second_order(model: LumpedModel) -> SecondOrderModel:
    """M q'' + D q' + K q = B u of a lumped model: K = sum_c k_c e_c e_c', e_c +1 and -1 at the ends.

    q holds the absolute displacements of `model.bodies`; u the inputs and y the sensors in the model's order.
    Differentiable in the element values; effects are not part of it.
    """
    if model.matrices is None:
        dtype = model.mass.dtype
        mass, damping, stiffness = _assemble(
            model.mass, model.damping, model.stiffness, as_array(incidence(model).astype(dtype))
        )
    else:
        mass, damping, stiffness = model.matrices.mass, model.matrices.damping, model.matrices.stiffness
        dtype = mass.dtype
    sensors = (
        _selector(model.bodies, [s.body if s.kind == kind else None for s in model.sensors])
        for kind in SENSOR_KINDS
    )
    forces = _selector(model.bodies, [i.body for i in model.inputs]).T
    return SecondOrderModel(
        mass, damping, stiffness, *(jnp.asarray(x, dtype) for x in (forces, *sensors)), diagnostics=None
    )


def free_bodies(model: LumpedModel) -> np.ndarray:
    """(N, k) displacement patterns that no spring resists: rigid-body motions, the null space of K.

    With elements, one 0/1 column for each group of bodies joined by springs that no spring joins to ground.
    Needs concrete values; empty, (N, 0), where everything is held.
    """
    return _unresisted(model, "stiffness")


def loose_bodies(model: LumpedModel) -> np.ndarray:
    """(N, k) velocity patterns that no damper resists, the null space of D; as `free_bodies` otherwise."""
    return _unresisted(model, "damping")


def _unresisted(model: LumpedModel, what: str) -> np.ndarray:
    if model.matrices is not None:
        return _null_space(np.asarray(getattr(model.matrices, what)), np.asarray(model.matrices.mass))
    group = {body: {body} for body in (*model.bodies, GROUND)}
    for connection, value in zip(model.connections, np.asarray(getattr(model, what)), strict=True):
        a, b = connection.between
        if value != 0 and group[a] is not group[b]:
            group[a] |= group[b]
            group.update({body: group[a] for body in group[b]})
    free = {id(g): g for body, g in group.items() if body != GROUND and GROUND not in g}
    columns = [[float(body in g) for body in model.bodies] for g in free.values()]
    return np.array(columns).reshape(len(columns), len(model.bodies)).T


def _null_space(matrix: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Null space of a symmetric matrix, judged after scaling by the masses; each column peaks at 1."""
    scale = 1 / np.sqrt(np.diag(mass))
    values, vectors = np.linalg.eigh(scale[:, None] * matrix * scale)
    threshold = 100 * len(values) * np.finfo(values.dtype).eps * np.abs(values).max(initial=0.0)
    null = scale[:, None] * vectors[:, np.abs(values) <= threshold]
    peaks = null[np.argmax(np.abs(null), axis=0), np.arange(null.shape[1])]
    return null / peaks
