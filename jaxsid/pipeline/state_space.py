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


class StateSpace(NamedTuple):
    """State-space model of the records, and how it was reached.

    Attributes:
        response: estimated impulse response.
        raw: realization of that response.
        polished: refined against the lines, with noise and residual.
        model: the refined realization in continuous time.
        lines: the lines, all brought to the common sampling interval.
        order_reason: in words.
        warnings: what went less than well.
    """

    response: ImpulseResponse
    raw: Realization
    polished: Polished
    model: ContinuousModel
    lines: Lines
    stabilization: Stabilization
    order_reason: str
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
    polished = polish(needed_poles(candidates, lines, order_used), lines)
    if not np.isfinite(polished.realization.A).all():
        raise InsufficientDataError(
            f"no model of order {order_used} fits the records: the refinement of the poles diverged. Lower the "
            "order, widen the band of the excitation, or lengthen the record."
        )
    if len(set(lines.record_dt)) > 1:
        lines = _common_rate(lines, polished.realization)
        polished = polish(np.linalg.eigvals(np.asarray(polished.realization.A)), lines)
    return StateSpace(
        response,
        raw,
        polished,
        continuous(polished.realization),
        lines,
        diagram,
        reason,
        _warnings(polished.realization, max(r.u.shape[0] for r in records)),
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
    drops = values[:-1] / np.maximum(values[1:], np.finfo(float).tiny)
    steepest = int(np.argmax(drops[1:])) + 2
    compared = "more than after any other" if steepest == expected else (
        f"{drops[steepest - 1]:.3g} times after {steepest}"
    )  # fmt: skip
    return (
        f"Bodies and sensors of the model have {expected} visible states; the singular values fall "
        f"{drops[expected - 1]:.3g} times after value {expected}, {compared}."
    )


def _warnings(found: Realization, samples: int) -> tuple[str, ...]:
    """Poles that grow over the record; the pole of a free body lies at 1, give or take noise."""
    growing = np.abs(np.linalg.eigvals(np.asarray(found.A))).max()
    if samples * np.log(growing) > 1:
        return (
            f"A pole is unstable (abs(z) = {growing:.6g}): a free body, active feedback, or too high an order.",
        )
    return ()


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
