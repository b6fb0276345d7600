"""Simulation of models with effects, with steps as short as the answer needs."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxsid.checks import InputError, is_concrete
from jaxsid.compilation import compiled
from jaxsid.least_squares import forward, levenberg_marquardt
from jaxsid.mechanics.band import extend
from jaxsid.mechanics.effects.catalogue import by_sort
from jaxsid.mechanics.lumped import LumpedModel, second_order
from jaxsid.mechanics.nonlinear import Response, respond, respond_twice, state_count
from jaxsid.mechanics.slots import Slots, slots_of
from jaxsid.records import SecondOrderModel

GOOD = 3e-5  # relative error of every output at which steps are short enough
MOST_SUBSTEPS = 64
PLAIN_SUBSTEPS = 4  # where values are traced, so that nobody can look at the error
FINER = 8  # samples of a band-limited input for each given one
STEPS = 25  # of the fit of an initial state


class Motion(NamedTuple):
    """A simulated motion.

    Attributes:
        response: readings, states and forces at the samples.
        substeps: steps for each sampling interval.
        error: estimated relative rms error of each output; NaN where steps were given or values traced.
    """

    response: Response
    substeps: int
    error: Float[np.ndarray, " outputs"]


class Driven(eqx.Module):
    """A model with effects, and inputs held at order zero or one.

    Attributes:
        linear: the model without effects.
        slots: its effects.
        u: (samples * finer, inputs).
        ramps: (inputs,) which are held to first order.
        dt: interval of u, s.
        finer: samples of u for each sample of the record.
    """

    linear: SecondOrderModel
    slots: Slots
    u: Float[Array, "samples inputs"]
    ramps: Bool[Array, " inputs"]
    dt: Float[Array, ""]
    finer: int = eqx.field(static=True)

    @property
    def states(self) -> int:
        return state_count(len(self.linear.mass), self.slots.count)


def driven(model: LumpedModel, u: Array, hold: tuple[str, ...], dt: Array, record: int) -> Driven:
    """A model and its inputs, ready to be simulated.

    Args:
        model: with effects.
        u: (samples, inputs) in the model's order.
        hold: of each.
        dt: sampling interval, s.
        record: number of the record, for parameters of which there is one a record.
    """
    dtype = model.mass.dtype if model.matrices is None else model.matrices.mass.dtype
    slots = jax.tree.map(
        lambda x: x if jnp.issubdtype(x.dtype, jnp.integer) else x.astype(dtype), slots_of(model, record)
    )
    if is_concrete(slots.kinds):
        slots = eqx.tree_at(lambda s: s.kinds, slots, by_sort(slots.kinds))
    u, dt = u.astype(dtype), jnp.asarray(dt, dtype)
    if "band" in hold:
        ramps = jnp.ones(len(hold), bool)
        return Driven(second_order(model), slots, _refined(u), ramps, dt / FINER, FINER)
    return Driven(second_order(model), slots, u, jnp.asarray([h == "first" for h in hold]), dt, 1)


@compiled
def _refined(u: Array) -> Array:
    """A band-limited signal between its samples, such that straight lines between them have its spectrum."""
    whole = extend(u)
    period = len(whole)
    spectrum = jnp.fft.rfft(whole, axis=0)
    spectrum = spectrum / jnp.sinc(jnp.fft.rfftfreq(period) / FINER)[:, None] ** 2
    if period % 2 == 0:
        spectrum = spectrum.at[-1].set(spectrum[-1].real / 2)
    return FINER * jnp.fft.irfft(spectrum, FINER * period, axis=0)[: FINER * len(u)].astype(u.dtype)


@compiled
def _respond(given: Driven, state: Array, substeps: Array) -> Response:
    return _run(given, state, substeps)


@compiled
def _respond_plain(given: Driven, state: Array, *, substeps: int) -> Response:
    return _run(given, state, substeps)


@compiled
def _respond_twice(given: Driven, state: Array) -> tuple[Response, Response]:
    one, two = respond_twice(given.linear, given.slots, given.u, given.ramps, given.dt, state)
    return _at_samples(given, one), _at_samples(given, two)


def _run(given: Driven, state: Array, substeps: Array | int) -> Response:
    found = respond(given.linear, given.slots, given.u, given.ramps, given.dt, state, substeps)
    return _at_samples(given, found)


def _at_samples(given: Driven, found: Response) -> Response:
    every = given.finer
    return Response(found.outputs[::every], found.states[::every], found.forces[::every])


def run_driven(given: Driven, state: Float[Array, " n"], substeps: int | None = None) -> Motion:
    """The motion from a state, with steps halved until the outputs change no more.

    The second of two runs errs by less than the difference between both: all of the method's parts are of second order
    or better. Of traced values a run with a fixed number of steps is made, through which derivatives flow both ways.

    Args:
        given: model and inputs.
        state: at the first sample.
        substeps: steps for each sampling interval; None to find out.
    """
    outputs = len(given.linear.displacement_sensors)
    unknown = np.full(outputs, np.nan)
    if substeps is not None or not all(map(is_concrete, jax.tree.leaves((given, state)))):
        number = substeps or PLAIN_SUBSTEPS
        return Motion(_respond_plain(given, state, substeps=number), number, unknown)
    number, (last, found) = 2, _respond_twice(given, state)
    while True:
        error = _relative_change(last.outputs, found.outputs)
        # long steps may grow where short ones do not
        if number >= MOST_SUBSTEPS and not np.isfinite(np.asarray(found.outputs)).all():
            raise InputError(
                "the motion grows beyond all bounds: the model with these effects is unstable. Check the signs and "
                "sizes of the effects' parameters."
            )
        if (error < GOOD).all() or number >= MOST_SUBSTEPS:
            return Motion(found, number, error)
        number, last = 2 * number, found
        found = _respond(given, state, jnp.asarray(number))


def _relative_change(x: Array, y: Array) -> np.ndarray:
    """Of each output: rms of the error of y, a third of the change, next to the rms of y."""
    before, after = np.asarray(x), np.asarray(y)
    with np.errstate(over="ignore", invalid="ignore"):  # of motions that grow beyond all numbers
        size = np.sqrt((after**2).mean(axis=0))
        return np.sqrt(((after - before) ** 2).mean(axis=0)) / 3 / np.where(size > 0, size, 1.0)


@compiled
def fitted_state(
    given: Driven, y: Float[Array, "samples outputs"], start: Float[Array, " n"], substeps: Array
) -> Float[Array, " n"]:
    """The initial state with which the outputs come closest to measured ones, each next to its own size.

    Args:
        given: model and inputs.
        y: measured, NaN where there is nothing.
        start: state to begin with.
        substeps: steps for each sampling interval.
    """
    known = jnp.isfinite(y)
    level = jnp.sqrt(jnp.nanmean(y**2, axis=0))
    weight = jnp.where(known, 1.0, 0.0) / jnp.where(level > 0, level, 1.0)

    def residual(state: Array) -> Array:
        outputs = _run(given, state, substeps).outputs
        return jnp.where(known, outputs - jnp.where(known, y, 0.0), 0.0) * weight

    # what leaves no trace in the outputs stays where it is
    found = levenberg_marquardt(forward(residual), start, max_steps=STEPS, tolerance=1e-8)
    # a search that begins in motion creeps towards a contact at rest and may end beside it
    still = jnp.zeros_like(start)
    at_rest = 0.5 * (residual(still) ** 2).sum() < found.cost
    return lax.stop_gradient(jnp.where(at_rest, still, found.value))
