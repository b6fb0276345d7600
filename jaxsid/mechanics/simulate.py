"""Responses of linear models to sampled inputs: outputs, Markov parameters, initial states."""

import warnings
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from jaxsid.checks import bad_input, is_concrete, require, require_finite
from jaxsid.compilation import compiled
from jaxsid.mechanics.band import band_response
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.hold import check_holds, continuous, discretise
from jaxsid.mechanics.lumped import LumpedModel, second_order
from jaxsid.mechanics.recursion import markov, powers, run
from jaxsid.mechanics.simulate_effects import (
    PLAIN_SUBSTEPS,
    Driven,
    Motion,
    driven,
    fitted_state,
    run_driven,
)
from jaxsid.records import ContinuousModel, ImpulseResponse, Realization, Record, columns

ENOUGH = 1e-3  # relative error of a response from which on a warning is due


class InitialState(eqx.Module):
    """An initial state fitted to a record.

    Attributes:
        state: (n,), of least norm where some directions leave no trace in the outputs.
        singular_values: of the map from the state, each entry scaled to equal effect, to the outputs.
        unobservable: number of state directions that leave no trace.
    """

    state: Float[Array, " n"]
    singular_values: Float[Array, " n"]
    unobservable: Int[Array, ""]

    @property
    def reason(self) -> str | None:
        """Why the state is not determined by the record, None where it is."""
        if int(self.unobservable) == 0:
            return None
        return (
            f"{int(self.unobservable)} of {len(self.state)} directions of the initial state leave no trace "
            "in the outputs, such as the position of a free body seen by velocity sensors; left at zero."
        )


def simulate_linear(
    model: ContinuousModel | Realization,
    u: ArrayLike,
    dt: ArrayLike | None = None,
    *,
    hold: str | Sequence[str] | None = None,
    initial_state: ArrayLike | None = None,
) -> Float[Array, "samples outputs"]:
    """Outputs at the sampling instants, exact for the hold: y_k = C x_k + D u_k.

    A continuous-time model starts from x(0) = initial_state at the first sample. A realization runs as the
    recursion it is; one with hold "band" is first taken back to continuous time by `continuous`, and
    `initial_state` is the state there. For "band" the input is the trigonometric interpolation of the
    record, continued at both ends by odd reflections that fade out over up to 512 samples: what the record
    cannot tell, its input before and after, matters within a few samples of the ends.

    Args:
        model: a continuous-time model, or a realization, which has its own interval and hold.
        u: (samples, inputs), N or N m.
        dt: sampling interval, s; for a continuous-time model only.
        hold: "zero" (default), "first" or "band", for all inputs or each; for a continuous-time model only.
        initial_state: (n,); zero, at rest, when left out.

    Raises:
        InputError: wrong shapes or holds, an interval missing or given twice.
    """
    u = columns(u).astype(model.A.dtype)
    require(
        u.shape[1] == model.B.shape[1],
        f"the model has {model.B.shape[1]} inputs, u has {u.shape[1]} columns.",
    )
    state = jnp.asarray(np.zeros(len(model.A)) if initial_state is None else initial_state, u.dtype)
    require(
        state.shape == (len(model.A),), f"the model has {len(model.A)} states, initial_state {state.shape}."
    )
    if isinstance(model, Realization):
        require(dt is None and hold is None, "a realization has its own dt and hold; do not give them again.")
        if "band" not in model.hold:
            return _run(model.A, model.B, model.C, model.D, u, state)
        return _band(continuous(model), u, model.dt, state)
    if dt is None:
        bad_input("a continuous-time model needs the sampling interval dt of its input.")
    each = check_holds(hold or "zero", u.shape[1])
    if "band" in each:
        return _band(model, u, jnp.asarray(dt, u.dtype), state)
    sampled = discretise(model, dt, hold=each)
    # with a first-order hold the sampled state is x_k less the ramp's part, (D_sampled - D) seen through C
    return _run(sampled.A, sampled.B, sampled.C, sampled.D, u, state - _ramp_part(model, sampled, u[0]))


def _ramp_part(model: ContinuousModel, sampled: Realization, u0: Array) -> Array:
    if "first" not in sampled.hold:
        return jnp.zeros(len(model.A), u0.dtype)
    identity = jnp.eye(len(model.A), dtype=u0.dtype)
    full = ContinuousModel(model.A, model.B, identity, jnp.zeros_like(model.B))
    return discretise(full, sampled.dt, hold=sampled.hold).D @ u0


_run = compiled(run)
_band = compiled(band_response)


def markov_parameters(realization: Realization, *, samples: int) -> Float[Array, "samples outputs inputs"]:
    """Markov parameters Y_0 = D, Y_k = C A^(k-1) B.

    Args:
        realization: sampled model.
        samples: how many, with Y_0.

    Raises:
        InputError: samples below 1.
    """
    require(samples >= 1, f"samples must be at least 1, not {samples}.")
    return _markov(realization.A, realization.B, realization.C, realization.D, samples=samples)


