"""Monte Carlo over noise on an impulse response: a linear estimator in closed form, ERA by first order, bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsid
from jaxsid.checks import InputError
from jaxsid.examples.systems import three_dof
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.simulate import impulse_response_of

IR = impulse_response_of(physical_displacement_velocity(jaxsid.second_order(three_dof())), 0.1, samples=100)
KEY = jax.random.key(5)


def test_a_linear_estimator_scatters_as_it_must():
    rng = np.random.default_rng(0)
    weights, noise = rng.standard_normal((100, 3, 3)), np.array([0.1, 0.2, 0.3])
    found = jaxsid.monte_carlo(
        lambda ir: (ir.h * weights).sum(), IR, noise_std=noise, num_samples=4000, key=KEY
    )
    expected = np.sqrt((weights**2 * noise[:, None] ** 2).sum())
    np.testing.assert_allclose(found.std, expected, rtol=4.5 / np.sqrt(2 * 4000))
    assert abs(found.mean - float((IR.h * weights).sum())) < 4.5 * expected / np.sqrt(4000)
    assert found.failed == 0


def test_poles_of_era_scatter_as_first_order_says():
    realize = lambda ir: jaxsid.era(ir, order=6, rows=40, cols=40)  # noqa: E731
    size = 0.005 * float(IR.h.std())
    found = jaxsid.monte_carlo(
        lambda ir: jaxsid.modal(realize(ir)).poles, IR, noise_std=size, num_samples=600, key=KEY
    )
    noise = jaxsid.IndependentNoise(jnp.full(IR.h.shape, size**2))
    closed = jaxsid.propagate(lambda rz: jaxsid.modal(rz).poles, realize(IR), noise, samples=100)
    for part in (np.real, np.imag):
        np.testing.assert_allclose(part(found.std), part(closed.deviation), rtol=0.13)


def test_realizations_do_not_depend_on_how_many_there_are():
    few, many = (
        jaxsid.monte_carlo(lambda ir: ir.h[3], IR, noise_std=0.1, num_samples=n, key=KEY, chunk=16)
        for n in (5, 40)
    )
    np.testing.assert_array_equal(few.samples, many.samples[:5])


def test_what_is_not_finite_is_counted_and_left_out():
    found = jaxsid.monte_carlo(lambda ir: jnp.sqrt(ir.h[0, 0, 1]), IR, noise_std=1.0, num_samples=50, key=KEY)
    finite = np.isfinite(found.samples)
    assert 0 < found.failed == (~finite).sum()
    np.testing.assert_allclose(found.mean, found.samples[finite].mean())


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"noise_std": -0.1, "num_samples": 5}, "negative"),
        ({"noise_std": np.ones(2), "num_samples": 5}, "3 outputs"),
        ({"noise_std": np.nan, "num_samples": 5}, "noise_std"),
        ({"noise_std": 0.1, "num_samples": 1}, "at least 2"),
    ],
)
def test_refuses(options, words):
    with pytest.raises(InputError, match=words):
        jaxsid.monte_carlo(lambda ir: ir.h, IR, key=KEY, **options)
