"""Motion of a lumped model with effects: exact where linear, fourth order for forces, event by event for friction.

Runge and Kutta's method with the matrix exponential (S. Cox and P. Matthews, J. Comput. Phys. 176, 2002, eq. 26-29), in
which the laws' forces enter through few ports only; dry friction acts on top, with its mean over each step.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsid.mechanics.augmented import Augmented
from jaxsid.mechanics.dry_friction import acting, friction, holding
from jaxsid.mechanics.effects.catalogue import forces, possible, rates, slips
from jaxsid.mechanics.effects.kind import Motion
from jaxsid.mechanics.functions_of_matrices import less_identity_by_phi
from jaxsid.mechanics.held_input import Late, parabola_over_step
from jaxsid.mechanics.slots import Slots


class Path(NamedTuple):
    """Motion at the sampling instants.

    Attributes:
        states: (samples, n).
        sliding: (samples, slots) which way dry friction slides, 0 where it holds.
        mean_force: (samples, ports) of every port over the sampling interval that begins there.
    """

    states: Float[Array, "samples n"]
    sliding: Float[Array, "samples slots"]
    mean_force: Float[Array, "samples ports"]


class Step(eqx.Module):
    """Matrices of one step; everything that the linear part does is in the first product.

    Attributes:
        linear: (n + 9 slots, n + 3 inputs) from state and input's parabola: the state at the end, and what the laws
            see at the start, in the middle and at the end, without forces.
        middle, carried: (3 slots, ports) what forces of the first half do to what is seen in the middle, at the end.
        weights: (n, 3 ports) of the forces at the start, of the two in the middle together, at the end.
        rubs: (n, slots) what a mean force does to the state.
        give: (slots, slots) what a unit of each mean force takes off each speed.
    """

    linear: Array
    middle: Array
    carried: Array
    weights: Array
    rubs: Array
    give: Array


def phi_columns(
    A: Array, columns: Array, h: Array, less_identity: Callable[[Array], Array] = less_identity_by_phi
) -> tuple[Array, Array, Array, Array]:
    """e^(A h), and h phi_k(A h) times columns for k = 1, 2, 3, all from one exponential.

    Args:
        A: (n, n).
        columns: (n, count).
        h: time, s.
        less_identity: e^L - I of a matrix; this one can be differentiated backwards.
    """
    n, count = columns.shape
    top = jnp.concatenate([A * h, columns * h, jnp.zeros((n, 2 * count), A.dtype)], axis=1)
    shift = jnp.eye(3 * count, n + 3 * count, n + count, dtype=A.dtype)
    whole = jnp.concatenate([top, shift])
    found = jnp.eye(len(whole), dtype=A.dtype) + less_identity(whole)
    parts = (found[:n, n + k * count : n + (k + 1) * count] for k in range(3))
    one, two, three = parts
    return found[:n, :n], one, two, three


def moved_by(
    system: Augmented,
    times: Float[Array, " k"],
    less_identity: Callable[[Array], Array] = less_identity_by_phi,
) -> tuple[Array, Array, Array, Array]:
    """`phi_columns` of all ports, then all inputs, for several times at once, which makes a short program.

    Args:
        system: from `augmented`.
        times: s.
        less_identity: as of `phi_columns`.
    """
    columns = jnp.concatenate([system.G, system.B], axis=1)
    return jax.vmap(lambda h: phi_columns(system.A, columns, h, less_identity))(times)


def pushed(moved: Sequence[Array], share: float) -> tuple[Array, Array, Array]:
    """What each part of the parabola of `parabola_over_step` has done to the state after a share of the step.

    Args:
        moved: h phi_k(A h) B for k = 1, 2, 3, with h that share.
        share: of the step.
    """
    one, two, three = moved
    return one, share * two, 12 * share**2 * three - 6 * share * two + one


def step_of(system: Augmented, moved: tuple[Array, Array, Array, Array]) -> Step:
    """Matrices of one step.

    Args:
        system: from `augmented`.
        moved: from `moved_by`, the first two times a step and half of it.
    """
    seen, ports, inputs = system.seen, system.G.shape[1], system.B.shape[1]
    slots = ports // 2
    whole, one, two, three = (x[0] for x in moved)
    half, *of_half = (x[1] for x in moved)
    end = jnp.concatenate([whole, *(x[:, ports:] for x in pushed((one, two, three), 1.0))], axis=1)
    middle = jnp.concatenate([half, *(x[:, ports:] for x in pushed(of_half, 0.5))], axis=1)
    start = jnp.concatenate([seen, jnp.zeros((3 * slots, 3 * inputs), seen.dtype)], axis=1)
    G1, G2, G3 = (x[:, :ports] for x in (one, two, three))
    first_half = of_half[0][:, :ports]
    return Step(
        linear=jnp.concatenate([end, start, seen @ middle, seen @ end]),
        middle=seen @ first_half,
        carried=seen @ half @ first_half,
        weights=jnp.concatenate([G1 - 3 * G2 + 4 * G3, 2 * G2 - 4 * G3, 4 * G3 - G2], axis=1),
        rubs=G1[:, :slots],
        give=-seen[slots : 2 * slots] @ G1[:, :slots],
    )


def _apply(matrix: Array, x: Array) -> Array:
    """A product of few numbers, written so that it joins the loop's other arithmetic in one kernel."""
    return (matrix * x).sum(axis=-1)


