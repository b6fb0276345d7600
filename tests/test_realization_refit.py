"""Refitted B and D: exact on exact records, indifferent to coordinates, absent sensors and scale."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsid.checks import InputError
from jaxsid.impulse.lines import record_lines
from jaxsid.mechanics.simulate import markov_parameters, simulate_linear
from jaxsid.realization.refit import refit_inputs
from jaxsid.records import Realization, Record

RNG = np.random.default_rng(3)
A = np.array([[0.8, 0.5, 0, 0], [-0.5, 0.8, 0, 0], [0, 0, 0.2, 0.9], [0, 0, -0.9, 0.2]])
MODEL = Realization(A, RNG.normal(size=(4, 2)), RNG.normal(size=(3, 4)), RNG.normal(size=(3, 2)), 0.01)


def record(noise=0.0, seed=0, outputs=("a", "b", "c")):
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(600, 2))
    y = np.asarray(simulate_linear(MODEL, u, initial_state=rng.normal(size=4)))
    y = y + noise * rng.normal(size=y.shape)
    columns = ["abc".index(name) for name in outputs]
    return Record(u, y[:, columns], 0.01, outputs=outputs)


def spoiled(model=MODEL):
    return eqx.tree_at(lambda m: (m.B, m.D), model, (model.B * 0.5 + 1, model.D - 2))


@pytest.mark.parametrize("band", [None, (4.0, 30.0)])
def test_exact_records_give_inputs_back_whatever_the_initial_state(band):
    found = refit_inputs(spoiled(), record_lines([record(seed=1), record(seed=2)], band=band))
    np.testing.assert_allclose(found.B, MODEL.B, atol=1e-10)
    np.testing.assert_allclose(found.D, MODEL.D, atol=1e-10)
    assert found.observability is None


def test_outputs_spread_over_records():
    parts = [record(seed=1, outputs=("a", "b")), record(seed=2, outputs=("a", "c"))]
    found = refit_inputs(spoiled(), record_lines(parts))
    np.testing.assert_allclose(found.B, MODEL.B, atol=1e-10)
    np.testing.assert_allclose(found.D, MODEL.D, atol=1e-10)


def test_coordinates_of_the_state_do_not_matter():
    T = RNG.normal(size=(4, 4))
    turned = eqx.tree_at(
        lambda m: (m.A, m.C), spoiled(), (jnp.asarray(T @ A @ np.linalg.inv(T)), MODEL.C @ np.linalg.inv(T))
    )
    lines = record_lines([record(noise=0.1)])
    plain, other = refit_inputs(spoiled(), lines), refit_inputs(turned, lines)
    expected = markov_parameters(plain, samples=30)
    np.testing.assert_allclose(markov_parameters(other, samples=30), expected, atol=1e-9)


def test_noise_is_met_by_least_squares():
    """The misfit, computed apart with the best transient, is least at what was found."""
    measured = record(noise=0.1)
    found = refit_inputs(MODEL, record_lines([measured]))
    error = np.abs(
        np.asarray(markov_parameters(found, samples=50) - markov_parameters(MODEL, samples=50))
    ).max()
    assert 1e-5 < error < 0.1

    def misfit(model):
        lines = record_lines([measured])
        z, U, Y = (np.asarray(x) for x in (lines.z, lines.u, lines.y))
        used = np.asarray(lines.weight)[:, 0] > 0
        eye = np.eye(4)
        states = np.linalg.solve(z[used, None, None] * eye - A, np.eye(4)[None])
        B, C, D = (np.asarray(x) for x in (model.B, model.C, model.D))
        left = Y[used] - np.einsum("mn,knp,pr,kr->km", C, states, B, U[used]) - U[used] @ D.T
        free = np.einsum("mn,knp,k->kmp", C, states, z[used])
        size = np.linalg.norm(Y[used], axis=0)[None, :]
        stack = lambda x: np.concatenate([x.real, x.imag])  # noqa: E731
        table, target = stack((free / size[..., None]).reshape(-1, 4)), stack((left / size).ravel())
        return np.linalg.norm(target - table @ np.linalg.lstsq(table, target, rcond=None)[0])

    best = misfit(found)
    for scale in (1e-3, -1e-3):
        moved = eqx.tree_at(lambda m: (m.B, m.D), found, (found.B + scale, found.D - scale))
        assert misfit(moved) > best


def test_wrong_sizes_are_refused():
    with pytest.raises(InputError, match="3 outputs and 2 inputs, the lines have 2 and 2"):
        refit_inputs(MODEL, record_lines([record(outputs=("a", "b"))]))
