"""Levenberg-Marquardt against scipy, closed forms, and as a part of compiled programs."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

from jaxsid.least_squares import forward, levenberg_marquardt


def rosenbrock(x):
    return jnp.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def decay(x, t, y):
    return x[0] * jnp.exp(-x[1] * t) * jnp.cos(x[2] * t) - y


T = np.linspace(0, 4, 120)
Y = 2.0 * np.exp(-0.4 * T) * np.cos(3.1 * T) + 0.05 * np.random.default_rng(0).standard_normal(len(T))
START = jnp.array([1.0, 1.0, 2.8])


def fit(y, start=START, **options):
    options = {"max_steps": 100, **options}
    return levenberg_marquardt(forward(lambda x: decay(x, T, y)), start, **options)


def test_a_linear_problem_has_its_closed_form():
    rng = np.random.default_rng(1)
    X, y = rng.standard_normal((30, 4)), rng.standard_normal(30)
    found = levenberg_marquardt(lambda b: (X @ b - y, jnp.asarray(X)), jnp.zeros(4), max_steps=50)
    np.testing.assert_allclose(found.value, np.linalg.lstsq(X, y)[0], rtol=1e-6)
    np.testing.assert_allclose(found.jacobian_product, X.T @ X, rtol=1e-12)
    np.testing.assert_allclose(found.cost, 0.5 * ((X @ found.value - y) ** 2).sum(), rtol=1e-12)


def test_the_curved_valley_is_followed_to_its_end():
    found = levenberg_marquardt(forward(rosenbrock), jnp.array([-1.2, 1.0]), max_steps=200)
    np.testing.assert_allclose(found.value, [1.0, 1.0], rtol=1e-7)


def test_scipy_finds_the_same_minimum():
    found = fit(Y)
    other = optimize.least_squares(lambda x: np.asarray(decay(x, T, Y)), START, xtol=1e-12, ftol=1e-14)
    np.testing.assert_allclose(found.value, other.x, rtol=1e-5)
    np.testing.assert_allclose(found.cost, other.cost, rtol=1e-9)
    np.testing.assert_allclose(found.jacobian_product, other.jac.T @ other.jac, rtol=1e-4)


def test_unknowns_of_very_different_size():
    size = jnp.array([1e6, 1e-5, 1.0])
    found = levenberg_marquardt(forward(lambda x: decay(x / size, T, Y)), START * size, max_steps=100)
    np.testing.assert_allclose(found.value / size, fit(Y).value, rtol=1e-6)


def test_a_step_that_does_not_help_is_undone():
    start = jnp.array([-1.2, 1.0])
    limited = jax.jit(lambda n: levenberg_marquardt(forward(rosenbrock), start, max_steps=n).cost)
    costs = [limited(n) for n in range(1, 25)]
    assert all(later <= earlier for earlier, later in itertools.pairwise(costs))
    assert float(costs[0]) == pytest.approx(0.5 * float((rosenbrock(start) ** 2).sum()), rel=1e-14)
    undone = [a == b for a, b in itertools.pairwise(costs)]
    assert any(undone)
    assert not all(undone)


def test_steps_that_leave_the_domain_are_refused():
    found = levenberg_marquardt(
        forward(lambda x: jnp.log(x) - jnp.array([-3.0, 2.0])), jnp.array([40.0, 0.01]), max_steps=100
    )
    np.testing.assert_allclose(found.value, np.exp([-3.0, 2.0]), rtol=1e-6)


def test_the_nearest_positive_matrix_is_reached_on_the_edge():
    """Closed form: negative eigenvalues become zero (N. Higham, Linear Algebra Appl. 103, 1988)."""
    rng = np.random.default_rng(3)
    goal = rng.standard_normal((5, 5))
    goal = goal + goal.T
    weight = np.where(np.eye(5) > 0, 1.0, np.sqrt(2.0))[np.triu_indices(5)]

    def positive(theta):
        lower = jnp.zeros((5, 5)).at[np.tril_indices(5)].set(theta)
        return (lower @ lower.T)[np.triu_indices(5)]

    def evaluate(upper):
        return weight * (upper - goal[np.triu_indices(5)]), jnp.diag(jnp.asarray(weight))

    values, vectors = np.linalg.eigh(goal)
    assert (values < 0).sum() == 2
    nearest = (vectors * np.maximum(values, 0)) @ vectors.T
    for seed in range(3):
        start = jnp.eye(5)[np.tril_indices(5)] + 0.1 * np.random.default_rng(seed).standard_normal(15)
        found = levenberg_marquardt(evaluate, start, max_steps=300, tolerance=1e-15, through=positive)
        np.testing.assert_allclose(positive(found.value), nearest[np.triu_indices(5)], atol=1e-5)
        np.testing.assert_allclose(found.cost, 0.5 * np.sum(values[values < 0] ** 2), rtol=1e-9)


def test_the_limit_of_steps_holds():
    found = fit(Y, max_steps=3)
    assert int(found.steps) == 3


def test_forward_gives_residual_and_jacobian():
    r, j = forward(lambda x: decay(x, T, Y).reshape(2, -1))(START)
    np.testing.assert_allclose(r, decay(START, T, Y))
    np.testing.assert_allclose(j, jax.jacrev(lambda x: decay(x, T, Y))(START), rtol=1e-10, atol=1e-12)


def test_jit_and_vmap_agree_with_the_plain_call():
    data = np.stack([Y, 1.1 * Y + 0.01])
    together = jax.jit(jax.vmap(fit))(data)
    for i, y in enumerate(data):
        np.testing.assert_allclose(together.value[i], fit(y).value, rtol=1e-6)


def test_covariance_is_that_of_repeated_noise():
    clean = decay(jnp.array([2.0, 0.4, 3.1]), T, 0.0)
    noise = np.random.default_rng(2).standard_normal((400, len(T)))
    found = jax.jit(jax.vmap(fit))(clean / 0.05 + noise)
    spread = np.cov(np.asarray(found.value).T)
    promised = np.linalg.inv(np.asarray(found.jacobian_product).mean(axis=0))
    np.testing.assert_allclose(np.sqrt(np.diag(spread) / np.diag(promised)), 1.0, atol=0.12)


def test_single_precision(single_precision):
    found = levenberg_marquardt(forward(rosenbrock), jnp.array([-1.2, 1.0]), max_steps=200)
    assert found.value.dtype == jnp.float32
    np.testing.assert_allclose(found.value, [1.0, 1.0], rtol=1e-3)


def test_a_step_that_promises_nothing_is_not_evaluated():
    asked = 1e-8
    found = fit(Y, tolerance=asked)
    again = fit(Y, start=found.value, tolerance=asked)
    assert int(again.steps) == 1
    np.testing.assert_array_equal(again.value, found.value)
    # what was left out is worth less than a hundred millionth of the cost
    exact = optimize.least_squares(
        lambda x: np.asarray(decay(x, T, Y)), START, xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    assert abs(float(found.cost) / exact.cost - 1) < asked
    assert int(found.steps) < int(fit(Y, tolerance=0.0).steps)
