"""Holds against scipy.signal.cont2discrete and scipy.linalg, and the way back."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.signal
from test_mechanics_first_order import CHAIN, FREE, OVERDAMPED, RIG, model

from jaxsid.checks import InputError, InsufficientDataError
from jaxsid.mechanics.first_order import physical_displacement_momentum, physical_displacement_velocity
from jaxsid.mechanics.functions_of_matrices import (
    exponential_with_slopes,
    less_identity_by_phi,
    less_identity_by_squaring,
    logarithm,
    phi_functions,
)
from jaxsid.mechanics.hold import continuous, discretise, laguerre_to_shift, shift_to_laguerre
from jaxsid.records import ContinuousModel, Realization

SYSTEMS = {
    "1 DOF": model([[1.0]], [[0.01]], [[1.0]]),
    "3 DOF": CHAIN,
    "rig": RIG,
    "overdamped": OVERDAMPED,
    "free": FREE,
    "free mass": model([[2.0]], [[0.0]], [[0.0]]),
}
SCIPY = {"zero": "zoh", "first": "foh", "band": "bilinear"}
FORMS = (physical_displacement_velocity, physical_displacement_momentum)


def arrays(m):
    return tuple(np.asarray(getattr(m, x)) for x in "ABCD")


def close(value, truth, tolerance):
    np.testing.assert_allclose(value, truth, atol=tolerance * max(np.abs(truth).max(), 1e-300), rtol=0)


@pytest.mark.parametrize("hold", SCIPY)
@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("form", FORMS)
def test_agrees_with_scipy_and_comes_back(name, hold, form):
    m = form(SYSTEMS[name])
    sampled = discretise(m, 1e-3, hold=hold)
    for value, truth in zip(
        arrays(sampled), scipy.signal.cont2discrete(arrays(m), 1e-3, SCIPY[hold]), strict=False
    ):
        close(value, truth, 1e-13)
    back = continuous(sampled)
    for value, truth in zip(arrays(back), arrays(m), strict=True):
        close(value, truth, 1e-11)


@pytest.mark.parametrize("hold", SCIPY)
@pytest.mark.parametrize("name", ["1 DOF", "3 DOF", "rig", "overdamped"])
def test_poles_come_back(name, hold):
    """To 1e-10 of each pole; the rig's zero pole to 1e-10 of its slowest other."""
    m = physical_displacement_velocity(SYSTEMS[name])
    back = np.linalg.eigvals(np.asarray(continuous(discretise(m, 1e-3, hold=hold)).A))
    for pole in np.linalg.eigvals(np.asarray(m.A)):
        if abs(pole) < 1e-6:
            assert np.abs(back).min() < 1e-10 * np.sort(np.abs(back))[1]
        else:
            assert np.abs(back - pole).min() < 1e-10 * abs(pole)


def test_defective_double_pole_at_zero_comes_back_exactly():
    m = physical_displacement_velocity(SYSTEMS["free mass"])
    for hold in SCIPY:
        close(continuous(discretise(m, 1e-3, hold=hold)).A, np.asarray(m.A), 1e-15)


def test_poles_near_the_nyquist_frequency_come_back():
    s = np.array([-0.01 + 3.1j, -0.3 + 2.5j, -6.0])
    A = scipy.linalg.block_diag(*([[p.real, p.imag], [-p.imag, p.real]] for p in s[:2]), s[2].real)
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(5, 5)))[0]
    A = turn @ A @ turn.T
    m = ContinuousModel(*(jnp.asarray(x) for x in (A, np.ones((5, 1)), np.ones((1, 5)), np.zeros((1, 1)))))
    back = np.linalg.eigvals(np.asarray(continuous(discretise(m, 1.0)).A))
    for pole in s:
        assert np.abs(back - pole).min() < 1e-10


def test_random_realization_has_scipys_logarithm():
    rng = np.random.default_rng(2)
    A = scipy.linalg.expm(0.5 * rng.normal(size=(8, 8)))
    L, found = jax.jit(logarithm)(A)
    assert found
    close(L, scipy.linalg.logm(A).real, 1e-12)