@compiled
def _markov(A: Array, B: Array, C: Array, D: Array, *, samples: int) -> Array:
    return markov(A, B, C, D, samples)


def impulse_response_of(
    model: ContinuousModel, dt: ArrayLike, *, samples: int, hold: str | Sequence[str] = "zero"
) -> ImpulseResponse:
    """The impulse response that a perfect record of this model would give.

    Args:
        model: continuous-time model.
        dt: sampling interval, s.
        samples: its length.
        hold: "zero", "first" or "band", for all inputs or for each.

    Raises:
        InputError: as `discretise`.
    """
    sampled = discretise(model, dt, hold=hold)
    h = markov_parameters(sampled, samples=samples)
    return ImpulseResponse(h, sampled.dt, hold=sampled.hold, method="model")


def estimate_initial_state(realization: Realization, u: ArrayLike, y: ArrayLike) -> InitialState:
    """The initial state that fits a record best: least squares on y_k - (response from rest)_k = C A^k x_0.

    Args:
        realization: sampled model; with hold "band" the state is that of `continuous(realization)`.
        u: (samples, inputs).
        y: (samples, outputs); columns of absent sensors may be NaN.

    Raises:
        InputError: wrong shapes, no output at all.
    """
    residual = _checked_outputs(realization.C, u, y) - simulate_linear(realization, u)
    if "band" in realization.hold:
        realization = discretise(continuous(realization), realization.dt)
    return _fit_state(realization.A, realization.C, residual)


def _checked_outputs(C: Array, u: ArrayLike, y: ArrayLike) -> Array:
    y = columns(y).astype(C.dtype)
    require(y.shape[1] == len(C), f"the model has {len(C)} outputs, y has {y.shape[1]} columns.")
    require(len(y) == len(columns(u)), f"u has {len(columns(u))} samples, y has {len(y)}.")
    if is_concrete(y):
        require(
            not np.isnan(np.asarray(y)).all(), "every output is NaN: no sensor to fit the initial state to."
        )
    return y


@compiled
def _fit_state(A: Array, C: Array, residual: Array) -> InitialState:
    """Least squares on C A^k x_0 = residual_k, columns of equal norm; directions under 1e-8 stay zero."""
    free = jnp.swapaxes(powers(A.T, C.T, len(residual)), 1, 2)
    known = jnp.isfinite(residual)
    system = jnp.where(known[:, :, None], free, 0.0).reshape(-1, len(A))
    norms = jnp.linalg.norm(system, axis=0)
    scale = 1 / jnp.where(norms > 0, norms, 1.0)
    target = jnp.where(known, residual, 0.0).reshape(-1, 1)
    R = jnp.linalg.qr(jnp.hstack([system * scale, target]), mode="r")
    U, s, Vt = jnp.linalg.svd(R[: len(A), : len(A)], full_matrices=False)
    seen = s > jnp.maximum(1e-8, 100 * jnp.finfo(s.dtype).eps) * s[0]
    state = scale * (Vt.T @ (jnp.where(seen, 1 / jnp.where(seen, s, 1.0), 0.0) * (U.T @ R[: len(A), -1])))
    return InitialState(state, s, len(A) - seen.sum())


def simulate(
    model: LumpedModel,
    record: Record | Mapping[str, ArrayLike],
    *,
    dt: ArrayLike | None = None,
    initial: str = "rest",
    substeps: int | None = None,
    number: int = 0,
) -> Float[Array, "samples sensors"]:
    """The response of a lumped model's sensors, in the model's order, to a record's inputs.

    Each input is held as the model or the record says; "zero", the default of both, gives way. Without effects the
    response is exact. With effects steps are halved until it is right to 1e-4 of its rms, and a warning says where
    that was not reached, as for a motion that is chaotic.

    Args:
        model: with or without effects.
        record: a Record, its inputs in any order, those that the model does not have unused; or a mapping
            from input names to (samples,) arrays.
        dt: sampling interval, s; with a mapping only.
        initial: "rest", or "estimate" to fit the initial state, hidden states too, to the record's sensors.
        substeps: of models with effects, steps for each sampling interval; None to find out, or, where values are
            traced, 4.
        number: of the record, from 0, for effects' parameters of which there is one a record.

    Raises:
        InputError: an input is missing, holds contradict, there is nothing to fit to, the model is unstable.

    Source: S. Cox and P. Matthews, J. Comput. Phys. 176 (2002), for the effects' forces.
    """
    require(substeps is None or substeps >= 1, f"substeps must be at least 1, not {substeps}.")
    require(initial in ("rest", "estimate"), f"initial '{initial}' is unknown; choose 'rest' or 'estimate'.")
    require(bool(model.sensors and model.inputs), f"{model.name}: simulation needs an input and a sensor.")
    record = _as_record(model, record, dt)
    u, hold = ordered_inputs(model, record)
    if model.effects:
        given = driven(model, u, hold, record.dt, number)
        state = jnp.zeros(given.states, given.u.dtype)
        if initial == "estimate":
            state = _state_with_effects(given, model, record, u, hold, substeps)
        return _said(run_driven(given, state, substeps), model)
    linear = physical_displacement_velocity(second_order(model))
    if initial == "rest":
        return simulate_linear(linear, u, record.dt, hold=hold)
    return _from_estimate(linear, model, record, u, hold)


