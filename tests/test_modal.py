"""Modal form: exact poles and transfer function for every hold, order, pairing, real form, indicators."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_markov import CHAIN, OVERDAMPED, impulse_samples, markov, pole_error, state_space

from jaxsid.checks import InputError
from jaxsid.mechanics.hold import continuous, discretise
from jaxsid.modes import modal, modal_realization
from jaxsid.realization.era import era
from jaxsid.realization.indicators import phase_collinearity
from jaxsid.realization.stabilization import stabilization
from jaxsid.records import ContinuousModel, ImpulseResponse, Realization

POINTS = 1j * np.array([0.3, 1.4, 2.4, 5.0]) + 0.1


def transfer(model, s):
    A, B, C, D = (np.asarray(x) for x in (model.A, model.B, model.C, model.D))
    return C @ np.linalg.solve(s * np.eye(len(A)) - A, B) + D


def modal_transfer(md, s):
    return (md.shapes / (s - md.poles)) @ md.participation + md.feedthrough


def model_of(system, kind="acceleration"):
    return ContinuousModel(*(jnp.asarray(x) for x in state_space(system, kind)))


def assert_same_transfer(md, model, atol=1e-10):
    for s in POINTS:
        np.testing.assert_allclose(modal_transfer(md, s), transfer(model, s), atol=atol)


@pytest.mark.parametrize("hold", ["zero", "first", "band"])
@pytest.mark.parametrize("system", [CHAIN, OVERDAMPED])
def test_undoes_the_hold(system, hold):
    model = model_of(system)
    md = modal(discretise(model, 0.01, hold=hold))
    assert pole_error(md.poles, np.linalg.eigvals(model.A)) < 1e-12
    assert_same_transfer(md, model)


def test_first_hold_from_samples_alone():
    h = impulse_samples(state_space(CHAIN), 0.02, 400, "first")
    md = modal(era(ImpulseResponse(h, 0.02, hold="first"), order=6, rows=150, cols=150))
    assert_same_transfer(md, model_of(CHAIN))


def test_holds_may_differ_between_inputs():
    model = model_of(CHAIN)
    md = modal(discretise(model, 0.01, hold=("zero", "first", "zero")))
    assert_same_transfer(md, model)
    with pytest.raises(InputError, match="band"):
        modal(Realization(np.eye(2), np.eye(2), np.eye(2), np.eye(2), 1.0, hold=("zero", "band")))


def test_agrees_with_the_continuous_model():
    h, _ = markov(CHAIN, 400, 0.02)
    rz = era(ImpulseResponse(h, 0.02), order=6, rows=150, cols=150)
    direct, through = modal(rz), modal(continuous(rz))
    np.testing.assert_allclose(direct.poles, through.poles, rtol=1e-11)
    np.testing.assert_allclose(direct.shapes, through.shapes, atol=1e-9)
    np.testing.assert_allclose(direct.participation, through.participation, atol=1e-9)


def test_order_pairs_and_normalization():
    md = modal(model_of(CHAIN))
    poles = np.asarray(md.poles)
    assert (np.diff(np.asarray(md.frequencies)) > -1e-12).all()
    np.testing.assert_array_equal(poles[1::2], poles[::2].conj())
    assert (poles[::2].imag > 0).all()
    np.testing.assert_allclose(np.linalg.norm(md.shapes, axis=0), 1)
    largest = np.take_along_axis(np.asarray(md.shapes), np.abs(md.shapes).argmax(0)[None], 0)[0]
    np.testing.assert_allclose(largest.imag, 0, atol=1e-15)
    assert (largest.real > 0).all()


def test_similarity_changes_nothing():
    model = model_of(CHAIN)
    T = np.random.default_rng(0).standard_normal((6, 6))
    other = ContinuousModel(
        jnp.linalg.solve(T, model.A @ T), jnp.linalg.solve(T, model.B), model.C @ T, model.D
    )
    one, two = modal(model), modal(other)
    np.testing.assert_allclose(two.poles, one.poles, rtol=1e-11)
    np.testing.assert_allclose(two.shapes, one.shapes, atol=1e-10)
    np.testing.assert_allclose(two.participation, one.participation, atol=1e-10)


def rigid_velocity_model():
    """Two inertias on a spring and dampers to ground: poles 0 and others, seen by rates, three states."""
    K, Dm = np.array([[2.0, -2], [-2, 2]]), np.array([[0.3, -0.1], [-0.1, 0.1]])
    A = np.block([[np.array([[0.0, 1, -1]])], [-K[:, :1], -Dm]])
    return ContinuousModel(*(jnp.asarray(x) for x in (A, np.eye(3)[:, 1:], np.eye(3)[1:], np.zeros((2, 2)))))


@pytest.mark.parametrize("hold", ["zero", "first", "band"])
def test_zero_pole(hold):
    model = ContinuousModel(
        *(jnp.asarray(x) for x in ([[0.0, 0], [0, -2]], [[1.0], [1]], [[1.0, 1]], [[0.5]]))
    )
    md = modal(discretise(model, 0.1, hold=hold))
    np.testing.assert_allclose(md.poles, [0, -2], atol=1e-14)
    assert_same_transfer(md, model)
    exact = modal(model)
    np.testing.assert_array_equal(exact.damping_ratios, [1, 1])
    assert np.isfinite(modal(rigid_velocity_model()).damping_ratios).all()


@pytest.mark.parametrize("system", [CHAIN, OVERDAMPED])
def test_real_form(system):
    model = model_of(system)
    real = modal_realization(modal(model))
    for s in POINTS:
        np.testing.assert_allclose(transfer(real, s), transfer(model, s), atol=1e-12)
    rebuilt = jax.jit(modal_realization)(modal(model_of(CHAIN)))
    np.testing.assert_allclose(transfer(rebuilt, 1.5j), transfer(model_of(CHAIN), 1.5j), atol=1e-12)


def test_mixed_real_and_complex_poles():
    real = modal_realization(modal(rigid_velocity_model()))
    for s in POINTS:
        np.testing.assert_allclose(transfer(real, s), transfer(rigid_velocity_model(), s), atol=1e-12)


def test_a_pole_without_its_conjugate_is_refused():
    md = modal(model_of(CHAIN))
    lonely = jax.tree.map(lambda x: x, md)
    object.__setattr__(lonely, "poles", md.poles.at[1].set(-1 + 2j))
    with pytest.raises(InputError, match="conjugate"):
        modal_realization(lonely)


def test_derivative_is_the_difference_quotient():
    model = model_of(CHAIN)
    direction = jnp.asarray(np.random.default_rng(0).standard_normal((6, 6)))

    def quantity(A):
        md = modal(ContinuousModel(A, model.B, model.C, model.D))
        return (
            jnp.sum(md.damping_ratios)
            + jnp.sum(jnp.abs(modal_transfer(md, 1.3j)))
            + jnp.sum(jnp.abs(md.shapes))
        )

    quotient = (quantity(model.A + 1e-6 * direction) - quantity(model.A - 1e-6 * direction)) / 2e-6
    np.testing.assert_allclose(jnp.vdot(jax.grad(quantity)(model.A), direction), quotient, rtol=1e-6)


def test_phase_collinearity():
    line = np.exp(0.7j) * np.array([1.0, -2, 0.5])
    circle = np.exp(2j * np.pi * np.arange(3) / 3)
    x = np.random.default_rng(0).standard_normal((3, 2)) @ [1, 1j]
    l1, l2 = np.linalg.eigvalsh(np.array([x.real, x.imag]) @ np.array([x.real, x.imag]).T)
    expected = (2 * l2 / (l1 + l2) - 1) ** 2
    found = phase_collinearity(jnp.asarray(np.stack([line, circle, x], axis=1)))
    np.testing.assert_allclose(found, [1, 0, expected], atol=1e-14)


def test_noise_modes_are_told_from_true_ones():
    h, poles = markov(CHAIN, 400, 0.02)
    h = h + 1e-3 * np.random.default_rng(0).standard_normal(h.shape) * np.abs(h[1:]).max()
    md = modal(era(ImpulseResponse(h, 0.02), order=12, rows=150, cols=150))
    true = np.array([np.abs(poles - p).min() < 0.05 * abs(p) for p in np.asarray(md.poles)])
    assert true.sum() == 6
    assert md.indicators is not None
    for indicator in (md.indicators.mac, md.indicators.emac, md.indicators.cmi):
        assert np.asarray(indicator)[true].min() > np.asarray(indicator)[~true].max()
    np.testing.assert_allclose(md.indicators.cmi, md.indicators.emac * md.indicators.mpc)


def test_mode_singular_value_by_its_sum():
    h, _ = markov(CHAIN, 400, 0.02)
    rz = era(ImpulseResponse(h, 0.02), order=6, rows=150, cols=150)
    lam, psi = np.linalg.eig(rz.A)
    c, b = np.linalg.norm(rz.C @ psi, axis=0), np.linalg.norm(np.linalg.solve(psi, rz.B), axis=1)
    sums = (np.abs(lam) ** np.arange(299)[:, None]).sum(0)
    indicators = modal(rz).indicators
    assert indicators is not None
    np.testing.assert_allclose(np.sort(indicators.msv), np.sort(np.sqrt(c * sums * b)), rtol=1e-9)


def test_stabilization():
    h, poles = markov(CHAIN, 400, 0.02)
    h = h + 1e-3 * np.random.default_rng(0).standard_normal(h.shape) * np.abs(h[1:]).max()
    orders = (4, 6, 8, 10, 12)
    found = stabilization(ImpulseResponse(h, 0.02), orders, rows=150, cols=150)
    for p in poles[poles.imag > 0]:
        near = np.abs(found.pole - p) < 0.01 * abs(p)
        assert set(found.order[near & found.stable]) >= {8, 10, 12}
    assert not found.stable[found.order == 4].any()
    assert found.shape.shape == (len(found.order), 3)
    six = modal(era(ImpulseResponse(h, 0.02), order=6, rows=150, cols=150))
    np.testing.assert_allclose(found.pole[found.order == 6], six.poles[::2], rtol=1e-8)
    with pytest.raises(InputError, match="increase"):
        stabilization(ImpulseResponse(h, 0.02), (4, 2))
