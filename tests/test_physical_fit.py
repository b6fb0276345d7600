"""The fit of M, D, K to lines: exact without noise, positive where asked, its parameterizations invertible."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from band_limited import DT, band_noise, chain, error, respond, state_space
from scipy import signal

from jaxsid.impulse.lines import record_lines
from jaxsid.physical.inband_fit import _lines_and_slopes, fit_matrices, fit_target
from jaxsid.physical.parameterization import PositiveMatrices, SymmetricMatrices, entry_sizes
from jaxsid.records import ContinuousModel, Realization, Record, SecondOrderModel

SYSTEM = chain([1.2, 0.9], [3000, 2500], [1.5, 1.2])
TRUTH = tuple(np.asarray(x) for x in SYSTEM[:3])
EYES = (np.eye(2),) * 3
SENSED = SecondOrderModel(
    *map(jnp.asarray, TRUTH),
    jnp.asarray(SYSTEM.force),
    jnp.zeros((2, 2)),
    jnp.zeros((2, 2)),
    jnp.eye(2),
    None,
)
KINDS = pytest.mark.parametrize("kind", [SymmetricMatrices, PositiveMatrices])


def parameters(kind, complements=EYES):
    return kind(entry_sizes(TRUTH, complements, 50.0), complements)


def target(noise, seed=0):
    rng = np.random.default_rng(seed)
    u = band_noise(rng, 8000, 1)
    y = respond(SYSTEM, u, state=np.array([0.01, 0.0, 1.0, 0.0]))
    size = noise * y.std(axis=0)
    lines = record_lines([Record(u, y + size * rng.standard_normal(y.shape), DT)])
    A, B, C, D, _ = signal.cont2discrete(state_space(SYSTEM), DT)
    level = jnp.broadcast_to(jnp.asarray(np.maximum(size, 1e-3 * y.std(axis=0))), lines.y.shape)
    return fit_target(
        lines, level, Realization(A, B, C, D, DT), ContinuousModel(*map(jnp.asarray, state_space(SYSTEM)))
    )


@KINDS
def test_matrices_without_noise_are_exact_from_a_wrong_start(kind):
    wrong = tuple(jnp.asarray(x * f) for x, f in zip(TRUTH, (1.01, 0.7, 0.995), strict=True))
    fit = fit_matrices(target(0.0), parameters(kind), wrong, SENSED)
    for found, truth in zip(fit.matrices, TRUTH, strict=True):
        assert error(found, truth)[0] < 1e-6
    assert float(fit.misfit) < 1e-6


def test_misfit_is_one_and_deviations_are_those_of_the_errors():
    kind, pulls, misfits = parameters(SymmetricMatrices), [], []
    start = tuple(map(jnp.asarray, TRUTH))
    for seed in range(25):
        fit = fit_matrices(target(0.05, seed), kind, start, SENSED)
        misfits.append(float(fit.misfit))
        for x, t, d in zip(fit.matrices, TRUTH, fit.deviation, strict=True):
            pulls.append(np.asarray((x - t) / d)[np.triu_indices(2)])
    assert 0.8 < np.sqrt(np.mean(np.square(pulls))) < 1.25
    assert abs(np.mean(misfits) - 1) < 0.03


@KINDS
def test_unknowns_and_matrices_are_inverse(kind):
    both = parameters(kind)
    theta = both.unknowns(tuple(map(jnp.asarray, TRUTH)))
    for found, truth in zip(both.matrices(theta), TRUTH, strict=True):
        np.testing.assert_allclose(found, truth, rtol=1e-9, atol=1e-9)


@KINDS
def test_patterns_that_nothing_resists_stay_so(kind):
    held = np.array([[1.0], [-1.0]]) / np.sqrt(2)
    both = parameters(kind, (np.eye(2), held, held))
    theta = jnp.asarray(np.random.default_rng(1).standard_normal(5))
    mass, damping, stiffness = both.matrices(theta)
    for matrix in (damping, stiffness):
        np.testing.assert_allclose(matrix @ np.ones(2), 0.0, atol=1e-9 * float(jnp.abs(matrix).max()))
    np.testing.assert_allclose(mass, mass.T)


def test_positive_matrices_are_positive_whatever_the_unknowns():
    both = parameters(PositiveMatrices)
    for seed in range(20):
        theta = jnp.asarray(np.random.default_rng(seed).standard_normal(9))
        for matrix in both.matrices(theta):
            values = np.linalg.eigvalsh(matrix)
            assert values[0] >= -1e-12 * values[-1]


def test_slopes_are_those_of_automatic_differentiation():
    goal, both = target(0.01), parameters(SymmetricMatrices)
    theta = both.unknowns(tuple(map(jnp.asarray, TRUTH)))
    model = lambda t: _lines_and_slopes(goal, both.matrices(t), jax.jacfwd(both.matrices)(t), SENSED)  # noqa: E731
    slopes = jax.jit(model)(theta)[1]
    other = jax.jit(jax.jacfwd(lambda t: model(t)[0]))(theta)
    np.testing.assert_allclose(
        slopes, jnp.moveaxis(other, 2, 1), rtol=1e-8, atol=1e-9 * float(jnp.abs(other).max())
    )
