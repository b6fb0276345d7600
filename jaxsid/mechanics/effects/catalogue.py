"""All kinds of effects, found by their files, and the laws of several effects at once."""

import difflib
import pkgutil
from collections.abc import Iterable, Mapping
from importlib import import_module
from types import MappingProxyType
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxsid.checks import bad_input, is_concrete, require
from jaxsid.mechanics import effects
from jaxsid.mechanics.effects.kind import Changes, Kind, Motion, Nominal
from jaxsid.mechanics.effects.prior import Amplitudes

NOT_KINDS = ("catalogue", "kind", "prior")


def _found() -> dict[str, Kind]:
    names = sorted(module.name for module in pkgutil.iter_modules(effects.__path__))
    modules = (import_module(f"{effects.__name__}.{n}") for n in names if n not in NOT_KINDS)
    return {module.EFFECT.name: module.EFFECT for module in modules}


# laws, with the forms that kinds have under names of their own; and kinds
LAWS: Mapping[str, Kind] = MappingProxyType(_found())
CATALOGUE: Mapping[str, Kind] = MappingProxyType({n: k for n, k in LAWS.items() if not k.form_of})
MOST_PARAMETERS = max(len(kind.parameters) for kind in LAWS.values())


def kind_number(name: str) -> int:
    """Position of a law among all."""
    return list(LAWS).index(name)


def law_of(name: str, parameters: Iterable[str]) -> Kind:
    """The law of an effect: its kind, or the form of it that has the parameters which are given.

    Args:
        name: of the kind.
        parameters: names of those given.
    """
    kind = CATALOGUE[name]
    further = set(parameters) - {p.name for p in kind.parameters}
    forms = (k for k in forms_of(name) if further <= {p.name for p in k.parameters})
    return next(forms, kind) if further else kind


def forms_of(name: str) -> list[Kind]:
    """Further laws that effects of a kind have, told by a parameter more.

    Args:
        name: of the kind.
    """
    return [kind for kind in LAWS.values() if kind.form_of == name]


def further_of(form: Kind) -> str:
    """The parameter that tells a form of a kind from it.

    Args:
        form: of a kind.
    """
    (name,) = {p.name for p in form.parameters} - {p.name for p in CATALOGUE[form.form_of].parameters}
    return name


def kind_named(name: str, said: str) -> Kind:
    """The kind of effect of this name.

    Args:
        name: of the kind.
        said: how to name the effect in a message.

    Raises:
        InputError: no such kind.
    """
    if name not in CATALOGUE:
        near = difflib.get_close_matches(name, CATALOGUE, 1)
        hint = f"did you mean '{near[0]}'?" if near else f"choose from {', '.join(CATALOGUE)}."
        bad_input(f"{said}: this kind of effect is unknown; {hint}")
    return CATALOGUE[name]


def check_effect(name: str, where: str, parameters: Mapping[str, ArrayLike], said: str) -> None:
    """Raise InputError where an effect's kind, place or parameters cannot be.

    Args:
        name: of the kind.
        where: "between", "body", "sensor" or "input".
        parameters: given values by name, one number or one a record.
        said: how to name the effect in a message.
    """
    kind = kind_named(name, said)
    require(where == kind.where, f"{said}: its place is '{kind.where}', not '{where}'.")
    kind = law_of(name, parameters)
    names = [p.name for p in kind.parameters]
    for given in parameters:
        require(given in names, f"{said}: it has no parameter '{given}'; choose from {', '.join(names)}.")
    for p in kind.parameters:
        require(
            p.default is not None or p.name in parameters, f"{said}: its parameter '{p.name}' is missing."
        )
        value = jnp.asarray(parameters.get(p.name, p.default))
        if is_concrete(value):
            low = float(np.min(np.asarray(value)))
            require(low >= p.lowest, f"{said}: '{p.name}' is {low:g}; it must be at least {p.lowest:g}.")
    require(bool(parameters) or not names, f"{said}: give one of {', '.join(names)}.")


def parameter_row(name: str, parameters: Mapping[str, ArrayLike], record: int) -> Float[Array, " most"]:
    """The parameters of an effect in the order of its kind, padded to the most that any has.

    Args:
        name: of the kind.
        parameters: one number or one a record each.
        record: number of the record, for those that have one a record; the last where there are fewer.
    """
    row = []
    for p in law_of(name, parameters).parameters:
        value = jnp.ravel(jnp.asarray(parameters.get(p.name, p.default), dtype=float))
        row.append(value[min(record, len(value) - 1)])
    return jnp.stack([*row, *[jnp.zeros(())] * (MOST_PARAMETERS - len(row))])


