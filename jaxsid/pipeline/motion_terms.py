"""Records of a model with effects as terms of a fit: windows, first initial states, steps that are short enough."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsid.checks import require
from jaxsid.compilation import compiled
from jaxsid.impulse.whitening import MOST
from jaxsid.mechanics.effects.catalogue import MOST_PARAMETERS, law_of, parameter_row
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.hold import discretise
from jaxsid.mechanics.lumped import LumpedModel, free_bodies, second_order
from jaxsid.mechanics.recursion import powers, run
from jaxsid.mechanics.simulate import measured_sensors, ordered_inputs
from jaxsid.mechanics.simulate_effects import driven, run_driven
from jaxsid.mechanics.slots import slots_of
from jaxsid.physical.elements import element_matrices
from jaxsid.physical.motion import MotionTerm, ParameterTable
from jaxsid.records import Realization, Record, as_array

MOST_SUBSTEPS = 8  # of a fit
SLOW = 0.1  # part of a free motion's time constant that a window lasts
FEWEST = 8  # samples of a window


class Windows(NamedTuple):
    """How records are cut: samples of each window, whether that is the whole record, which sampling interval."""

    length: int
    whole: bool
    dt: float


def window_length(model: LumpedModel, records: Sequence[Record], window: float | None) -> list[Windows]:
    """Windows for each sampling interval that occurs.

    A whole record, where the system comes to rest by itself; on a free axis a tenth of its time constant, since there
    small disturbing forces drive a long simulation away from any measurement.

    Args:
        model: nominal.
        records: to be cut.
        window: length asked for, s; None to choose.
    """
    if window is None and free_bodies(model).shape[1]:
        plain = physical_displacement_velocity(second_order(model))
        rates = -np.linalg.eigvals(np.asarray(plain.A)).real
        slowest = rates[rates > 1e-9 * np.abs(rates).max(initial=0.0)].min(initial=np.inf)
        window = SLOW / slowest if np.isfinite(slowest) else None
    found = []
    for dt in dict.fromkeys(float(r.dt) for r in records):
        longest = max(len(r.y) for r in records if float(r.dt) == dt)
        length = longest if not window else min(max(round(window / dt), FEWEST), longest)
        found.append(Windows(length, length == longest, dt))
    return found


def lowest_frequency(model: LumpedModel) -> float:
    """Of the slowest vibration, Hz; infinite for a model that does not vibrate.

    Args:
        model: without its effects.
    """
    plain = physical_displacement_velocity(second_order(model))
    rates = np.abs(np.linalg.eigvals(np.asarray(plain.A)).imag)
    return float(rates[rates > 1e-6 * rates.max(initial=0.0)].min(initial=np.inf)) / (2 * np.pi)


def motion_term(model: LumpedModel, records: Sequence[Record], cut: Windows, *, rest: bool) -> MotionTerm:
    """Records of one sampling interval as a term, all weights one over the rms of the sensor.

    Args:
        model: nominal.
        records: all of them; those with another sampling interval are left out, but count in the numbers of records.
        cut: their windows.
        rest: whether they begin at rest.

    Raises:
        InputError: a record without the model's inputs or without any sensor, band-limited inputs.
    """
    chosen = [(i, r) for i, r in enumerate(records) if float(r.dt) == cut.dt]
    u, y, holds = zip(*(_channels(model, r) for _, r in chosen), strict=True)
    require(
        len(set(holds)) == 1,
        f"records with inputs held in different ways, {set(holds)}: refine against one kind.",
    )
    require(
        "band" not in holds[0],
        "models with effects are refined in time, between samples that are held: give the inputs a hold of 'zero' or "
        "'first', which for an input sampled ten times faster than it varies is as good.",
    )
    counts = [-(-len(x) // cut.length) for x in y]
    record = np.repeat(np.arange(len(y)), counts)
    first = np.concatenate([cut.length * np.arange(n) for n in counts])
    padded = max(counts) * cut.length
    forces = np.stack([np.pad(x, ((0, padded - len(x)), (0, 0)), mode="edge") for x in u])
    whole = np.stack([np.pad(x, ((0, padded - len(x)), (0, 0)), constant_values=np.nan) for x in y])
    rows = first[:, None] + np.arange(cut.length)
    parts = whole[record[:, None], rows]
    size = np.sqrt(np.nanmean(whole**2, axis=(0, 1)))
    seen = np.isfinite(parts)
    weight = seen / np.where(size > 0, size, 1.0)
    weight[:, : _skipped(model, cut), :] *= 1.0 if cut.whole else 0.0
    slots, dt = slots_of(model), as_array(np.asarray(cut.dt))
    ramps = as_array(np.array([h == "first" for h in holds[0]]))
    n = 2 * (len(model.bodies) + slots.count)
    states = np.zeros((len(parts), n))
    if not rest:
        plain = discretise(physical_displacement_velocity(second_order(model)), dt, hold=holds[0])
        near = _linear_states(plain, jnp.asarray(forces[record[:, None], rows]), jnp.asarray(parts))
        states[:, : 2 * len(model.bodies)] = np.nan_to_num(np.asarray(near))
    given = driven(model, as_array(u[0]), holds[0], dt, chosen[0][0])
    start = as_array(states[0])
    return MotionTerm(
        u=as_array(forces),
        y=as_array(np.nan_to_num(parts)),
        weight=as_array(weight),
        record=jnp.asarray(record),
        first=jnp.asarray(first),
        state=as_array(states),
        free=() if rest else tuple(_free_states(model)),
        kinds=tuple(np.asarray(slots.kinds).tolist()),
        color=as_array(np.eye(1, MOST + 1 if cut.whole else 1).repeat(len(model.sensors), axis=0)),
        ramps=ramps,
        dt=dt,
        slots=slots,
        table=parameter_table(model, [i for i, _ in chosen]),
        sensed=second_order(model),
        substeps=min(max(run_driven(given, start).substeps // 2, 1), MOST_SUBSTEPS),
    )


def _free_states(model: LumpedModel) -> list[int]:
    """Displacements, velocities, and the states that the effects have."""
    motion, slots = 2 * len(model.bodies), len(model.effects)
    own = [law_of(e.kind, e.parameters).states for e in model.effects]
    firsts = [motion + i for i, count in enumerate(own) if count > 0]
    return [*range(motion), *firsts, *(motion + slots + i for i, count in enumerate(own) if count > 1)]


def _channels(
    model: LumpedModel, record: Record
) -> tuple[Float[np.ndarray, "samples inputs"], Float[np.ndarray, "samples outputs"], tuple[str, ...]]:
    """Inputs and sensors in the model's order, NaN where a sensor is absent."""
    u, hold = ordered_inputs(model, record)
    rows, columns = measured_sensors(model, record)
    y = np.full((len(record.y), len(model.sensors)), np.nan)
    y[:, rows] = np.asarray(record.y)[:, columns]
    return np.asarray(u), y, hold


