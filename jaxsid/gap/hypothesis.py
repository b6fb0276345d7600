"""What a fit holds for possible: effects with their parameters, and how far the model's own numbers may be off.

All unknowns are of order one and have a normal prior: z = (ratio - centre) / spread, or log(ratio / centre) /
log(spread) of a size, where ratio is a parameter next to its scale at the place; of an element z is the relative
change.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsid.mechanics.amplitudes import amplitudes
from jaxsid.mechanics.effects.catalogue import MOST_PARAMETERS, by_sort, kind_number, law_of
from jaxsid.mechanics.effects.kind import Kind
from jaxsid.mechanics.effects.prior import Amplitudes, Prior
from jaxsid.mechanics.lumped import Effect, LumpedModel, with_effects
from jaxsid.mechanics.slots import Slots, slots_of
from jaxsid.records import SecondOrderModel

FLAT = math.pi / math.sqrt(3)  # standard deviation of an angle that may be any
FIXED = 1e-9  # deviation of what does not vary
INERT = "sensor_gain"  # a kind that does nothing without a place


class Coordinates(eqx.Module):
    """From unknowns to parameters of effects, each (slots, most).

    Attributes:
        centre, spread: of the ratio to the scale.
        logarithmic: whether the unknown is of the ratio's logarithm.
        scale: of the parameter.
        raised: number of the parameter that is the power of the scale, -1 for none.
        lowest: least ratio.
        deviation: of the unknown's prior; `FIXED` for parameters that the kind does not have.
        per_record: whether every record has its own.
    """

    centre: Float[Array, "slots most"]
    spread: Float[Array, "slots most"]
    logarithmic: Bool[Array, "slots most"]
    scale: Float[Array, "slots most"]
    raised: Int[Array, "slots most"]
    lowest: Float[Array, "slots most"]
    deviation: Float[Array, "slots most"]
    per_record: Bool[Array, "slots most"]

    def parameters(self, z: Float[Array, "slots most"]) -> Float[Array, "slots most"]:
        """In SI units.

        Args:
            z: unknowns.
        """
        logarithm = jnp.log(jnp.where(self.logarithmic, self.spread, 1.0)) * z
        ratio = jnp.where(
            self.logarithmic,
            self.centre * jnp.exp(jnp.clip(logarithm, -50, 50)),
            self.centre + self.spread * z,
        )
        power = jnp.take_along_axis(ratio, jnp.maximum(self.raised, 0), axis=1)
        power = jnp.where(self.raised >= 0, power, 1.0)
        return ratio * jnp.exp(power * jnp.log(self.scale))

    def unknowns(self, parameters: Float[np.ndarray, "slots most"]) -> Float[np.ndarray, "slots most"]:
        """Of parameters in SI units; undoes `parameters`.

        Args:
            parameters: in the order of the kind.
        """
        given, raised = np.asarray(parameters, float), np.asarray(self.raised)
        plain = given / np.asarray(self.scale)
        power = np.take_along_axis(plain, np.maximum(raised, 0), axis=1)
        ratio = np.where(
            raised >= 0, given / np.asarray(self.scale) ** np.where(raised >= 0, power, 1.0), plain
        )
        sensible = np.where(np.asarray(self.logarithmic) & (ratio <= 0), np.asarray(self.centre), ratio)
        return self._standard(np.maximum(sensible, np.asarray(self.lowest)))

    def least(self) -> Float[np.ndarray, "slots most"]:
        """Smallest unknowns that make sense."""
        return self._standard(np.asarray(self.lowest))

    def _standard(self, ratio: Float[np.ndarray, "slots most"]) -> Float[np.ndarray, "slots most"]:
        """Unknowns of ratios."""
        centre, spread, size = (np.asarray(x) for x in (self.centre, self.spread, self.logarithmic))
        positive = np.where(size & (ratio > 0), ratio, 1.0)
        log = np.log(positive / np.where(size, centre, 1.0)) / np.where(size, np.log(spread), 1.0)
        log = np.where(ratio > 0, log, -np.inf)
        return np.where(size, log, (ratio - centre) / spread)


class Moved(NamedTuple):
    """How the bodies move in one record, for the scales of effects.

    Attributes:
        displacements, velocities: (samples, N).
        u: (samples, inputs).
        y: (samples, outputs), NaN where there is nothing.
        dt: sampling interval, s.
    """

    displacements: Float[np.ndarray, "samples N"]
    velocities: Float[np.ndarray, "samples N"]
    u: Float[np.ndarray, "samples inputs"]
    y: Float[np.ndarray, "samples outputs"]
    dt: float


def effect_slots(model: LumpedModel, effects: Sequence[Effect]) -> Slots:
    """The effects as arrays; one that does nothing where there is none.

    Args:
        model: names bodies, sensors and inputs.
        effects: of the hypothesis.
    """
    slots = slots_of(with_effects(model, effects))
    if not effects:
        one = lambda x: jnp.zeros((1, *x.shape[1:]), x.dtype)  # noqa: E731
        slots = Slots(jnp.asarray([kind_number(INERT)], jnp.int32), *map(one, _arrays(slots)))
    return eqx.tree_at(lambda s: s.kinds, slots, by_sort(jnp.asarray(slots.kinds)))


def _arrays(slots: Slots) -> tuple[Array, ...]:
    return slots.parameters, slots.joints, slots.pushes, slots.sensors, slots.inputs


def amplitudes_of(linear: SecondOrderModel, slots: Slots, moved: Sequence[Moved]) -> Amplitudes:
    """How the places move, over all records.

    Args:
        linear: without effects.
        slots: the places.
        moved: each record.
    """
    # kinds do not count: one program for all
    slots = eqx.tree_at(lambda s: s.kinds, slots, jnp.zeros(slots.count, jnp.int32))
    each = []
    for m in moved:
        q, v, u, y, dt = (jnp.asarray(x) for x in (m.displacements, m.velocities, m.u, m.y, m.dt))
        each.append(amplitudes(linear, slots, q, v, u, y, dt))
    mean = (
        np.sqrt(np.mean([np.asarray(x) ** 2 for x in field], axis=0)) for field in zip(*each, strict=True)
    )
    return Amplitudes(*mean)


def coordinates_of(effects: Sequence[Effect], at: Amplitudes) -> Coordinates:
    """The unknowns of effects.

    Args:
        effects: of the hypothesis.
        at: how their places move.
    """
    rows = max(len(effects), 1)
    table = {name: np.zeros((rows, MOST_PARAMETERS)) for name in Coordinates.__annotations__}
    for name in ("spread", "scale"):
        table[name][:] = 1.0
    table["raised"][:], table["deviation"][:], table["lowest"][:] = -1, FIXED, -np.inf
    table["centre"][len(effects) :, 0] = 1.0
    for row, effect in enumerate(effects):
        parameters = law_of(effect.kind, effect.parameters).parameters
        names = [p.name for p in parameters]
        moves, own = Amplitudes(*(np.asarray(x)[row] for x in at)), own_of_records(effect)
        for i, p in enumerate(parameters):
            values = _coordinate(p.prior)
            scale = float(np.asarray(p.scale.of(moves)))
            values["scale"] = scale if np.isfinite(scale) and scale > 0 else 1.0
            values["raised"] = names.index(p.raised) if p.raised else -1
            values["per_record"] = p.name in own
            for name, value in values.items():
                table[name][row, i] = value
    whole = {"logarithmic": bool, "per_record": bool, "raised": int}
    return Coordinates(**{k: jnp.asarray(v.astype(whole.get(k, float))) for k, v in table.items()})


def own_of_records(effect: Effect) -> list[str]:
    """Names of an effect's parameters that each record has a value of: the phase of a force that goes on between them.

    Args:
        effect: its kind, parameters and place.
    """
    of = law_of(effect.kind, effect.parameters).parameters if effect.place[0][0] == "body" else ()
    return [p.name for p in of if p.prior.shape == "uniform"]


def _coordinate(prior: Prior) -> dict[str, float]:
    if prior.shape == "uniform":
        return {"centre": 0.0, "spread": 1.0, "deviation": FLAT, "lowest": -np.inf, "logarithmic": 0}
    return {
        "centre": prior.centre,
        "spread": prior.spread,
        "deviation": 1.0,
        "lowest": prior.lowest if prior.bounded else -np.inf,
        "logarithmic": prior.shape == "log-normal",
    }


def parameter_rows(effects: Sequence[Effect]) -> Float[np.ndarray, "slots most"]:
    """The parameters of effects in the order of their kinds; one neutral row where there is none.

    Args:
        effects: of the hypothesis.
    """
    found = np.zeros((max(len(effects), 1), MOST_PARAMETERS))
    found[len(effects) :, 0] = 1.0
    for row, effect in enumerate(effects):
        for i, p in enumerate(law_of(effect.kind, effect.parameters).parameters):
            found[row, i] = np.ravel(np.asarray(effect.parameters.get(p.name, p.default), float))[0]
    return found


def shifts_of(effects: Sequence[Effect], records: int) -> Float[np.ndarray, " n"]:
    """What is added in further records to a parameter that each has of its own: (records - 1) * slots.

    Args:
        effects: of the hypothesis, such a parameter an array over the records.
        records: how many.
    """
    found = np.zeros((records - 1, max(len(effects), 1)))
    for row, effect in enumerate(effects):
        for value in effect.parameters.values():
            if np.size(value) == records > 1:
                found[:, row] = _within(np.asarray(value)[1:] - np.asarray(value)[0])
    return found.ravel()


def _within(angle: np.ndarray) -> np.ndarray:
    """The same angle no more than half a turn from zero."""
    return np.asarray(np.angle(np.exp(1j * angle)))


def upright(kind: Kind, values: Mapping[str, float | np.ndarray]) -> dict[str, float | np.ndarray]:
    """The same parameters with the amplitude of a wave above zero and its angle no more than half a turn from zero.

    Args:
        kind: of effect.
        values: of its parameters by name.
    """
    if kind.wave is None:
        return dict(values)
    amplitude, angle = (np.asarray(values[n], float) for n in kind.wave)
    turned = _within(np.asarray(angle + np.pi * (amplitude < 0)))
    new = dict(zip(kind.wave, (np.asarray(np.abs(amplitude)), turned), strict=True))
    return {**values, **{n: v if v.ndim else float(v) for n, v in new.items()}}


def with_parameters(effect: Effect, values: Mapping[str, Array | float | np.ndarray]) -> Effect:
    """The same effect with other parameters.

    Args:
        effect: its kind and place.
        values: by name, SI units.
    """
    return Effect(effect.kind, effect.place, dict(values))
