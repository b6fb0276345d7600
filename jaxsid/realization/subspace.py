"""Dominant singular subspaces of an operator, by restarted block Krylov iteration, with their derivative.

The iteration goes on until the residual of the kept singular triplets reaches rounding, or vanishes beside the first
discarded singular value, which is noise: the answer is that of a full singular value decomposition whatever the gap
at the cut. Where that gap is small and the matrix not large, the full decomposition takes over. The Gram matrix, which
loses everything below 1e-8 of the largest singular value, serves for nothing but a start, where it is far smaller than
the matrix: with noise, which lies above that, the iteration then has nothing left to do.
Source: Musco and Musco, "Randomized block Krylov methods", NeurIPS 2015; Baglama and Reichel, SIAM J. Sci.
Comput. 27, 2005 (restarting).
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsid.realization.hankel import LARGEST_DENSE, DenseOperator
from jaxsid.realization.lapack import eigh, qr, svd

# Most searches end after one or two restarts; where a full decomposition is not dear it then takes over.
FEW_RESTARTS, RESTARTS = 2, 120
LARGEST_SIDE = 512  # shorter side of a matrix that is decomposed in full after all
OVERSAMPLING = 5
# Residual at which iteration stops: that of LAPACK, in units of eps times the largest singular value, or one that is
# as good as none beside the noise, in units of the first discarded singular value.
RESIDUAL, UNSEEN = 30.0, 1e-9
CG_STEPS = 300
ROUGH_RESTARTS = 2
BLOCK_ELEMENTS = 4096  # of a block of rows in a QR factorization
TALL = 8  # rows for each column, from which on the Gram matrix costs less than a restart


@runtime_checkable
class LinearOperator(Protocol):
    """Something with products; also a pytree, linear in its array leaves."""

    @property
    def shape(self) -> tuple[int, int]: ...

    def mv(self, v: Array) -> Array: ...

    def rmv(self, u: Array) -> Array: ...


@runtime_checkable
class WithGram(LinearOperator, Protocol):
    """An operator that knows its transposed matrix times its matrix."""

    def gram(self) -> Array: ...


class Subspace(NamedTuple):
    """Left and right singular vectors (rows, order), (cols, order), and all computed singular values (k,)."""

    left: Float[Array, "rows n"]
    right: Float[Array, "cols n"]
    values: Float[Array, " k"]


def small_enough(shape: tuple[int, int], order: int) -> bool:
    """Whether a full decomposition costs no more than the iteration."""
    return min(shape) <= 6 * (order + OVERSAMPLING)


@partial(jax.custom_jvp, nondiff_argnums=(1, 2))
def dominant_subspace(operator: LinearOperator, order: int, full: bool) -> Subspace:
    """The leading `order` singular vectors of an operator and the singular values computed on the way.

    Its derivative only rotates kept against discarded directions: it is finite for equal kept singular values
    and right for everything that does not depend on the basis chosen inside the kept subspaces. Singular
    values past `order` have derivative zero.

    Args:
        operator: products with a (rows, cols) matrix.
        order: vectors to keep.
        full: decompose the matrix of a DenseOperator.
    """
    if full:
        assert isinstance(operator, DenseOperator)
        u, s, vt = svd(operator.matrix)
        return Subspace(u[:, :order], vt[:order].T, s)
    return _iterate(operator, order)


@dominant_subspace.defjvp
def _rotate(order: int, full: bool, primals: tuple, tangents: tuple) -> tuple[Subspace, Subspace]:
    (operator,), (change,) = primals, tangents
    space = dominant_subspace(operator, order, full)
    u, v, s = space.left, space.right, space.values[:order]
    du_v = jax.jvp(lambda op: op.mv(v), (operator,), (change,))[1]
    dv_u = jax.jvp(lambda op: op.rmv(u), (operator,), (change,))[1]
    ds = jnp.sum(u * du_v, axis=0)
    du_v, dv_u = du_v - u @ (u.T @ du_v), dv_u - v @ (v.T @ dv_u)

    def discarded(w: Array) -> Array:
        w = operator.mv(w - v @ (v.T @ w))
        return w - u @ (u.T @ w)

    def discarded_transposed(w: Array) -> Array:
        w = operator.rmv(w - u @ (u.T @ w))
        return w - v @ (v.T @ w)

    # X S - H_d Z = dH V and Z S - H_d' X = dH' U, with H_d the discarded part: eliminate Z.
    right_side = (du_v + discarded(dv_u / s)) / s
    x = _cg(lambda w: w - discarded(discarded_transposed(w)) / s**2, right_side)
    z = (dv_u + discarded_transposed(x)) / s
    tail = jnp.zeros_like(space.values[order:])
    return space, Subspace(x, z, jnp.concatenate([ds, tail]))


def leading_values(operator: LinearOperator, count: int) -> Float[Array, " count"]:
    """The first `count` singular values, or nearly: good for a look at the order, not iterated to rounding.

    Args:
        operator: products with a (rows, cols) matrix.
        count: how many.
    """
    width = min(count + OVERSAMPLING, *operator.shape)
    return _restart(operator, _start(operator, width), count, width, ROUGH_RESTARTS).values[:count]


def _cg(product: Callable[[Array], Array], right_side: Array) -> Array:
    """Solution of a symmetric positive definite system near the identity, differentiable both ways."""
    return jax.lax.custom_linear_solve(product, right_side, _conjugate_gradients, symmetric=True)


def _conjugate_gradients(product: Callable[[Array], Array], b: Array) -> Array:
    stop = (10 * jnp.finfo(b.dtype).eps) ** 2 * jnp.vdot(b, b)

    def unfinished(state: tuple) -> Array:
        *_, size, count = state
        return (size > stop) & (count < CG_STEPS)

    def step(state: tuple) -> tuple:
        x, residual, direction, size, count = state
        image = product(direction)
        length = size / jnp.vdot(direction, image)
        residual = residual - length * image
        new_size = jnp.vdot(residual, residual)
        return x + length * direction, residual, residual + new_size / size * direction, new_size, count + 1

    return jax.lax.while_loop(unfinished, step, (jnp.zeros_like(b), b, b, jnp.vdot(b, b), 0))[0]


def _tall_qr(x: Array) -> tuple[Array, Array]:
    """QR of a tall matrix by blocks of rows: small factorizations need no threads waiting for each other."""
    rows, width = x.shape
    block = max(2 * width, BLOCK_ELEMENTS // width)
    count = -(-rows // block)
    if count < 3:
        return qr(x)
    blocks = jnp.pad(x, ((0, count * block - rows), (0, 0))).reshape(count, block, width)
    q, r = jax.vmap(qr)(blocks)
    top, r = _tall_qr(r.reshape(count * width, width))
    return (q @ top.reshape(count, width, width)).reshape(-1, width)[:rows], r


def _orthonormal(x: Array) -> Array:
    return _tall_qr(x)[0]


def _orthonormal_against(basis: Array, x: Array) -> Array:
    """Orthonormal columns orthogonal to the basis; twice, because the remainder may be all rounding."""
    for _ in range(2):
        x = _orthonormal(x - basis @ (basis.T @ x))
    return x


def _triplets(basis: Array, products: Array, width: int) -> tuple[Array, Array, Array]:
    """Leading singular vectors, and all values, of Q (H' Q)' from an orthonormal Q and H' Q."""
    z, t = _tall_qr(products)
    a, s, bt = svd(t.T)
    return basis @ a[:, :width], s, z @ bt[:width].T


class _State(NamedTuple):
    left: Array
    values: Array  # twice as many as vectors: the later ones are estimates from below
    right: Array
    image: Array  # H times right
    count: Array


def _residual(state: _State, order: int) -> Array:
    """max_i norm(H v_i - s_i u_i) / s_1 over the kept triplets; H' u_i = s_i v_i holds by construction."""
    error = state.image[:, :order] - state.left[:, :order] * state.values[:order]
    return jnp.max(jnp.linalg.norm(error, axis=0)) / jnp.maximum(state.values[0], jnp.finfo(error.dtype).tiny)


def _start(operator: LinearOperator, width: int) -> _State:
    """Triplets from the image of random vectors, or of the eigenvectors of a Gram matrix that is small."""
    rows, cols = operator.shape
    dtype = jax.eval_shape(operator.mv, jax.ShapeDtypeStruct((cols, 1), jnp.result_type(float))).dtype
    if isinstance(operator, WithGram) and cols <= LARGEST_SIDE and rows >= TALL * cols:
        start = eigh(operator.gram())[1][:, -width:]
    else:
        start = jax.random.uniform(jax.random.key(0), (cols, width), dtype, -1.0, 1.0)
    basis = _orthonormal(operator.mv(start))
    left, values, right = _triplets(basis, operator.rmv(basis), width)
    later = jnp.zeros(_values_kept(operator, width) - width, dtype)
    return _State(left, jnp.concatenate([values, later]), right, operator.mv(right), jnp.array(0))


def _values_kept(operator: LinearOperator, width: int) -> int:
    return min(2 * width, *operator.shape)


def _expand(operator: LinearOperator, state: _State, width: int) -> _State:
    """One restart: the Krylov space of two blocks from the images of the last right vectors."""
    first = _orthonormal(state.image)
    first_product = operator.rmv(first)
    second = _orthonormal_against(first, operator.mv(first_product))
    # no more directions than the matrix has
    second = second[:, : _values_kept(operator, width) - width]
    basis = jnp.concatenate([first, second], axis=1)
    products = jnp.concatenate([first_product, operator.rmv(second)], axis=1)
    left, values, right = _triplets(basis, products, width)
    return _State(left, values, right, operator.mv(right), state.count + 1)


def _iterate(operator: LinearOperator, order: int) -> Subspace:
    width = min(order + OVERSAMPLING, *operator.shape)
    small = min(operator.shape) <= LARGEST_SIDE and operator.shape[0] * operator.shape[1] <= LARGEST_DENSE
    state = _start(operator, width)
    state = _restart(operator, state, order, width, FEW_RESTARTS if small else RESTARTS)
    if small:
        state = _in_full(operator, state, order, width)
    return Subspace(state.left[:, :order], state.right[:, :order], state.values)


def _restart(operator: LinearOperator, state: _State, order: int, width: int, restarts: int) -> _State:
    """Restarts until the residual of the kept triplets is rounding, or nothing beside the noise."""

    def unfinished(state: _State) -> Array:
        return (state.count < restarts) & _coarse(state, order)

    return jax.lax.while_loop(unfinished, lambda st: _expand(operator, st, width), state)


def _coarse(state: _State, order: int) -> Array:
    least = RESIDUAL * jnp.finfo(state.image.dtype).eps
    noise = state.values[order] / jnp.maximum(state.values[0], jnp.finfo(state.image.dtype).tiny)
    return _residual(state, order) > jnp.maximum(least, UNSEEN * noise)


def _in_full(operator: LinearOperator, state: _State, order: int, width: int) -> _State:
    """The full decomposition where the restarts did not suffice: a loop of one step, skipped when no state needs it."""

    def decompose(state: _State) -> _State:
        one = jnp.eye(operator.shape[1], dtype=state.image.dtype)
        # made to depend on the state, or XLA takes all this out of the loop and does it always
        u, s, vt = svd(operator.mv(jnp.where(state.count < RESTARTS, one, 0.0)))
        right = vt[:width].T
        return _State(
            u[:, :width], s[: len(state.values)], right, u[:, :width] * s[:width], jnp.array(RESTARTS)
        )

    return jax.lax.while_loop(lambda st: _coarse(st, order) & (st.count < RESTARTS), decompose, state)
