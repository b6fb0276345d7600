"""The time-domain estimate: exact on noise-free sweeps, sane on noise, and right about the noise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from impulse_truth import (
    CHAIN,
    ONE,
    chirp,
    era,
    error,
    markov,
    noisy,
    one_at_a_time,
    physical,
    poles,
    respond,
    sorted_poles,
)
from scipy.linalg import toeplitz

from jaxsid.checks import InputError
from jaxsid.impulse.direct import Direct, bayesian, smooth_prior
from jaxsid.impulse.noise import noise_level
from jaxsid.impulse.protocol import stack
from jaxsid.impulse.toeplitz import series_inverse, simulate
from jaxsid.impulse.wavelet import Wavelet
from jaxsid.records import Record

DT = 1e-3
S = 4096
SWEEPS = {"1 DOF": (ONE, (0.02, 3, 100)), "3 DOF": (CHAIN, (0.1, 10, 10))}


@pytest.mark.parametrize("method", [Direct(), Wavelet("db4")], ids=["direct", "wavelet"])
@pytest.mark.parametrize("system", ["1 DOF", pytest.param("3 DOF", marks=pytest.mark.slow)])
def test_sweep_gives_poles_and_matrices(system, method):
    """The sweep starts at 0, so that the Toeplitz matrix is singular: the shift by one sample mends that."""
    matrices, sweep = SWEEPS[system]
    n = len(matrices[0])
    ir = method(one_at_a_time(matrices, DT, chirp(*sweep, DT, S)))
    assert "exact" in ir.method
    h = np.asarray(ir.h)[:-1]
    np.testing.assert_allclose(h, markov(matrices, DT, S)[:-1], atol=1e-10)
    lam, B, C = era(h, DT, 2 * n)
    np.testing.assert_allclose(sorted_poles(lam), poles(matrices), rtol=1e-6)
    for found, truth in zip(physical(lam, B, C, np.eye(n)), matrices, strict=True):
        assert np.linalg.norm(found - truth) < 1e-4 * np.linalg.norm(truth)


def test_series_inverse_is_the_inverse_of_the_triangular_toeplitz_matrix():
    rng = np.random.default_rng(0)
    u = 0.9 ** np.arange(60) * rng.standard_normal(60)
    u[0] = 3
    g = series_inverse(jnp.asarray(u)[:, None, None])[:, 0, 0]
    np.testing.assert_allclose(g, np.linalg.inv(toeplitz(u, np.zeros(60)))[:, 0], atol=1e-11)


def white(seed=0, samples=1024, dt=0.02, level=0.01, inputs=3):
    rng = np.random.default_rng(seed)
    u = np.zeros((samples, 3))
    u[:, :inputs] = rng.standard_normal((samples, inputs))
    return noisy(Record(u[:, :inputs], respond(CHAIN, dt, u), dt), level, rng)


@pytest.mark.slow
@pytest.mark.parametrize("dt", [1e-3, 0.02])
def test_white_excitation_with_noise(dt):
    record = white(samples=4096, inputs=1, dt=dt)
    ir = Direct()([record])
    truth = markov(CHAIN, dt, S)[:, :, :1]
    assert error(ir.h, truth) < 0.05
    np.testing.assert_allclose(ir.noise_std, 0.01 * np.asarray(record.y).std(axis=0), rtol=0.05)


@pytest.mark.slow
def test_several_inputs_at_once():
    """Three records with all inputs acting determine nine responses as one record does one."""
    records = [white(seed=i, samples=1500) for i in range(3)]
    ir = Direct()(records, samples=600)
    assert ir.h.shape == (600, 3, 3)
    assert error(ir.h, markov(CHAIN, 0.02, 600)) < 0.05


def test_a_given_ridge_is_the_dense_regularized_solution():
    """On the full Krylov space, for the prior's own matrix formed column by column."""
    record = white(samples=60, inputs=1)
    ensemble = stack([record])
    theta = jnp.array([[2.0, 10.0, 0.3]])
    noise = jnp.ones(3)
    h, _ = bayesian(ensemble, noise, smooth_prior, theta, taps=60, skip=0, steps=60, ridge=1e-4)
    u, y = np.asarray(record.u)[:, 0], np.asarray(record.y)
    rms = np.sqrt(np.mean(u**2))
    T = toeplitz(u / rms, np.zeros(60))
    L = np.array(jax.vmap(lambda z: smooth_prior(theta[0], z[:, None])[:, 0], out_axes=1)(jnp.eye(60)))
    probe = np.array(jax.random.normal(jax.random.key(0), (60, 1)))[:, 0]
    probe[0] = 0
    L[:, 0] *= np.linalg.norm(T @ L @ probe) / np.linalg.norm(T[:, 0])
    A = T @ L
    ridge = 1e-4 * np.linalg.norm(A, 2) ** 2
    dense = L @ np.linalg.solve(A.T @ A + ridge * np.eye(60), A.T @ y) / rms
    np.testing.assert_allclose(h[:, :, 0], dense, atol=1e-5 * np.abs(dense).max())


