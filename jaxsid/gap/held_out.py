"""Which samples at a record's end are held out: nothing is chosen or fitted with them."""

from collections.abc import Sequence

import numpy as np

from jaxsid.records import Record

HELD_OUT = 0.25  # part of the end of every record
LOUDER = 4.0  # times the power that a model leaves before, from which on what is held out is something else
FEWEST, LEAST = 64, 0.02  # samples that stay held out, and their part of the record


def usual_end(record: Record) -> int:
    """How many samples of a record are seen.

    Args:
        record: whole.
    """
    return round((1 - HELD_OUT) * len(record.y))


def seen_part(record: Record, end: int) -> Record:
    """A record without its held-out end.

    Args:
        record: whole.
        end: samples that are seen.
    """
    return Record(
        record.u[:end],
        record.y[:end],
        record.dt,
        inputs=record.inputs,
        outputs=record.outputs,
        hold=record.hold,
        name=record.name,
    )


def later_ends(
    records: Sequence[Record],
    ends: Sequence[int],
    before: Sequence[np.ndarray],
    after: Sequence[np.ndarray],
) -> tuple[int, ...]:
    """Ends that leave in sight most of what the last samples alone hold, where a model leaves far more of them.

    A sweep comes to a resonance, or a gap closes, only then. Of what is left above the level of the samples before,
    the last quarter stays held out.

    Args:
        records: whole.
        ends: samples of each that were seen.
        before, after: (samples, outputs) of each, what the best linear model leaves of those, and of the others; NaN
            for absent sensors.
    """
    return tuple(map(_later, records, ends, before, after))


def _later(record: Record, end: int, before: np.ndarray, after: np.ndarray) -> int:
    there = np.isfinite(before).any(axis=0) & np.isfinite(after).any(axis=0)
    level = np.sqrt(np.nanmean(before[:, there] ** 2, axis=0))
    if not there.any() or not (level > 0).all():
        return end
    power = np.nan_to_num(np.nanmean((after[:, there] / level) ** 2, axis=1))
    if power.mean() <= LOUDER:
        return end
    above = np.cumsum(np.maximum(power - 1.0, 0.0))
    later = end + int(np.argmax(above >= (1 - HELD_OUT) * above[-1])) + 1
    kept = max(FEWEST, round(LEAST * len(record.y)))
    return max(end, min(later, len(record.y) - kept))
