"""What raw records say of a model with effects: simulated motion in windows, each from the initial state that fits.

A window is a whole record, or a part of it where small disturbing forces would drive a long simulation away, as they do
on a free axis. Its initial state is found anew for every set of values (G. Golub and V. Pereyra, SIAM J. Numer. Anal.
10, 1973), so that only the model's values are unknowns.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsid.mechanics.augmented import augmented
from jaxsid.mechanics.held_input import Late
from jaxsid.mechanics.nonlinear import forced, respond_to
from jaxsid.mechanics.slots import Slots
from jaxsid.physical.elements import LinearMatrices
from jaxsid.physical.parameterization import Matrix
from jaxsid.records import SecondOrderModel

ROUNDS = 2  # of the search for the initial states, beside the last linear one
SHORTER = 0.25  # part of a step that did not help
BLIND_STATE = 1e-9  # of scaled J'J: directions of an initial state that leave no trace


class ParameterTable(eqx.Module):
    """Where the parameters of effects come from: values of unknowns, or constants.

    Attributes:
        constant: (records, slots, most).
        index: (records, slots, most) of the value that takes its place, -1 for none.
    """

    constant: Matrix
    index: Matrix

    def parameters(self, values: Float[Array, " e"]) -> Float[Array, "records slots most"]:
        return jnp.where(self.index >= 0, values[jnp.maximum(self.index, 0)], self.constant)


class MotionTerm(eqx.Module):
    """Records of one sampling interval, in windows.

    Attributes:
        u: (records, samples, inputs) in the model's order, the last sample repeated after the end.
        y: (windows, length, outputs) measured.
        weight: (windows, length, outputs) one over the noise, 0 where nothing was measured.
        record: (windows,) that each window is of.
        first: (windows,) number of its first sample.
        state: (windows, n) initial states to begin with.
        free: which of them vary; none of windows that begin at rest.
        color: (outputs, order + 1) coefficients, the first 1, that make the noise white.
        ramps: (inputs,) which are held to first order.
        dt: sampling interval, s.
        slots: effects, with places that count; kinds and parameters do not.
        table: where the parameters come from.
        sensed: gives the input matrix and the sensors.
        kinds: of the effects.
        substeps: steps for each sampling interval.
    """

    u: Float[Array, "records samples inputs"]
    y: Float[Array, "windows length outputs"]
    weight: Float[Array, "windows length outputs"]
    record: Int[Array, " windows"]
    first: Int[Array, " windows"]
    state: Float[Array, "windows n"]
    color: Float[Array, "outputs taps"]
    ramps: Bool[Array, " inputs"]
    dt: Float[Array, ""]
    slots: Slots
    table: ParameterTable
    sensed: SecondOrderModel
    free: tuple[int, ...] = eqx.field(static=True)
    kinds: tuple[int, ...] = eqx.field(static=True)
    substeps: int = eqx.field(static=True)

    @property
    def equations(self) -> Array:
        return (counted(self.weight, self.color) > 0).sum()

    def left(self, unknowns: LinearMatrices, theta: Array) -> "Left":
        """What the model leaves of every window, its initial state the best one.

        Args:
            unknowns: what theta means.
            theta: unknowns.
        """

        def improved(_: Array, found: tuple) -> tuple:
            states, difference, move, cost, part = found
            candidate = states - self._moved(part[:, None] * move)
            new = self._slopes(unknowns, theta, candidate, jnp.zeros((len(theta), 0), theta.dtype))
            cost_new = (new.residual**2).sum(axis=1)
            better = (cost_new < cost)[:, None]
            move = jnp.where(better, _product(_pseudo_inverse(new.of_states), new.residual), move)
            part = jnp.where(better[:, 0], 1.0, SHORTER * part)
            states = jnp.where(better, candidate, states)
            difference = jnp.where(better[:, None], new.difference, difference)
            return states, difference, move, jnp.minimum(cost, cost_new), part

        # what the rounds leave is kept: to simulate the best states once more is to compile the simulation twice
        windows, free = len(self.state), len(self.free)
        nothing, unknown = jnp.zeros((windows, free), theta.dtype), jnp.full_like(self.y, jnp.nan)
        start = (self.state, unknown, nothing, jnp.full(windows, jnp.inf), jnp.ones(windows, theta.dtype))
        states, difference, _, _, _ = lax.fori_loop(0, 2 * ROUNDS, improved, start)
        return Left(difference, states)

    def projected(self, unknowns: LinearMatrices, theta: Array) -> tuple[Array, Array]:
        """Weighted residual (windows, k) and its Jacobian (windows, k, p), both without what initial states explain.

        Args:
            unknowns: what theta means.
            theta: unknowns.
        """
        every = jnp.eye(len(theta), dtype=theta.dtype)

        # all rounds are of one kind, so that the simulation is compiled once; a step that does not help is cut short
        def improved(_: Array, found: tuple) -> tuple:
            states, r, j, slopes, inverse, cost, part = found
            candidate = states - self._moved(part[:, None] * _product(inverse, r))
            _, r_new, j_new, slopes_new = self._slopes(unknowns, theta, candidate, every)
            cost_new = (r_new**2).sum(axis=1)
            better = cost_new < cost
            new = (candidate, r_new, j_new, slopes_new, _pseudo_inverse(j_new), cost_new, jnp.ones_like(part))
            old = (states, r, j, slopes, inverse, cost, SHORTER * part)
            keep = lambda x, y: jnp.where(better.reshape(-1, *[1] * (x.ndim - 1)), x, y)  # noqa: E731
            return tuple(map(keep, new, old))

        windows, size = len(self.state), self.y[0].size
        shapes = (size,), (size, len(self.free)), (size, len(theta)), (len(self.free), size)
        nothing = (jnp.zeros((windows, *x), theta.dtype) for x in shapes)
        start = (self.state, *nothing, jnp.full(windows, jnp.inf), jnp.ones(windows, theta.dtype))
        _, r, j, slopes, inverse, _, _ = lax.fori_loop(0, ROUNDS + 1, improved, start)
        r = r - jnp.einsum("wkn,wn->wk", j, _product(inverse, r))
        return r, slopes - jnp.einsum("wkn,wnp->wkp", j, jnp.einsum("wnk,wkp->wnp", inverse, slopes))

    def _slopes(
        self, unknowns: LinearMatrices, theta: Array, states: Array, along: Float[Array, "p directions"]
    ) -> "_Slopes":
        """What is left, and how it changes with the initial states, and with theta along some directions."""
        free = len(self.free)

        def residual(move: Array) -> tuple[Array, tuple[Array, Array]]:
            moved = theta + along @ move[free:]
            left = self.simulated(unknowns, moved, states + self._moved(move[:free])) - self.y
            r = self._weighted(left)
            return r, (left, r)

        nothing = jnp.zeros(free + along.shape[1], states.dtype)
        j, (left, r) = jax.jacfwd(residual, has_aux=True)(nothing)
        return _Slopes(left, r, j[..., :free], j[..., free:])

    def simulated(self, unknowns: LinearMatrices, theta: Array, states: Array) -> Array:
        """(windows, length, outputs).

        Args:
            unknowns: what theta means.
            theta: unknowns.
            states: (windows, n) initial ones.
        """
        mass, damping, stiffness = unknowns.matrices(theta)
        at = lambda s: (s.mass, s.damping, s.stiffness)  # noqa: E731
        linear = eqx.tree_at(at, self.sensed, (mass, damping, stiffness))
        parameters = self.table.parameters(unknowns.values(theta))
        length = self.y.shape[1]

        def slots_with(values: Array) -> Slots:
            kinds = np.array(self.kinds, np.int32)
            return eqx.tree_at(lambda s: (s.kinds, s.parameters), self.slots, (kinds, values))

        def of_record(values: Array, u: Array) -> Late:
            slots = slots_with(values)
            return forced(augmented(linear, slots), slots, u, self.ramps, self.dt)

        late = jax.vmap(of_record)(parameters, self.u)

        def window(record: Array, first: Array, state: Array) -> Array:
            own = slots_with(parameters[record])
            cut = [lax.dynamic_slice_in_dim(x[record], first, length) for x in late[:4]]
            part = Late(cut[0], cut[1], cut[2], cut[3], late.arrival[record])
            system = augmented(linear, own)
            return respond_to(system, own, part, self.dt, state, self.substeps, first).outputs

        return jax.vmap(window)(self.record, self.first, states)

    def _moved(self, move: Float[Array, "*windows free"]) -> Float[Array, "*windows n"]:
        """Changes of all states from those of the free ones."""
        nothing = jnp.zeros((*move.shape[:-1], self.state.shape[1]), move.dtype)
        return nothing.at[..., np.array(self.free, int)].set(move)

    def _weighted(self, left: Array) -> Array:
        """Of unit variance, each window as one row."""
        r = jnp.where(self.weight > 0, left, 0.0)
        taps = self.color.shape[1]
        white = sum(self.color[:, k] * jnp.roll(r, k, axis=1) for k in range(taps))
        return (white * counted(self.weight, self.color)).reshape(len(r), -1)


def _product(inverse: Float[Array, "windows n k"], r: Float[Array, "windows k"]) -> Float[Array, "windows n"]:
    return jnp.einsum("wnk,wk->wn", inverse, r)


class _Slopes(NamedTuple):
    """Simulated less measured, as rows of unit variance, and changes of these.

    Attributes:
        difference: (windows, length, outputs).
        residual: (windows, k).
        of_states: (windows, k, free) with the initial states.
        of_unknowns: (windows, k, directions).
    """

    difference: Float[Array, "windows length outputs"]
    residual: Float[Array, "windows k"]
    of_states: Float[Array, "windows k free"]
    of_unknowns: Float[Array, "windows k directions"]


class Left(NamedTuple):
    """Simulated less measured, (windows, length, outputs), and the initial states, (windows, n)."""

    difference: Float[Array, "windows length outputs"]
    states: Float[Array, "windows n"]


def counted(weight: Array, color: Array) -> Array:
    """Weights, 0 where a filter of this length would reach beyond the window or over a gap.

    Args:
        weight: (windows, length, outputs).
        color: (outputs, taps).
    """
    return jnp.stack([jnp.roll(weight, k, axis=1) for k in range(color.shape[1])]).min(axis=0) * (
        jnp.arange(weight.shape[1])[:, None] >= color.shape[1] - 1
    )


def _pseudo_inverse(j: Float[Array, "windows k n"]) -> Float[Array, "windows n k"]:
    """Of least squares; directions without trace stay where they are."""
    size = jnp.linalg.norm(j, axis=1)
    scale = 1 / jnp.where(size > 0, size, 1.0)
    scaled = j * scale[:, None, :]
    values, vectors = jnp.linalg.eigh(jnp.einsum("wkn,wkm->wnm", scaled, scaled))
    seen = values > BLIND_STATE * values[:, -1:]
    inverse = jnp.where(seen, 1 / jnp.where(seen, values, 1.0), 0.0)
    back = jnp.einsum("wni,wi,wmi->wnm", vectors, inverse, vectors)
    return jnp.einsum("wnm,wkm->wnk", scale[:, :, None] * back, scaled)
