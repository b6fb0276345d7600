"""What measurements say of mass, damping and stiffness: weighted residuals and their slopes, one kind of data each.

Every term maps M, D, K and p directions of change to a residual of unit variance and its Jacobian. The directions go
through the exact sampled model, so that Jacobians cost little more than residuals.
"""

import math
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from jaxsid.least_squares import Sums, sums_of
from jaxsid.mechanics.functions_of_matrices import exponential_with_slopes
from jaxsid.mechanics.inverses import inverse_each
from jaxsid.physical.inband_fit import Target, line_residual
from jaxsid.physical.parameterization import Slopes, Triple
from jaxsid.records import SecondOrderModel

Stack = Float[Array, "_ _ _"]  # (1 + p, rows, columns): a matrix, then its change in each direction


@runtime_checkable
class Term(Protocol):
    """One set of data."""

    @property
    def equations(self) -> Array:
        """How many count."""
        ...

    def evaluate(self, matrices: Triple, slopes: Slopes) -> tuple[Array, Array]:
        """Weighted residual (equations,) and its Jacobian (equations, p).

        Args:
            matrices: M, D, K.
            slopes: (p, N, N) their changes.
        """
        ...

    def sums(self, matrices: Triple, slopes: Slopes) -> Sums:
        """What a step of a fit needs of both."""
        ...


class LineTerm(eqx.Module):
    """In-band Fourier lines of records, their transients projected out.

    Attributes:
        target: the lines and what noise is on them.
        sensed: gives the input matrix and the sensors.
    """

    target: Target
    sensed: SecondOrderModel

    @property
    def equations(self) -> Array:
        return 2 * (self.target.weight > 0).sum()

    def evaluate(self, matrices: Triple, slopes: Slopes) -> tuple[Array, Array]:
        upper = jnp.triu_indices(len(matrices[0]))
        onto = jnp.concatenate([x[:, upper[0], upper[1]] for x in slopes], axis=1)
        r, j = line_residual(self.target, matrices, self.sensed)
        return r, j @ onto.T

    def sums(self, matrices: Triple, slopes: Slopes) -> Sums:
        return sums_of(*self.evaluate(matrices, slopes))


class ResponseTerm(eqx.Module):
    """An impulse response: the Markov parameters of the sampled system.

    Attributes:
        h: (samples, outputs, inputs) measured.
        weight: (samples, outputs, inputs) one over the noise, 0 where a sample is not to count.
        laid: both but for the first sample, in the order in which products of blocks make a response.
        whitener: (outputs, samples, samples) makes the weighted noise of each output independent in time; None where
            it is.
        dt: sampling interval, s.
        sensed: gives the input matrix and the sensors.
        ramps: which inputs are held to first order.
    """

    h: Float[Array, "samples outputs inputs"]
    weight: Float[Array, "samples outputs inputs"]
    laid: tuple[Float[Array, "_ _ _ _"], Float[Array, "_ _ _ _"]]
    whitener: Float[Array, "outputs samples samples"] | None
    dt: Float[Array, ""]
    sensed: SecondOrderModel
    ramps: tuple[bool, ...] = eqx.field(static=True)

    @property
    def equations(self) -> Array:
        return (self.weight > 0).sum()

    def evaluate(self, matrices: Triple, slopes: Slopes) -> tuple[Array, Array]:
        if self.whitener is not None:
            left = self.left(matrices, slopes)
            rows = jnp.einsum("oab,pboi->paoi", self.whitener, left).reshape(len(left), -1)
            return rows[0], rows[1:].T
        rows = jnp.concatenate(self._parts(matrices, slopes), axis=1)
        return rows[0], rows[1:].T

    def sums(self, matrices: Triple, slopes: Slopes) -> Sums:
        if self.whitener is not None:
            return sums_of(*self.evaluate(matrices, slopes))
        # one product of all rows with themselves, which are never put side by side
        first, later = self._parts(matrices, slopes)
        both = first @ first.T + later @ later.T
        return 0.5 * both[0, 0], both[1:, 1:], both[1:, 0]

    def _parts(self, matrices: Triple, slopes: Slopes) -> tuple[Array, Array]:
        """Weighted rows of the first sample and of the others, the data in the order of the blocks."""
        first, later = self._blocks(matrices, slopes)
        h, weight = self.laid
        parts = (first.at[0].add(-self.h[0]) * self.weight[0], later.at[0].add(-h) * weight)
        a, b = (x.reshape(len(x), -1) for x in parts)
        return a, b

    def left(self, matrices: Triple, slopes: Slopes) -> Float[Array, "_ samples outputs inputs"]:
        """Weighted model less measured, then its changes, in the order of time.

        Args:
            matrices: M, D, K.
            slopes: (p, N, N) their changes.
        """
        first, later = self._blocks(matrices, slopes)
        both = jnp.concatenate([first[:, None], _in_time(later)], axis=1)[:, : len(self.h)]
        return both.at[0].add(-self.h) * self.weight

    def _blocks(self, matrices: Triple, slopes: Slopes) -> tuple[Stack, Array]:
        sampled = sampled_with_slopes(matrices, slopes, self.sensed, self.dt, self.ramps)
        return _markov_blocks(*sampled, len(self.h))


