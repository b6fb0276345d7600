"""ERA/DC: exact for every lag and shape, fast as dense, its derivative, and less bias from noise than ERA."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_markov import CHAIN, ONE, SYSTEMS, markov, pole_error, rebuilt

from jaxsid.checks import InputError
from jaxsid.modes import modal
from jaxsid.realization.era_dc import CorrelationOperator, _correlations, _operator, _Shape, era_dc
from jaxsid.records import ImpulseResponse


def assert_exact(name, order, samples=4096, **window):
    h, poles = markov(SYSTEMS[name], samples)
    rz = era_dc(ImpulseResponse(h, 1e-3), order=order, **window)
    md = modal(rz)
    assert pole_error(md.poles, poles) < 1e-10
    assert np.abs(rebuilt(rz, samples) - h).max() < 1e-12
    assert md.indicators is not None
    np.testing.assert_allclose(md.indicators.mac, 1, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "order", "window"),
    [
        ("one", 2, {"rows": 500, "cols": 500, "lags": 5}),
        ("one", 2, {"rows": 500, "cols": 500, "lags": 5, "first_lag": 500, "lag_step": 50}),
        ("chain", 6, {"rows": 5, "cols": 3000, "lags": 100}),
        ("chain_one_input", 6, {"rows": 5, "cols": 3000, "lags": 100, "first_lag": 5}),
        pytest.param(
            "chain",
            6,
            {"rows": 5, "cols": 2000, "lags": 20, "lag_step": 40, "first_lag": 5},
            marks=pytest.mark.slow,
        ),
        ("chain", 6, {"rows": 50, "cols": 200, "lags": 7, "lag_step": 13, "first_lag": 1, "stride": 11}),
        ("overdamped", 2, {"rows": 30, "cols": 40, "lags": 10, "lag_step": 20, "first_lag": 3, "stride": 40}),
    ],
)
def test_exact_recovery(name, order, window):
    assert_exact(name, order, **window)


@pytest.mark.parametrize("first_lag", [0, 1, 4, 37])
@pytest.mark.parametrize("window", [{"rows": 4, "cols": 300, "lags": 15, "lag_step": 30, "stride": 5}])
def test_exact_recovery_by_full_decomposition(first_lag, window):
    assert_exact("chain", 6, first_lag=first_lag, method="svd", **window)


@pytest.mark.slow
def test_exact_recovery_by_full_decomposition_at_the_size_of_the_thesis():
    assert_exact("chain", 6, rows=5, cols=3000, lags=100, method="svd")


@pytest.mark.parametrize("shape", [(7, 9, 3, 2, 4, 1), (30, 10, 3, 4, 5, 2), (5, 5, 1, 1, 0, 3)])
def test_operators_are_the_matrix(shape):
    rows, cols, lags, tau, first, stride = shape
    h = np.random.default_rng(0).standard_normal((140, 3, 2))

    def hankel(k):
        blocks = [[h[1 + k + stride * (i + j)] for j in range(cols)] for i in range(rows)]
        return np.block(blocks)

    matrix = np.block(
        [[hankel(first + (i + j) * tau) @ hankel(0).T for j in range(lags)] for i in range(lags)]
    )
    steps = _Shape(
        tuple(range(0, stride * rows, stride)),
        tuple(range(0, stride * cols, stride)),
        tuple(range(0, lags * tau, tau)),
        first,
    )
    for full in (False, True):
        operator = _operator(jnp.asarray(h), jnp.asarray(h), steps, full)
        assert isinstance(operator, CorrelationOperator) == (not full and 3 * rows > 64)
        eye = jnp.eye(len(matrix))
        np.testing.assert_allclose(operator.mv(eye), matrix, atol=1e-11)
        np.testing.assert_allclose(operator.rmv(eye), matrix.T, atol=1e-11)


def noisy(seed, level=0.05, samples=300, dt=0.05, system=ONE):
    h, poles = markov(system, samples, dt)
    noise = np.random.default_rng(seed).standard_normal(h.shape)
    return ImpulseResponse(h + level * np.abs(h[1:]).max() * noise, dt), poles


@pytest.mark.parametrize("rows", [8, 30])
def test_fast_is_the_full_decomposition_with_noise(rows):
    ir, _ = noisy(0, system=CHAIN, level=0.01)
    window = {"order": 6, "rows": rows, "cols": 100, "lags": 4, "lag_step": 17, "first_lag": 9}
    fast, full = (era_dc(ir, method=method, **window) for method in ("fast", "svd"))
    np.testing.assert_allclose(rebuilt(fast, 100), rebuilt(full, 100), atol=1e-10)


def test_noise_biases_correlations_only_below_the_number_of_rows():
    rows, cols, std, copies = 4, 20, 0.1, 4000
    h, _ = markov(ONE, 60, 0.05)
    noise = std * np.random.default_rng(0).standard_normal((copies, *h.shape))

    def average_bias(first_lag):
        steps = _Shape(tuple(range(rows)), tuple(range(cols)), (0,), first_lag)
        found = jax.vmap(lambda g: _correlations(g, g, steps)[0])(jnp.asarray(h + noise))
        spread = np.asarray(found.std(axis=0)) / np.sqrt(copies)
        return np.asarray(found.mean(axis=0)) - _correlations(jnp.asarray(h), jnp.asarray(h), steps)[
            0
        ], spread

    bias, spread = average_bias(0)
    assert (np.abs(bias - cols * std**2 * np.eye(rows)) < 5 * spread).all()
    assert (np.diag(bias) > 20 * np.diag(spread)).all()
    bias, spread = average_bias(rows)
    assert (np.abs(bias) < 5 * spread).all()


def test_vmap_jit_and_gradient():
    ir, _ = noisy(0)
    direction = jnp.asarray(np.random.default_rng(1).standard_normal(ir.h.shape))

    def quantity(h):
        rz = era_dc(ImpulseResponse(h, 0.05), order=2, rows=70, cols=100, lags=4, lag_step=20, first_lag=3)
        return jnp.sum((rz.C @ rz.A @ rz.A @ rz.B) ** 2) + modal(rz).damping_ratios[0]

    quotient = (quantity(ir.h + 1e-6 * direction) - quantity(ir.h - 1e-6 * direction)) / 2e-6
    value, gradient = jax.jit(jax.value_and_grad(quantity))(ir.h)
    np.testing.assert_allclose(value, quantity(ir.h), rtol=1e-11)
    np.testing.assert_allclose(jnp.vdot(gradient, direction), quotient, rtol=1e-6)
    np.testing.assert_allclose(jax.vmap(quantity)(jnp.stack([ir.h, 2 * ir.h]))[0], value, rtol=1e-11)


def test_single_precision(single_precision):
    h, poles = markov(ONE, 400, 0.05)
    ir = ImpulseResponse(h.astype(np.float32), 0.05)
    rz = era_dc(ir, order=2, rows=20, cols=200, lags=5, lag_step=15)
    assert rz.A.dtype == jnp.float32
    assert pole_error(modal(rz).poles, poles) < 1e-4


def test_order_by_itself():
    h, _ = markov(ONE, 1000)
    assert era_dc(ImpulseResponse(h, 1e-3), rows=100, cols=400, lags=5, lag_step=40).A.shape == (2, 2)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rows": 100}, "up to sample"),
        ({"order": 30}, "order 30"),
        ({"first_lag": -1}, "first_lag"),
        ({"lags": 0}, "lags"),
        ({"method": "magic"}, "magic"),
    ],
)
def test_bad_windows(options, words):
    h, _ = markov(CHAIN, 100)
    window = {"order": 6, "rows": 3, "cols": 40, "lags": 3, **options}
    with pytest.raises(InputError, match=words):
        era_dc(ImpulseResponse(h, 1e-3), **window)
