"""Impulse response in the excited band, through an observer: OKID in the Laguerre shift, by Fourier lines.

An observer with gain G turns x' = A x + B u into x' = (A + G C) x + (B + G D) u - G y, whose Markov parameters
die out after few steps even when A is hardly damped. Least squares therefore finds, from a record of any
initial state, the coefficients of
    y = sum_{j=1..p} A_j w^-j y + sum_{j=0..p} B_j w^-j u + sum_{j=0..p} T_j w^-j x_0 ,
here line by line in the excited band and in the Laguerre shift w, which spreads this band over the whole
circle. The system's Markov parameters follow by the recursion Y_k = B_k + sum_j A_j Y_(k-j), all terms kept.

Source: J.-N. Juang, M. Phan, L. Horta, R. Longman, "Identification of observer/Kalman filter Markov
parameters", J. Guidance, Control and Dynamics 16 (1993); P. Heuberger, P. Van den Hof, B. Wahlberg,
Modelling and Identification with Rational Orthogonal Basis Functions, Springer 2005, ch. 2 and 10.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsid.checks import InsufficientDataError, require
from jaxsid.compilation import compiled
from jaxsid.impulse.lines import Lines, laguerre_shift, record_lines
from jaxsid.records import ImpulseResponse, Record, as_array

# Relative Tikhonov term: far below any noise, it only picks the smallest of many exact observers.
RIDGE = 1e-11
MOST_COLUMNS = 600


class InBand(eqx.Module):
    """Estimator for records whose excitation covers a band only; it works for any excitation.

    Attributes:
        band: Hz; None finds the band that the inputs excite.
        lags: largest observer order tried; None fits it to the amount of data.
    """

    band: tuple[float, float] | None = eqx.field(static=True, default=None)
    lags: int | None = eqx.field(static=True, default=None)

    def __call__(self, records: Sequence[Record], samples: int | None = None) -> ImpulseResponse:
        """Markov parameters in the Laguerre shift, up to `samples` of them (200 by default).

        Args:
            records: they may differ in length, rate and in which outputs they hold.
            samples: number of Markov parameters.

        Raises:
            InputError: malformed records or options.
            InsufficientDataError: too few lines in the band.
        """
        lines = record_lines(records, band=self.band)
        return observer_response(lines, samples=200 if samples is None else samples, lags=self.lags)


def observer_response(lines: Lines, *, samples: int = 200, lags: int | None = None) -> ImpulseResponse:
    """Impulse response from in-band lines, outputs that share records being estimated together.

    Args:
        lines: of one or more records.
        samples: number of Markov parameters.
        lags: largest observer order tried.

    Raises:
        InsufficientDataError: fewer lines than unknowns.
    """
    require(samples >= 3, f"an impulse response of {samples} samples is too short to realize anything")
    pole = lines.pole
    h = np.zeros((samples, lines.y.shape[1], lines.u.shape[1]))
    noise, orders = np.zeros(lines.y.shape[1]), []
    for outputs in output_groups(lines):
        largest = largest_lags(lines, outputs, lags)
        h[:, outputs], noise[outputs], order = observer(lines, as_array(outputs), pole, largest, samples)
        orders.append(int(order))
    low, high = np.asarray(lines.band).tolist()
    words = f"in-band observer, {low:.3g} to {high:.3g} Hz, {max(orders)} lags"
    return ImpulseResponse(
        h, lines.dt, pole=pole, noise_std=noise, band=lines.band, hold=lines.hold, method=words
    )


def output_groups(lines: Lines) -> list[np.ndarray]:
    """Indices of the outputs, grouped by the set of records in which they were measured."""
    measured = np.asarray(lines.weight).T @ np.asarray(lines.record) > 0
    _, group = np.unique(measured, axis=0, return_inverse=True)
    return [np.flatnonzero(group.ravel() == g) for g in range(group.max() + 1)]


def largest_lags(lines: Lines, outputs: np.ndarray, lags: int | None) -> int:
    """As many lags as were asked for, or as the data and the cost allow; of lines with values."""
    width = len(outputs) + lines.u.shape[1] + lines.record.shape[1]
    equations = 2 * int((np.asarray(lines.weight)[:, outputs].min(axis=1) > 0).sum())
    affordable = min(equations // 3 // width, max(MOST_COLUMNS // width, 2), 40)
    if affordable < 2:
        raise InsufficientDataError(
            f"{equations} equations in the band cannot determine an observer of {len(outputs)} outputs and "
            f"{lines.u.shape[1]} inputs: give a longer record or a wider band."
        )
    return affordable if lags is None else min(lags, equations // 2 // width)


@compiled
def observer(
    lines: Lines, outputs: Int[Array, " m"], pole: Array, largest: int, samples: int
) -> tuple[Float[Array, "samples m r"], Float[Array, " m"], Int[Array, ""]]:
    """Markov parameters, noise and order of the observer: one QR factorization for all orders, Akaike's choice.

    Args:
        lines: values, or traced.
        outputs: which, measured in the same records.
        pole: of the Laguerre shift.
        largest: order tried.
        samples: number of Markov parameters.
    """
    y, weight = lines.y[:, outputs], lines.weight[:, outputs].min(axis=1)
    m, r = len(outputs), lines.u.shape[1]
    y_scale, u_scale = _mean_size(y, weight), _mean_size(lines.u, weight)
    known = jnp.concatenate([lines.u / u_scale, lines.record], axis=1)
    back = 1 / laguerre_shift(lines.z, pole)
    block = jnp.concatenate([known, y / y_scale], axis=1)
    delays = back[:, None] ** jnp.arange(1, largest + 1)
    design = jnp.concatenate([known, (delays[:, :, None] * block[:, None]).reshape(len(y), -1)], axis=1)
    design, target = _real(design * weight[:, None]), _real(y / y_scale * weight[:, None])
    scale = jnp.linalg.norm(design, axis=0)
    scale = jnp.where(scale > 0, scale, 1.0)
    design = jnp.concatenate([design / scale, RIDGE * jnp.eye(design.shape[1])])
    target = jnp.concatenate([target, jnp.zeros((design.shape[1], m))])
    q, triangle = jnp.linalg.qr(design)
    projected = q.T @ target
    first, width = known.shape[1], block.shape[1]
    order, residual = _akaike(projected, target, 2 * weight.sum(), first, width, largest)
    inside = jnp.arange(design.shape[1]) < first + order * width
    triangle = jnp.where(inside[:, None] & inside, triangle, jnp.eye(len(triangle)))
    x = (
        jax.scipy.linalg.solve_triangular(triangle, jnp.where(inside[:, None], projected, 0.0))
        / scale[:, None]
    )
    lagged = x[first:].reshape(largest, width, m)
    a = jnp.swapaxes(lagged[:, first:], 1, 2)
    b = jnp.swapaxes(jnp.concatenate([x[None, :r], lagged[:, :r]]), 1, 2)
    h = _recursion(a, b, samples) * y_scale[:, None] / u_scale
    return h, residual * y_scale, order


def _akaike(
    projected: Array, target: Array, equations: Array, first: int, width: int, largest: int
) -> tuple[Array, Array]:
    """The order with the least equations * log det(residual covariance) + 2 unknowns, and its residual rms."""
    energy = jnp.concatenate([jnp.zeros((1, target.shape[1])), jnp.cumsum(projected**2, axis=0)])
    ends = first + width * jnp.arange(1, largest + 1)
    left = jnp.maximum((target**2).sum(axis=0) - energy[ends], 1e-24 * (target**2).sum(axis=0))
    criterion = equations * jnp.log(left).sum(axis=1) + 2 * ends * target.shape[1]
    best = jnp.argmin(criterion)
    return best + 1, jnp.sqrt(left[best] / jnp.maximum(equations - ends[best], 1.0))


def _recursion(a: Array, b: Array, samples: int) -> Array:
    """Y_k = B_k + sum_j A_j Y_(k-j), k = 0 .. samples-1."""
    lags = len(a)
    b = jnp.concatenate([b, jnp.zeros((max(samples - len(b), 0), *b.shape[1:]))])[:samples]

    def step(past: Array, b_k: Array) -> tuple[Array, Array]:
        y = b_k + jnp.einsum("jab,jbc->ac", a, past)
        return jnp.concatenate([y[None], past[:-1]]), y

    return jax.lax.scan(step, jnp.zeros((lags, *b.shape[1:])), b)[1]


def _mean_size(x: Array, weight: Array) -> Array:
    size = (jnp.abs(x) * weight[:, None]).sum(axis=0) / weight.sum()
    return jnp.where(size > 0, size, 1.0)


def _real(x: Array) -> Array:
    return jnp.concatenate([x.real, x.imag])
