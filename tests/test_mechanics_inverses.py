"""Inverses of many small matrices against LAPACK's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsid.mechanics.inverses import inverse_each


def matrices(n, count=50, seed=0, kind=complex):
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((count, n, n)) + (
        1j * rng.standard_normal((count, n, n)) if kind is complex else 0
    )
    return x


@pytest.mark.parametrize("kind", [float, complex])
@pytest.mark.parametrize("n", [1, 2, 6, 14])
def test_inverses_are_those_of_lapack(n, kind):
    x = matrices(n, kind=kind)
    exact = np.linalg.inv(x)
    error = np.abs(np.asarray(inverse_each(jnp.asarray(x))) - exact).max(axis=(1, 2))
    assert (error < 1e-14 * np.linalg.cond(x) * np.abs(exact).max(axis=(1, 2))).all()


def test_zeros_on_the_diagonal_need_pivots():
    x = np.array([[[0.0, 2.0], [3.0, 0.0]], [[0.0, 1.0], [1.0, 1e-20]], [[1e-20, 1.0], [1.0, 1.0]]])
    np.testing.assert_allclose(inverse_each(jnp.asarray(x)), np.linalg.inv(x), rtol=1e-14, atol=1e-15)


def test_near_a_resonance_it_is_as_exact_as_lapack():
    """A lightly damped system at its resonance, in units far apart."""
    K, D, M = np.diag([4e6, 9e8]), np.diag([1e-3, 1e-2]), np.array([[1.0, 0.1], [0.1, 2.0]])
    s = 1j * np.array([1999.0, 2000.0, 21000.0])[:, None, None]
    x = M * s**2 + D * s + K
    product = np.asarray(inverse_each(jnp.asarray(x))) @ x
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(2), product.shape), atol=1e-9)


def test_singular_matrices_are_not_finite_and_leave_others_alone():
    x = np.stack([np.eye(3), np.zeros((3, 3)), 2 * np.eye(3)])
    found = np.asarray(inverse_each(jnp.asarray(x)))
    assert not np.isfinite(found[1]).all()
    np.testing.assert_array_equal(found[[0, 2]], np.stack([np.eye(3), 0.5 * np.eye(3)]))


def test_derivatives_transformations_and_single_precision():
    x = jnp.asarray(matrices(4, 6, kind=float))
    change = jnp.asarray(matrices(4, 6, seed=1, kind=float))
    given, moved = jax.jvp(inverse_each, (x,), (change,))
    step = 1e-6
    numeric = (np.linalg.inv(x + step * change) - np.linalg.inv(x - step * change)) / (2 * step)
    np.testing.assert_allclose(moved, numeric, rtol=1e-5, atol=1e-6 * np.abs(numeric).max())
    reverse = jax.grad(lambda a: (inverse_each(a) * change).sum())(x)
    np.testing.assert_allclose((reverse * change).sum(), (moved * change).sum(), rtol=1e-10)
    np.testing.assert_allclose(jax.jit(jax.vmap(inverse_each))(x), given, rtol=1e-12)
    single = inverse_each(x.astype(jnp.float32))
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, given, rtol=1e-3, atol=1e-3)
