"""A record line by line beside what a linear model makes of it: transfer functions, response, what is left.

For a record of any length, and any state at its start, the discrete Fourier transforms obey
Y(w) = G(w) U(w) + T(w) t + G_f(w) F(w) + noise: G exact for the input's hold, T = C (z I - A)^-1 z with t the state at
the start less that at the end, F forces that the model does not have, which are smooth enough between samples for
their continuous transfer function G_f. No simulation runs, so free axes and unstable models are as good as any.

Source: R. Pintelon and J. Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., ch. 6.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jaxsid.checks import require, require_finite
from jaxsid.compilation import compiled, compiled_in_full
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.hold import discretise
from jaxsid.mechanics.inverses import inverse_each
from jaxsid.mechanics.lumped import LumpedModel, second_order
from jaxsid.mechanics.simulate import measured_sensors, ordered_inputs
from jaxsid.records import ContinuousModel, Realization, Record, SecondOrderModel

FEWEST = 64  # samples of a record
FREE = 1e-9  # stiffness of a motion, next to the largest, below which nothing holds it
CLEAR = 1e-6  # distance of a line from a pole on the circle of z from which on it is used: rounding parts double poles


class Spectra(eqx.Module):
    """The lines of one record with a linear model's transfer functions, scaled by 1/sqrt(samples).

    Attributes:
        omega: (lines,) rad/s.
        weight: (lines,) 1; 1/2 for the lines that are real; 0 for one on a pole of the model.
        u: (lines, inputs).
        y: (lines, outputs) measured, 0 for absent sensors.
        present: (outputs,) 1 for sensors that the record has.
        forced: (lines, outputs, N) from forces on the bodies.
        forced_states: (lines, 2 N, N) likewise to displacements and velocities.
        free: (lines, outputs, 2 N) from the state at the start less that at the end.
        free_states: (lines, 2 N, 2 N) likewise to the states.
        driven: (lines, outputs, inputs) from the held inputs.
        driven_states: (lines, 2 N, inputs) likewise to the states.
        held: (lines, outputs, N) from forces on the bodies that keep their values between samples.
        jumps: (inputs,) 1 for inputs that do.
        linear: M, D, K, where forces act and what sensors read.
        inverse_mass: (N, N).
        flexibility: (N, N) pseudo-inverse of the stiffness.
        dt: sampling interval, s.
        samples: of the record.
    """

    omega: Float[Array, " lines"]
    weight: Float[Array, " lines"]
    u: Complex[Array, "lines inputs"]
    y: Complex[Array, "lines outputs"]
    present: Float[Array, " outputs"]
    forced: Complex[Array, "lines outputs N"]
    forced_states: Complex[Array, "lines n N"]
    free: Complex[Array, "lines outputs n"]
    free_states: Complex[Array, "lines n n"]
    driven: Complex[Array, "lines outputs inputs"]
    driven_states: Complex[Array, "lines n inputs"]
    held: Complex[Array, "lines outputs N"]
    jumps: Float[Array, " inputs"]
    linear: SecondOrderModel
    inverse_mass: Float[Array, "N N"]
    flexibility: Float[Array, "N N"]
    dt: Float[Array, ""]
    samples: int = eqx.field(static=True)

    @property
    def response(self) -> Complex[Array, "lines outputs"]:
        """Of the model to the inputs, without transients."""
        return jnp.einsum("lpi,li->lp", self.driven, self.u)


def spectra_of(model: LumpedModel, record: Record) -> Spectra:
    """Lines of a record and a model's transfer functions, effects left out.

    Args:
        model: its linear part; inputs and sensors by name.
        record: with some of its sensors.

    Raises:
        InputError: an input or all sensors are missing, holds contradict, values are NaN, too few samples.
    """
    u, hold = ordered_inputs(model, record)
    rows, measured = measured_sensors(model, record)
    values = np.asarray(record.y)[:, measured]
    _check(record, values)
    present = np.zeros(len(model.sensors))
    present[rows] = np.isfinite(values).all(axis=0)
    y = np.zeros((len(values), len(model.sensors)))
    y[:, rows] = np.where(np.isfinite(values).all(axis=0), values, 0.0)
    given = jnp.asarray(u), jnp.asarray(y), jnp.asarray(present)
    return _spectra(*given, _sampled_model(model, record.dt, hold))


def _check(record: Record, values: np.ndarray) -> None:
    require(
        len(record.u) == len(record.y),
        f"{record.name}: u has {len(record.u)} samples, y {len(record.y)}; read them at the same instants.",
    )
    require(float(record.dt) > 0, f"{record.name}: the sampling interval must be positive.")
    require(
        len(record.u) >= FEWEST,
        f"{record.name}: {len(record.u)} samples tell too little; at least {FEWEST} are needed.",
    )
    require_finite(record.u, f"{record.name}, input", record.inputs)
    missing = ~np.isfinite(values)
    torn = [record.outputs[j] for j in np.flatnonzero(missing.any(axis=0) & ~missing.all(axis=0))]
    require(
        not torn,
        f"{record.name}: sensor '{torn[0] if torn else ''}' has values that are NaN or infinite. Cut the record, or "
        "leave the column out.",
    )
    require(not missing.all(), f"{record.name}: none of the model's sensors holds values.")


class _Sampled(NamedTuple):
    """A model in continuous time, driven at every body, and its sampled states."""

    linear: SecondOrderModel
    plain: ContinuousModel
    states: Realization
    held: Realization
    jumps: Array
    inverse_mass: Array
    flexibility: Array
    poles: Array
    band: bool


def _sampled_model(model: LumpedModel, dt: Array, hold: tuple[str, ...]) -> _Sampled:
    linear = second_order(model)
    size = len(linear.mass)
    plain, states, held = _driven(linear, jnp.asarray(dt), tuple("zero" if h == "band" else h for h in hold))
    jumps = jnp.asarray([float(h == "zero") for h in hold])
    poles = jnp.asarray(np.linalg.eigvals(np.asarray(states.A)))
    flexibility = jnp.asarray(np.linalg.pinv(np.asarray(linear.stiffness), rcond=FREE, hermitian=True))
    return _Sampled(linear, plain, states, held, jumps, plain.B[size:], flexibility, poles, "band" in hold)


@compiled
def _driven(
    linear: SecondOrderModel, dt: Array, hold: tuple[str, ...]
) -> tuple[ContinuousModel, Realization, Realization]:
    """Driven at every body, the states driven by the inputs, and by held forces on every body."""
    size, dtype = len(linear.mass), linear.mass.dtype
    every = eqx.tree_at(lambda s: s.input_matrix, linear, jnp.eye(size, dtype=dtype))
    plain = physical_displacement_velocity(every)
    eye = jnp.eye(2 * size, dtype=dtype)
    driven = plain.B @ linear.input_matrix
    # the states as outputs turn a first-order hold's shifted state into the plain one
    states = discretise(ContinuousModel(plain.A, driven, eye, jnp.zeros_like(driven)), dt, hold=hold)
    return plain, states, discretise(ContinuousModel(plain.A, plain.B, eye, jnp.zeros_like(plain.B)), dt)


@compiled_in_full
def _spectra(u: Array, y: Array, present: Array, model: _Sampled) -> Spectra:
    samples, plain, states = len(u), model.plain, model.states
    eye = jnp.eye(len(plain.A), dtype=plain.A.dtype)
    omega = 2 * jnp.pi * jnp.arange(samples // 2 + 1, dtype=plain.A.dtype) / (samples * states.dt)
    z = jnp.exp(1j * omega * states.dt)
    clear = jnp.abs(z[:, None] - model.poles).min(axis=1) > CLEAR
    z = jnp.where(clear, z, 2.0)[:, None, None]  # a line on a pole is not used
    s = jnp.where(clear, 1j * omega, 1.0)[:, None, None]
    shifted, smooth = jnp.split(inverse_each(jnp.concatenate([z * eye - states.A, s * eye - plain.A])), 2)
    forced_states = smooth @ plain.B
    inputs = model.linear.input_matrix
    driven_states = forced_states @ inputs if model.band else shifted @ states.B + states.D
    free_states = shifted * z / np.sqrt(samples)
    line = jnp.arange(len(omega))
    real = (line == 0) | (2 * line == samples)
    transform = lambda x: jnp.fft.rfft(x, axis=0) / np.sqrt(samples)  # noqa: E731
    return Spectra(
        omega,
        jnp.where(clear, jnp.where(real, 0.5, 1.0), 0.0),
        transform(u),
        transform(y),
        present,
        plain.C @ forced_states + plain.D,
        forced_states,
        plain.C @ free_states,
        free_states,
        plain.C @ driven_states + plain.D @ inputs,
        driven_states,
        plain.C @ (shifted @ model.held.B) + plain.D,
        model.jumps,
        model.linear,
        model.inverse_mass,
        model.flexibility,
        states.dt,
        samples,
    )


def in_time(spectra: Spectra, lines: Complex[Array, "lines k"]) -> Float[Array, "samples k"]:
    """The signals that have these lines.

    Args:
        spectra: of the record.
        lines: scaled by 1/sqrt(samples).
    """
    return jnp.fft.irfft(lines * np.sqrt(spectra.samples), spectra.samples, axis=0)


def to_lines(spectra: Spectra, signals: Float[Array, "samples k"]) -> Complex[Array, "lines k"]:
    """Lines of signals; undoes `in_time`."""
    return jnp.fft.rfft(signals, axis=0) / np.sqrt(spectra.samples)


class Motion(eqx.Module):
    """What the bodies do, line by line.

    Attributes:
        states: (lines, 2 N) displacements and velocities.
        accelerations: (lines, N).
    """

    states: Complex[Array, "lines n"]
    accelerations: Complex[Array, "lines N"]


def motion_under(
    spectra: Spectra, forces: Complex[Array, "lines N"], transient: Float[Array, " n"]
) -> Motion:
    """The motion under the inputs, further forces on the bodies, and a state at the start less that at the end.

    Args:
        spectra: of the record.
        forces: on the bodies.
        transient: of both states.
    """
    linear = spectra.linear
    states = jnp.einsum("lni,li->ln", spectra.driven_states, spectra.u)
    states = (
        states + spectra.free_states @ transient + jnp.einsum("lnf,lf->ln", spectra.forced_states, forces)
    )
    q, v = jnp.split(states, 2, axis=1)
    given = forces + spectra.u @ linear.input_matrix.T
    pushed = given - q @ linear.stiffness.T - v @ linear.damping.T
    accelerations = pushed @ spectra.inverse_mass.T
    steady_states, steady_accelerations = _steady(spectra, given[0], transient)
    free = spectra.weight[0] == 0
    return Motion(
        states.at[0].set(jnp.where(free, steady_states, states[0])),
        accelerations.at[0].set(jnp.where(free, steady_accelerations, accelerations[0])),
    )


def _steady(spectra: Spectra, given: Array, transient: Array) -> tuple[Array, Array]:
    """Means of states, about a middle at zero, and of accelerations of free bodies: from how far their state went."""
    linear, duration = spectra.linear, spectra.dt * np.sqrt(spectra.samples)
    v, a = jnp.split(-transient / duration, 2)
    q = spectra.flexibility @ (given - linear.damping @ v - linear.mass @ a)
    return jnp.concatenate([q, v + 0 * q]), a + 0 * q


def readings(spectra: Spectra, motion: Motion) -> Complex[Array, "lines outputs"]:
    """What the sensors read of a motion; arguments as of `parameter_columns`."""
    linear, (q, v) = spectra.linear, jnp.split(motion.states, 2, axis=1)
    sensed = q @ linear.displacement_sensors.T + v @ linear.velocity_sensors.T
    return sensed + motion.accelerations @ linear.acceleration_sensors.T


def parameter_columns(
    spectra: Spectra, motion: Motion, directions: tuple[Array, Array, Array]
) -> Complex[Array, "lines outputs e"]:
    """What unit changes of elements of M, D, K do to the outputs, on a given motion.

    Exact where the motion is the true one: dM q'' + dD q' + dK q acts as a force against the bodies. Of that the part
    dM M^-1 u jumps where a held input does, and between its values no straight band would lead: it would respond to
    inputs that are still to come, which a controller makes of the noise that is there now.

    Args:
        spectra: of the record.
        motion: of the bodies.
        directions: (e, N, N) each, of M, D, K.
    """
    linear = spectra.linear
    pushed = (spectra.u * spectra.jumps) @ (spectra.inverse_mass @ linear.input_matrix).T
    jumping = -jnp.einsum("efk,lk->lfe", directions[0], pushed)
    smooth = parameter_forces(motion, directions) - jumping
    every = jnp.concatenate([spectra.forced, spectra.held], axis=2)
    return jnp.einsum("lpf,lfe->lpe", every, jnp.concatenate([smooth, jumping], axis=1))


def parameter_forces(motion: Motion, directions: tuple[Array, Array, Array]) -> Complex[Array, "lines N e"]:
    """The forces on the bodies of unit changes of elements; arguments as of `parameter_columns`."""
    size = motion.accelerations.shape[1]
    parts = motion.accelerations, motion.states[:, size:], motion.states[:, :size]
    return -sum(
        (jnp.einsum("efk,lk->lfe", d, x) for d, x in zip(directions, parts, strict=True)),
        start=jnp.zeros((), motion.states.dtype),
    )


def stacked(columns: Complex[Array, "lines outputs k"]) -> Float[Array, "rows k"]:
    """Real and imaginary parts as rows."""
    flat = columns.reshape(-1, columns.shape[-1])
    return jnp.concatenate([flat.real, flat.imag])
