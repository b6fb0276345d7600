"""Poles, mode shapes and participation of a model, and a real model back from them."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex

from jaxsid.checks import bad_input, is_concrete, require, require_finite
from jaxsid.compilation import compiled
from jaxsid.mechanics.hold import check_holds
from jaxsid.realization.indicators import mode_indicators
from jaxsid.records import ContinuousModel, Indicators, ModalModel, Realization

PAIR_TOLERANCE = 1e-6  # relative distance within which two poles are each other's conjugates


def modal(model: Realization | ContinuousModel) -> ModalModel:
    """Modal form z' = L z + W u, y = S z + D u in continuous time, slowest pole first, pairs adjacent.

    From a realization: poles log(lambda) / dt for the holds "zero" and "first", (2 / dt)(lambda - 1)/(lambda
    + 1) for "band"; W and D are those whose held, sampled model is the realization [4.54-4.61], with the
    limits at zero poles. A shape has norm 1 and its largest component real and positive; the product of shape
    and participation does not depend on that. A pole at zero (rigid body) has damping ratio 1, as every pole
    on the negative real axis. A double zero pole has no modal form: rounding splits it into two near zero,
    whose shapes are nearly parallel.

    Args:
        model: Realization or ContinuousModel.

    Returns:
        ModalModel, with indicators where the realization carries its factors.

    Raises:
        InputError: holds "band" and others are mixed, so that the inputs disagree on the poles.
    """
    for name in ("A", "B", "C", "D"):
        require_finite(getattr(model, name), f"model, matrix {name}")
    if isinstance(model, ContinuousModel):
        return _modal_continuous(model)
    check_holds(model.hold, model.B.shape[1])
    return _modal(model)


def modal_realization(modal: ModalModel) -> ContinuousModel:
    """A real block-diagonal model: [[a, w], [-w, a]] for a pair a +- i w, [a] for a real pole. [4.62-4.65]

    The pattern of pairs sets the blocks, so that under tracing every pole must be of a pair; eagerly real
    poles are found by value.

    Args:
        modal: with conjugate pairs adjacent, as `modal` makes it.

    Raises:
        InputError: a complex pole has no conjugate beside it.
    """
    pairs = _pairs(modal.poles) if is_concrete(modal.poles) else (True,) * (modal.poles.shape[0] // 2)
    require(
        len(pairs) + sum(pairs) == modal.poles.shape[0],
        "an odd number of poles: call it eagerly",
    )
    return _real_form(modal, pairs)


def _pairs(poles: Array) -> tuple[bool, ...]:
    """For each block of the real form, whether it is a pair."""
    p, blocks, i = np.asarray(poles), [], 0
    eps = float(np.finfo(p.dtype).eps)
    while i < len(p):
        if abs(p[i].imag) <= eps * abs(p[i]):
            blocks.append(False)
        elif i + 1 < len(p) and abs(p[i] - p[i + 1].conj()) <= PAIR_TOLERANCE * abs(p[i]):
            blocks.append(True)
        else:
            bad_input(f"pole {p[i]:.6g} has no conjugate beside it; a real model needs conjugate pairs")
        i += 1 + blocks[-1]
    return tuple(blocks)


def _real_form(modal: ModalModel, pairs: tuple[bool, ...]) -> ContinuousModel:
    """Real and imaginary parts of the first mode of each pair as states."""
    n = len(pairs) + sum(pairs)
    first = np.cumsum([0, *(1 + pair for pair in pairs[:-1])]).astype(int)
    starts, twos = first, np.flatnonzero(pairs)
    pole, shape = modal.poles[starts], modal.shapes[:, starts]
    row = modal.participation[starts]
    scale = np.where(pairs, 2.0, 1.0)
    a = jnp.zeros((n, n), shape.real.dtype).at[starts, starts].set(pole.real)
    b = jnp.zeros((n, row.shape[1]), shape.real.dtype).at[starts].set(row.real)
    c = jnp.zeros((shape.shape[0], n), shape.real.dtype).at[:, starts].set(scale * shape.real)
    if len(twos):
        one = starts[twos]
        two = one + 1
        a = a.at[two, two].set(pole[twos].real).at[one, two].set(-pole[twos].imag)
        a = a.at[two, one].set(pole[twos].imag)
        b = b.at[two].set(row[twos].imag)
        c = c.at[:, two].set(-2.0 * shape[:, twos].imag)
    return ContinuousModel(a, b, c, modal.feedthrough)


def _eigen(a: Array) -> tuple[Complex[Array, " n"], Complex[Array, "n n"]]:
    """Eigenvalues and right eigenvectors, differentiable but for the scale of the latter."""
    values, vectors = jax.lax.linalg.eig(
        a, compute_left_eigenvectors=False, compute_right_eigenvectors=True, enable_eigvec_derivs=True
    )
    return values, vectors


def _order(poles: Complex[Array, " n"]) -> Array:
    """Slowest first, the pole with positive imaginary part first of its pair."""
    return jnp.lexsort((-poles.imag, jnp.abs(poles.imag), jnp.abs(poles)))


def _form(poles, shapes, participation, feedthrough, indicators: Indicators | None) -> ModalModel:
    """The record, with shapes of norm 1, largest component real and positive."""
    size = jnp.sqrt(jnp.sum(jnp.abs(shapes) ** 2, axis=0))
    largest = jnp.take_along_axis(shapes, jnp.argmax(jnp.abs(shapes), axis=0)[None], axis=0)[0]
    seen = size > 0
    phase = jnp.where(seen, largest, 1) / jnp.where(seen, jnp.abs(largest), 1)
    scale = jnp.where(seen, size, 1) * phase
    frequencies = jnp.abs(poles)
    rigid = frequencies == 0
    damping_ratios = jnp.where(rigid, 1.0, -poles.real / jnp.where(rigid, 1.0, frequencies))
    return ModalModel(
        poles,
        frequencies,
        damping_ratios,
        shapes / scale,
        participation * scale[:, None],
        feedthrough,
        indicators,
    )


@compiled
def _modal_continuous(model: ContinuousModel) -> ModalModel:
    poles, vectors = _eigen(model.A)
    order = _order(poles)
    poles, vectors = poles[order], vectors[:, order]
    rows = jnp.linalg.solve(vectors, model.B.astype(vectors.dtype))
    return _form(poles, model.C @ vectors, rows, model.D, None)


@compiled
def _modal(rz: Realization) -> ModalModel:
    # The eigenvalues of A - I keep the digits that lambda near 1 would lose.
    step, vectors = _eigen(rz.A - jnp.eye(rz.A.shape[0], dtype=rz.A.dtype))
    band = "band" in rz.hold
    poles = 2 / rz.dt * step / (2 + step) if band else jnp.log1p(step) / rz.dt
    order = _order(poles)
    step, vectors, poles = step[order], vectors[:, order], poles[order]
    shapes = rz.C @ vectors
    inverse = jnp.linalg.inv(vectors)
    held = inverse @ rz.B
    rows, through = zip(*(_released(hold, poles, step, rz.dt) for hold in rz.hold), strict=True)
    rows, through = (jnp.stack(x, axis=1) * held for x in (rows, through))
    known = rz.observability is not None and rz.controllability is not None
    indicators = mode_indicators(rz, 1 + step, vectors, inverse) if known else None
    return _form(poles, shapes, rows, rz.D - (shapes @ through).real, indicators)


def _released(hold: str, pole: Array, step: Array, dt: Array) -> tuple[Array, Array]:
    """Factors from an input row of a sampled mode to the continuous one and to feedthrough."""
    if hold == "band":  # bilinear: the row and feedthrough of b (1 - s dt/2) / (s - p) / (dt/2 (1 + lambda))
        return 4 / (dt * (2 + step) ** 2), 1 / (2 + step)
    rate = _over(pole, step, 1 / dt)  # p / (lambda - 1)
    if hold == "zero":
        return rate, jnp.zeros_like(rate)
    row = dt * rate**2
    # (lambda - 1 - p dt) / p^2 / dt, dt / 2 at p = 0; a series where the difference cancels
    x = pole * dt
    series = dt * (0.5 + x / 6 + x**2 / 24 + x**3 / 120 + x**4 / 720 + x**5 / 5040)
    curve = jnp.where(jnp.abs(x) < 1e-2, series, _over(step - x, pole**2, dt**2 / 2) / dt)
    return row, row * curve


def _over(a: Array, b: Array, limit: Array) -> Array:
    zero = b == 0
    return jnp.where(zero, limit, a / jnp.where(zero, 1, b))