@pytest.mark.slow
def test_unequal_lengths_are_an_ensemble():
    records = [white(seed=i, samples=n, inputs=1) for i, n in enumerate((1024, 700, 900))]
    together = error(Direct()(records, samples=400).h, markov(CHAIN, 0.02, 400)[:, :, :1])
    alone = error(Direct()(records[1:2], samples=400).h, markov(CHAIN, 0.02, 400)[:, :, :1])
    assert together < min(alone, 0.05)


@pytest.mark.slow
def test_unknown_history():
    """A record cut out of a longer one is not at rest at its start; the taps must outlast the response."""
    record = white(samples=6000, inputs=1, level=1e-3, dt=0.05)
    cut = Record(record.u[2000:], record.y[2000:], record.dt)
    truth = markov(CHAIN, 0.05, 300)[:, :, :1]
    wrong = error(Direct()([cut], samples=300).h, truth)
    right = error(Direct(history="unknown")([cut], samples=300).h, truth)
    assert right < 0.05
    assert right < wrong / 2


def test_noise_level_of_a_noise_free_record_is_rounding():
    u = np.random.default_rng(0).standard_normal((500, 1))
    y = respond(ONE, 0.1, u)
    level = noise_level(jnp.asarray(u)[None], jnp.asarray(y)[None], jnp.ones((1, 500)))
    assert float(level[0]) < 1e-12 * y.std()


def test_simulate_is_the_convolution():
    u = np.random.default_rng(0).standard_normal((200, 3))
    h = markov(CHAIN, 0.05, 200)
    found = simulate(jnp.asarray(u)[None], jnp.asarray(h))[0]
    np.testing.assert_allclose(found, respond(CHAIN, 0.05, u), atol=1e-10)


def small(y, u):
    return Direct(steps=20)([Record(u, y, 0.02)], samples=50).h


@pytest.mark.slow
def test_jit_vmap_and_derivative():
    record = white(samples=200, inputs=1)
    u, y = record.u, record.y
    h = small(y, u)
    np.testing.assert_allclose(jax.jit(small)(y, u), h, atol=1e-8)
    many = jax.vmap(small, in_axes=(0, None))(jnp.stack([y, 2 * y]), u)
    np.testing.assert_allclose(many[0], h, atol=1e-8)

    def fixed(scale):
        method = Direct(solver="regularized", ridge=1e-3, steps=20)
        return jnp.sum(method([Record(u, y * scale + y[::-1] * scale**2, 0.02)], samples=50).h ** 2)

    step = 1e-5
    difference = (fixed(1 + step) - fixed(1 - step)) / (2 * step)
    assert float(jax.grad(fixed)(1.0)) == pytest.approx(float(difference), rel=1e-4)


@pytest.mark.slow
def test_single_precision(single_precision):
    record = white(samples=1024, inputs=1)
    ir = Direct()([Record(np.asarray(record.u, np.float32), np.asarray(record.y, np.float32), 0.02)])
    assert ir.h.dtype == jnp.float32
    assert error(ir.h[:500], markov(CHAIN, 0.02, 500)[:, :, :1]) < 0.1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"solver": "best"}, "best"),
        ({"solver": "exact"}, "as many records as inputs"),
        ({"history": "known"}, "known"),
        ({"taps": 999}, "taps must be"),
        ({"skip": 300}, "leaves nothing"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(InputError, match=message):
        Direct(**options)([white(samples=200)])