def _as_record(model: LumpedModel, record: Record | Mapping[str, ArrayLike], dt: ArrayLike | None) -> Record:
    if isinstance(record, Record):
        require(dt is None, f"{record.name}: a record has its own dt; do not give it again.")
        require(len(record.u) == len(record.y), f"{record.name}: u and y differ in length.")
        require_finite(record.u, f"{record.name}, input", record.inputs)
        return record
    if dt is None:
        bad_input("inputs given by name need the sampling interval dt.")
    lengths = {name: jnp.size(x) for name, x in record.items()}
    require(len(set(lengths.values())) == 1, f"{model.name}: inputs of one length, please, not {lengths}.")
    u = jnp.stack([jnp.ravel(jnp.asarray(x)) for x in record.values()], axis=1)
    return Record(u, jnp.zeros((len(u), 0)), dt, inputs=tuple(record), outputs=(), name=model.name)


def ordered_inputs(model: LumpedModel, record: Record) -> tuple[Array, tuple[str, ...]]:
    order, hold = [], []
    for wanted in model.inputs:
        require(
            wanted.name in record.inputs,
            f"{record.name}: input '{wanted.name}' of the model is missing; it has "
            f"{', '.join(record.inputs)}.",
        )
        order.append(record.inputs.index(wanted.name))
        said = {h for h in (wanted.hold, record.hold[order[-1]]) if h != "zero"}
        require(
            len(said) < 2,
            f"{record.name}: input '{wanted.name}' is held '{record.hold[order[-1]]}' in the record but "
            f"'{wanted.hold}' in the model. Make them agree.",
        )
        hold.append(said.pop() if said else "zero")
    # a choice of columns takes longer than all else here
    u = record.u if order == list(range(record.u.shape[1])) else record.u[:, np.array(order)]
    return u, tuple(hold)


def _said(motion: Motion, model: LumpedModel) -> Array:
    """The outputs, and a warning where they are not as exact as they should be."""
    worst = np.nan_to_num(motion.error).max(initial=0.0)
    if worst > ENOUGH:
        warnings.warn(
            f"{model.name}: even with {motion.substeps} steps for each sample the response changes by "
            f"{100 * worst:.2g} % of its rms when steps are halved. It depends on its beginning more than any "
            "simulation can follow, or its effects act faster than the record's samples show.",
            stacklevel=3,
        )
    return motion.response.outputs


def _from_estimate(
    linear: ContinuousModel, model: LumpedModel, record: Record, u: Array, hold: tuple[str, ...]
) -> Array:
    rows, measured = measured_sensors(model, record)
    free = discretise(linear, record.dt)
    forced = simulate_linear(linear, u, record.dt, hold=hold)
    fit = _fit_state(free.A, linear.C[rows], record.y[:, measured] - forced[:, rows])
    return forced + simulate_linear(free, jnp.zeros_like(u), initial_state=fit.state)


def measured_sensors(model: LumpedModel, record: Record) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of the model's sensors that the record has, and of their columns there.

    Args:
        model: names the sensors.
        record: has some of them.
    """
    known = [
        (i, record.outputs.index(s.name)) for i, s in enumerate(model.sensors) if s.name in record.outputs
    ]
    require(
        bool(known),
        f"{record.name}: none of the model's sensors ({', '.join(s.name for s in model.sensors)}) is in the "
        "record, so no initial state can be fitted. Simulate from rest.",
    )
    rows, measured = (np.array(x) for x in zip(*known, strict=True))
    return rows, measured


def _state_with_effects(
    given: Driven,
    model: LumpedModel,
    record: Record,
    u: Array,
    hold: tuple[str, ...],
    substeps: int | None,
) -> Array:
    """The initial state that fits a record, from that of the linear part; the effects' own states with it."""
    rows, measured = measured_sensors(model, record)
    linear = physical_displacement_velocity(given.linear)
    free = discretise(linear, record.dt)
    y = record.y[:, measured]
    start = _fit_state(
        free.A, linear.C[rows], y - simulate_linear(linear, u, record.dt, hold=hold)[:, rows]
    ).state
    start = jnp.concatenate([start, jnp.zeros(given.states - len(start), start.dtype)])
    every = jnp.full((len(y), len(model.sensors)), jnp.nan).at[:, rows].set(y)
    return fitted_state(given, every, start, jnp.asarray(substeps or PLAIN_SUBSTEPS))