def scales(name: str, at: Amplitudes, given: Mapping[str, ArrayLike] = MappingProxyType({})) -> list[Array]:
    """How large each parameter of a kind is where it matters; its prior is of the ratio to that.

    Args:
        name: of the kind.
        at: how its place moves.
        given: values of parameters that are the power of another's unit; their defaults where left out.
    """
    parameters = law_of(name, given).parameters
    powers = {p.name: given.get(p.name, 1.0 if p.default is None else p.default) for p in parameters}
    return [p.scale.of(at) ** (powers[p.raised] if p.raised else 1) for p in parameters]


def sort_of(kind: Kind) -> str:
    """What a program has to compute for a kind: "dry" friction, a "law", or "linear" for nothing beside matrices."""
    return "dry" if kind.slip is not None else "linear" if kind.force is None else "law"


class Sorted(eqx.Module):
    """Numbers of kinds that may be traced, of which no more is known than their sorts.

    Attributes:
        numbers: of the kinds.
        sorts: of each, from `sort_of`.
    """

    numbers: Int[Array, " slots"]
    sorts: tuple[str, ...] = eqx.field(static=True)

    def __len__(self) -> int:
        return len(self.sorts)


# of kinds of which nothing is known while a program is traced; all; their sorts
Numbers = Int[Array, " slots"] | Int[np.ndarray, " slots"] | Sorted


def by_sort(kinds: Int[Array, " slots"]) -> Sorted:
    """Numbers of kinds with their sorts, so that few programs, short ones where they can be, serve all.

    Args:
        kinds: known numbers.
    """
    every = [sort_of(kind) for kind in LAWS.values()]
    return Sorted(kinds, tuple(every[i] for i in np.asarray(kinds)))


def _chosen(kind: Kind, kinds: Numbers, parameters: Array) -> tuple[Array, list[Array]]:
    """Which slots are of a kind, and their parameters; typical ones for the others, whose results are dropped."""
    numbers = kinds.numbers if isinstance(kinds, Sorted) else kinds
    here = jnp.asarray(numbers) == kind_number(kind.name)
    return here, [jnp.where(here, parameters[:, i], p.typical) for i, p in enumerate(kind.parameters)]


def possible(kinds: Numbers) -> list[Kind]:
    """All kinds; where the slots' kinds or sorts are known while the program is traced, those alone.

    Args:
        kinds: numbers of the kinds.
    """
    if isinstance(kinds, np.ndarray):
        return [kind for number, kind in enumerate(LAWS.values()) if number in kinds]
    if isinstance(kinds, Sorted):
        return [kind for kind in LAWS.values() if sort_of(kind) in kinds.sorts]
    return list(LAWS.values())


def _total(hook: str, kinds: Numbers, parameters: Array, seen: Any) -> Array:
    total = jnp.zeros(len(parameters), parameters.dtype)
    for kind in possible(kinds):
        law = getattr(kind, hook)
        if law is not None:
            here, values = _chosen(kind, kinds, parameters)
            total = jnp.where(here, law(seen, *values), total)
    return total


def forces(kinds: Numbers, parameters: Float[Array, "slots most"], motion: Motion) -> Float[Array, " slots"]:
    """Forces without jumps of every slot.

    Args:
        kinds: numbers of the kinds.
        parameters: in their order.
        motion: what each slot sees.
    """
    return _total("force", kinds, parameters, motion)


def rates(kinds: Numbers, parameters: Float[Array, "slots most"], motion: Motion) -> Float[Array, " slots"]:
    """Rates of the memories of every slot; arguments as of `forces`."""
    return _total("rate", kinds, parameters, motion)


def slips(kinds: Numbers, parameters: Float[Array, "slots most"], speed: Array) -> Float[Array, " slots"]:
    """Magnitude of dry friction of every slot at a speed; arguments as of `forces`."""
    return _total("slip", kinds, parameters, speed)


def rubbing(kinds: Numbers) -> Bool[Array, " slots"] | Bool[np.ndarray, " slots"]:
    """Which slots are dry friction, whatever its magnitude."""
    if isinstance(kinds, Sorted):
        return np.array([sort == "dry" for sort in kinds.sorts], bool)
    numbers = [kind_number(kind.name) for kind in LAWS.values() if kind.slip is not None]
    return (np if isinstance(kinds, np.ndarray) else jnp).isin(kinds, np.array(numbers))


def changes(kinds: Numbers, parameters: Float[Array, "slots most"], nominal: Nominal) -> Changes:
    """What every slot changes in the linear model and in signals, each (slots,).

    Args:
        kinds: numbers of the kinds.
        parameters: in their order.
        nominal: what the model has at the place of each slot.
    """
    total = [jnp.zeros(len(parameters), parameters.dtype)] * len(Changes._fields)
    for kind in possible(kinds):
        if kind.changes is not None:
            here, values = _chosen(kind, kinds, parameters)
            found = kind.changes(nominal, *values)
            total = [jnp.where(here, x, t) for x, t in zip(found, total, strict=True)]
    return Changes(*total)
