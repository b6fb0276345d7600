"""A hypothesis run over a record from one state, piece by piece, so that programs do not depend on its length."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsid.compilation import compiled_in_full
from jaxsid.gap.shooting import Shot, matrices_of, parameters_of
from jaxsid.mechanics.augmented import augmented
from jaxsid.mechanics.nonlinear import Response, forced, respond_to

PIECE, LEAD = 2048, 256  # samples of a piece, and before it, which late sensors and inputs need


class Run(NamedTuple):
    """From its first sample on: readings (samples, outputs) and states (samples, n)."""

    outputs: Float[np.ndarray, "samples outputs"]
    states: Float[np.ndarray, "samples n"]


def free_run(
    shot: Shot,
    theta: Float[np.ndarray, " p"],
    u: Float[np.ndarray, "samples inputs"],
    ramps: Bool[Array, " inputs"],
    dt: float,
    state: Float[np.ndarray, " n"],
    *,
    record: int,
    first: int,
    substeps: int,
) -> Run:
    """Readings from a sample on, one row for it and each after it, and the states.

    Args:
        shot: the hypothesis.
        theta: its unknowns.
        u: inputs of the whole record.
        ramps: which are held to first order.
        dt: sampling interval, s.
        state: at the first sample.
        record: number of the record.
        first: number of that sample, less than 0 before the record, where inputs are zero.
        substeps: steps for each sampling interval.
    """
    before = max(0, 2 * LEAD - first)
    whole = np.pad(np.asarray(u), ((before, PIECE + LEAD), (0, 0)))
    whole[before + len(u) :] = np.asarray(u)[-1]
    given, number = (jnp.asarray(theta), ramps, jnp.asarray(dt), jnp.asarray(record)), jnp.asarray(substeps)
    found, at, now = [], first, jnp.asarray(state)
    while at < len(u):
        # what lies before the state is of use to the inputs only
        cut = jnp.asarray(whole[before + at - LEAD : before + at + PIECE + LEAD])
        piece = _piece(shot, *given, cut, now, jnp.asarray(at), number)
        outputs, states = (np.asarray(x) for x in (piece.outputs, piece.states))
        part = slice(LEAD if found else 0, PIECE + LEAD)
        found.append((outputs[part], states[part]))
        at, now = at + PIECE, jnp.asarray(states[PIECE])
    rows = len(u) - first
    return Run(*(np.concatenate(x)[:rows] for x in zip(*found, strict=True)))


@compiled_in_full
def _piece(
    shot: Shot,
    theta: Array,
    ramps: Array,
    dt: Array,
    record: Array,
    u: Array,
    state: Array,
    first: Array,
    substeps: Array,
) -> Response:
    slots = eqx.tree_at(lambda s: s.parameters, shot.slots, parameters_of(shot, theta, record))
    system = augmented(matrices_of(shot, theta), slots)
    late = forced(system, slots, u, ramps, dt)
    late = eqx.tree_at(lambda x: x[:4], late, tuple(x[LEAD:] for x in late[:4]))
    return respond_to(system, slots, late, dt, state, substeps, first)