def _ports(slots: Slots, spring: Array, seen: Array, time: Array) -> Array:
    """Forces and rates of memory."""
    d, v, z = jnp.split(seen, 3)
    motion = Motion(d, v, z, time, spring)
    found = (law(slots.kinds, slots.parameters, motion) for law in (forces, rates))
    # once for all that use it, not again for each of their entries
    return lax.optimization_barrier(jnp.concatenate(list(found)))


def integrate(
    system: Augmented,
    slots: Slots,
    late: Late,
    dt: Array,
    state: Float[Array, " n"],
    substeps: int | Array,
    first: int | Array = 0,
) -> Path:
    """Motion from a state at the first sample.

    Args:
        system: linear part and ports.
        slots: the effects.
        late: the inputs between samples.
        dt: sampling interval, s.
        state: to begin with.
        substeps: steps for each sampling interval; a traced number costs reverse differentiation.
        first: number of the first sample in the record.
    """
    h, length = dt / substeps, 1 / jnp.asarray(substeps, state.dtype)
    step = step_of(system, moved_by(system, jnp.stack([h, h / 2])))

    def sample(carry: tuple, row: Array) -> tuple[tuple, tuple[Array, Array]]:
        x, sliding = carry

        def one(i: Array, carry: _Carry) -> _Carry:
            return _advance(system, slots, step, dt, row, (i * length, length), carry)

        begin = _Carry(x, sliding, jnp.zeros(2 * slots.count, x.dtype))
        x1, after, mean = lax.fori_loop(0, substeps, one, begin)
        # the mean by itself: few ask for it, and where none does it is not computed
        return (x1, after), (jnp.concatenate([x, sliding]), mean)

    begin = state, _sliding_at(system, slots, state)
    _, (found, mean) = lax.scan(sample, begin, _rows(late, first, state))
    return _path(found, mean, system)


def integrate_twice(
    system: Augmented, slots: Slots, late: Late, dt: Array, state: Float[Array, " n"]
) -> tuple[Path, Path]:
    """The motions of `integrate` with one step and with two for each sample, in the time of two.

    The one step is taken beside the second of the two: what a loop costs is its turns, not its arithmetic.

    Args:
        system: linear part and ports.
        slots: the effects.
        late: the inputs between samples.
        dt: sampling interval, s.
        state: to begin with.
    """
    begins, lengths = jnp.asarray([0.0, 0.5], state.dtype), jnp.asarray([1.0, 0.5], state.dtype)
    steps = jax.vmap(lambda h: step_of(system, moved_by(system, jnp.stack([h, h / 2]))))(lengths * dt)
    half = jax.tree.map(lambda x: x[1], steps)

    def sample(carry: tuple, row: Array) -> tuple[tuple, tuple[Array, Array]]:
        x, sliding = carry
        still = jnp.zeros((2, 2 * slots.count), x.dtype)
        one, two = (_Carry(x[i], sliding[i], still[i]) for i in range(2))
        two = _advance(system, slots, half, dt, row, (begins[0], lengths[1]), two)

        def last(step: Step, begin: Array, length: Array, carry: _Carry) -> _Carry:
            return _advance(system, slots, step, dt, row, (begin, length), carry)

        both = jax.tree.map(lambda *x: jnp.stack(x), one, two)
        x1, after, mean = jax.vmap(last)(steps, begins, lengths, both)
        return (x1, after), (jnp.concatenate([x, sliding], axis=1), mean)

    begin = (jnp.stack([x, x]) for x in (state, _sliding_at(system, slots, state)))
    _, (found, mean) = lax.scan(sample, tuple(begin), _rows(late, 0, state))
    one, two = (_path(found[:, i], mean[:, i], system) for i in range(2))
    return one, two


