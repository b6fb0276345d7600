"""The four first-order forms and the complex modes against scipy.linalg."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from jaxsid.checks import InsufficientDataError
from jaxsid.mechanics.first_order import (
    modal_displacement_momentum,
    modal_displacement_velocity,
    normal_modes,
    physical_displacement_momentum,
    physical_displacement_velocity,
)
from jaxsid.mechanics.pencil import complex_modes, is_proportional
from jaxsid.records import SecondOrderModel

FORMS = (
    physical_displacement_velocity,
    physical_displacement_momentum,
    modal_displacement_velocity,
    modal_displacement_momentum,
)


def model(mass, damping, stiffness):
    """One sensor of every kind on every body, one force on every body."""
    mass, damping, stiffness = (np.asarray(x, float) for x in (mass, damping, stiffness))
    size = len(mass)
    rows = [np.zeros((3 * size, size)) for _ in range(3)]
    for kind in range(3):
        rows[kind][kind * size : (kind + 1) * size] = np.eye(size)
    arrays = (jnp.asarray(x) for x in (mass, damping, stiffness, np.eye(size), *rows))
    return SecondOrderModel(*arrays, diagnostics=None)


CHAIN = model(
    np.eye(3),
    [[0.2, -0.1, 0], [-0.1, 0.2, -0.1], [0, -0.1, 1.1]],
    [[4, -2, 0], [-2, 4, -2], [0, -2, 22]],
)
RIG = model(
    [[0.0053, 0], [0, 0.18]],
    [[0.8268 + 0.4352, -0.8268], [-0.8268, 0.8268 + 0.4782]],
    [[9365, -9365], [-9365, 9365]],
)
OVERDAMPED = model(np.eye(2), [[210, -10], [-10, 210]], [[200, -100], [-100, 200]])
FREE = model(np.diag([1.0, 2.0]), 0.1 * np.array([[1, -1], [-1, 1]]), 100 * np.array([[1, -1], [-1, 1]]))
COUPLED = model([[2, 0.3], [0.3, 1]], [[0.5, 0.2], [0.2, 0.1]], [[40, -10], [-10, 30]])
SYSTEMS = {"chain": CHAIN, "rig": RIG, "overdamped": OVERDAMPED, "free": FREE, "coupled": COUPLED}


def blocks(m):
    return (np.asarray(x) for x in (m.mass, m.damping, m.stiffness))


@pytest.mark.parametrize("name", SYSTEMS)
def test_all_forms_have_the_transfer_function_of_the_second_order_model(name):
    m = SYSTEMS[name]
    M, D, K = blocks(m)
    for s in (0.3 + 0.2j, 3j, 50j, -0.2 + 1400j):
        dynamic = M * s**2 + D * s + K
        q = np.linalg.inv(dynamic)
        # a soft motion beside a stiff spring costs digits, whatever the form
        tolerance = max(1e-12, np.finfo(float).eps * np.linalg.cond(dynamic))
        truth = np.vstack([q, s * q, s**2 * q])
        for form in FORMS:
            A, B, C, d = (np.asarray(getattr(form(m), x)) for x in "ABCD")
            G = C @ np.linalg.solve(s * np.eye(len(A)) - A, B) + d
            for kind in range(3):
                part = slice(kind * len(M), (kind + 1) * len(M))
                # slow accelerations are the feedthrough less nearly all of it
                scale = max(np.abs(truth[part]).max(), np.abs(d[part]).max())
                np.testing.assert_allclose(G[part], truth[part], atol=tolerance * scale, rtol=0)


@pytest.mark.parametrize("name", SYSTEMS)
def test_all_forms_have_the_same_markov_parameters(name):
    """C e^(A t) B by scipy's exponential agrees to 1e-12 of its peak, every kind of sensor by itself."""
    m = SYSTEMS[name]
    times = (0.0, 1e-3, 0.01, 0.1)
    h = []
    for form in FORMS:
        A, B, C, D = (np.asarray(getattr(form(m), x)) for x in "ABCD")
        h.append(np.array([D] + [C @ scipy.linalg.expm(A * t) @ B for t in times]).reshape(5, 3, -1))
    peak = np.abs(h[0]).max(axis=(0, 2))[:, None]
    for other in h[1:]:
        np.testing.assert_allclose(other / peak, h[0] / peak, atol=1e-12, rtol=0)


def test_structure_of_the_forms():
    M, D, K = blocks(COUPLED)
    A = physical_displacement_momentum(COUPLED).A
    np.testing.assert_allclose(A[:2, 2:], np.linalg.inv(M), rtol=1e-14)
    np.testing.assert_allclose(A[2:, :2], -K)
    squares, shapes = normal_modes(COUPLED)
    np.testing.assert_allclose(squares, scipy.linalg.eigh(K, M)[0], rtol=1e-13)
    np.testing.assert_allclose(shapes.T @ M @ shapes, np.eye(2), atol=1e-14)
    A = modal_displacement_velocity(COUPLED).A
    np.testing.assert_allclose(A[2:, :2], -np.diag(squares), atol=1e-15)
    np.testing.assert_allclose(A[2:, 2:], -shapes.T @ D @ shapes, atol=1e-14)


