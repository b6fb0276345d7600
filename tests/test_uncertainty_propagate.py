"""First-order covariance against Monte Carlo, against reverse differentiation of the factorization, and densely."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import jaxsid
from jaxsid.checks import InputError
from jaxsid.examples.systems import three_dof
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.hold import discretise, shift_to_laguerre
from jaxsid.mechanics.lumped import second_order
from jaxsid.mechanics.recursion import markov
from jaxsid.uncertainty.ensemble import ensemble
from jaxsid.uncertainty.noise import CorrelatedNoise, IndependentNoise, StationaryNoise
from jaxsid.uncertainty.propagate import propagate, propagate_response

DT, SAMPLES = 0.1, 120
MODEL = physical_displacement_velocity(second_order(three_dof()))
WINDOW = {"order": 6, "rows": 40, "cols": 40}


def exact(pole=0.0):
    sampled = discretise(MODEL, DT)
    shifted = shift_to_laguerre(sampled.A, sampled.B, sampled.C, sampled.D, pole)
    return jaxsid.ImpulseResponse(markov(*shifted, SAMPLES), DT, pole=pole)


def results(realization):
    so = jaxsid.cbsi(realization, sensors=("acceleration",) * 3, collocated=(0, 1, 2))
    md = jaxsid.modal(realization)
    return {"M": so.mass, "D": so.damping, "K": so.stiffness, "f": md.frequencies, "poles": md.poles}


def noisy(ir, size, key):
    return jaxsid.ImpulseResponse(ir.h + size * jax.random.normal(key, ir.h.shape), ir.dt, pole=ir.pole)


def ratios(spread, other):
    """Standard deviations over those of another source, where these are not rounding."""
    mine, theirs = (
        np.concatenate(
            [part for x in jax.tree.leaves(tree) for part in (np.real(x).ravel(), np.imag(x).ravel())]
        )
        for tree in (spread, other)
    )
    return mine[theirs > 0] / theirs[theirs > 0]


def scatter(values):
    return jax.tree.map(
        lambda x: x.real.std(axis=0) + 1j * x.imag.std(axis=0) if np.iscomplexobj(x) else x.std(axis=0),
        values,
    )


def monte_carlo(realize, count, size=0.01):
    ir = exact()
    size = size * float(ir.h.std())
    drawn = ensemble(lambda key: results(realize(noisy(ir, size, key))), jax.random.key(0), count)
    return scatter(drawn), IndependentNoise(jnp.full(ir.h.shape, size**2))


@pytest.mark.slow
def test_deviations_are_those_of_monte_carlo():
    """Deviations over 1600 samples are known to 1.8 %."""
    realize = lambda ir: jaxsid.era(ir, **WINDOW)  # noqa: E731
    drawn, noise = monte_carlo(realize, 1600)
    found = propagate(results, realize(exact()), noise, samples=SAMPLES)
    assert np.abs(ratios(found.deviation, drawn) - 1).max() < 0.09


@pytest.mark.slow
def test_deviations_are_those_of_many_samples():
    realize = lambda ir: jaxsid.era(ir, **WINDOW)  # noqa: E731
    drawn, noise = monte_carlo(realize, 10_000)
    found = propagate(results, realize(exact()), noise, samples=SAMPLES)
    assert np.abs(ratios(found.deviation, drawn) - 1).max() < 0.05


@pytest.mark.slow
def test_era_dc_too():
    realize = lambda ir: jaxsid.era_dc(ir, order=6, rows=20, cols=40, lags=10, first_lag=1)  # noqa: E731
    drawn, noise = monte_carlo(realize, 1600)
    found = propagate_response(lambda ir: results(realize(ir)), exact(), noise)
    assert np.abs(ratios(found.deviation, drawn) - 1).max() < 0.09


@pytest.mark.parametrize(
    "window",
    [
        WINDOW,
        pytest.param({"order": 6, "rows": 30, "cols": 25, "stride": 2}, marks=pytest.mark.slow),
        pytest.param(
            {"order": 6, "row_steps": (0, 1, 3, 4, 7, 20, 33), "column_steps": tuple(range(50))},
            marks=pytest.mark.slow,
        ),
        pytest.param(
            {"order": 6, "row_steps": tuple(range(40)), "column_steps": (0, 2, 5, 9, 30)},
            marks=pytest.mark.slow,
        ),
    ],
)
@pytest.mark.parametrize("pole", [pytest.param(0.0, marks=pytest.mark.slow), 0.3])
def test_the_closed_form_is_the_derivative_through_the_factorization(window, pole):
    ir = exact(pole)
    noise = IndependentNoise(jnp.asarray(np.random.default_rng(0).uniform(0.5, 2.0, ir.h.shape)) * 1e-6)
    closed = propagate(results, jaxsid.era(ir, **window), noise, samples=SAMPLES)
    through = propagate_response(lambda r: results(jaxsid.era(r, **window)), ir, noise)
    np.testing.assert_allclose(ratios(closed.deviation, through.deviation), 1, rtol=1e-6)
    size = np.sqrt(np.diag(through.covariance))
    np.testing.assert_allclose(
        closed.covariance / size / size[:, None], through.covariance / size / size[:, None], atol=1e-6
    )


def linear(ir):
    """Something with a simple derivative: weighted sums over the samples."""
    weights = np.random.default_rng(3).normal(size=(4, *ir.h.shape))
    return jnp.einsum("pkoc,koc->p", weights, ir.h), weights


def test_noise_covariances_densely():
    ir = exact()
    weights = linear(ir)[1].reshape(4, -1)
    rng = np.random.default_rng(1)
    variance = rng.uniform(size=ir.h.shape)
    factor = rng.normal(size=(7, *ir.h.shape))
    c = np.array([1.0, 0.6, -0.2])[:, None] * rng.uniform(1, 2, 3)
    column = np.zeros((SAMPLES, 3))
    column[:3] = c
    toeplitz = np.zeros((*ir.h.shape, *ir.h.shape))
    for o in range(3):
        for r in range(3):
            toeplitz[:, o, r, :, o, r] = scipy.linalg.toeplitz(column[:, o])
    per_output = np.broadcast_to(np.array([1.0, 2, 3])[:, None], ir.h.shape)
    for noise, dense in (
        (IndependentNoise(variance), np.diag(variance.ravel())),
        (IndependentNoise(np.array([1.0, 2, 3])), np.diag(per_output.ravel())),
        (CorrelatedNoise(jnp.asarray(factor)), factor.reshape(7, -1).T @ factor.reshape(7, -1)),
        (StationaryNoise(jnp.asarray(c)), toeplitz.reshape(ir.h.size, ir.h.size)),
    ):
        got = propagate_response(lambda r: linear(r)[0], ir, noise).covariance
        np.testing.assert_allclose(got, weights @ dense @ weights.T, rtol=1e-9, atol=1e-9)


def test_under_jit_and_vmap_it_gives_the_same():
    ir = exact()
    keys = jax.random.split(jax.random.key(2), 3)
    noise = IndependentNoise(jnp.full(3, 1e-6))

    def spread(key):
        realization = jaxsid.era(noisy(ir, 1e-3, key), **WINDOW)
        return propagate(results, realization, noise, samples=SAMPLES).deviation

    together = jax.jit(jax.vmap(spread))(keys)
    for i, key in enumerate(keys):
        alone = spread(key)
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-6, atol=1e-12)


def test_refuses():
    ir = exact()
    noise = IndependentNoise(jnp.ones(3))
    realization = jaxsid.era(ir, **WINDOW)
    bare = jaxsid.Realization(realization.A, realization.B, realization.C, realization.D, DT)
    with pytest.raises(InputError, match="factors"):
        propagate(results, bare, noise, samples=SAMPLES)
    with pytest.raises(InputError, match="samples"):
        propagate(results, realization, noise, samples=60)
    with pytest.raises(InputError, match="shape"):
        IndependentNoise(jnp.ones((2, 2)))
