"""The laws that a diagnosis chose, along the motion of a place: what the force there should have been."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxsid.compilation import compiled
from jaxsid.gap.diagnose import Diagnosis
from jaxsid.gap.explain import element_place
from jaxsid.gap.force_map import ForceMap
from jaxsid.gap.ranking import ERRORS
from jaxsid.mechanics.effects.catalogue import law_of, parameter_row
from jaxsid.mechanics.effects.kind import Kind, Motion, Nominal
from jaxsid.mechanics.lumped import GROUND, Effect, LumpedModel, second_order, with_effects
from jaxsid.mechanics.slots import nominal_at, slots_of
from jaxsid.physical.elements import element_matrices

FINER = 4  # steps of a memory for each sample


def law_along(found: Diagnosis, force: ForceMap) -> Float[np.ndarray, " samples"] | None:
    """F of all chosen effects at the place of a map, as the catalogue counts it; None where none acts there.

    Args:
        found: a diagnosis.
        force: map of a place between two ends; signals and inertias are beyond it.
    """
    if found.causes is None or force.place.where != "between":
        return None
    total = None
    for effect in chosen_effects(found):
        sign = _sense(effect, force.place.ends)
        law = None if sign is None else _along(found.nominal, effect, force, sign)
        if law is not None:
            total = law if total is None else total + law
    return total


def chosen_effects(found: Diagnosis) -> tuple[Effect, ...]:
    """Effects of the improved model, and the model's numbers that were singled out as wrong.

    Args:
        found: a diagnosis.
    """
    if found.causes is None:
        return ()
    chosen, listed = found.causes.chosen, element_matrices(found.nominal).listed
    wrong = []
    for i in chosen.hypothesis.wrong:
        place = element_place(found.nominal, listed[i])
        named = tuple((where, tuple(x) if isinstance(x, list) else x) for where, x in place.items())
        wrong.append(Effect(ERRORS[listed[i].quantity], named, {"factor": 1 + float(chosen.fit.theta[i])}))
    return (*chosen.model.effects, *wrong)


def _sense(effect: Effect, ends: tuple[str, ...]) -> tuple[float, float] | None:
    """Sign of the effect's motion and of its force next to those of a map; None where it acts elsewhere."""
    ((where, place),) = effect.place
    if where == "body" and set(ends) == {GROUND, place}:
        turned = 1.0 if ends[1] == place else -1.0
        return turned, -turned  # a force on a body is +F, between two ends -F on the second
    if where != "between" or set(place) != set(ends):
        return None
    turned = 1.0 if tuple(place) == tuple(ends) else -1.0
    return turned, turned


def _along(
    model: LumpedModel, effect: Effect, force: ForceMap, sign: tuple[float, float]
) -> Float[np.ndarray, " samples"] | None:
    bare = with_effects(model, (effect,))
    place, speed, time = (jnp.asarray(x) for x in (force.displacement, force.velocity, force.time))
    law, inertia = _force(bare, sign[0] * place, sign[0] * speed, time, force.record)
    return None if float(inertia) else sign[1] * np.asarray(law)


@compiled
def _force(
    model: LumpedModel, place: Array, speed: Array, time: Array, record: int
) -> tuple[Float[Array, " samples"], Float[Array, ""]]:
    """Force of a model's one effect, and mass that it adds: a map knows no acceleration."""
    (effect,) = model.effects
    kind = law_of(effect.kind, effect.parameters)
    at = Nominal(*(x[0] for x in nominal_at(slots_of(model), second_order(model))))
    values = list(parameter_row(effect.kind, effect.parameters, record)[: len(kind.parameters)])
    if kind.changes is not None:
        change = kind.changes(at, *values)
        return change.stiffness * place + change.damping * speed, jnp.asarray(
            change.mass + change.attached_mass
        )
    if kind.slip is not None:
        return kind.slip(jnp.abs(speed), *values) * jnp.sign(speed), jnp.zeros(())
    seen = Motion(place, speed, jnp.zeros_like(place), time, at.stiffness)
    if kind.rate is not None:
        seen = seen._replace(memory=_memory(kind, values, seen))
    assert kind.force is not None
    return kind.force(seen, *values) + jnp.zeros_like(place), jnp.zeros(())


def _memory(kind: Kind, values: list[Array], seen: Motion) -> Array:
    """The memory along a motion from 0 on, the motion between samples on straight lines.

    By z + h phi(h J) z' with J its slope, all in the middle of a step: the exponential method of Rosenbrock and Euler,
    which a law that is far quicker than the samples does not upset.
    """
    assert kind.rate is not None
    law, count = kind.rate, len(seen.displacement)
    step = (seen.time[1] - seen.time[0]) / FINER

    def rate(at: Array, z: Array) -> Array:
        i = jnp.minimum(at.astype(int), count - 2)
        part = at - i
        between = [x[i] + part * (x[i + 1] - x[i]) for x in (seen.displacement, seen.velocity, seen.time)]
        return law(Motion(between[0], between[1], z, between[2], seen.spring), *values)

    def advance(z: Array, k: Array) -> tuple[Array, Array]:
        now, slope = jax.jvp(lambda x: rate((k + 0.5) / FINER, x), (z,), (jnp.ones_like(z),))
        far = step * slope
        return z + step * now * jnp.where(far != 0, jnp.expm1(far) / jnp.where(far != 0, far, 1.0), 1.0), z

    _, course = lax.scan(advance, jnp.zeros_like(seen.displacement[0]), jnp.arange(FINER * count))
    return course[::FINER]