@pytest.mark.parametrize("size", [5, 14])
def test_derivative_of_the_logarithm_undoes_that_of_scipys_exponential(size):
    rng = np.random.default_rng(6)
    S = rng.normal(size=(size, size))
    L = 0.1 * (S - S.T) - 0.05 * np.diag(rng.uniform(1, 2, size))
    L[:2, :2] = [[0.0, 1.0], [0.0, 0.0]]  # a rigid body: not diagonalizable
    L[:2, 2:] = L[2:, :2] = 0.0
    direction = rng.normal(size=(size, size))
    A, change = scipy.linalg.expm_frechet(L, direction)
    found, forward = jax.jit(lambda a, da: jax.jvp(lambda x: logarithm(x)[0], (a,), (da,)))(A, change)
    close(found, L, 1e-12)
    close(forward, direction, 1e-10)
    weight = rng.normal(size=(size, size))
    reverse = jax.jit(jax.grad(lambda a: jnp.vdot(weight, logarithm(a)[0])))(A)
    np.testing.assert_allclose(np.vdot(reverse, change), np.vdot(weight, direction), rtol=1e-10)


def test_phi_functions_against_scipy():
    rng = np.random.default_rng(3)
    for size in (1e-8, 0.1, 5.0, 40.0):
        S = rng.normal(size=(5, 5))
        L = size * (S - S.T - np.eye(5))  # normal, so that its exponential is well conditioned
        zero, eye = np.zeros((5, 5)), np.eye(5)
        big = scipy.linalg.expm(np.block([[L, eye, zero], [zero, zero, eye], [zero, zero, zero]]))
        one, two = jax.jit(phi_functions)(L)
        close(one, big[:5, 5:10], 1e-12)
        close(two, big[:5, 10:], 1e-12)


def test_exponential_and_its_slopes_against_scipy():
    rng = np.random.default_rng(4)
    for size in (1e-8, 0.1, 5.0, 40.0):
        S = rng.normal(size=(5, 5))
        L = size * (S - S.T - np.eye(5))
        directions = rng.normal(size=(3, 5, 5))
        found = jax.jit(exponential_with_slopes)(np.concatenate([L[None], directions]))
        np.testing.assert_allclose(found[0], scipy.linalg.expm(L), rtol=0, atol=1e-12)
        for slope, direction in zip(found[1:], directions, strict=True):
            truth = scipy.linalg.expm_frechet(L, direction, compute_expm=False)
            np.testing.assert_allclose(slope, truth, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("of", "size"),
    [
        *((less_identity_by_phi, size) for size in (1e-8, 0.1, 5.0)),
        *((less_identity_by_squaring, size) for size in (1e-8, 0.1, 5.0, 40.0)),
    ],
)
def test_exponential_less_identity_and_its_slope_against_scipy(of: Callable, size: float):
    rng = np.random.default_rng(5)
    S = rng.normal(size=(5, 5))
    # of entries as far apart as those of displacements and velocities
    units = 10.0 ** np.arange(-2, 3)
    L = size * (S - S.T) * units / units[:, None]
    direction = rng.normal(size=(5, 5)) * units / units[:, None]
    found, slope = jax.jit(lambda x, dx: jax.jvp(of, (x,), (dx,)))(L, direction)
    balanced = lambda x: x * units[:, None] / units  # noqa: E731
    truth, change = scipy.linalg.expm_frechet(balanced(L), balanced(direction))
    series = sum((np.linalg.matrix_power(balanced(L), k) / math.factorial(k) for k in range(1, 6)), 0.0)
    close(balanced(found), series if size < 1e-3 else truth - np.eye(5), 1e-12)
    close(balanced(slope), change, 1e-11)


def test_each_input_has_its_own_hold():
    m = physical_displacement_velocity(CHAIN)
    mixed = discretise(m, 0.1, hold=("zero", "first", "zero"))
    zero, first = (discretise(m, 0.1, hold=h) for h in ("zero", "first"))
    np.testing.assert_allclose(mixed.B, np.where([False, True, False], first.B, zero.B), atol=1e-15)
    np.testing.assert_allclose(mixed.D, np.where([False, True, False], first.D, zero.D), atol=1e-15)
    for value, truth in zip(arrays(continuous(mixed)), arrays(m), strict=True):
        close(value, truth, 1e-12)


def test_band_keeps_the_frequency_response_under_the_bilinear_map():
    m, dt = physical_displacement_velocity(CHAIN), 0.1
    A, B, C, D = arrays(m)
    a, b, c, d = arrays(discretise(m, dt, hold="band"))
    for w in (0.5, 4.7, 100.0):
        z = (1 + 0.5j * w * dt) / (1 - 0.5j * w * dt)
        truth = C @ np.linalg.solve(1j * w * np.eye(6) - A, B) + D
        close(c @ np.linalg.solve(z * np.eye(6) - a, b) + d, truth, 1e-12)


