"""Eager validation at the boundary, and the errors that users see.

A message says what happened, where, the likely cause and what to do. Checks of values are skipped on
traced arrays, so that every public function works under `jit`, `vmap` and `grad`.
"""

from collections.abc import Sequence
from typing import NoReturn

import jax.core
import numpy as np
from jaxtyping import Array

from jaxsid.records import HOLDS, Record


class JaxsidError(ValueError):
    """Base of the errors that jaxsid raises on purpose."""


class InputError(JaxsidError):
    """The input is wrong: a file, a name, a shape or a value. The command exits with code 2."""


class InsufficientDataError(JaxsidError):
    """The input is well formed but cannot support an answer. The command exits with code 3."""


def bad_input(message: str) -> NoReturn:
    raise InputError(message)


def require(condition: bool | np.bool_, message: str) -> None:
    """Raise InputError(message) unless the condition, on shapes or options, holds."""
    if not condition:
        raise InputError(message)


def is_concrete(*arrays: Array) -> bool:
    """Whether all arrays hold values now, so that these can be checked."""
    return not any(isinstance(a, jax.core.Tracer) for a in arrays)


def require_finite(values: Array, what: str, names: Sequence[str] = ()) -> None:
    """Raise InputError naming the first NaN or infinite entry of an eager array."""
    if not is_concrete(values):
        return
    bad = np.argwhere(~np.isfinite(np.asarray(values)))
    if bad.size:
        index = tuple(int(i) for i in bad[0])
        channel = f" (column '{names[index[-1]]}')" if names else ""
        bad_input(
            f"{what}: {len(bad)} values are NaN or infinite, the first at {index}{channel}. Repair or cut the record."
        )


def check_record(record: Record) -> None:
    """Raise InputError where a record's shapes, names, holds or values cannot be used."""
    require(record.u.ndim == 2 and record.y.ndim == 2, f"{record.name}: u and y must be (samples, channels)")
    samples = record.u.shape[0]
    require(
        samples == record.y.shape[0],
        f"{record.name}: u has {samples} samples but y has {record.y.shape[0]}; read them at the same instants.",
    )
    require(record.u.shape[1] > 0 and record.y.shape[1] > 0, f"{record.name}: needs an input and an output")
    require(
        len(record.inputs) == record.u.shape[1] and len(record.outputs) == record.y.shape[1],
        f"{record.name}: as many names as columns, please",
    )
    require(len(record.hold) == record.u.shape[1], f"{record.name}: one hold for each input, please")
    for hold in record.hold:
        require(hold in HOLDS, f"{record.name}: hold '{hold}' is unknown; choose from {', '.join(HOLDS)}.")
    require_finite(record.u, f"{record.name}, input", record.inputs)
    require_finite(record.y, f"{record.name}, output", record.outputs)
    if is_concrete(record.dt):
        dt = float(record.dt)
        require(dt > 0, f"{record.name}: the sampling interval must be positive, not {dt} s")


def check_excitation(record: Record) -> None:
    """Raise InputError where an input is zero, constant, or proportional to another one."""
    if not is_concrete(record.u):
        return
    u = np.asarray(record.u, dtype=float)
    centred = u - u.mean(axis=0)
    scale = np.sqrt((centred**2).sum(axis=0))
    for name, column, size in zip(record.inputs, u.T, scale, strict=True):
        if size <= 1e-12 * max(np.abs(column).max() * np.sqrt(len(u)), np.finfo(float).tiny):
            state = "zero" if not column.any() else "constant"
            bad_input(
                f"{record.name}: input '{name}' is {state} throughout: it excites nothing. Leave it out, or use "
                "another record."
            )
    coherence = np.abs((centred / scale).T @ (centred / scale))
    for i, j in zip(*np.triu_indices(u.shape[1], 1), strict=True):
        if coherence[i, j] > 1 - 1e-10:
            bad_input(
                f"{record.name}: inputs '{record.inputs[i]}' and '{record.inputs[j]}' are the same signal up to a "
                "factor, so their effects cannot be told apart. Drive them independently, one after another, or "
                "drop one."
            )


def check_sensors(record: Record) -> None:
    """Raise InputError where an output is constant, as that of a sensor that is dead or not connected."""
    if not is_concrete(record.y):
        return
    y = np.asarray(record.y, dtype=float)
    for name, column in zip(record.outputs, y.T, strict=True):
        if np.ptp(column) <= 1e-14 * np.abs(column).max():
            bad_input(
                f"{record.name}: sensor '{name}' reads {column[0]:.6g} throughout: it is dead, not connected, or "
                "saturated. Leave its column out."
            )
