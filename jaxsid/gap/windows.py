"""Records in windows of one length, in blocks of one size, so that programs do not depend on how long a record is.

A window begins a little before the samples that it judges: late sensors read what was there before them, and what its
initial state gets wrong at first has died out or is told from them.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsid.gap.noise import Noise
from jaxsid.mechanics.lumped import LumpedModel
from jaxsid.mechanics.simulate import measured_sensors, ordered_inputs
from jaxsid.records import Record

BLOCKS = 1024, 2048  # samples that a block judges: the shortest that a record fills, so that programs are few
SHORTEST, LONGEST = 128, 2048  # samples that a window judges
PERIODS = 4.0  # of the slowest vibration, in a window
LEAD = 8  # part of a window, as its inverse, that comes before what it judges
SHORTEST_LEAD = 2  # samples, where that would be less
UNTOLD, UNTOLD_PART = SHORTEST // LEAD, 0.02  # first samples of a record that are not judged, and most of it


class Block(eqx.Module):
    """Windows side by side; those beyond the end of the records have no weight.

    Attributes:
        u: (windows, lead + lead + length, inputs) inputs, from one lead before the window begins.
        y: (windows, lead + length, outputs) measured.
        weight: (windows, lead + length, outputs) one over the noise's level, 0 where nothing was measured, and of a
            record's first samples; what comes before the window serves the filter only.
        taps: (windows, outputs, taps) of the filter that makes the noise white, the first 1.
        first: (windows,) number of the sample that a window begins at, less than 0 before the record's start.
        record: (windows,) number of the record.
        ramps: (inputs,) which are held to first order.
        dt: sampling interval, s.
    """

    u: Float[Array, "windows before inputs"]
    y: Float[Array, "windows length outputs"]
    weight: Float[Array, "windows length outputs"]
    taps: Float[Array, "windows outputs taps"]
    first: Int[Array, " windows"]
    record: Int[Array, " windows"]
    ramps: Bool[Array, " inputs"]
    dt: Float[Array, ""]

    @property
    def lead(self) -> int:
        return self.u.shape[1] - self.y.shape[1]


def window_length(rate: float, dt: float, longest: int) -> int:
    """Samples that a window judges: a power of two.

    Args:
        rate: of the slowest vibration, rad/s.
        dt: sampling interval, s.
        longest: samples of the longest record.
    """
    wished = PERIODS * 2 * np.pi / rate / dt
    power = int(np.ceil(np.log2(max(min(wished, longest), 1.0))))
    return int(np.clip(2**power, SHORTEST, LONGEST))


def untold(samples: int) -> int:
    """How many of a record's first samples are not judged: a late input is still there what it was before.

    Args:
        samples: of the record.
    """
    return min(UNTOLD, round(UNTOLD_PART * samples))


def blocks_of(
    model: LumpedModel,
    records: Sequence[Record],
    noises: Sequence[Noise],
    length: int,
    begin: Sequence[int] | None = None,
) -> tuple[Block, ...]:
    """All records, cut into windows.

    Args:
        model: its inputs and sensors.
        records: with some of its sensors each.
        noises: of each.
        length: samples that a window judges, from `window_length`.
        begin: the first sample of each that is judged; 0 where left out.
    """
    start = [0] * len(records) if begin is None else begin
    return tuple(
        block
        for number, (record, noise, first) in enumerate(zip(records, noises, start, strict=True))
        for block in _of_record(model, record, noise, number, length, first)
    )


def _of_record(
    model: LumpedModel, record: Record, noise: Noise, number: int, length: int, begin: int
) -> list[Block]:
    lead = max(length // LEAD, SHORTEST_LEAD)
    whole = next((b for b in BLOCKS if len(record.y) - begin <= b), BLOCKS[-1])
    count = max(whole // length, 1)
    u, hold = ordered_inputs(model, record)
    ramps = jnp.asarray([h != "zero" for h in hold])
    rows, columns = measured_sensors(model, record)
    samples = len(record.y)
    y = np.zeros((samples, len(model.sensors)))
    y[:, rows] = np.nan_to_num(np.asarray(record.y)[:, columns])
    seen = np.zeros_like(y)
    seen[:, rows] = np.isfinite(np.asarray(record.y)[:, columns])
    if begin == 0:
        seen[: untold(samples)] = 0.0
    level = np.where(np.isfinite(noise.level) & (noise.level > 0), noise.level, np.inf)
    windows = -(-(samples - begin) // (length * count)) * count
    after = begin + windows * length - samples
    before = np.pad(np.asarray(u), ((2 * lead, 0), (0, 0)))
    u = np.pad(before, ((0, after), (0, 0)), mode="edge")
    y, weight = (np.pad(x, ((lead, after), (0, 0))) for x in (y, seen / level))
    starts = begin + length * np.arange(windows)
    cut = lambda x, extra: x[starts[:, None] + np.arange(length + extra)]  # noqa: E731
    taps = np.tile(noise.taps, (windows, 1, 1))
    parts = cut(u, 2 * lead), cut(y, lead), cut(weight, lead), taps, starts - lead, np.full(windows, number)
    return [
        Block(*(jnp.asarray(x[i : i + count]) for x in parts), ramps=ramps, dt=jnp.asarray(float(record.dt)))
        for i in range(0, windows, count)
    ]
