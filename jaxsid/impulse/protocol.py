"""What every impulse-response estimator takes and gives, and how several records become one ensemble."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsid.checks import bad_input, check_excitation, check_record, is_concrete, require
from jaxsid.records import ImpulseResponse, Record


@runtime_checkable
class ImpulseMethod(Protocol):
    """An estimator: a frozen value which, called with records, gives an impulse response."""

    def __call__(self, records: Sequence[Record], samples: int | None = None) -> ImpulseResponse: ...


class Ensemble(eqx.Module):
    """Records of one system side by side, the shorter ones padded with zeros.

    Attributes:
        u: (records, samples, inputs).
        y: (records, samples, outputs).
        mask: (records, samples), 1 where a sample was measured, 0 where it is padding.
        dt: s.
        lengths: samples of each record.
        hold: behaviour of each input between samples.
    """

    u: Float[Array, "records samples inputs"]
    y: Float[Array, "records samples outputs"]
    mask: Float[Array, "records samples"]
    dt: Float[Array, ""]
    lengths: tuple[int, ...] = eqx.field(static=True)
    hold: tuple[str, ...] = eqx.field(static=True)


def as_records(records: Record | Sequence[Record]) -> tuple[Record, ...]:
    """One record or several, as a tuple; InputError where they cannot belong to one experiment series."""
    many = (records,) if isinstance(records, Record) else tuple(records)
    require(len(many) > 0, "impulse_response: no record was given.")
    first = many[0]
    for record in many:
        check_record(record)
        same = (record.inputs, record.outputs) == (first.inputs, first.outputs)
        require(
            same,
            f"{record.name}: its channels {record.inputs} -> {record.outputs} differ from those of "
            f"{first.name}, "
            f"{first.inputs} -> {first.outputs}. An ensemble needs the same channels in the same order.",
        )
        require(record.hold == first.hold, f"{record.name}: its holds differ from those of {first.name}.")
        if is_concrete(record.dt, first.dt) and abs(float(record.dt) / float(first.dt) - 1) > 1e-6:
            bad_input(
                f"{record.name}: sampled every {float(record.dt):g} s but {first.name} every "
                f"{float(first.dt):g} s. "
                "Resample them to one rate first."
            )
    check_excitation(_joined(many))
    return many


def _joined(records: Sequence[Record]) -> Record:
    """All records one after another: an input may rest in one record if another record drives it."""
    first = records[0]
    u = jnp.concatenate([r.u for r in records])
    y = jnp.concatenate([r.y for r in records])
    return Record(
        u, y, first.dt, inputs=first.inputs, outputs=first.outputs, hold=first.hold, name=first.name
    )


def stack(records: Sequence[Record]) -> Ensemble:
    """Pad to the longest record and stack."""
    lengths = tuple(r.u.shape[0] for r in records)
    s = max(lengths)
    u = jnp.stack([jnp.pad(r.u, ((0, s - r.u.shape[0]), (0, 0))) for r in records])
    y = jnp.stack([jnp.pad(r.y, ((0, s - r.y.shape[0]), (0, 0))) for r in records])
    mask = jnp.stack([jnp.where(jnp.arange(s) < n, 1.0, 0.0) for n in lengths]).astype(y.dtype)
    return Ensemble(u=u, y=y, mask=mask, dt=records[0].dt, lengths=lengths, hold=records[0].hold)


def returned_samples(samples: int | None, available: int, what: str) -> int:
    """How many taps to return; InputError where more are asked for than the data can show."""
    if samples is None:
        return available
    require(samples >= 1, f"samples must be at least 1, not {samples}.")
    require(
        samples <= available,
        f"{samples} samples of the impulse response were asked for, but {what} shows at most {available}. "
        "Ask for fewer, or give a longer record.",
    )
    return samples
