"""Records to a state-space model: impulse response, order, ERA or ERA/DC, refinement against the lines."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np

from jaxsid.checks import InsufficientDataError, require
from jaxsid.impulse.inband import observer_response
from jaxsid.impulse.lines import Lines
from jaxsid.impulse.protocol import ImpulseMethod
from jaxsid.mechanics.hold import continuous, discretise
from jaxsid.realization.elimination import needed_poles
from jaxsid.realization.era import era
from jaxsid.realization.era_dc import era_dc
from jaxsid.realization.polish import Polished, polish
from jaxsid.realization.stabilization import Stabilization, stabilization
from jaxsid.records import ContinuousModel, ImpulseResponse, Realization, Record, as_array

# Correlation lags of ERA/DC: few, since the window of the in-band response already spans the slowest period.
LAGS = 5
ROUNDING = 1e-18  # part of the power of a line that no fit can explain
CLEARLY = 0.1  # less noise, in logarithm, before a growing pole is believed
RATE_ROUNDS = 8  # of bringing records to a common rate by a model, each several times nearer than the last
SETTLED = 1e-3  # of the noise: a change of a line that the model no longer feels
GROWTH = 1e4  # over a record, beyond which a pole is unstable and not a free body's in noise


class StateSpace(NamedTuple):
    """State-space model of the records, and how it was reached.

    Attributes:
        response: estimated impulse response.
        raw: realization of that response.
        measured: realization of that response, of a higher order where `raw` misses a pole that the lines need.
        polished: refined against the lines, with noise and residual.
        model: the refined realization in continuous time.
        lines: the lines, all brought to the common sampling interval.
        order_reason: in words.
        stable: False where a pole grows too fast for noise.
        warnings: what went less than well.
    """

    response: ImpulseResponse
    raw: Realization
    measured: Realization
    polished: Polished
    model: ContinuousModel
    lines: Lines
    stabilization: Stabilization
    order_reason: str
    stable: bool
    warnings: tuple[str, ...]


def state_space(
    records: Sequence[Record],
    lines: Lines,
    *,
    order: int | None,
    expected: int,
    realization: str = "era",
    method: ImpulseMethod | None = None,
) -> StateSpace:
    """Estimate, realize and refine.

    Args:
        records: of one system.
        lines: their in-band lines.
        order: number of states; None takes what the model promises.
        expected: number of states that the model promises.
        realization: "era" or "era_dc".
        method: estimator of the impulse response; None for the in-band observer.

    Raises:
        InputError: an unknown realization, an order that does not fit the data.
        InsufficientDataError: no stable fit of that order.
    """
    require(
        realization in ("era", "era_dc"), f"realization '{realization}' is unknown; choose era or era_dc."
    )
    response = observer_response(lines) if method is None else method(records, None)
    order_used = expected if order is None else order
    raw = _realize(response, order_used, realization)
    reason = _reason(raw, order, expected)
    diagram = _diagram(response, max(expected, order_used))
    candidates = [np.linalg.eigvals(np.asarray(raw.A)), _larger(diagram, 2 * order_used, response)]
    growing, stable = _growing(candidates, lines), True
    polished, given = polish(needed_poles(candidates, lines, order_used), lines), lines
    polished, lines = _settled(polished, given, stable=True)
    if len(growing) > 0:
        free = polish(needed_poles(candidates, lines, order_used, stable=False), lines, stable=False)
        if _noise_gain(polished, free, lines) > CLEARLY:
            polished, lines = _settled(free, given, stable=False)
            stable = False
    if not np.isfinite(polished.realization.A).all():
        raise InsufficientDataError(
            f"no model of order {order_used} fits the records: the refinement of the poles diverged. Lower the "
            "order, widen the band of the excitation, or lengthen the record."
        )
    measured = raw
    if not _holds(raw, polished.realization):
        measured = _realize(response, min(2 * order_used, int(diagram.order.max())), realization)
    return StateSpace(
        response,
        raw,
        measured,
        polished,
        continuous(polished.realization),
        lines,
        diagram,
        reason,
        stable,
        () if stable else _unstable(growing),
    )


def _realize(response: ImpulseResponse, order: int, realization: str) -> Realization:
    half = (response.h.shape[0] - 1) // 2
    if realization == "era":
        return era(response, order=order, rows=half, cols=half)
    reach = response.h.shape[0] - 2 - 2 * (LAGS - 1)
    return era_dc(
        response, order=order, rows=reach // 3, cols=reach - reach // 3 - LAGS, lags=LAGS, first_lag=1
    )


def _diagram(response: ImpulseResponse, order: int) -> Stabilization:
    """Orders up to twice the expected one and some, from the window of the impulse response."""
    half = (response.h.shape[0] - 1) // 2
    most = min(2 * order + 8, half)
    return stabilization(response, tuple(range(2, most + 1)), rows=half, cols=half)


def _holds(found: Realization, wanted: Realization) -> bool:
    """Whether every pole that is wanted lies within a tenth of its size, in continuous time, of one found."""
    s, near = (np.log(np.linalg.eigvals(np.asarray(x.A)).astype(complex)) for x in (wanted, found))
    return bool((np.abs(s[:, None] - near).min(axis=1) < 0.1 * np.abs(s) + 1e-9).all())


def _larger(diagram: Stabilization, order: int, response: ImpulseResponse) -> np.ndarray:
    """Poles z, with all conjugates, of the model of about that order in the diagram."""
    s = diagram.pole[diagram.order == min(order, diagram.order.max())]
    half = 0.5 * s * float(response.dt)
    z = (1 + half) / (1 - half) if "band" in response.hold else np.exp(2 * half)
    return np.concatenate([z, z[np.imag(s) > 0].conj()])


def _reason(raw: Realization, order: int | None, expected: int) -> str:
    values = np.asarray(raw.singular_values)
    if order is not None:
        return f"Order {order} was asked for; bodies and sensors of the model have {expected} visible states."
    rounding = np.finfo(values.dtype).eps * values[0]
    drops = values[:-1] / np.maximum(values[1:], rounding)
    steepest = int(np.argmax(drops[1:])) + 2
    compared = "more than after any other" if steepest == expected else (
        f"{drops[steepest - 1]:.3g} times after {steepest}"
    )  # fmt: skip
    return (
        f"Bodies and sensors of the model have {expected} visible states; the singular values fall "
        f"{drops[expected - 1]:.3g} times after value {expected}, {compared}."
    )


def _growing(candidates: Sequence[np.ndarray], lines: Lines) -> np.ndarray:
    """Poles (1/s) within the band that grow by more than GROWTH over the longest record, at either order.

    Noise makes poles grow too, but hardly so much, and others at another order; the pole of a free body lies at
    zero, give or take noise.
    """
    s, again = (np.log(z.astype(complex)) / float(lines.dt) for z in candidates)
    longest = max(n * dt for n, dt in zip(lines.samples, lines.record_dt, strict=True))
    inside = np.abs(s) < 2 * np.pi * float(np.asarray(lines.band)[1])
    twice = np.abs(s[:, None] - again).min(axis=1) < 0.05 * np.abs(s)
    return s[inside & twice & (s.real * longest > np.log(GROWTH)) & (s.imag >= 0)]


def _settled(polished: Polished, given: Lines, *, stable: bool) -> tuple[Polished, Lines]:
    """The fit and the lines at the common rate of records of different rates, which each follow from the other."""
    lines = given
    for _ in range(RATE_ROUNDS if len(set(given.record_dt)) > 1 else 0):
        if not np.isfinite(polished.realization.A).all():
            break
        before, lines = lines, _common_rate(given, polished.realization)
        polished = polish(np.linalg.eigvals(np.asarray(polished.realization.A)), lines, stable=stable)
        if np.all(np.abs(lines.y - before.y) < SETTLED * np.asarray(polished.noise)):
            break
    return polished, lines


def _noise_gain(one: Polished, other: Polished, lines: Lines) -> float:
    """By how much the other fit leaves less noise, mean logarithm over lines and outputs; rounding is none."""
    used = np.asarray(lines.weight) > 0
    size = np.abs(np.asarray(lines.y)) ** 2
    floor = ROUNDING * size.sum(axis=0) / np.maximum(used.sum(axis=0), 1)
    one_log, other_log = (np.log(np.maximum(np.asarray(x.noise), floor)) for x in (one, other))
    return float(np.mean((one_log - other_log)[used]))


def _unstable(poles: np.ndarray) -> tuple[str, ...]:
    told = ", ".join(f"{p.real:.4g} +- {p.imag:.4g}j" if p.imag else f"{p.real:.4g}" for p in poles)
    return (
        f"The system is unstable (poles at {told} 1/s): active feedback, negative stiffness, or wrong signs. No "
        "passive mass, damping and stiffness have these poles, and no simulation can follow the records for long.",
    )


def _common_rate(lines: Lines, found: Realization) -> Lines:
    """Outputs as they would be had every record been sampled, and its inputs held, at the common interval."""
    model = continuous(found)
    y = np.array(lines.y)
    omega, owner = np.asarray(lines.omega), np.asarray(lines.record).argmax(axis=1)
    for i, dt in enumerate(lines.record_dt):
        if dt == float(lines.dt) or lines.hold[0] == "band":
            continue
        rows = np.flatnonzero(owner == i)
        own = discretise(model, dt, hold=lines.hold)
        excess = _response(own, np.exp(1j * omega[rows] * dt)) - _response(found, np.asarray(lines.z)[rows])
        y[rows] -= np.einsum("kor,kr->ko", excess, np.asarray(lines.u)[rows])
    return eqx.tree_at(lambda x: x.y, lines, as_array(y * (np.asarray(lines.weight) > 0)))


def _response(model: Realization, z: np.ndarray) -> np.ndarray:
    A, B, C, D = (np.asarray(x) for x in (model.A, model.B, model.C, model.D))
    return C @ np.linalg.solve(z[:, None, None] * np.eye(len(A)) - A, B[None]) + D
