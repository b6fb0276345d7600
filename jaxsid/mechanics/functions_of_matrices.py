"""Exponential-like functions and the logarithm of a matrix, accurate near zero and near the identity.

A sampled mechanical system has A = exp(L) with L of 1e-3 or less: all of its poles sit in A - I. So
everything here works with phi_1(L) = (exp(L) - I) / L and with E = A - I, subtracting no more than once.
"""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

_TERMS = 15  # 0.5^15 / 16! < 1e-17, the first Taylor term left out
_DOUBLINGS = 24
# Newton steps for each of eight square roots in a row: the first starts furthest from its goal. Enough
# for eigenvalues with |z| > e^(-18), up to 3.13 rad from the positive real axis.
_ROOT_STEPS = (18, 11, 9, 7, 6, 5, 5, 5)
_LARGEST_SYSTEM = 12  # size n whose derivative of the logarithm is one system of n^2 equations


def balance(matrix: Float[Array, "n n"]) -> Float[Array, " n"]:
    """Powers of two d that level row and column norms of matrix * d / d[:, None] (Osborne, J. ACM 7, 1960).

    A second-order system in displacements and velocities has norm w^2; balanced it has w, its poles' size.

    Args:
        matrix: square; its diagonal plays no part.
    """
    off = jnp.abs(lax.stop_gradient(matrix))
    off = off * (1 - jnp.eye(len(off), dtype=off.dtype))

    def step(_: Array, log: Array) -> Array:
        scaled = off * jnp.exp(log - log[:, None])
        rows, cols = scaled.sum(1), scaled.sum(0)
        linked = (rows > 0) & (cols > 0)
        # a quarter, for all entries move at once
        return log + jnp.where(linked, jnp.log(jnp.where(linked, rows / cols, 1.0)) / 4, 0.0)

    log = lax.fori_loop(0, 20, step, jnp.zeros(len(off), off.dtype))
    return jnp.exp2(jnp.round((log - log.mean()) / math.log(2)))