def _skipped(model: LumpedModel, cut: Windows) -> int:
    """Samples at the start of a window that late sensors take from before it."""
    late = [
        float(np.max(np.asarray(e.parameters["delay"]))) for e in model.effects if e.kind == "sensor_delay"
    ]
    return min(int(np.ceil(2 * max(late, default=0.0) / cut.dt)), cut.length // 2)


@compiled
def _linear_states(
    plain: Realization, u: Float[Array, "windows length inputs"], y: Float[Array, "windows length outputs"]
) -> Float[Array, "windows n"]:
    """Initial states of windows that fit them best without effects, every column of equal size."""
    n, length = len(plain.A), y.shape[1]
    free = jnp.swapaxes(powers(plain.A.T, plain.C.T, length), 1, 2).reshape(-1, n)

    def one(u: Array, y: Array) -> Array:
        left = (y - run(plain.A, plain.B, plain.C, plain.D, u, jnp.zeros(n, y.dtype))).ravel()
        system = jnp.where(jnp.isfinite(left)[:, None], free, 0.0)
        norms = jnp.linalg.norm(system, axis=0)
        scale = 1 / jnp.where(norms > 0, norms, 1.0)
        solved = jnp.linalg.lstsq(system * scale, jnp.where(jnp.isfinite(left), left, 0.0), rcond=1e-8)[0]
        return scale * solved

    return jax.vmap(one)(u, y)


def parameter_table(model: LumpedModel, numbers: Sequence[int]) -> ParameterTable:
    """Where the parameters of a model's effects come from.

    Args:
        model: with effects; its unknowns are those of `element_matrices` with effects.
        numbers: of the records, for parameters of which there is one a record.
    """
    shape = (len(numbers), len(model.effects), MOST_PARAMETERS)
    index, at = np.full(shape, -1), len(element_matrices(model).listed)
    for slot, effect in enumerate(model.effects):
        names = [p.name for p in law_of(effect.kind, effect.parameters).parameters]
        for name, value in effect.parameters.items():
            size = np.size(np.asarray(value))
            index[:, slot, names.index(name)] = at + np.minimum(numbers, size - 1)
            at += size
    rows = [[parameter_row(e.kind, e.parameters, i) for e in model.effects] for i in numbers]
    return ParameterTable(np.asarray(rows, float).reshape(shape), index)