class FrequencyTerm(eqx.Module):
    """A frequency response, of the sampled and held system or in continuous time.

    Attributes:
        s: (lines,) j w, 1/s.
        H: (lines, outputs, inputs) measured.
        weight: (lines, outputs, inputs) one over the standard deviation of real and imaginary part.
        dt: sampling interval, s; None in continuous time.
        sensed: gives the input matrix and the sensors.
        ramps: which inputs are held to first order.
    """

    s: Complex[Array, " lines"]
    H: Complex[Array, "lines outputs inputs"]
    weight: Float[Array, "lines outputs inputs"]
    dt: Float[Array, ""] | None
    sensed: SecondOrderModel
    ramps: tuple[bool, ...] = eqx.field(static=True)

    @property
    def equations(self) -> Array:
        return 2 * (self.weight > 0).sum()

    def evaluate(self, matrices: Triple, slopes: Slopes) -> tuple[Array, Array]:
        if self.dt is None:
            A, B, C, D = _state_space_with_slopes(matrices, slopes, self.sensed)
            points = self.s
        else:
            A, B, C, D = sampled_with_slopes(matrices, slopes, self.sensed, self.dt, self.ramps)
            points = jnp.exp(self.s * self.dt)
        inverse = inverse_each(points[:, None, None] * jnp.eye(A.shape[1]) - A[0])
        x, p = inverse @ B[0], C[0] @ inverse
        change = jnp.einsum("kon,dnm,kmi->dkoi", p, A[1:], x) + jnp.einsum("don,kni->dkoi", C[1:], x)
        change = change + jnp.einsum("kon,dni->dkoi", p, B[1:]) + D[1:, None]
        both = jnp.concatenate([(C[0] @ x + D[0] - self.H)[None], change]) * self.weight
        rows = both.reshape(len(both), -1)
        rows = jnp.concatenate([rows.real, rows.imag], axis=1)
        return rows[0], rows[1:].T

    def sums(self, matrices: Triple, slopes: Slopes) -> Sums:
        return sums_of(*self.evaluate(matrices, slopes))


def product(x: Stack, y: Stack) -> Stack:
    """Of two matrices, with the changes of the product."""
    first = (jnp.arange(len(x)) == 0)[:, None, None]
    return x @ y[0] + jnp.where(first, 0.0, x[0] @ y)


def _state_space_with_slopes(
    matrices: Triple, slopes: Slopes, sensed: SecondOrderModel
) -> tuple[Stack, Stack, Stack, Stack]:
    """A, B, C, D in displacements and velocities."""
    M, D, K = matrices
    dM, dD, dK = slopes
    size, forces = len(M), sensed.input_matrix
    per_mass = jnp.linalg.inv(M)
    lower = per_mass @ jnp.concatenate([-K, -D, forces], axis=1)  # accelerations
    pushed = jnp.concatenate([-dK, -dD, jnp.zeros((len(dM), *forces.shape))], axis=2) - dM @ lower
    below = jnp.concatenate([lower[None], per_mass @ pushed])
    count = len(below)
    shift = jnp.zeros((count, size, 2 * size)).at[0].set(jnp.eye(size, 2 * size, size))
    A = jnp.concatenate([shift, below[:, :, : 2 * size]], axis=1)
    B = jnp.concatenate([jnp.zeros((count, *forces.shape)), below[:, :, 2 * size :]], axis=1)
    seen = jnp.concatenate([sensed.displacement_sensors, sensed.velocity_sensors], axis=1)
    C = (sensed.acceleration_sensors @ below[:, :, : 2 * size]).at[0].add(seen)
    return A, B, C, sensed.acceleration_sensors @ below[:, :, 2 * size :]


