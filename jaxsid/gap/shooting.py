"""A hypothesis simulated in windows, each from an initial state that is found with the rest.

Multiple shooting (H. Bock, 1983): no window is long enough for a wrong start to lead astray, and none shorter than a
few vibrations. One compiled program prepares the linear part for effects of all sorts; another gives, for a block of
windows of fixed size, all products of residuals and slopes that a step of Gauss and Newton needs, and knows kinds of
effects by their sorts only. The search itself runs outside, so that few programs serve records of any length.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsid.compilation import compiled, compiled_in_full
from jaxsid.gap.hypothesis import Coordinates
from jaxsid.gap.windows import Block
from jaxsid.mechanics.effects.catalogue import Sorted
from jaxsid.mechanics.sensitivity import Laws, LinearPart, Windows, linear_part, marched
from jaxsid.mechanics.slots import Slots
from jaxsid.parallel import side_by_side
from jaxsid.physical.motion import counted
from jaxsid.records import SecondOrderModel


class Shot(eqx.Module):
    """A hypothesis ready to be simulated.

    Attributes:
        linear: the nominal model without effects.
        directions: (e, N, N) each, what the elements add to M, D, K, times their values.
        slots: effects; their parameters do not count.
        coordinates: of their unknowns.
    """

    linear: SecondOrderModel
    directions: tuple[Array, Array, Array]
    slots: Slots
    coordinates: Coordinates


class Products(NamedTuple):
    """Of every window: products of all slopes and the residual, in this order: unknowns, initial state, residual.

    Attributes:
        gram: (windows, p + n + 1, p + n + 1).
        equations: (windows,) entries of the residual that count.
        left: (windows, lead + length, outputs) simulated less measured.
        forces: (windows, lead + length, slots) of each effect.
        ends: (windows, n, 1 + p + n) states where the next window begins, then their slopes.
    """

    gram: Float[Array, "windows q q"]
    equations: Int[Array, " windows"]
    left: Float[Array, "windows length outputs"]
    forces: Float[Array, "windows length slots"]
    ends: Float[Array, "windows n columns"]


class Prepared(eqx.Module):
    """A hypothesis with its unknowns, ready for windows: of the linear part and the parameters, values and slopes.

    Attributes:
        own, slopes: the linear part, from `linear_part`, and by the unknowns, the last axis.
        parameters: (records, slots, most).
        parameter_slopes: (records, slots, most, p).
        kinds: of the effects.
        substeps: steps for each sampling interval.
    """

    own: LinearPart
    slopes: LinearPart
    parameters: Float[Array, "records slots most"]
    parameter_slopes: Float[Array, "records slots most p"]
    kinds: Sorted
    substeps: Int[Array, ""]


def ready(shot: Shot, theta: Array, dt: Array, records: int, substeps: Array) -> Prepared:
    """A hypothesis with its unknowns.

    Args:
        shot: the hypothesis.
        theta: (p,) unknowns.
        dt: sampling interval, s.
        records: how many there are.
        substeps: steps for each sampling interval.
    """
    # the linear part is one program for kinds of all sorts
    kinds = shot.slots.kinds
    assert isinstance(kinds, Sorted)
    plain = eqx.tree_at(lambda s: s.slots.kinds, shot, kinds.numbers)
    own, slopes, *parameters = _with_slopes(plain, theta, dt, records, substeps)
    return Prepared(own, slopes, parameters[0], parameters[1], kinds, substeps)


@compiled_in_full
def _with_slopes(shot: Shot, theta: Array, dt: Array, records: int, substeps: Array) -> tuple[Any, ...]:
    def of(theta: Array) -> tuple[LinearPart, Array]:
        # but for phases of periodic laws parameters are the same in all records
        every = jnp.stack([parameters_of(shot, theta, i) for i in range(records)])
        slots = eqx.tree_at(lambda s: s.parameters, shot.slots, every[0])
        return linear_part(matrices_of(shot, theta), slots, dt, substeps), every

    (own, every), (slopes, every_slopes) = of(theta), jax.jacfwd(of)(theta)
    return own, slopes, every, every_slopes


@compiled_in_full
def products(given: Prepared, block: Block, states: Array) -> Products:
    """What a step needs of a block.

    Args:
        given: the hypothesis with its unknowns.
        block: windows.
        states: (windows, n) initial ones.
    """
    rows, found = _rows(given, block, states)
    gram = jnp.einsum("wrp,wrq->wpq", rows, rows)
    return Products(gram, (_counts(block) > 0).sum(axis=(1, 2)), *found)


@compiled_in_full
def slopes(given: Prepared, block: Block, states: Array) -> tuple[Float[Array, "windows rows q"], Array]:
    """Rows of a block as noise is white in them, slopes and what is left as in `Products`; and what is left itself.

    Args:
        given: the hypothesis with its unknowns.
        block: windows.
        states: (windows, n) initial ones.
    """
    rows, (left, *_) = _rows(given, block, states)
    return rows, left


def _rows(given: Prepared, block: Block, states: Array) -> tuple[Array, tuple[Array, Array, Array]]:
    own = lambda x: jnp.moveaxis(x[block.record], 0, -1)  # noqa: E731
    laws = Laws(given.kinds, own(given.parameters), own(given.parameter_slopes))
    windows = Windows(
        block.u, block.ramps, block.lead, block.dt, block.first, states, block.y.shape[1] - block.lead
    )
    found = marched(given.own, given.slopes, laws, windows, given.substeps)
    turned = lambda x: jnp.moveaxis(x, -1, 0)  # noqa: E731
    left = turned(found.outputs).at[:, :, :, 0].add(-block.y)
    white = _white(jnp.where(block.weight[..., None] > 0, left, 0.0), block.taps, block.lead)
    rows = (white * _counts(block)[..., None]).reshape(len(left), -1, left.shape[-1])
    # the residual comes last
    rows = jnp.concatenate([rows[..., 1:], rows[..., :1]], axis=2)
    return rows, (left[..., 0], turned(found.forces), turned(found.ends))


def _counts(block: Block) -> Float[Array, "windows length outputs"]:
    every = jax.vmap(lambda weight, taps: counted(weight[None], taps)[0])(block.weight, block.taps)
    return every[:, block.lead :]


def _white(left: Array, taps: Array, lead: int) -> Float[Array, "windows length outputs columns"]:
    """Filtered, without the samples before a window, where the filter has settled."""
    count = taps.shape[-1]
    before = jnp.pad(left, ((0, 0), (max(count - 1 - lead, 0), 0), (0, 0), (0, 0)))
    length, begin = left.shape[1] - lead, before.shape[1] - left.shape[1] + lead
    parts = (taps[:, None, :, k, None] * before[:, begin - k : begin - k + length] for k in range(count))
    return sum(parts, start=jnp.zeros(()))


def parameters_of(shot: Shot, theta: Array, record: Array | int) -> Float[Array, "slots most"]:
    """Parameters of the effects in a record.

    Args:
        shot: the hypothesis.
        theta: (p,) unknowns.
        record: number of the record.
    """
    return _parameters(shot.coordinates, len(shot.directions[0]), theta, record)


def told_parameters(shot: Shot, theta: Array, records: int) -> tuple[Array, Array]:
    """`parameters_of` every record, (records, slots, most), and slopes of the first one's, (slots * most, p).

    Args:
        shot: the hypothesis.
        theta: (p,) unknowns.
        records: how many.
    """
    return _told(shot.coordinates, len(shot.directions[0]), theta, records)


@compiled
def _told(coordinates: Coordinates, elements: int, theta: Array, records: int) -> tuple[Array, Array]:
    every = jnp.stack([_parameters(coordinates, elements, theta, i) for i in range(records)])
    return every, jax.jacfwd(lambda t: _parameters(coordinates, elements, t, 0).ravel())(theta)


def _parameters(coordinates: Coordinates, elements: int, theta: Array, record: Array | int) -> Array:
    count = coordinates.centre.size
    z = theta[elements : elements + count].reshape(coordinates.centre.shape)
    further = theta[elements + count :].reshape(-1, len(coordinates.centre))
    shift = jnp.concatenate([jnp.zeros((1, further.shape[1]), z.dtype), further])[record]
    return coordinates.parameters(jnp.where(coordinates.per_record, z + shift[:, None], z))


def matrices_of(shot: Shot, theta: Array) -> SecondOrderModel:
    """The linear model with its elements changed.

    Args:
        shot: the hypothesis.
        theta: (p,) unknowns.
    """
    change = theta[: len(shot.directions[0])]
    linear = shot.linear
    moved = [
        x + jnp.einsum("e,eij->ij", change, d)
        for x, d in zip((linear.mass, linear.damping, linear.stiffness), shot.directions, strict=True)
    ]
    return eqx.tree_at(lambda s: (s.mass, s.damping, s.stiffness), linear, tuple(moved))


def products_of(
    shot: Shot,
    blocks: Sequence[Block],
    theta: Float[np.ndarray, " p"],
    states: Sequence[Float[np.ndarray, "windows n"]],
    substeps: int,
) -> list[Products]:
    """What a step needs of all blocks.

    Args:
        shot: the hypothesis.
        blocks: windows.
        theta: (p,) unknowns.
        states: of each block (windows, n), initial ones.
        substeps: steps for each sampling interval.
    """
    each = ready_for(shot, blocks, theta, substeps)

    def of(given: tuple[Prepared, Block, np.ndarray]) -> Products:
        # XLA would run one after the other
        return jax.block_until_ready(products(given[0], given[1], jnp.asarray(given[2])))

    return side_by_side(of, zip(each, blocks, states, strict=True))


def ready_for(
    shot: Shot, blocks: Sequence[Block], theta: Float[np.ndarray, " p"], substeps: int
) -> list[Prepared]:
    """A hypothesis with its unknowns, for each block; once for all of one sampling interval.

    Args:
        shot: the hypothesis.
        blocks: windows.
        theta: (p,) unknowns.
        substeps: steps for each sampling interval.
    """
    records = 1 + (len(theta) - len(shot.directions[0]) - shot.coordinates.centre.size) // shot.slots.count
    number, by_interval = jnp.asarray(substeps), {}
    for block in blocks:
        if (dt := float(block.dt)) not in by_interval:
            by_interval[dt] = ready(shot, jnp.asarray(theta), block.dt, records, number)
    return [by_interval[float(b.dt)] for b in blocks]
