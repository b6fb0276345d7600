"""The eigensystem realization algorithm with data correlations (ERA/DC)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsid.checks import require
from jaxsid.compilation import compiled
from jaxsid.mechanics.hold import laguerre_to_shift
from jaxsid.realization.era import LARGEST_CANDIDATE, balanced, factor, named_factors
from jaxsid.realization.hankel import Operator, hankel_matrix, hankel_operator
from jaxsid.realization.order import select_order
from jaxsid.realization.subspace import leading_values
from jaxsid.realization.window import check_method, check_order, check_reach, check_response
from jaxsid.records import ImpulseResponse, Realization

LARGEST_BLOCK = 64  # rows of a correlation matrix up to which the sequence of them is formed


class _Shape(eqx.Module):
    """The static numbers: block rows s, block columns t, multiples of the lag step, first lag."""

    rows: tuple[int, ...] = eqx.field(static=True)
    columns: tuple[int, ...] = eqx.field(static=True)
    lags: tuple[int, ...] = eqx.field(static=True)
    first_lag: int = eqx.field(static=True)


def era_dc(
    ir: ImpulseResponse,
    *,
    order: int | None = None,
    rows: int,
    cols: int,
    lags: int,
    first_lag: int = 0,
    lag_step: int = 1,
    stride: int = 1,
    method: str = "fast",
) -> Realization:
    """A balanced discrete-time model of chosen order from correlations of Markov parameters.

    R(k) = H(k) H(0)', U(k) has the blocks R(k + (i + j) tau), U(k0) = R S V', then
    A = S^-1/2 R' U(k0 + 1) V S^-1/2, P = R S^1/2, C = first m rows of P. P is the observability matrix at the
    instants s_a + i tau, whatever the first lag, so B = P^+ [Y_(1 + s_a + i tau)]: the whole column of Markov
    parameters is used, where the thesis's P^+ H(0) takes the first `rows` blocks of P only, which a short
    block leaves ill-conditioned. White noise on the Markov parameters leaves no bias in R(k) once k >= rows.

    Args:
        ir: Markov parameters (samples, outputs, inputs).
        order: states n; None selects by the singular values, which needs values now (no tracing).
        rows, cols: block rows and block columns of each H(k).
        lags: block rows and block columns of U.
        first_lag: k0, samples.
        lag_step: tau, samples.
        stride: samples between neighbouring block rows and block columns of H.
        method: "fast" (U is not formed where large; block Krylov iteration to rounding) or "svd".

    Returns:
        Realization; its singular values are those of U (squares, in size), its controllability factor S^1/2
        V'.

    Raises:
        InputError: the window does not fit the samples, or is too small for the order.

    Source: Juang, Cooper and Wright, Control Theory and Advanced Technology 4, 1988; thesis [4.28-4.44].
    """
    check_response(ir)
    check_method(method)
    counts = {"rows": rows, "cols": cols, "lags": lags, "lag_step": lag_step, "stride": stride}
    for name, number in counts.items():
        require(number >= 1, f"{name} must be at least 1, not {number}")
    require(first_lag >= 0, f"first_lag must not be negative, as {first_lag} is")
    check_reach(2 + stride * (rows + cols - 2) + first_lag + 2 * (lags - 1) * lag_step, ir.h.shape[0])
    steps = _Shape(
        tuple(range(0, stride * rows, stride)),
        tuple(range(0, stride * cols, stride)),
        tuple(range(0, lag_step * lags, lag_step)),
        first_lag,
    )
    size = lags * rows * ir.h.shape[1]
    if order is None:
        values = _singular_values(ir.h, steps, min(LARGEST_CANDIDATE, size))
        order = select_order(values, shape=(size, size)).order
    check_order(order, (size, size))
    check_order(order, (size, cols * ir.h.shape[2]))
    A, B, C, D, factors = _era_dc(ir.h, ir.pole, steps, order, method == "svd")
    return Realization(
        A,
        B,
        C,
        D,
        ir.dt,
        **factors,
        pole=ir.pole,
        row_steps=_instants(steps),
        column_steps=steps.lags,
        hold=ir.hold,
    )


def _instants(steps: _Shape) -> tuple[int, ...]:
    """Time index of each block row of P: s_a + i tau."""
    return tuple(s + lag for lag in steps.lags for s in steps.rows)


class CorrelationOperator(eqx.Module):
    """The block-correlation matrix as a chain of Hankel products: no correlation is ever formed.

    Row block i of U v is the Hankel matrix from the first lag on, at the instants s + i tau, times the sum of
    H(0)' v_j laid down at t + j tau.
    """

    near: Operator  # H(0)
    far: Operator  # blocks Y_(1 + k0 + x + y) at the distinct instants x = s + i tau and y = t + j tau
    steps: _Shape

    @property
    def shape(self) -> tuple[int, int]:
        size = len(self.steps.lags) * self.near.shape[0]
        return size, size

    def mv(self, v: Float[Array, "cols k"]) -> Float[Array, "rows k"]:
        """U v."""
        w = _each_block(self.near.rmv, v, len(self.steps.lags))
        x = self.far.mv(_lay_down(w, self.steps.columns, self.steps.lags))
        return _pick_up(x, self.steps.rows, self.steps.lags)

    def rmv(self, u: Float[Array, "rows k"]) -> Float[Array, "cols k"]:
        """U' u."""
        w = self.far.rmv(_lay_down(u, self.steps.rows, self.steps.lags))
        w = _pick_up(w, self.steps.columns, self.steps.lags)
        return _each_block(self.near.mv, w, len(self.steps.lags))


