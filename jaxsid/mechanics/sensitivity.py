"""Motion of a model with effects in many windows side by side, together with its slopes in all directions.

What `nonlinear` computes for one record, marched once for all windows and directions: x' and every dx' go through
the same matrices as columns of one product. A law is evaluated where the motion is and its few slopes there are
multiplied into every direction. Of the linear part only matrices are needed, so that one program, apart from this one,
prepares them for all sorts of laws.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsid.mechanics.augmented import augmented
from jaxsid.mechanics.dry_friction import friction, holding
from jaxsid.mechanics.effects.catalogue import LAWS, Sorted, slips, sort_of
from jaxsid.mechanics.effects.kind import Kind, Motion
from jaxsid.mechanics.functions_of_matrices import less_identity_by_squaring
from jaxsid.mechanics.held_input import parabola_over_step, value_at_sample
from jaxsid.mechanics.input_lines import Arrival, direct_of_lines, input_lines, of_lines
from jaxsid.mechanics.integrate import moved_by, pushed, step_of
from jaxsid.mechanics.nonlinear import Scaled, scaled_inputs
from jaxsid.mechanics.slots import Slots
from jaxsid.records import SecondOrderModel


class LinearPart(NamedTuple):
    """All that a march needs of the linear part, or its slopes, with their directions as the last axis.

    Attributes:
        step: (n + 9 slots, n + 3 inputs) from state and input's parabola: the state at the end, and what laws see at
            the start, in the middle, at the end, without forces.
        stages: (4, 3 slots, 8 slots) what forces of earlier stages do to what is seen at each.
        weights: (n, 8 slots) of the forces of all stages.
        rubs: (n, slots) what a mean force of dry friction does to the state.
        give: (slots, slots) what it takes off the speeds over the step.
        spring: (slots,) stiffness that the model has at each place.
        pull: (slots, n + inputs + 2 slots) relative accelerations from state, inputs, forces.
        read: (outputs, n + 4 slots) readings so long after the sample as a late sensor needs, from the state, mean
            forces over the interval and forces at its start.
        after: (outputs, 2 slots) likewise, from forces at its end.
        still: (outputs, n) readings of the state at once.
        direct: (outputs, 4 inputs) likewise, from the inputs' parabola up to then, and their value then.
        offset: (outputs,) added to readings.
        part: (outputs,) of an interval, how long after the sample is read.
        back: (outputs,) how many intervals before.
        inputs: limits, gains and delays of the inputs.
    """

    step: Array
    stages: Array
    weights: Array
    rubs: Array
    give: Array
    spring: Array
    pull: Array
    read: Array
    after: Array
    still: Array
    direct: Array
    offset: Array
    part: Array
    back: Array
    inputs: Scaled


PRODUCTS = (
    "step",
    "stages",
    "weights",
    "rubs",
    "pull",
    "read",
    "after",
    "still",
)  # matrices that columns go through


class Marched(NamedTuple):
    """Readings with their slopes, and forces.

    Attributes:
        outputs: (samples, outputs, 1 + directions, windows) readings, then slopes.
        forces: (samples, slots, windows) of each effect at the sampling instants.
        ends: (n, 1 + directions, windows) states at the sample that was asked for, then their slopes.
    """

    outputs: Float[Array, "samples outputs columns windows"]
    forces: Float[Array, "samples slots windows"]
    ends: Float[Array, "n columns windows"]


def linear_part(linear: SecondOrderModel, slots: Slots, dt: Array, substeps: Array) -> LinearPart:
    """The linear part for steps of one length.

    Args:
        linear: M, D, K, inputs and sensors without effects.
        slots: the effects.
        dt: sampling interval, s.
        substeps: steps for each sampling interval.
    """
    system = augmented(linear, slots)
    count, ports, h = slots.count, 2 * slots.count, dt / substeps
    change = system.changed
    delay = change.delay @ slots.sensors / dt
    back = jnp.ceil(delay)
    part = back - delay
    times = jnp.concatenate([jnp.stack([h, h / 2]), part * dt])
    # its slopes are many, all forwards
    moved = moved_by(system, times, less_identity_by_squaring)
    step = step_of(system, moved)
    none = jnp.zeros_like(step.middle)
    of_stages = (
        (none, none, none, none),
        (step.middle, none, none, none),
        (none, step.middle, none, none),
        (step.carried - step.middle, none, 2 * step.middle, none),
    )
    start, half, end = jnp.split(step.weights, 3, axis=1)
    speeds = system.seen[count : 2 * count]
    whole, *read = (jnp.einsum("on,onk->ok", system.C, x[2:]) for x in moved)
    direct = jnp.stack([*(x[:, ports:] for x in pushed(read, 1.0)), system.D], axis=1)
    now, after = (x[:, None] * system.F for x in (1 - part, part))
    gain = (1 + change.gain @ slots.sensors)[:, None]
    return LinearPart(
        step.linear,
        jnp.stack([jnp.concatenate(x, axis=1) for x in of_stages]),
        jnp.concatenate([start, half, half, end], axis=1),
        step.rubs,
        -speeds @ step.rubs,
        system.spring,
        speeds @ jnp.concatenate([system.A, system.B, system.G], axis=1),
        gain * jnp.concatenate([whole, read[0][:, :ports], now], axis=1),
        gain * after,
        gain * system.C,
        (gain[:, None] * direct).reshape(len(gain), -1),
        change.offset @ slots.sensors,
        part,
        back,
        scaled_inputs(system, slots, dt),
    )


class Windows(NamedTuple):
    """Pieces of records side by side.

    Attributes:
        u: inputs, `lead` samples more than readings are wanted of.
        ramps: which are held to first order.
        lead: samples of the inputs that come before.
        dt: sampling interval, s.
        first: numbers of the first sample in the record.
        states: to begin with, n of the bodies' and effects' own.
        end: number of the sample, from the start of a window, whose states are wanted.
    """

    u: Float[Array, "windows samples inputs"]
    ramps: Bool[Array, " inputs"]
    lead: int
    dt: Float[Array, ""]
    first: Int[Array, " windows"]
    states: Float[Array, "windows n"]
    end: int


class Laws(NamedTuple):
    """Effects as of each window.

    Attributes:
        kinds: numbers and sorts.
        parameters: of the effects.
        slopes: of the parameters, by p unknowns.
    """

    kinds: Sorted
    parameters: Float[Array, "slots most windows"]
    slopes: Float[Array, "slots most p windows"]


class _March(NamedTuple):
    """What stays the same on the way: linear part, its slopes, effects, arrival, times, speeds as of the state.

    Slopes of `PRODUCTS` have p as their last axis but one.
    """

    own: LinearPart
    slopes: LinearPart
    laws: Laws
    arrival: Arrival
    dt: Array
    substeps: Array
    speeds: Array


class _Row(NamedTuple):
    """Of one sample: columns of the lines that inputs follow, from `input_lines`, and its numbers.

    `last` is 1 where its states are wanted.
    """

    lines: Array
    numbers: Array
    last: Array


class _At(NamedTuple):
    """On the way: columns of states, which way dry friction slides, mean forces, forces at the sample."""

    Z: Array
    sliding: Array
    mean: Array
    begun: Array


def marched(own: LinearPart, slopes: LinearPart, laws: Laws, windows: Windows, substeps: Array) -> Marched:
    """Readings of a model with effects in all windows, with slopes by p unknowns and by the initial states.

    Args:
        own: the linear part, from `linear_part`.
        slopes: its slopes by the unknowns.
        laws: the effects.
        windows: inputs and initial states.
        substeps: steps for each sampling interval, as of `linear_part`.
    """
    kinds, states = laws.kinds, windows.states
    (n, count), p = (states.shape[1], len(kinds)), slopes.part.shape[-1]
    # a step's start is seen the same however long it is
    speeds = own.step[n + count : n + 2 * count, :n]
    # before the loop, which would turn them round for each product
    along = {name: jnp.swapaxes(getattr(slopes, name), -1, -2) for name in PRODUCTS}
    slopes = slopes._replace(**along)
    lines, arrival = input_lines(own.inputs, slopes.inputs, windows.u, windows.ramps)
    lines = lines[windows.lead :]
    march = _March(own, slopes, laws, arrival, windows.dt, substeps, speeds)
    Z = jnp.zeros((n, 1 + p + n, len(states)), states.dtype).at[:, 0].set(states.T)
    Z = Z.at[:, 1 + p :].set(jnp.eye(n, dtype=Z.dtype)[:, :, None])
    # a speed that is nothing but rounding is rest
    speed, size = speeds @ states.T, 1e-12 * jnp.abs(speeds) @ jnp.abs(states.T)
    sliding = jnp.where(jnp.abs(speed) > size, jnp.sign(speed), 0.0)
    numbers = jnp.arange(len(lines))
    rows = _Row(lines, windows.first + numbers[:, None].astype(Z.dtype), numbers == windows.end)
    (*_, ends), (read, after, forces) = lax.scan(partial(_sample, march), (Z, sliding, Z), rows)
    # all samples are columns here
    flat = jnp.moveaxis(lines, 0, -1)
    direct = direct_of_lines((own.direct, slopes.direct), (own.part, slopes.part), arrival)
    driven = _through(*direct, flat.reshape(*flat.shape[:2], -1))
    driven = jnp.moveaxis(driven.reshape(len(driven), *flat.shape[1:]), -1, 0)
    outputs = read + jnp.concatenate([after[1:], after[-1:]]) + _wide(driven, n)
    if "linear" in kinds.sorts:
        # before the record there was rest
        at = jnp.arange(len(read))[:, None] - own.back.astype(int)
        rest = _through(own.still, slopes.still, Z)
        outputs = jnp.take_along_axis(outputs, jnp.maximum(at, 0)[:, :, None, None], axis=0)
        outputs = jnp.where((at < 0)[:, :, None, None], rest, outputs)
    offset = jnp.concatenate([own.offset[:, None], slopes.offset], axis=1)
    return Marched(outputs + _wide(offset[:, :, None], n), forces, ends)


def _sample(march: _March, carry: tuple, row: _Row) -> tuple[tuple, tuple]:
    """From one sampling instant to the next, and what is read there."""
    own, slopes, (kinds, *_) = march[:3]
    (Z, sliding, ends), count = carry, len(kinds)
    none = jnp.zeros((2 * count, *Z.shape[1:]), Z.dtype)
    begin = _At(Z, sliding, none, none)
    end = lax.fori_loop(0, march.substeps, lambda i, at: _substep(march, row, i, at), begin)
    begun = end.begun
    if "dry" in kinds.sorts:
        now = _wide(_through(*of_lines(lambda x: (value_at_sample(x),), march.arrival), row.lines), len(Z))
        gain = _through(own.pull, slopes.pull, jnp.concatenate([Z, now, begun]))
        at = own.pull.shape[1] - 2 * count
        give = -own.pull[:, at : at + count], -jnp.swapaxes(slopes.pull[..., at : at + count], -1, -2)
        force, _ = _contact(_resting, march.laws, (_product(march.speeds, Z), gain), give, sliding)
        begun = begun.at[:count].add(force)
    if set(kinds.sorts) == {"linear"}:
        read = _through(own.read[:, : len(Z)], slopes.read[..., : len(Z)], Z)
        after = jnp.zeros_like(read)
    else:
        read = _through(own.read, slopes.read, jnp.concatenate([Z, end.mean, begun]))
        after = _through(own.after, slopes.after, begun)
    return (end.Z, end.sliding, jnp.where(row.last, Z, ends)), (read, after, begun[:count, 0])


def _substep(march: _March, row: _Row, i: Array, at: _At) -> _At:
    own, slopes, laws = march[:3]
    Z, sliding, mean, begun = at
    n, count = len(Z), len(laws.kinds)
    begin, length = i / march.substeps, 1 / jnp.asarray(march.substeps, Z.dtype)
    push = _through(*of_lines(lambda x: parabola_over_step(x, begin, length), march.arrival), row.lines)
    Y = _through(own.step, slopes.step, jnp.concatenate([Z, _wide(push, n)]))
    Z1, seen = Y[:n], Y[n:].reshape(3, 3 * count, *Z.shape[1:])
    if "law" in laws.kinds.sorts:
        F = _stages(march, seen, march.dt * (row.numbers + begin), march.dt * length)
        Z1 = Z1 + _through(own.weights, slopes.weights, F)
        f0, fa, fb, f1 = F.reshape(4, 2 * count, *Z.shape[1:])
        begun = jnp.where(i == 0, f0, begun)
        mean = mean + (f0 + 2 * (fa + fb) + f1) / 6 * length
    if "dry" in laws.kinds.sorts:
        parts = seen[0, count : 2 * count], _product(march.speeds, Z1)
        force, sliding = _contact(_rubbing, laws, parts, (own.give, slopes.give), sliding)
        Z1 = Z1 + _through(own.rubs, slopes.rubs, force)
        mean = mean.at[:count].add(force * length)
    return _At(Z1, sliding, mean, begun)


def _product(matrix: Array, columns: Array) -> Array:
    """(m, k) by (k, columns, windows)."""
    return jnp.einsum("mk,kcw->mcw", matrix, columns)


def _through(matrix: Array, slopes: Array, columns: Array) -> Array:
    """(m, columns, windows): a matrix that has slopes, (m, p, k), by columns whose first is no slope."""
    moved = jnp.einsum("mpk,kw->mpw", slopes, columns[:, 0])
    after = columns.shape[1] - 1 - moved.shape[1]
    return _product(matrix, columns) + jnp.pad(moved, ((0, 0), (1, after), (0, 0)))


def _wide(columns: Array, n: int) -> Array:
    """With slopes of nothing by the initial states."""
    return jnp.pad(columns, (*[(0, 0)] * (columns.ndim - 2), (0, n), (0, 0)))


def _stages(march: _March, seen: Array, time: Array, h: Array) -> Array:
    """(8 slots, columns, windows) forces and rates of the four stages of a step.

    Args:
        seen: (3, 3 slots, columns, windows) at the start, in the middle, at the end, without forces.
        time: (windows,) at the start, s.
        h: length of the step, s.
    """
    own, slopes, laws = march[:3]
    ports = 2 * len(laws.kinds)

    def stage(F: Array, row: tuple) -> tuple[Array, None]:
        number, free, matrix, slope, since = row
        found = _ports(march, free + _through(matrix, slope, F), time + since * h)
        return lax.dynamic_update_slice_in_dim(F, found, number * ports, 0), None

    rows = (
        jnp.arange(4),
        seen[np.array([0, 1, 1, 2])],
        own.stages,
        slopes.stages,
        jnp.array([0.0, 0.5, 0.5, 1.0]),
    )
    # one after another in a loop, for the sake of a small program
    return lax.scan(stage, jnp.zeros((4 * ports, *seen.shape[2:]), seen.dtype), rows)[0]


def _slope_of(kind: Kind) -> Callable[..., tuple[Array, Array]]:
    """Of a kind: (2, windows) force and rate of memory, and (most + 4, 2, windows) slopes by all they depend on."""

    def found(
        parameters: Array, d: Array, v: Array, z: Array, spring: Array, time: Array
    ) -> tuple[Array, Array]:
        def law(*x: Array) -> Array:
            *own, d, v, z, spring = x
            motion = Motion(d, v, z, time, spring)
            values = (f(motion, *own) if f else jnp.zeros_like(d) for f in (kind.force, kind.rate))
            return jnp.stack([jnp.broadcast_to(y, d.shape) for y in values])

        count = len(kind.parameters)
        value, back = jax.vjp(law, *parameters[:count], d, v, z, jnp.broadcast_to(spring, d.shape))
        one, none = jnp.ones_like(d), jnp.zeros_like(d)
        by_both = zip(back(jnp.stack([one, none])), back(jnp.stack([none, one])), strict=True)
        along = [jnp.stack(x) for x in by_both]
        padding = [jnp.zeros_like(value)] * (len(parameters) - count)
        return value, jnp.stack([*along[:count], *padding, *along[count:]])

    return found


NUMBERS = [number for number, kind in enumerate(LAWS.values()) if sort_of(kind) == "law"]
BRANCH = np.searchsorted(NUMBERS, np.arange(len(LAWS)))  # of each kind that is a law
BRANCHES = [_slope_of(list(LAWS.values())[number]) for number in NUMBERS]


def _ports(march: _March, seen: Array, time: Array) -> Array:
    """(2 slots, columns, windows) forces and rates of memory.

    Args:
        seen: (3 slots, columns, windows).
        time: (windows,), s.
    """
    kinds, parameters, slopes = march.laws
    spring, spring_slopes = march.own.spring, march.slopes.spring
    count, most, p = slopes.shape[:3]
    found = jnp.zeros((2, count, *seen.shape[1:]), seen.dtype)
    for a in range(count):
        if kinds.sorts[a] != "law":
            continue
        own = seen[a::count]
        # of all laws only one is computed
        branch = jnp.asarray(BRANCH)[kinds.numbers[a]]
        value, slope = lax.switch(branch, BRANCHES, parameters[a], *own[:, 0], spring[a], time)
        slope = slope[:, :, None]
        moved = slope[most] * own[0, 1:] + slope[most + 1] * own[1, 1:] + slope[most + 2] * own[2, 1:]
        few = (slope[:most] * slopes[a, :, None]).sum(axis=0) + slope[-1] * spring_slopes[a][:, None]
        moved = moved.at[:, :p].add(few)
        found = found.at[:, a].set(jnp.concatenate([value[:, None], moved], axis=1))
    return found.reshape(2 * count, *seen.shape[1:])


def _rubbing(laws: Laws, v: Array, sliding: Array) -> tuple[Array, Array]:
    """Mean dry friction over a step in one window, and which way it slides then."""
    before, free, rows, give = _split(v, laws)
    found = friction(laws.kinds, rows, before, sliding, free, give)
    return found.force, found.sliding


def _resting(laws: Laws, v: Array, sliding: Array) -> tuple[Array, Array]:
    """Dry friction at an instant in one window, at rest in balance with all other forces."""
    speed, gain, rows, give = _split(v, laws)
    slides = sliding * slips(laws.kinds, rows, jnp.abs(speed))
    return slides + holding(laws.kinds, rows, sliding == 0, gain - give @ slides, give), sliding


def _split(v: Array, laws: Laws) -> tuple[Array, Array, Array, Array]:
    count, most = laws.parameters.shape[:2]
    one, two, rows, give = jnp.split(v, np.cumsum([count, count, count * most]))
    return one, two, rows.reshape(count, most), give.reshape(count, count)


def _contact(
    of: Callable[[Laws, Array, Array], tuple[Array, Array]],
    laws: Laws,
    parts: tuple[Array, Array],
    give: tuple[Array, Array],
    sliding: Array,
) -> tuple[Array, Array]:
    """Dry friction, (slots, columns, windows), and which way it slides then, (slots, windows).

    Args:
        of: both of one window, from the numbers below.
        parts: (slots, columns, windows), two that it depends on besides parameters and give.
        give: (slots, slots) what a unit of force takes off the second of them, and its slopes.
        sliding: (slots, windows).
    """
    n = parts[0].shape[1] - 1 - laws.slopes.shape[2]
    steady = jnp.concatenate([give[0][:, :, None], give[1]], axis=2)[..., None]
    steady = jnp.broadcast_to(steady, (*steady.shape[:3], sliding.shape[1]))
    rows = jnp.concatenate([laws.parameters[:, :, None], laws.slopes], axis=2)
    v = jnp.concatenate([*parts, *(_wide(x.reshape(-1, *x.shape[2:]), n) for x in (rows, steady))])

    def one(v: Array, sliding: Array) -> tuple[Array, tuple[Array, Array]]:
        force, now = of(laws, v, sliding)
        return force, (force, now)

    each = jax.vmap(jax.jacfwd(one, has_aux=True), in_axes=1, out_axes=(0, 1))
    slope, (force, now) = each(v[:, 0], sliding)
    # slopes are computed once for all columns: a product is not merged with what makes its factors
    moved = jnp.einsum("wsk,kcw->scw", slope, v[:, 1:])
    return jnp.concatenate([force[:, None], moved], axis=1), now