def test_bad_input_is_refused_with_the_reason():
    m = physical_displacement_velocity(CHAIN)
    with pytest.raises(InputError, match="cannot be mixed"):
        discretise(m, 0.1, hold=("band", "zero", "zero"))
    with pytest.raises(InputError, match="hold 'third' is unknown"):
        discretise(m, 0.1, hold="third")
    with pytest.raises(InputError, match="3 inputs need as many holds"):
        discretise(m, 0.1, hold=("zero",))
    with pytest.raises(InputError, match="must be positive"):
        discretise(m, 0.0)
    with pytest.raises(InputError, match="inside the unit circle"):
        laguerre_to_shift(*(getattr(m, x) for x in "ABCD"), 1.0)


@pytest.mark.parametrize("pole", [-0.5, -1.0, 0.0])
def test_no_real_logarithm_is_said_or_nan(pole):
    A = jnp.array([[0.5, 0.3], [0.0, pole]])
    bad = Realization(A, jnp.ones((2, 1)), jnp.ones((1, 2)), jnp.zeros((1, 1)), 0.1)
    with pytest.raises(InsufficientDataError, match="at or beyond the Nyquist frequency"):
        continuous(bad)
    assert np.isnan(jax.jit(continuous)(bad).A).all()


def test_bilinear_map_takes_negative_real_poles_but_not_minus_one():
    def sampled(pole):
        return Realization([[pole]], [[1.0]], [[1.0]], [[0.0]], 0.1, hold="band")

    np.testing.assert_allclose(continuous(sampled(-0.5)).A, [[-60.0]], rtol=1e-14)
    with pytest.raises(InsufficientDataError, match="Nyquist"):
        continuous(sampled(-1.0))


@pytest.mark.parametrize("a", [-0.6, 0.0, 0.97])
def test_laguerre_shift(a):
    sampled = arrays(discretise(physical_displacement_velocity(CHAIN), 0.1))
    moved = shift_to_laguerre(*(jnp.asarray(x) for x in sampled), a)
    eye = np.eye(6)
    for z in (np.exp(0.3j), np.exp(2j), 1.7 - 0.4j):
        w = (z - a) / (1 - a * z)
        A, B, C, D = sampled
        truth = C @ np.linalg.solve(z * eye - A, B) + D
        A, B, C, D = (np.asarray(x) for x in moved)
        close(C @ np.linalg.solve(w * eye - A, B) + D, truth, 1e-11)
    for value, truth in zip(laguerre_to_shift(*moved, a), sampled, strict=True):
        close(value, truth, 1e-12)


def test_jit_vmap_grad():
    m = physical_displacement_velocity(CHAIN)

    def there_and_back(x, hold):
        sampled = discretise(ContinuousModel(x * m.A, m.B, m.C, m.D), 0.3, hold=hold)
        return sampled.A, continuous(sampled).A, continuous(sampled).B

    for hold in ("zero", "first"):
        batched = jax.jit(jax.vmap(lambda x, hold=hold: there_and_back(x, hold)))(jnp.array([1.0, 2.0]))
        for value, truth in zip(batched, there_and_back(2.0, hold), strict=True):
            close(value[1], truth, 1e-12)
    # d exp(x A dt) / dx = A dt exp(x A dt), and back it is A again
    forward = jax.jacfwd(lambda x: there_and_back(x, "zero"))(1.0)
    reverse = jax.jacrev(lambda x: there_and_back(x, "zero"))(1.0)
    for slope in (forward, reverse):
        close(slope[0], 0.3 * np.asarray(m.A) @ scipy.linalg.expm(0.3 * np.asarray(m.A)), 1e-12)
        close(slope[1], np.asarray(m.A), 1e-11)
        np.testing.assert_allclose(slope[2], 0, atol=1e-11)


def test_single_precision():
    m = jax.tree.map(lambda x: x.astype(jnp.float32), physical_displacement_velocity(CHAIN))
    for hold in SCIPY:
        back = continuous(discretise(m, 0.05, hold=hold))
        assert back.A.dtype == jnp.float32
        close(back.A, np.asarray(m.A), 2e-5)
