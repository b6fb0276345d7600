"""Residuals of measurements against scipy's sampled systems, their slopes against automatic differentiation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from band_limited import THREE, chain, state_space
from chains import DT, chain_model, exact_response
from scipy import signal

from jaxsid.impulse.spectra import FrequencyResponse
from jaxsid.mechanics.lumped import second_order
from jaxsid.physical.elements import element_matrices
from jaxsid.physical.measured import Weights, frequency_term, response_term, response_weights
from jaxsid.uncertainty.noise import StationaryNoise

KINDS = "dva"
MODEL = chain_model(THREE, driven=(0, 2))
SENSED = second_order(MODEL)
UNKNOWNS = element_matrices(MODEL)
THETA = UNKNOWNS.of_values(jnp.asarray(UNKNOWNS.nominal)) * jnp.linspace(0.8, 1.2, 9)
ONES = Weights(jnp.ones((60, 3, 2)), None)


def evaluated(term):
    slopes = tuple(jnp.moveaxis(x, -1, 0) for x in jax.jacfwd(UNKNOWNS.matrices)(THETA))
    return term.evaluate(UNKNOWNS.matrices(THETA), slopes)


def differentiated(term):
    nothing = tuple(jnp.zeros((0, 3, 3)) for _ in range(3))
    return jax.jit(jax.jacfwd(lambda t: term.evaluate(UNKNOWNS.matrices(t), nothing)[0]))(THETA)


def close(found, wanted, rtol=1e-9):
    np.testing.assert_allclose(found, wanted, rtol=rtol, atol=rtol * float(np.abs(wanted).max()))


def system_of(theta):
    values = np.asarray(UNKNOWNS.values(theta))
    return chain(values[:3], values[6:], values[3:6], driven=(0, 2))


@pytest.mark.parametrize("hold", ["zero", "first"])
def test_an_impulse_response_and_its_slopes(hold):
    ir = exact_response(MODEL, 60, hold=hold)
    term = response_term(ir, SENSED, ONES)
    slopes = tuple(jnp.moveaxis(x, -1, 0) for x in jax.jacfwd(UNKNOWNS.matrices)(THETA))
    left = term.left(UNKNOWNS.matrices(THETA), slopes)
    wide = {"zero": "zoh", "first": "foh"}[hold]
    A, B, C, D, _ = signal.cont2discrete(state_space(system_of(THETA)), DT, method=wide)
    h = np.stack([D, *(C @ np.linalg.matrix_power(A, k) @ B for k in range(59))])
    close(left[0], h - np.asarray(ir.h))
    r, j = evaluated(term)
    close(r @ r, (left[0] ** 2).sum())
    close(j.T @ r, jnp.einsum("psoi,soi->p", left[1:], left[0]), 1e-8)
    close(j, differentiated(term), 1e-8)


@pytest.mark.parametrize("hold", ["zero", "first", None])
def test_a_frequency_response_and_its_slopes(hold):
    f = np.linspace(0.5, 40.0, 30)
    H = np.random.default_rng(0).standard_normal((30, 3, 2, 2)) @ [1, 1j]
    half, ones = np.full(H.shape, 0.5), np.ones((30, 3))
    seen = FrequencyResponse(*(jnp.asarray(x) for x in (f, H, half, 0.5 * ones, ones)), 8)
    term = frequency_term(
        seen, SENSED, None if hold is None else DT, ("first" if hold == "first" else "zero",) * 2
    )
    r, j = evaluated(term)
    if hold is None:
        A, B, C, D = state_space(system_of(THETA))
        points = 2j * np.pi * f
    else:
        A, B, C, D, _ = signal.cont2discrete(
            state_space(system_of(THETA)), DT, method={"zero": "zoh", "first": "foh"}[hold]
        )
        points = np.exp(2j * np.pi * f * DT)
    wanted = C @ np.linalg.solve(points[:, None, None] * np.eye(6) - A, B[None]) + D - H
    deviation = np.abs(H) / np.sqrt(8)  # (1 - g) / g is one at g = 1/2
    both = (wanted * np.sqrt(2) / deviation).ravel()
    close(r, np.concatenate([both.real, both.imag]), 1e-8)
    close(j, differentiated(term), 1e-8)


def test_coloured_noise_is_made_white():
    ir = exact_response(MODEL, 60)
    autocovariance = 0.3 * 0.8 ** np.arange(60)[:, None] * np.array([1.0, 4.0, 9.0])
    weights = response_weights(ir, StationaryNoise(jnp.asarray(autocovariance)))
    r, _ = evaluated(response_term(ir, SENSED, weights))
    nothing = tuple(jnp.zeros((0, 3, 3)) for _ in range(3))
    left = np.asarray(response_term(ir, SENSED, ONES).left(UNKNOWNS.matrices(THETA), nothing)[0])
    lag = np.abs(np.arange(60)[:, None] - np.arange(60))
    squares = sum(
        left[:, o, i] @ np.linalg.solve(autocovariance[:, o][lag], left[:, o, i])
        for o in range(3)
        for i in range(2)
    )
    close(r @ r, squares, 1e-6)


@pytest.mark.parametrize("samples", [60, 59, 2])
def test_the_sums_of_a_response_are_those_of_its_rows(samples):
    ir = exact_response(MODEL, samples)
    rng = np.random.default_rng(1)
    term = response_term(ir, SENSED, Weights(jnp.asarray(rng.uniform(0, 2, ir.h.shape)), None))
    r, j = evaluated(term)
    half, product, gradient = term.sums(UNKNOWNS.matrices(THETA), UNKNOWNS.slopes)
    close(half, 0.5 * r @ r)
    close(product, j.T @ j)
    close(gradient, j.T @ r, 1e-8)
