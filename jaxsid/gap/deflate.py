"""Records without what effects that were found do to them, so that what is left can be looked at as if they were not.

Given the motion, forces of effects are forces like any other, and all the rest is linear: x+ = A x + e from window to
window, e what the effects did on the way. Their share of the motion builds up as c+ = A c + e, and what they do to
readings is how a window that begins at x differs from one of the linear model that begins at x - c. So laws act at
every step of a simulation, not only where there are samples.

Windows of a fit that lead to one another follow what was measured, so that no small error leads astray. Windows that
stand alone know their motion from a few samples each; a free run knows it better, unless it drifts away, or grows
without bound, as it may with a law that holds within windows.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxsid.gap.free_run import free_run
from jaxsid.gap.measure import is_free_or_unstable
from jaxsid.gap.refit import Bench, Refit, shot_of
from jaxsid.gap.shooting import Products, Shot, products_of
from jaxsid.gap.windows import Block, untold
from jaxsid.mechanics.simulate import ordered_inputs
from jaxsid.records import Record


def deflated(records: Sequence[Record], bench: Bench, found: Refit) -> list[Record]:
    """Records less what effects do to them.

    Args:
        records: that the effects were fitted to.
        bench: of them.
        found: the fit.
    """
    if not found.hypothesis.effects:
        return list(records)
    begun = found.fit.states if _followed(bench) else _run(records, bench, found)
    first = [untold(len(r.y)) for r in records]
    changes = _changes(bench, found, begun, first)
    if not all(np.isfinite(x).all() for x in changes):
        changes = _changes(bench, found, found.fit.states, first)
    return [_less(record, i, bench, changes) for i, record in enumerate(records)]


def _changes(
    bench: Bench, found: Refit, begun: Sequence[Float[np.ndarray, "windows n"]], first: Sequence[int]
) -> list[Float[np.ndarray, "windows length outputs"]]:
    """What effects do to the readings of every window, whose states are given where it begins.

    Of each record the first sample that is judged is given, too.
    """
    size = 2 * len(bench.model.bodies)
    plain, theta = _linear(found, bench)
    own = ((0, 0), (0, 2 * plain.slots.count))
    within = products_of(found.shot, bench.blocks, found.fit.theta, begun, bench.substeps)
    states = [np.pad(s[:, :size], own) for s in begun]
    shares = _shares(bench, within, products_of(plain, bench.blocks, theta, states, 1), size)
    rest = [s - np.pad(c, own) for s, c in zip(states, shares, strict=True)]
    without = products_of(plain, bench.blocks, theta, rest, 1)
    # samples that were not judged become what the linear model makes of them
    parts = zip(bench.blocks, within, without, strict=True)
    return [np.where(_told(b, first), x.left, 0.0) - np.asarray(y.left) for b, x, y in parts]


def _told(block: Block, first: Sequence[int]) -> Bool[np.ndarray, "windows length 1"]:
    """Which samples of its windows are no earlier than the first of its record that is judged."""
    number = np.asarray(block.first)[:, None] + np.arange(block.y.shape[1])
    return (number >= first[int(block.record[0])])[:, :, None]


def _followed(bench: Bench) -> bool:
    """Whether the windows are a better motion than a free run."""
    return bool(np.isfinite(bench.jump)) or is_free_or_unstable(bench.model)


def _run(records: Sequence[Record], bench: Bench, found: Refit) -> list[Float[np.ndarray, "windows n"]]:
    """States at the start of every window, of runs from the first window of each record."""
    states = []
    for number, record in enumerate(records):
        own = [
            (b, s) for b, s in zip(bench.blocks, found.fit.states, strict=True) if int(b.record[0]) == number
        ]
        (block, begun), u = own[0], np.asarray(ordered_inputs(bench.model, record)[0])
        first = int(block.first[0])
        given = {"record": number, "first": first, "substeps": bench.substeps}
        run = free_run(found.shot, found.fit.theta, u, block.ramps, float(record.dt), begun[0], **given)
        states += [run.states[np.clip(np.asarray(b.first) - first, 0, len(run.states) - 1)] for b, _ in own]
    return states


def _linear(found: Refit, bench: Bench) -> tuple[Shot, Float[np.ndarray, " p"]]:
    """The fit's model without effects, and its unknowns."""
    shot = shot_of(bench, ())
    elements = len(bench.tolerance)
    rest = shot.coordinates.centre.size + (bench.records - 1) * shot.slots.count
    return shot, np.pad(np.asarray(found.fit.theta)[:elements], (0, rest))


def _shares(
    bench: Bench, within: Sequence[Products], linear: Sequence[Products], size: int
) -> list[Float[np.ndarray, "windows n"]]:
    """The effects' share of the motion at the start of every window; none where a record begins."""
    shares, share, number = [], np.zeros(size), -1
    for block, x, y in zip(bench.blocks, within, linear, strict=True):
        if int(block.record[0]) != number:
            share, number = np.zeros(size), int(block.record[0])
        did = np.asarray(x.ends)[:, :size, 0] - np.asarray(y.ends)[:, :size, 0]
        # slopes by the initial state come last
        carried = np.asarray(y.ends)[:, :size, -np.asarray(y.ends).shape[1] :][:, :, :size]
        own = []
        for forced, free in zip(did, carried, strict=True):
            own.append(share)
            share = free @ share + forced
        shares.append(np.stack(own))
    return shares


def _less(record: Record, number: int, bench: Bench, changes: Sequence[np.ndarray]) -> Record:
    """A record less the changes of its windows, side by side."""
    parts = [
        x[:, b.lead :].reshape(-1, x.shape[2])
        for b, x in zip(bench.blocks, changes, strict=True)
        if int(b.record[0]) == number
    ]
    change = np.concatenate(parts)[: len(record.y)]
    names = [s.name for s in bench.model.sensors]
    columns = [change[:, names.index(n)] if n in names else 0.0 * change[:, 0] for n in record.outputs]
    return eqx.tree_at(lambda r: r.y, record, jnp.asarray(np.asarray(record.y) - np.stack(columns, axis=1)))