def test_rigid_body_modes_are_exactly_zero():
    assert normal_modes(FREE)[0][0] == 0


def test_forms_under_jit_vmap_grad():
    stack = jax.tree.map(lambda x: jnp.stack([x, x]), CHAIN)
    batched = jax.vmap(modal_displacement_momentum)(stack)
    np.testing.assert_allclose(batched.A[1], modal_displacement_momentum(CHAIN).A, atol=1e-14)

    def size(k):
        m = SecondOrderModel(
            CHAIN.mass, CHAIN.damping, k * CHAIN.stiffness, *list(vars(CHAIN).values())[3:7], None
        )
        return (modal_displacement_velocity(m).C ** 2).sum()

    difference = (size(1.0 + 1e-6) - size(1.0 - 1e-6)) / 2e-6
    np.testing.assert_allclose(jax.grad(size)(1.0), difference, rtol=1e-7)


REPEATED = np.linalg.qr(np.random.default_rng(0).normal(size=(4, 4)))[0]
MODES = {
    **{k: v for k, v in SYSTEMS.items() if k != "free"},
    "repeated": model(
        np.eye(4),
        REPEATED @ np.diag([0.1, 0.1, 0.1, 0.3]) @ REPEATED.T,
        REPEATED @ np.diag([4.0, 4.0, 4.0, 9.0]) @ REPEATED.T,
    ),
    "twins": model(np.eye(2), 0.1 * np.eye(2), 4 * np.eye(2)),
}


@pytest.mark.parametrize("name", MODES)
def test_pencil_normalization(name):
    m = MODES[name]
    M, D, K = blocks(m)
    modes = complex_modes(m)
    X, poles = np.asarray(modes.shapes), np.asarray(modes.poles)
    Z, zero = np.vstack([X, X * poles]), np.zeros_like(M)
    scale = np.abs(poles).max()
    np.testing.assert_allclose(Z.T @ np.block([[D, M], [M, zero]]) @ Z, np.eye(len(poles)), atol=1e-12)
    np.testing.assert_allclose(
        Z.T @ np.block([[K, zero], [zero, -M]]) @ Z, -np.diag(poles), atol=1e-12 * scale
    )
    size = np.linalg.norm(M) * np.abs(poles) ** 2 + np.linalg.norm(D) * np.abs(poles) + np.linalg.norm(K)
    residual = np.linalg.norm(M @ X * poles**2 + D @ X * poles + K @ X, axis=0)
    assert (residual <= 1e-12 * size * np.linalg.norm(X, axis=0)).all()
    assert (np.diff(np.abs(poles)) >= 0).all()
    upper = np.flatnonzero(poles.imag > 0)
    np.testing.assert_array_equal(poles[upper + 1], poles[upper].conj())
    np.testing.assert_array_equal(X[:, upper + 1], X[:, upper].conj())


def test_poles_agree_with_the_reference():
    poles = complex_modes(CHAIN).poles
    reference = [-0.04745 + 1.377j, -0.1470 + 2.420j, -0.5556 + 4.681j]
    np.testing.assert_allclose(poles[::2], reference, atol=5e-4)
    slow = np.asarray(complex_modes(RIG).poles[:2])
    assert abs(slow[0]) < 1e-9
    np.testing.assert_allclose(slow[1], -4.9298, atol=1e-3)


def test_proportional_modes_are_the_real_ones():
    m = model(np.eye(2), 0.02 * np.array([[4, -2], [-2, 5.0]]), [[4, -2], [-2, 5]])
    X = np.asarray(complex_modes(m).shapes)
    turned = X / X[np.argmax(np.abs(X), axis=0), np.arange(4)]
    np.testing.assert_allclose(turned.imag, 0, atol=1e-12)
    assert is_proportional(m)
    assert is_proportional(OVERDAMPED)
    assert not is_proportional(RIG)
    assert not is_proportional(COUPLED)


def test_missing_normalization_is_explained():
    with pytest.raises(InsufficientDataError, match=r"rigid-body motion \(0.577, 0.577\) meets neither"):
        complex_modes(FREE)
    with pytest.raises(InsufficientDataError, match="critically damped"):
        complex_modes(model([[1.0]], [[2.0]], [[1.0]]))


def test_complex_modes_under_jit_and_single_precision():
    np.testing.assert_allclose(
        jax.jit(complex_modes)(COUPLED).shapes, complex_modes(COUPLED).shapes, atol=1e-13
    )
    single = complex_modes(jax.tree.map(lambda x: x.astype(jnp.float32), CHAIN))
    assert single.poles.dtype == jnp.complex64
    np.testing.assert_allclose(single.poles, complex_modes(CHAIN).poles, rtol=1e-5)
