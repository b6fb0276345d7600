"""The eigensystem realization algorithm (ERA)."""

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsid.compilation import compiled
from jaxsid.mechanics.hold import laguerre_to_shift
from jaxsid.realization.hankel import DenseOperator, hankel_operator
from jaxsid.realization.order import select_order
from jaxsid.realization.outputs import few_outputs
from jaxsid.realization.subspace import (
    OVERSAMPLING,
    LinearOperator,
    Subspace,
    dominant_subspace,
    leading_values,
    small_enough,
)
from jaxsid.realization.window import Window, check_method, check_order, check_response, era_window
from jaxsid.records import ImpulseResponse, Realization

LARGEST_CANDIDATE = 40  # orders that are weighed when none is given
WORTHWHILE = 3  # times as many outputs as directions, before these are tried


def era(
    ir: ImpulseResponse,
    *,
    order: int | None = None,
    rows: int | None = None,
    cols: int | None = None,
    stride: int = 1,
    row_steps: Sequence[int] | None = None,
    column_steps: Sequence[int] | None = None,
    method: str = "fast",
) -> Realization:
    """A balanced discrete-time model of chosen order from Markov parameters.

    Blocks H(k)_ij = Y_(1+k+s_i+t_j), H(0) = R S V', then
    A = S^-1/2 R' H(1) V S^-1/2, B = S^1/2 V' E_r, C = E_m' R S^1/2, D = Y_0. H(1) is H(0) one sample later
    whatever the stride, so that A is for the sampling interval. Poles, Markov parameters and everything else
    that does not depend on the state coordinates have exact derivatives with respect to `ir.h`; single
    entries of A, B, C do not.

    Args:
        ir: Markov parameters (samples, outputs, inputs); with a Laguerre `pole` the Hankel matrix is in that
            shift, and A, B, C, D are for the samples.
        order: states n; None selects by the singular values, which needs values now (no tracing).
        rows, cols: number of block rows and block columns; default: as many as the samples allow, half and
        half. stride: samples between neighbouring block rows and block columns (s_i = i stride, t_j = j
        stride). A window
            must span a good part of the slowest period: lengthen it by the stride rather than by rows.
        row_steps, column_steps: s_i and t_j themselves, increasing from 0, instead of rows, cols and stride.
        method: "fast" (products by the Fourier transform, block Krylov iteration to rounding) or "svd"
            (full singular value decomposition of the dense matrix).

    Returns:
        Realization, with the singular values computed: all of them for "svd", else about 2 order + 10, of
        which those after the order are estimates from below.

    Raises:
        InputError: the window does not fit the samples, or is too small for the order.

    Source: Juang and Pappa, J. Guidance, Control and Dynamics 8, 1985; thesis [4.8-4.27].
    """
    check_response(ir)
    check_method(method)
    given = (None if x is None else tuple(int(i) for i in x) for x in (row_steps, column_steps))
    window = era_window(ir.h.shape[0], rows, cols, stride, *given)
    shape = window.shape(*ir.h.shape[1:])
    if order is None:
        candidates = min(LARGEST_CANDIDATE, *shape)
        values = _singular_values(ir.h, window, candidates)
        order = select_order(values, shape=shape).order
    check_order(order, shape)
    A, B, C, D, factors = _era(ir.h, ir.pole, window, order, method == "svd")
    return Realization(
        A,
        B,
        C,
        D,
        ir.dt,
        **factors,
        pole=ir.pole,
        row_steps=window.rows,
        column_steps=window.columns,
        hold=ir.hold,
    )


def factor(operator: LinearOperator, order: int, full: bool) -> Subspace:
    """The dominant subspaces, by the full decomposition where asked for or where the matrix is small."""
    full = full or (isinstance(operator, DenseOperator) and small_enough(operator.shape, order))
    return dominant_subspace(operator, order, full)


def balanced(
    operator: LinearOperator, change: LinearOperator, space: Subspace
) -> tuple[Array, Float[Array, "rows n"], Float[Array, "n cols"]]:
    """State matrix and balanced factors from H(0), H(1) - H(0) and the subspaces of H(0).

    A - I = (U' (H1 - H0) V) (U' H0 V)^-1 is exact for any bases of the right spaces, so it also carries the
    derivative; taking the difference first keeps the digits that a small sampling interval would cost.
    """
    u, v = space.left, space.right
    root = jax.lax.stop_gradient(jnp.sqrt(space.values[: u.shape[1]]))
    products = operator.rmv(u)
    step = jnp.linalg.solve((products.T @ v).T, (u.T @ change.mv(v)).T).T
    a = jnp.eye(len(root), dtype=u.dtype) + step * (root / root[:, None])
    return a, u * root, (products / root).T


def named_factors(values: Array, observability: Array, controllability: Array) -> dict[str, Array]:
    """Singular values and balanced factors by the names they have in a Realization."""
    return {
        "singular_values": values,
        "observability": observability,
        "controllability": controllability,
    }


@compiled
def _era(h, pole, window, order, full):
    width = order // 2 + OVERSAMPLING  # a mode has one shape for its two poles, if that is real
    if full or h.shape[1] < WORTHWHILE * width:
        a, observability, controllability, values = _factors(h, window, order, full)
    else:
        a, observability, controllability, values = _by_few_outputs(h, window, order, width)
    b, c = controllability[:, : h.shape[2]], observability[: h.shape[1]]
    return *laguerre_to_shift(a, b, c, h[0], pole), named_factors(values, observability, controllability)


def _factors(h: Array, window: Window, order: int, full: bool) -> tuple[Array, Array, Array, Array]:
    """A, the balanced factors, and the singular values."""
    change = hankel_operator(jnp.diff(h, axis=0), window.rows, window.columns, 1)
    operator = hankel_operator(h, window.rows, window.columns, 1, full)
    space = factor(operator, order, full)
    return *balanced(operator, change, space), space.values


def _by_few_outputs(h: Array, window: Window, order: int, width: int) -> tuple[Array, Array, Array, Array]:
    """The same, out of few directions of the outputs where these hold all of the response."""
    few = few_outputs(h[1:], width)

    def whole() -> tuple[Array, Array, Array, Array]:
        return _factors(h, window, order, False)

    def compressed() -> tuple[Array, Array, Array, Array]:
        small = jnp.concatenate([h[:1, :width], few.h])  # Markov parameter 0 takes no part
        a, observability, controllability, values = _factors(small, window, order, False)
        rows = jnp.einsum("own,mw->omn", observability.reshape(-1, width, order), few.directions)
        rows = rows.reshape(-1, order) + _missed(few.rest, (controllability / values[:order, None]).T, window)
        count = jax.eval_shape(whole)[3].shape[0]  # all others are zero
        return a, rows, controllability, jnp.pad(values, (0, max(count - len(values), 0)))[:count]

    return jax.lax.cond(few.exact, compressed, whole)


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _missed(rest: Array, factor: Array, window: Window) -> Array:
    """What is no more than rounding times a matrix, and so zero; but as it changes the product does."""
    return jnp.zeros((window.shape(*rest.shape[1:])[0], factor.shape[1]), factor.dtype)


@_missed.defjvp
def _change_of_missed(window: Window, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    change = hankel_operator(tangents[0], window.rows, window.columns)
    return _missed(*primals, window), change.mv(primals[1])


@compiled
def _singular_values(h, window, candidates):
    operator = hankel_operator(h, window.rows, window.columns, 1)
    return leading_values(operator, candidates)
