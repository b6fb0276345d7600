"""Records without what effects that were found do to them, so that what is left can be looked at as if they were not.

What effects do is the difference of two free runs, with and without them. On a free axis a law's run leaves what was
measured without bounds. There its force is taken from the windows that it was fitted in, sample by sample; with these
forces given all the rest is linear.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsid.gap.free_run import free_run
from jaxsid.gap.measure import is_free_or_unstable
from jaxsid.gap.refit import Bench, Refit, in_windows, shot_of
from jaxsid.gap.shooting import Shot
from jaxsid.mechanics.effects.catalogue import CATALOGUE, sort_of
from jaxsid.mechanics.simulate import ordered_inputs
from jaxsid.records import Record


def deflated(record: Record, number: int, bench: Bench, found: Refit) -> Record:
    """A record less what effects do to it.

    Args:
        record: that the effects were fitted to.
        number: of it.
        bench: of all records.
        found: the fit.
    """
    effects = found.hypothesis.effects
    if not effects:
        return record
    leaves = is_free_or_unstable(bench.model)
    laws = [i for i, e in enumerate(effects) if leaves and sort_of(CATALOGUE[e.kind]) != "linear"]
    kept = [i for i in range(len(effects)) if i not in laws]
    first = next(i for i, b in enumerate(bench.blocks) if int(b.record[0]) == number)
    block, begin = bench.blocks[first], int(bench.blocks[first].first[0])
    u = np.asarray(ordered_inputs(bench.model, record)[0])
    given = {"record": number, "first": begin, "substeps": bench.substeps}

    def run(shot: Shot, theta: np.ndarray, inputs: np.ndarray, ramps: Array, state: np.ndarray) -> np.ndarray:
        return free_run(shot, theta, inputs, ramps, float(record.dt), state, **given).outputs[-begin:]

    size, state = 2 * len(bench.model.bodies), found.fit.states[first][0]
    hidden = state[size:].reshape(2, len(effects))[:, kept].ravel()

    def padded(shot: Shot, *parts: np.ndarray) -> np.ndarray:
        joined = np.concatenate(parts)
        return np.pad(joined, (0, size + 2 * shot.slots.count - len(joined)))

    plain, rest = _part(found, bench, [])
    without = run(plain, rest, u, block.ramps, padded(plain, state[:size]))
    shot, theta = _part(found, bench, kept)
    begun = padded(shot, state[:size], hidden)
    if laws:
        shot = _driven(shot, np.asarray(found.shot.slots.pushes)[laws])
        u = np.concatenate([u, _forces(number, bench, found)[: len(u), laws]], axis=1)
    ramps = jnp.concatenate([block.ramps, jnp.ones(len(laws), bool)])
    change = run(shot, theta, u, ramps, begun) - without
    names = [s.name for s in bench.model.sensors]
    columns = [change[:, names.index(n)] if n in names else 0.0 * change[:, 0] for n in record.outputs]
    return eqx.tree_at(lambda r: r.y, record, jnp.asarray(np.asarray(record.y) - np.stack(columns, axis=1)))


def _forces(number: int, bench: Bench, found: Refit) -> Float[np.ndarray, "samples slots"]:
    """Of every effect along a record."""
    blocks = [
        (b, x)
        for b, x in zip(bench.blocks, in_windows(bench, found), strict=True)
        if int(b.record[0]) == number
    ]
    return np.concatenate(
        [np.asarray(x.forces)[:, b.lead :].reshape(-1, x.forces.shape[2]) for b, x in blocks]
    )


def _part(found: Refit, bench: Bench, kept: list[int]) -> tuple[Shot, np.ndarray]:
    """The hypothesis with some of its effects only, and its unknowns."""
    shot = shot_of(bench, tuple(found.hypothesis.effects[i] for i in kept))
    elements, slots = len(bench.tolerance), len(found.shot.slots.parameters)
    theta, rows = np.asarray(found.fit.theta), shot.slots.count
    own, further = (
        np.zeros((rows, found.shot.coordinates.centre.shape[1])),
        np.zeros((bench.records - 1, rows)),
    )
    z = theta[elements : elements + found.shot.coordinates.centre.size].reshape(slots, -1)
    shifts = theta[elements + z.size :].reshape(-1, slots)
    own[: len(kept)], further[:, : len(kept)] = z[kept], shifts[:, kept]
    return shot, np.concatenate([theta[:elements], own.ravel(), further.ravel()])


def _driven(shot: Shot, pushes: Float[np.ndarray, "laws N"]) -> Shot:
    """The same with forces of laws as further inputs."""
    matrix = jnp.concatenate([shot.linear.input_matrix, jnp.asarray(pushes).T], axis=1)
    inputs = jnp.pad(shot.slots.inputs, ((0, 0), (0, len(pushes))))
    return eqx.tree_at(lambda s: (s.linear.input_matrix, s.slots.inputs), shot, (matrix, inputs))
