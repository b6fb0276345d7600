"""The fit of M, D, K to lines: exact without noise, positive where asked, its parameterizations invertible."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from band_limited import DT, band_noise, chain, error, respond, state_space
from scipy import linalg, signal

from jaxsid.impulse.lines import record_lines
from jaxsid.physical.inband_fit import _motion, _symmetric, fit_matrices, fit_target, line_model
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
    goal = target(0.01)
    upper = jnp.concatenate([x[np.triu_indices(2)] for x in TRUTH])
    model = lambda x: line_model(goal, _symmetric(x, 2), SENSED)  # noqa: E731
    slopes = jax.jit(model)(upper)[1]
    other = jax.jit(jax.jacfwd(lambda x: model(x)[0]))(upper)
    np.testing.assert_allclose(
        slopes, jnp.moveaxis(other, 2, 1), rtol=1e-8, atol=1e-9 * float(jnp.abs(other).max())
    )


def test_transients_move_with_the_matrices_as_scipys_exponential_does():
    goal = target(0.01)
    F, slopes = jax.jit(lambda m: _motion(goal, m))(tuple(map(jnp.asarray, TRUTH)))
    A = lambda M, D, K: np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(M, np.hstack([K, D]))]])  # noqa: E731
    np.testing.assert_allclose(F[0], linalg.expm(A(*TRUTH) * DT), rtol=1e-12, atol=1e-12)
    entries = list(zip(*np.triu_indices(2), strict=True))
    for k, (kind, (i, j)) in enumerate((kind, at) for kind in range(3) for at in entries):
        size = 1e-6 * np.abs(TRUTH[kind]).max()
        change = np.zeros((2, 2))
        change[i, j] = change[j, i] = size
        moved = [
            linalg.expm(A(*(x + sign * change * (n == kind) for n, x in enumerate(TRUTH))) * DT)
            for sign in (1, -1)
        ]
        numeric = (moved[0] - moved[1]) / (2 * size)
        np.testing.assert_allclose(
            slopes[0, :, :, k], numeric, rtol=1e-5, atol=1e-7 * float(np.abs(numeric).max())
        )


def test_the_best_positive_matrices_are_found_on_the_edge_from_anywhere():
    """Data of a damping matrix with a negative eigenvalue: the best positive one is singular."""
    active = TRUTH[1] + np.array([[0.0, -0.7], [-0.7, 0.0]])
    assert np.linalg.eigvalsh(active)[0] < -0.05
    system = SYSTEM._replace(damping=active)
    rng = np.random.default_rng(5)
    u = band_noise(rng, 8000, 1)
    y = respond(system, u)
    size = 0.05 * y.std(axis=0)
    A, B, C, D, _ = signal.cont2discrete(state_space(system), DT)
    lines = record_lines([Record(u, y + size * rng.standard_normal(y.shape), DT)])
    goal = fit_target(
        lines,
        jnp.broadcast_to(jnp.asarray(size), lines.y.shape),
        Realization(A, B, C, D, DT),
        ContinuousModel(*map(jnp.asarray, state_space(system))),
    )
    free = fit_matrices(goal, parameters(SymmetricMatrices), tuple(map(jnp.asarray, TRUTH)), SENSED)
    assert np.linalg.eigvalsh(free.matrices[1])[0] < 0
    starts = (free.matrices, tuple(map(jnp.asarray, TRUTH)), tuple(jnp.asarray(1.1 * x) for x in TRUTH))
    fits = [fit_matrices(goal, parameters(PositiveMatrices), start, SENSED) for start in starts]
    misfits = [float(fit.misfit) for fit in fits]
    assert misfits[0] > float(free.misfit)
    np.testing.assert_allclose(misfits, misfits[0], rtol=1e-5)
    for fit in fits:
        values = np.linalg.eigvalsh(fit.matrices[1])
        assert abs(values[0]) < 1e-6 * values[1]
        for x, deviation in zip(fit.matrices, fit.deviation, strict=True):
            assert np.isfinite(deviation).all()
            assert (deviation < 0.2 * np.abs(x).max()).all()