def phi_functions(L: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
    """phi_1(L) = (e^L - I) / L and phi_2(L) = (e^L - I - L) / L^2, entire functions, so for singular L too.

    Taylor series of L / 2^s, then s doublings phi_1(2 L) = phi_1 (I + L phi_1 / 2),
    phi_2(2 L) = (phi_1^2 + 2 phi_2) / 4 (Higham, Functions of Matrices, SIAM 2008, section 10.7.4).

    Args:
        L: square, of norm below 2^23.
    """
    d = balance(L)
    L = L * d / d[:, None]
    eye = jnp.eye(len(L), dtype=L.dtype)
    norm = lax.stop_gradient(jnp.max(jnp.abs(L).sum(0)))
    doublings = jnp.clip(jnp.ceil(jnp.log2(jnp.maximum(norm, 0.5))) + 1, 0, _DOUBLINGS)
    small = L * jnp.exp2(-doublings)

    def horner(phi_2: Array, k: Array) -> tuple[Array, None]:
        return eye + small @ phi_2 / k, None

    series, _ = lax.scan(horner, eye, jnp.arange(_TERMS + 2, 2, -1, dtype=L.dtype))
    phi_2 = series / 2

    def double(k: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        x, one, two = carry
        doubled = (2 * x, one + x @ one @ one / 2, (one @ one + 2 * two) / 4)
        return jax.tree.map(lambda new, old: jnp.where(k < doublings, new, old), doubled, carry)

    _, one, two = lax.fori_loop(0, _DOUBLINGS, double, (small, eye + small @ phi_2, phi_2))
    return one * d[:, None] / d, two * d[:, None] / d


def less_identity_by_phi(L: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """e^L - I as L phi_1(L), of which rounding takes more the larger L: 1e-11 at norm 20, 2e-9 at 150.

    Args:
        L: square, of norm below 2^23.
    """
    return L @ phi_functions(L)[0]


def less_identity_by_squaring(L: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """e^L - I in a tenth of the time of `less_identity_by_phi`, but not to be differentiated backwards.

    Args:
        L: square, of norm below 2^23.
    """
    d = balance(L)
    return _less_identity(L * d / d[:, None], jnp.eye(len(L), dtype=L.dtype), jnp.matmul) * d[:, None] / d


def exponential_with_slopes(stack: Float[Array, "stacked n n"]) -> Float[Array, "stacked n n"]:
    """e^L of the first matrix, and its derivatives in the directions of the others.

    For many directions of one small matrix, with a program much smaller than that of differentiated code.

    Args:
        stack: L, of norm below 2^23, and directions.
    """
    others = (jnp.arange(len(stack)) > 0)[:, None, None]

    def product(x: Array, y: Array) -> Array:
        return x @ y[0] + jnp.where(others, x[0] @ y, 0.0)

    eye = jnp.eye(stack.shape[1], dtype=stack.dtype)
    return _less_identity(stack, jnp.where(others, 0.0, eye), product).at[0].add(eye)


def _less_identity(L: Array, one: Array, product: Callable[[Array, Array], Array]) -> Array:
    """e^L - I: Taylor series of it for L / 2^s, then s doublings E(2 L) = 2 E + E^2.

    Args:
        L: a matrix, or a stack whose first one it is, the others directions.
        one: I, likewise.
        product: of such.
    """
    norm = lax.stop_gradient(jnp.abs(L if L.ndim == 2 else L[0]).sum(0).max())
    doublings = jnp.clip(jnp.ceil(jnp.log2(jnp.maximum(norm, 0.5))) + 1, 0, _DOUBLINGS)
    small = L * jnp.exp2(-doublings)
    # sixteen terms in six products (M. Paterson and L. Stockmeyer, SIAM J. Comput. 2, 1973)
    second = product(small, small)
    third = product(second, small)
    fourth = product(second, second)

    def part(k: int) -> Array:
        terms = zip((one, small, second, third), range(k, k + 4), strict=True)
        return sum((x / math.factorial(n) for x, n in terms), start=jnp.zeros_like(small))

    E = part(12) + fourth / math.factorial(16)
    for k in (8, 4):
        E = part(k) + product(fourth, E)
    E = small + second / 2 + third / 6 + product(fourth, E)
    return lax.fori_loop(0, doublings.astype(int), lambda _, E: 2 * E + product(E, E), E)


def logarithm(A: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Bool[Array, ""]]:
    """Principal logarithm of a real matrix, and whether it was found; also for defective eigenvalues at 1.

    Inverse scaling and squaring: R_j = A^(1/2^j) by the product form of the Denman-Beavers iteration, then
    E_j = R_j - I through E_(j-1) = E_j (R_j + I), which loses nothing for A near I, and Gregory's series
    log(I + E) = 2 (Z + Z^3 / 3 + ...), Z = E (2 I + E)^-1 (Higham, SIAM 2008, sections 6.3 and 11.4). Small matrices
    are differentiated once by solving for the change of the exponential, as one linear system.

    Args:
        A: square. There is none for an eigenvalue at zero or on the negative real axis.
    """
    d = balance(A)
    L, found = (_logarithm if len(A) <= _LARGEST_SYSTEM else _by_roots)(A * d / d[:, None])
    return L * d[:, None] / d, found


@jax.custom_jvp
def _logarithm(A: Array) -> tuple[Array, Array]:
    return _by_roots(A)


@_logarithm.defjvp
def _change_of_logarithm(primals: tuple, tangents: tuple) -> tuple[tuple, tuple]:
    L, found = _logarithm(*primals)
    n = len(L)
    directions = jnp.eye(n * n, dtype=L.dtype).reshape(n * n, n, n)
    pushed = exponential_with_slopes(jnp.concatenate([L[None], directions]))[1:].reshape(n * n, n * n)
    change = jnp.linalg.solve(pushed.T, tangents[0].ravel()).reshape(n, n)
    return (L, found), (change, np.zeros(found.shape, jax.dtypes.float0))


def _by_roots(A: Array) -> tuple[Array, Array]:
    eye = jnp.eye(len(A), dtype=A.dtype)

    def newton(carry: tuple[Array, Array], last: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        root, rest = carry
        inverse = jnp.linalg.inv(rest)
        root = root @ (eye + inverse) / 2
        rest = (eye + (rest + inverse) / 2) / 2
        error = jnp.max(jnp.abs(rest - eye))
        return (root, jnp.where(last, root, rest)), (root, error)

    ends = np.cumsum(_ROOT_STEPS) - 1
    last = np.isin(np.arange(ends[-1] + 1), ends)
    _, (roots, errors) = lax.scan(newton, (A, A), jnp.asarray(last))

    def shrink(E: Array, root: Array) -> tuple[Array, None]:
        return jnp.linalg.solve((eye + root).T, E.T).T, None

    E, _ = lax.scan(shrink, A - eye, roots[ends])
    Z = jnp.linalg.solve((2 * eye + E).T, E.T).T
    square = Z @ Z
    series = eye / 17
    for k in range(15, 0, -2):
        series = eye / k + square @ series
    return 2 * 2.0 ** len(_ROOT_STEPS) * Z @ series, jnp.all(errors[ends] <= jnp.sqrt(jnp.finfo(A.dtype).eps))
