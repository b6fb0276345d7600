"""Which poles stay where they are as the order of the model grows."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxsid.checks import is_concrete, require
from jaxsid.compilation import compiled
from jaxsid.mechanics.hold import check_holds
from jaxsid.realization.era import balanced, factor
from jaxsid.realization.hankel import hankel_operator
from jaxsid.realization.indicators import phase_collinearity
from jaxsid.realization.window import check_method, check_order, check_response, era_window
from jaxsid.records import ImpulseResponse, as_array


class Stabilization(NamedTuple):
    """Poles of models of growing order, one row an entry, ready to plot; numpy arrays.

    Attributes:
        order: order of the model that the pole belongs to, (entries,).
        pole: 1/s, with imaginary part >= 0, (entries,).
        frequency: abs(pole), rad/s, (entries,).
        damping_ratio: (entries,).
        mpc: modal phase collinearity, (entries,).
        shape: (entries, outputs) complex.
        stable_frequency, stable_damping, stable_shape: whether the nearest pole of the
            order before agrees, (entries,).
        singular_values: of the Hankel matrix.
    """

    order: np.ndarray
    pole: np.ndarray
    frequency: np.ndarray
    damping_ratio: np.ndarray
    mpc: np.ndarray
    shape: np.ndarray
    stable_frequency: np.ndarray
    stable_damping: np.ndarray
    stable_shape: np.ndarray
    singular_values: np.ndarray

    @property
    def stable(self) -> np.ndarray:
        """Entries that agree in frequency, damping and shape."""
        return self.stable_frequency & self.stable_damping & self.stable_shape


def stabilization(
    ir: ImpulseResponse,
    orders: Sequence[int],
    *,
    rows: int | None = None,
    cols: int | None = None,
    stride: int = 1,
    frequency_tolerance: float = 0.01,
    damping_tolerance: float = 0.05,
    shape_tolerance: float = 0.02,
    method: str = "fast",
) -> Stabilization:
    """Stabilization diagram: one ERA factorization, many orders, each pole against the order before.

    A pole is stable where, against the nearest one of the order before, abs(w - w0) <= tolerance w0,
    abs(zeta - zeta0) <= tolerance zeta0, and 1 - abs(phi* phi0)^2 / (phi* phi phi0* phi0) <= tolerance.

    Args:
        ir: Markov parameters (samples, outputs, inputs); eager.
        orders: increasing.
        rows, cols, stride, method: window and factorization as for `era`.
        frequency_tolerance: relative.
        damping_tolerance: relative.
        shape_tolerance: on 1 less the coherence of the shapes.

    Raises:
        InputError: orders do not increase, or the window does not fit.

    Source: Heylen, Lammens and Sas, "Modal analysis theory and testing", KU Leuven 1997.
    """
    check_response(ir)
    check_method(method)
    check_holds(ir.hold, ir.h.shape[2])
    require(is_concrete(ir.h), "a stabilization diagram is eager: it cannot be traced")
    require(len(orders) > 0 and list(orders) == sorted(set(orders)), f"orders must increase, not {orders}")
    window = era_window(ir.h.shape[0], rows, cols, stride, None, None)
    shape = window.shape(*ir.h.shape[1:])
    check_order(orders[-1], shape)
    check_order(orders[0], shape)
    a, c, values = _largest(ir.h, ir.pole, window, orders[-1], method == "svd")
    numbers = np.asarray(a), np.asarray(c), float(ir.pole), float(ir.dt), ir.hold[0]
    models = [_modes(*numbers, n) for n in orders]
    tolerances = (frequency_tolerance, damping_tolerance, shape_tolerance)
    return _diagram(orders, models, tolerances, np.asarray(values))


@compiled
def _largest(h, pole, window, order, full) -> tuple[Array, Array, Array]:
    """Balanced A and C of the largest order, in the shift of h; those of a smaller one are their corners."""
    operator = hankel_operator(h, window.rows, window.columns, 1, full)
    change = hankel_operator(jnp.diff(h, axis=0), window.rows, window.columns, 1)
    space = factor(operator, order, full)
    a, observability, _ = balanced(operator, change, space)
    return a, observability[: h.shape[1]], space.values


def _modes(
    a: np.ndarray, c: np.ndarray, laguerre: float, dt: float, hold: str, order: int
) -> tuple[np.ndarray, np.ndarray]:
    """Continuous poles and shapes (modes, outputs) of the leading corner, one of each pair, slowest first."""
    step, vectors = np.linalg.eig(a[:order, :order] - np.eye(order))
    # lambda_z - 1 from lambda_w - 1; the shapes only change in scale
    step = step.astype(complex) * (1 - laguerre) / (1 + laguerre * (1 + step))
    shapes = (c[:, :order] @ vectors).T
    with np.errstate(divide="ignore", invalid="ignore"):
        poles = 2 / dt * step / (2 + step) if hold == "band" else np.log1p(step) / dt
    keep = np.flatnonzero((poles.imag >= 0) & np.isfinite(poles))
    keep = keep[np.argsort(np.abs(poles[keep]), kind="stable")]
    return poles[keep], shapes[keep]


def _damping(poles: np.ndarray) -> np.ndarray:
    size = np.abs(poles)
    return np.where(size == 0, 1.0, -np.real(poles) / np.where(size == 0, 1.0, size))


def _agreement(now: tuple, before: tuple, tolerances: tuple[float, float, float]) -> np.ndarray:
    """(modes, 3) booleans: frequency, damping, shape, against the nearest pole of the order before."""
    (poles, shapes), (old, old_shapes) = now, before
    if not len(old) or not len(poles):
        return np.zeros((len(poles), 3), dtype=bool)
    near = np.argmin(np.abs(poles[:, None] - old), axis=1)
    old, old_shapes = old[near], old_shapes[near]
    size = (np.abs(shapes) ** 2).sum(1) * (np.abs(old_shapes) ** 2).sum(1)
    inner = np.abs((shapes * old_shapes.conj()).sum(1)) ** 2
    frequency = np.abs(np.abs(poles) - np.abs(old)) <= tolerances[0] * np.abs(old)
    damping = np.abs(_damping(poles) - _damping(old)) <= tolerances[1] * np.abs(_damping(old))
    return np.stack([frequency, damping, size - inner <= tolerances[2] * size], axis=1)


def _diagram(
    orders: Sequence[int], models: list, tolerances: tuple[float, float, float], values: np.ndarray
) -> Stabilization:
    nothing = (np.zeros(0, complex), np.zeros((0, models[0][1].shape[1]), complex))
    previous = [nothing, *models[:-1]]
    agree = np.concatenate([_agreement(m, p, tolerances) for m, p in zip(models, previous, strict=True)])
    poles = np.concatenate([m[0] for m in models])
    shapes = np.concatenate([m[1] for m in models])
    order = np.repeat(orders, [len(m[0]) for m in models])
    mpc = np.asarray(phase_collinearity(as_array(shapes.T)))
    frequency, damping, shape = agree.T
    return Stabilization(
        order, poles, np.abs(poles), _damping(poles), mpc, shapes, frequency, damping, shape, values
    )
