"""The refinement of poles: exact without noise, near the bound with it, never beyond what is possible."""

import jax.numpy as jnp
import numpy as np
import pytest
from band_limited import DT, band_noise, chain, poles, respond

from jaxsid.impulse.lines import record_lines
from jaxsid.realization.polish import _possible, polish
from jaxsid.records import Record

SYSTEM = chain([1.2, 0.9], [3000, 2500], [1.5, 1.2])
FAST = chain([1.2, 0.9], [3000, 2500], [1.5, 200.0])


def lines_of(system, noise, seed=0):
    rng = np.random.default_rng(seed)
    u = band_noise(rng, 8000, 1)
    y = respond(system, u)
    return record_lines(
        [Record(u, y + noise * y.std(axis=0) * rng.standard_normal(y.shape), DT)], band=(0.5, 80.0)
    )


def start(system, off):
    """Poles that are wrong by the factor off."""
    return np.exp(DT * poles(system) * off)


def found_poles(polished):
    return np.log(np.linalg.eigvals(np.asarray(polished.realization.A)).astype(complex)) / DT


@pytest.mark.parametrize("system", [SYSTEM, FAST])
def test_poles_without_noise_are_exact_from_a_wrong_start(system):
    own = found_poles(polish(start(system, 1.02), lines_of(system, 0.0)))
    for p in poles(system):
        assert np.abs(own - p).min() < 1e-6 * abs(p)


def test_noise_spectrum_and_residual_are_those_of_the_record():
    lines = lines_of(SYSTEM, 0.05)
    polished = polish(start(SYSTEM, 1.01), lines)
    used = np.asarray(lines.weight) > 0
    noise = np.asarray(polished.noise)
    # white noise of standard deviation s has lines of standard deviation s in this scaling
    clean = respond(SYSTEM, band_noise(np.random.default_rng(0), 8000, 1))
    for i in range(2):
        level = 0.05 * clean[:, i].std()
        assert abs(np.sqrt((noise[used[:, i], i] ** 2).mean()) / level - 1) < 0.1
    assert np.all(np.asarray(polished.residual)[~used] == 0)


def test_pole_deviations_are_those_of_the_errors():
    exact = polish(start(SYSTEM, 1.0), lines_of(SYSTEM, 0.0)).denominators
    pulls = []
    for seed in range(12):
        polished = polish(start(SYSTEM, 1.0), lines_of(SYSTEM, 0.05, seed))
        pulls.append((polished.denominators - exact) / np.sqrt(np.diag(polished.pole_covariance)))
    assert 0.7 < np.sqrt(np.mean(np.square(pulls))) < 1.4


@pytest.mark.parametrize("seed", range(4))
def test_a_pole_beyond_the_band_stays_possible_in_noise(seed):
    own = np.linalg.eigvals(np.asarray(polish(start(FAST, 1.3), lines_of(FAST, 0.2, seed)).realization.A))
    assert np.abs(own).max() < 1.001
    assert np.all((np.abs(own.imag) > 1e-9) | (own.real > 0))


def test_what_is_possible():
    limits = jnp.asarray([-0.8, 1.001])
    pair = lambda p: [-2 * p.real, abs(p) ** 2]  # noqa: E731
    two = lambda a, b: [-(a + b), a * b]  # noqa: E731
    for theta, expected in (
        (pair(0.6 + 0.7j), True),
        (pair(0.8 + 0.7j), False),
        (pair(-0.9 + 0.1j), True),
        (two(0.9, -0.7), True),
        (two(0.9, -0.85), False),
        (two(-0.9, -0.95), False),
        (two(0.5, 1.2), False),
        ([*two(0.5, 0.2), -0.9], True),
        ([*two(0.5, 0.2), -1.2], False),
        ([*two(0.5, 0.2), 0.9], False),
    ):
        assert bool(_possible(jnp.array(theta), limits)) is expected, theta
    assert bool(_possible(jnp.array(two(0.5, 1.2)), jnp.asarray([-0.8, jnp.inf])))