def _grid(steps: tuple[int, ...], lags: tuple[int, ...]) -> tuple[tuple[int, ...], np.ndarray]:
    """The distinct instants s + lag, and where each (lag, s) is among them."""
    instants, place = np.unique(np.add.outer(lags, steps), return_inverse=True)
    return tuple(int(i) for i in instants), place.reshape(len(lags) * len(steps))


def _each_block(product, v: Array, blocks: int) -> Array:
    """The same product on each block of rows of v."""
    k = v.shape[1]
    wide = jnp.swapaxes(v.reshape(blocks, -1, k), 0, 1).reshape(-1, blocks * k)
    return jnp.swapaxes(product(wide).reshape(-1, blocks, k), 0, 1).reshape(-1, k)


def _lay_down(v: Array, steps: tuple[int, ...], lags: tuple[int, ...]) -> Array:
    """Blocks (lag, s) summed at their instants."""
    instants, place = _grid(steps, lags)
    blocks = v.reshape(len(place), -1, v.shape[1])
    total = jnp.zeros((len(instants), *blocks.shape[1:]), v.dtype).at[place].add(blocks)
    return total.reshape(-1, v.shape[1])


def _pick_up(v: Array, steps: tuple[int, ...], lags: tuple[int, ...]) -> Array:
    """Blocks (lag, s) read at their instants."""
    instants, place = _grid(steps, lags)
    return v.reshape(len(instants), -1, v.shape[1])[place].reshape(-1, v.shape[1])


def _correlations(h: Array, g: Array, steps: _Shape) -> Float[Array, "lags rows rows"]:
    """R(k0 + l tau), l = 0 .. 2 (lags - 1), of the sequence g against h."""
    count = 2 * len(steps.lags) - 1
    tau = steps.lags[1] if count > 1 else 1
    instants, place = _grid(steps.rows, tuple(range(0, count * tau, tau)))
    far = hankel_operator(g, instants, steps.columns, 1 + steps.first_lag)
    near = hankel_matrix(h, steps.rows, steps.columns, 1)
    products = far.mv(near.T).reshape(len(instants), g.shape[1], near.shape[0])
    return products[place].reshape(count, near.shape[0], near.shape[0])


def _operator(h: Array, g: Array, steps: _Shape, full: bool):
    """The block-correlation matrix of g against h."""
    block = len(steps.rows) * h.shape[1]
    if full or block <= LARGEST_BLOCK:
        lags = tuple(range(len(steps.lags)))
        return hankel_operator(_correlations(h, g, steps), lags, lags, dense=full)
    far_rows, far_columns = (_grid(s, steps.lags)[0] for s in (steps.rows, steps.columns))
    near = hankel_operator(h, steps.rows, steps.columns, 1)
    return CorrelationOperator(near, hankel_operator(g, far_rows, far_columns, 1 + steps.first_lag), steps)


@compiled
def _era_dc(h, pole, steps, order, full):
    change = _operator(h, jnp.diff(h, axis=0), steps, False)
    operator = _operator(h, h, steps, full)
    space = factor(operator, order, full)
    a, observability, controllability = balanced(operator, change, space)
    column = hankel_matrix(h, _instants(steps), (0,), 1)
    b = (space.left.T @ column) / jax.lax.stop_gradient(jnp.sqrt(space.values[:order]))[:, None]
    c = observability[: h.shape[1]]
    return *laguerre_to_shift(a, b, c, h[0], pole), named_factors(
        space.values, observability, controllability
    )


@compiled
def _singular_values(h, steps, candidates):
    return leading_values(_operator(h, h, steps, False), candidates)