def sampled_with_slopes(
    matrices: Triple, slopes: Slopes, sensed: SecondOrderModel, dt: Array, ramps: tuple[bool, ...]
) -> tuple[Stack, Stack, Stack, Stack]:
    """A, B, C, D of the sampled system and their changes, all from one exponential.

    exp([[A, B, 0], [0, 0, I], [0, 0, 0]] dt) has e^(A dt), dt phi_1 B and dt^2 phi_2 B in its first rows.

    Args:
        matrices: M, D, K.
        slopes: (p, N, N) their changes.
        sensed: gives the input matrix and the sensors.
        dt: sampling interval, s.
        ramps: which inputs are held to first order; the others to zero order.
    """
    A, B, C, D = _state_space_with_slopes(matrices, slopes, sensed)
    states, inputs = B.shape[1:]
    levels = 2 if any(ramps) else 1
    size = states + levels * inputs
    # displacements in units in which they are about as large as velocities
    rate = jnp.sqrt(jnp.abs(jnp.trace(matrices[2]) / jnp.trace(matrices[0])))
    units = jnp.where(jnp.arange(size) < states // 2, 1.0, jnp.where(rate > 0, rate, 1.0))
    stack = jnp.zeros((len(A), size, size)).at[:, :states, :states].set(A)
    stack = stack.at[:, :states, states : states + inputs].set(B)
    if levels == 2:
        stack = stack.at[0, states : states + inputs, states + inputs :].set(jnp.eye(inputs))
    held = exponential_with_slopes(stack * dt * units / units[:, None]) * units[:, None] / units
    A, step = held[:, :states, :states], held[:, :states, states : states + inputs]
    if levels == 1:
        return A, step, C, D
    ramp = held[:, :states, states + inputs :] / dt * jnp.asarray(ramps)
    return A, step + product(A, ramp) - ramp, C, D + product(C, ramp)


def _markov_blocks(
    A: Stack, B: Stack, C: Stack, D: Stack, samples: int
) -> tuple[Stack, Float[Array, "_ _ _ _ _"]]:
    """D, and C A^(j q) A^k B as (1 + p, j, outputs, k, inputs): sample 1 + j q + k, products of about sqrt(samples)
    rows with as many columns, and their changes."""
    outer, doublings = _blocks_of(samples)
    columns, stride = B, A
    for _ in range(doublings):
        columns, stride = _doubled(stride, columns), product(stride, stride)
    rows, step = _transposed(C), _transposed(stride)
    while rows.shape[2] < outer * C.shape[1]:
        rows, step = _doubled(step, rows), product(step, step)
    rows = _transposed(rows[:, :, : outer * C.shape[1]])
    both = _with_changes(rows, columns)
    return D, both.reshape(len(A), outer, C.shape[1], 2**doublings, B.shape[2])


def _blocks_of(samples: int) -> tuple[int, int]:
    """How many blocks the samples after the first are in, and the logarithm to base 2 of their length."""
    doublings = max(0, round(math.log2(max(samples - 1, 1)) / 2))
    return max(1, -(-(samples - 1) // 2**doublings)), doublings


def _in_time(blocks: Float[Array, "_ _ _ _ _"]) -> Float[Array, "_ _ _ _"]:
    """(1 + p, samples, outputs, inputs) from blocks."""
    stacked, outer, outputs, inner, inputs = blocks.shape
    return jnp.swapaxes(blocks, 2, 3).reshape(stacked, outer * inner, outputs, inputs)


def in_blocks(x: Float[Array, "samples outputs inputs"]) -> Float[Array, "_ _ _ _"]:
    """All samples but the first as (j, outputs, k, inputs), zeros after the last."""
    outer, doublings = _blocks_of(len(x))
    _, outputs, inputs = x.shape
    padded = jnp.zeros((outer * 2**doublings, outputs, inputs), x.dtype).at[: len(x) - 1].set(x[1:])
    return jnp.swapaxes(padded.reshape(outer, 2**doublings, outputs, inputs), 1, 2)


def _transposed(x: Stack) -> Stack:
    return jnp.swapaxes(x, 1, 2)


def _doubled(A: Stack, X: Stack) -> Stack:
    """X and A X side by side."""
    return jnp.concatenate([X, _with_changes(A, X)], axis=2)


def _with_changes(x: Stack, y: Stack) -> Stack:
    """`product` for many columns: what only the first of y enters is one product of matrices."""
    changed = (x[1:].reshape(-1, x.shape[2]) @ y[0]).reshape(len(x) - 1, x.shape[1], y.shape[2])
    return (x[0] @ y).at[1:].add(changed)