class _Carry(NamedTuple):
    """State, which way each place slides, and sum so far of the ports' mean forces."""

    x: Array
    sliding: Array
    total: Array


def _advance(
    system: Augmented,
    slots: Slots,
    step: Step,
    dt: Array,
    row: Array,
    part: tuple[Array, Array],
    carry: _Carry,
) -> _Carry:
    """One step, which begins and lasts the two given parts of the sample of a row."""
    x, sliding, total = carry
    # else each number that a law needs is computed before the loop, and every kernel is handed dozens of arrays
    arrays, known = eqx.partition(slots, eqx.is_array)
    x, row, arrays = lax.optimization_barrier((x, row, arrays))
    slots = eqx.combine(arrays, known)
    begin, length = part
    n, count, inputs = len(system.A), slots.count, system.B.shape[1]
    speeds, h = system.seen[count : 2 * count], length * dt
    push = parabola_over_step(Late(*row[:-1].reshape(5, inputs)), begin, length)
    time = dt * (row[-1] + begin)
    free = _apply(step.linear, jnp.concatenate([x, *push]))
    ahead, w0, wm, w1 = jnp.split(free, [n, n + 3 * count, n + 6 * count])
    law = partial(_ports, slots, system.spring)
    x1, mean = ahead, jnp.zeros_like(total)
    if any(kind.force is not None for kind in possible(slots.kinds)):
        f0 = law(w0, time)
        fa = law(wm + _apply(step.middle, f0), time + h / 2)
        fb = law(wm + _apply(step.middle, fa), time + h / 2)
        late_half = _apply(step.middle, 2 * fb - f0)
        f1 = law(w1 + _apply(step.carried, f0) + late_half, time + h)
        x1 = x1 + _apply(step.weights, jnp.concatenate([f0, fa + fb, f1]))
        mean = (f0 + 2 * (fa + fb) + f1) / 6
    if acting(slots.kinds):
        before, free = w0[count : 2 * count], _apply(speeds, x1)
        force, sliding = friction(slots.kinds, slots.parameters, before, sliding, free, step.give)
        x1, mean = x1 + _apply(step.rubs, force), mean.at[:count].add(force)
    return _Carry(x1, sliding, total + mean * length)


def _rows(late: Late, first: int | Array, state: Array) -> Array:
    """One row a sample goes in, one comes out: each access costs as much as the arithmetic."""
    arrival = jnp.broadcast_to(late.arrival, late.new.shape)
    numbers = first + jnp.arange(len(late.new), dtype=state.dtype)
    return jnp.concatenate([*late[:4], arrival, numbers[:, None]], axis=1)


def _path(found: Array, mean: Array, system: Augmented) -> Path:
    states, sliding = jnp.split(found, [len(system.A)], axis=1)
    return Path(states, sliding, mean)


def _sliding_at(system: Augmented, slots: Slots, state: Array) -> Array:
    """Which way each place slides at first; a speed that is nothing but rounding is rest."""
    speeds = system.seen[slots.count : 2 * slots.count]
    size = 1e-12 * jnp.abs(speeds) @ jnp.abs(state)
    relative = speeds @ state
    return jnp.where(jnp.abs(relative) > size, jnp.sign(relative), 0.0)


def instant_forces(
    system: Augmented,
    slots: Slots,
    path: Path,
    u: Float[Array, "samples inputs"],
    dt: Array,
    first: int | Array = 0,
) -> Float[Array, "samples ports"]:
    """Forces at the sampling instants, friction where it holds in balance with all others.

    Args:
        system: linear part and ports.
        slots: the effects.
        path: from `integrate`.
        u: inputs at the sampling instants.
        dt: sampling interval, s.
        first: number of the first sample in the record.
    """
    count = slots.count
    speeds = system.seen[count : 2 * count]
    give = -speeds @ system.G[:, :count]

    def at(x: Array, sliding: Array, pushed: Array, number: Array) -> Array:
        seen = system.seen @ x
        speed = seen[count : 2 * count]
        force = _ports(slots, system.spring, seen, dt * number)
        rubs = sliding * slips(slots.kinds, slots.parameters, jnp.abs(speed))
        force = force.at[:count].add(rubs)
        gain = speeds @ (system.A @ x + system.B @ pushed + system.G @ force)
        return force.at[:count].add(holding(slots.kinds, slots.parameters, sliding == 0, gain, give))

    return jax.vmap(at)(path.states, path.sliding, u, first + jnp.arange(len(u), dtype=u.dtype))
