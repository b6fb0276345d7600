"""Whether a law of any shape at a place explains more than those that were found there.

A further force sum_k c_k phi_k(d, v) between two ends adds, as long as it is small, sum_k c_k Phi_k to what a fit
leaves, Phi_k being what the fitted model, its effects and all, makes of the force phi_k on the motion that it has. The
shapes phi_k are hinges of the displacement and of the velocity and products of both: any law without jumps and without
memory is nearly a sum of them. An F test says whether they explain more than chance does, with all unknowns of the fit
and all initial states free. To a law that is there they add nothing; one that stands for another leaves them what that
has of its own, however little that is beside the gap.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxsid.gap.f_test import FTest, f_test
from jaxsid.gap.places import Place, joint_of
from jaxsid.gap.ranking import ERRORS, Explanation, ends_of
from jaxsid.gap.refit import Bench, Refit, prior_of
from jaxsid.gap.shooting import Prepared, Shot, ready_for, slopes
from jaxsid.gap.windows import Block
from jaxsid.mechanics.effects.catalogue import CATALOGUE

HINGES = np.arange(-3, 4) / 4  # of the largest displacement or velocity
SMALL = 1e-4  # of the force that moves the bodies there: a law is as good as straight over that


def smooth_places(selected: Sequence[Explanation]) -> tuple[Place, ...]:
    """Where laws were found, all of which such a sum could be; a damper or spring that is off is a straight one.

    Dry friction and hysteresis are richer at small speeds than any law of theirs, and no sum is in their place. A load
    that is the same at all times is no law of the motion, and is there whatever else is.

    Args:
        selected: what was found.
    """
    at: dict[tuple[str, ...], bool] = {}
    for x in selected:
        where, *ends = ends_of(x.place)
        kind = CATALOGUE[x.kind]
        if where == "between" and x.kind != ERRORS["mass"] and not kind.steady:
            at[tuple(ends)] = at.get(tuple(ends), True) and kind.smooth
    return tuple(Place("between", ends) for ends, smooth in at.items() if smooth)


def any_law(bench: Bench, found: Refit, place: Place) -> FTest:
    """F test of a further law of any shape, over c_k, unknowns theta and states x: min |r + J_t dt + J_x dx + Phi c|^2.

    Args:
        bench: records.
        found: the fit to all of it.
        place: two ends.
    """
    joint = joint_of(bench.model, place)
    shot = _with_port(found.shot, joint)
    blocks = [_with_force(b) for b in bench.blocks]
    each = ready_for(shot, blocks, found.fit.theta, bench.substeps)
    parts = [slopes(*x) for x in zip(each, blocks, map(jnp.asarray, found.fit.states), strict=True)]
    rows, lefts = ([np.asarray(x[i]) for x in parts] for i in (0, 1))
    motions = [x[..., -2:] for x in lefts]
    largest = [
        np.abs(np.where(_told(b), m, 0.0)).max(axis=(0, 1)) for m, b in zip(motions, blocks, strict=True)
    ]
    every = [_shapes(m, np.max(largest, axis=0)) for m in motions]
    small = SMALL * _force(shot, joint, blocks, motions)
    columns = [
        _responses(prepared, block, states, row[..., -1], small * shapes) / small
        for prepared, block, states, row, shapes in zip(
            each, bench.blocks, found.fit.states, rows, every, strict=True
        )
    ]
    unknowns = len(found.fit.theta)
    deviations = bench.state_deviations(found.hypothesis.effects)
    grams = [_without_states(*x, unknowns, deviations) for x in zip(rows, columns, strict=True)]
    gram = np.sum(grams, axis=0)
    # what is likely beforehand counts like any other row
    prior, row = prior_of(bench, found.hypothesis, found.shot), np.zeros((unknowns, len(gram)))
    row[:, :unknowns] = np.diag(1 / prior.deviation)
    row[:, -1] = (found.fit.theta - prior.mean) / prior.deviation
    if not np.isfinite(gram).all():  # a law that lets the motion grow may let a small force carry it away
        return FTest(1.0, 0.0)
    windows = sum(int(_told(b).sum()) for b in blocks)
    fitted = unknowns + windows * found.fit.states[0].shape[1]
    return f_test(gram + row.T @ row, unknowns, found.fit.equations - fitted)


def _with_port(shot: Shot, joint: Float[np.ndarray, " N"]) -> Shot:
    """The hypothesis with one more input, a force at the place, and its displacement and velocity read as well."""
    row, none = jnp.asarray(joint)[None], jnp.zeros((1, len(joint)))
    parts = lambda s: (  # noqa: E731
        s.linear.input_matrix,
        s.linear.displacement_sensors,
        s.linear.velocity_sensors,
        s.linear.acceleration_sensors,
        s.slots.inputs,
        s.slots.sensors,
    )
    force, displacement, velocity, acceleration, inputs, sensors = parts(shot)
    new = (
        jnp.concatenate([force, row.T], axis=1),
        jnp.concatenate([displacement, row, none]),
        jnp.concatenate([velocity, none, row]),
        jnp.concatenate([acceleration, none, none]),
        jnp.pad(inputs, ((0, 0), (0, 1))),
        jnp.pad(sensors, ((0, 0), (0, 2))),
    )
    return eqx.tree_at(parts, shot, new)


def _with_force(block: Block, force: Float[np.ndarray, "windows length"] | None = None) -> Block:
    """A block with that input, from where its windows begin, and those readings, which are not judged."""
    more = np.zeros((*block.u.shape[:2], 1))
    if force is not None:
        more[:, block.lead :, 0] = force
    wide = lambda x: jnp.pad(x, ((0, 0), (0, 0), (0, 2)))  # noqa: E731
    return Block(
        jnp.concatenate([block.u, jnp.asarray(more)], axis=2),
        wide(block.y),
        wide(block.weight),
        jnp.pad(block.taps, ((0, 0), (0, 2), (0, 0))),
        block.first,
        block.record,
        jnp.append(block.ramps, True),
        block.dt,
    )


def _told(block: Block) -> Bool[np.ndarray, "windows 1 1"]:
    """Windows where anything was measured."""
    return np.asarray((block.weight > 0).any(axis=(1, 2)))[:, None, None]


def _force(shot: Shot, joint: np.ndarray, blocks: Sequence[Block], motions: Sequence[np.ndarray]) -> float:
    """Rms of the force that accelerates what hangs there."""
    mass = float(joint @ np.asarray(shot.linear.mass) @ joint)
    pairs = zip(motions, blocks, strict=True)
    moved = [np.diff(np.where(_told(b)[..., 0], m[..., 1], 0.0), axis=1) / float(b.dt) for m, b in pairs]
    return mass * float(np.sqrt(np.mean([(x**2).mean() for x in moved])))


def _shapes(
    motion: Float[np.ndarray, "windows length 2"], largest: Float[np.ndarray, " 2"]
) -> Float[np.ndarray, "windows length k"]:
    """All phi_k, of displacement and velocity next to their largest."""
    d, v = np.moveaxis(motion / np.where(largest > 0, largest, 1.0), -1, 0)
    hinges = [np.maximum(x - at, 0.0) for x in (d, v) for at in HINGES]
    products = [np.ones_like(d), d, v, d * v, d * d * v, d * v * v, np.abs(d) * v]
    return np.stack([*hinges, *products], axis=-1)


def _responses(
    prepared: Prepared,
    block: Block,
    states: Float[np.ndarray, "windows n"],
    left: Float[np.ndarray, "windows rows"],
    forces: Float[np.ndarray, "windows length k"],
) -> Float[np.ndarray, "windows rows k"]:
    """What each force changes of what is left."""
    given = jnp.asarray(states)
    return np.stack(
        [
            np.asarray(slopes(prepared, _with_force(block, force), given)[0])[..., -1] - left
            for force in np.moveaxis(forces, -1, 0)
        ],
        axis=-1,
    )


def _without_states(
    rows: Float[np.ndarray, "windows rows q"],
    columns: Float[np.ndarray, "windows rows k"],
    unknowns: int,
    deviations: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "m m"]:
    """Products of unknowns, columns and what is left, the initial state of each window out of the way first.

    Of what is left rather than differences of products: without noise states take up all but rounding.
    """
    own = rows[..., unknowns:-1]
    rest = np.concatenate([rows[..., :unknowns], columns, rows[..., -1:]], axis=2)
    turned = own.transpose(0, 2, 1)
    inner = turned @ own + np.diag(1 / deviations**2)
    scale = 1 / np.sqrt(np.diagonal(inner, axis1=1, axis2=2))
    across = scale[:, :, None] * (turned @ rest)
    by_states = scale[:, :, None] * np.linalg.solve(inner * scale[:, :, None] * scale[:, None, :], across)
    left, likely = rest - own @ by_states, by_states / deviations[:, None]
    return (left.transpose(0, 2, 1) @ left + likely.transpose(0, 2, 1) @ likely).sum(axis=0)
