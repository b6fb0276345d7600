"""Experiments: exact without noise, noise of the right size and colour, one program for many cases, sane results."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsid.examples.truth import exact_record
from jaxsid.mechanics.lumped import Connection, Input, Sensor, lumped_model
from jaxsid.study.configuration import Case
from jaxsid.study.experiment import make_experiment
from jaxsid.study.noise import POLE, disturbed, whitened
from jaxsid.study.records import excitation
from jaxsid.study.system import BUILT_IN, make_system
from jaxsid.uncertainty.ensemble import ensemble

KEY = jax.random.key(11)
MODAL = ("mini_mast", "galileo")


def make(system, model=None, **values):
    return make_experiment(Case(0, {"system": system, **values}, model))


@eqx.filter_jit
def call(experiment, key=KEY):
    return experiment(key)


def close(experiment, tolerance):
    """Each quantity against the largest of its kind."""
    got = np.asarray(call(experiment))
    kinds = np.array([name.split("_")[0] for name in experiment.names])
    truth = np.asarray(experiment.truth)
    for kind in np.unique(kinds):
        size = np.abs(truth[kinds == kind]).max()
        np.testing.assert_allclose(got[kinds == kind], truth[kinds == kind], atol=tolerance * size)


# --- exact recovery


QUICK = (("rig", "era"),)
SLOW = [(s, r) for s in BUILT_IN for r in ("era", "era_dc") if s not in MODAL and (s, r) not in QUICK]


@pytest.mark.parametrize(
    ("system", "realization"), [*QUICK, *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOW)]
)
def test_without_noise_the_truth_comes_back(system, realization):
    # ERA/DC squares the singular values
    close(make(system, noise=0.0, realization=realization), 1e-4 if realization == "era_dc" else 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("system", MODAL)
def test_modal_structures_without_noise(system):
    experiment = make(system, noise=0.0)
    got = np.asarray(call(experiment))
    half = len(got) // 2  # the weak modes bend the strong ones a little
    np.testing.assert_allclose(got[:half], experiment.truth[:half], rtol=1e-4)
    np.testing.assert_allclose(got[half:], experiment.truth[half:], rtol=2e-2)


@pytest.mark.slow
def test_a_free_shaft_seen_by_displacements():
    model = lumped_model(
        ["a", "b"],
        [1.0, 2.0],
        [3.0],
        [0.1],
        connections=[Connection("shaft", ("a", "b"))],
        inputs=[Input("torque", "a")],
        sensors=[Sensor("angle_a", "a", "displacement"), Sensor("angle_b", "b", "displacement")],
    )
    for sensors, order in (("default", 4), ("velocity", 3), ("acceleration", 2)):
        experiment = make("shaft.toml", model, sensors=sensors, noise=0.0, samples=60)
        assert experiment.plan.order == order
        assert experiment.names[:2] == ("frequency_1", "damping_ratio_1")  # the free motion is no quantity
        close(experiment, 1e-5)


def test_names_units_and_order():
    experiment = make("rig")
    assert experiment.names[:4] == ("frequency_1", "damping_ratio_1", "pole_1", "mass_1_1")
    assert experiment.names[4:6] == ("mass_1_2", "mass_2_2")
    assert experiment.units[:4] == ("Hz", "", "1/s", "kg m^2")
    np.testing.assert_allclose(experiment.truth[2], -4.92978, rtol=1e-6)
    assert (
        len(experiment.names) == len(experiment.units) == len(experiment.truth) == len(experiment.bound) == 12
    )


def test_matrices_need_a_sensor_on_each_body_and_the_true_order():
    assert len(make("chain2").names) == 13
    assert len(make("chain2", sensors="sensor1").names) == 4
    assert len(make("chain2", order="true+2").names) == 4
    assert "mass_1_1" in make("chain2", sensors="sensor2, sensor1").names
    close(make("chain2", sensors="sensor2, sensor1", noise=0.0), 1e-6)


def test_each_true_pole_takes_the_nearest():
    experiment = make("chain2", noise=0.0, order="true+2", realization="era")
    close(experiment, 1e-6)  # two poles more, in the rounding
    broken = eqx.tree_at(lambda e: e.exact, experiment, jnp.full_like(experiment.exact, jnp.nan))
    assert np.isnan(np.asarray(call(broken))).all()


# --- records


def test_records_without_noise():
    close(make("chain2", data="record", noise=0.0, samples=60, record_samples=256), 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["direct", "wavelet"])
def test_regularized_estimates_are_nearly_right_without_noise(method):
    values = {"data": "record", "method": method, "noise": 0.0, "samples": 60, "record_samples": 256}
    experiment = make("chain2", **values)
    got = call(experiment)
    np.testing.assert_allclose(got[:2], experiment.truth[:2], rtol=3e-3)
    np.testing.assert_allclose(got[2:4], experiment.truth[2:4], rtol=0.2)


@pytest.mark.slow
def test_fourier_from_records_of_a_response_that_dies_out():
    experiment = make("railway_vehicle", data="record", method="fourier", noise=0.0, record_samples=4000)
    got = call(experiment)
    np.testing.assert_allclose(got[:4], experiment.truth[:4], rtol=2e-2)
    np.testing.assert_allclose(got[4:8], experiment.truth[4:8], rtol=0.1)


def test_records_are_those_of_another_integrator():
    experiment = make(
        "chain3", data="record", noise=0.0, record_samples=300, method="direct", excitation="chirp"
    )
    system = BUILT_IN["chain3"].build()
    u = np.zeros((300, 3))
    u[:, 1] = excitation("chirp", 300, 0)
    expected = exact_record(system, u, 0.25)
    np.testing.assert_allclose(experiment.exact[:, :, 1], expected.y, atol=1e-11)


def test_the_prepared_observer_is_the_method():
    from jaxsid.impulse.inband import InBand
    from jaxsid.study.records import one_after_another

    experiment = make("rig", data="record", method="inband", samples=80)
    y = disturbed(experiment.exact, experiment.deviation, KEY, "white")
    expected = InBand()(one_after_another(experiment.excitation, y, experiment.dt), 80)
    got = experiment.response(y)
    np.testing.assert_allclose(got.h, expected.h, rtol=1e-6, atol=1e-9 * np.abs(expected.h).max())
    np.testing.assert_allclose(got.pole, expected.pole)


@pytest.mark.parametrize("kind", ["multisine", "white", "chirp"])
def test_excitation(kind):
    u = excitation(kind, 501, 4)
    assert u.shape == (501,)
    np.testing.assert_allclose(np.mean(u**2), 1)
    np.testing.assert_array_equal(u, excitation(kind, 501, 4))
    assert (kind == "chirp") == np.array_equal(u, excitation(kind, 501, 5))
    power = np.abs(np.fft.rfft(u)) ** 2
    if kind == "multisine":
        np.testing.assert_allclose(power[1:], power[1])
        assert power[0] < 1e-20 * power[1]


# --- noise


@pytest.mark.parametrize("colour", ["white", "coloured", "quantization"])
def test_noise_has_its_size(colour):
    y = jnp.asarray(np.random.default_rng(0).standard_normal((40, 3, 2)))
    deviation = jnp.array([[0.1], [1.0], [0.0]])
    draws = np.asarray(jax.vmap(lambda k: disturbed(y, deviation, k, colour))(jax.random.split(KEY, 4000)))
    error = draws - np.asarray(y)
    assert not error[:, :, 2].any()
    size = error[:, :, :2].std(axis=0) / np.array([[0.1], [1.0]])
    # of 4000 Gaussian draws the relative error of a standard deviation is 1.1 %
    np.testing.assert_allclose(size, 1, atol=0.06)
    np.testing.assert_allclose(error[:, :, :2].mean(axis=0) / np.array([[0.1], [1.0]]), 0, atol=0.08)
    neighbours = np.mean(error[:, 1:, 1] * error[:, :-1, 1], axis=0)
    if colour != "quantization":
        np.testing.assert_allclose(neighbours, POLE if colour == "coloured" else 0.0, atol=0.08)
    else:
        step = np.sqrt(12)
        offset = error[:, :, 1] + np.asarray(y)[:, 1]  # whole steps from the first sample on
        parts = (offset - offset[:, :1]) / step
        np.testing.assert_allclose(parts, np.round(parts), atol=1e-9)


def test_whitening_undoes_the_colour():
    white = np.random.default_rng(1).standard_normal((50, 2))
    coloured = np.linalg.cholesky(POLE ** np.abs(np.subtract.outer(np.arange(50), np.arange(50)))) @ white
    np.testing.assert_allclose(whitened(coloured, "coloured"), white, atol=1e-12)
    assert whitened(white, "quantization") is white


def test_deviation_is_relative_to_each_output():
    experiment = make("chain3", noise=0.05)
    expected = 0.05 * np.sqrt(np.mean(np.asarray(experiment.exact) ** 2, axis=(0, 2)))
    np.testing.assert_allclose(experiment.deviation[:, 0], expected)


# --- programs and statistics


def test_cases_that_differ_in_numbers_share_a_program():
    first, second = make("chain2", noise=0.01, rate=12.0), make("chain2", noise=0.05, rate=15.0)
    static = [eqx.partition(e, eqx.is_array)[1] for e in (first, second)]
    assert jax.tree.structure(static[0]) == jax.tree.structure(static[1])
    shapes = [
        [(x.shape, x.dtype) for x in jax.tree.leaves(eqx.filter(e, eqx.is_array))] for e in (first, second)
    ]
    assert shapes[0] == shapes[1]
    inband = [make("chain2", data="record", rate=r, samples=50, record_samples=200) for r in (12.0, 15.0)]
    static = [eqx.partition(e, eqx.is_array)[1] for e in inband]
    assert jax.tree.structure(static[0]) == jax.tree.structure(static[1])


def test_an_ensemble_is_the_calls():
    experiment = make("chain2", colour="coloured")
    many = ensemble(experiment, KEY, 5)
    for i in (0, 4):
        np.testing.assert_allclose(
            many[i], call(experiment, jax.random.fold_in(KEY, i)), rtol=1e-7, atol=1e-9
        )


@pytest.mark.parametrize(
    "colour", ["white", "coloured", pytest.param("quantization", marks=pytest.mark.slow)]
)
def test_estimates_scatter_around_the_truth(colour):
    experiment = make("chain2", colour=colour)
    many = ensemble(experiment, KEY, 200)
    spread = many.std(axis=0)
    assert (np.abs(np.median(many, axis=0) - np.asarray(experiment.truth)) < 0.5 * spread).all()
    if colour != "quantization":  # which is not Gaussian: the bound is that of white noise
        assert (spread > 0.85 * np.asarray(experiment.bound)).all()  # three standard deviations below
        assert (spread[:2] < 6 * np.asarray(experiment.bound)[:2]).all()


def test_the_bound_grows_with_the_noise():
    one, five = make("chain3", noise=0.01), make("chain3", noise=0.05)
    np.testing.assert_allclose(five.bound, 5 * one.bound, rtol=1e-12)
    assert not make("chain3", noise=0.0).bound.any()


@pytest.mark.slow
@pytest.mark.parametrize("realization", ["era", "era_dc"])
@pytest.mark.parametrize("system", list(BUILT_IN))
def test_every_built_in_system_at_one_percent(system, realization):
    experiment = make(system, realization=realization)
    many = ensemble(experiment, KEY, 64)
    assert np.isfinite(many).all()
    truth, bound = np.asarray(experiment.truth), np.asarray(experiment.bound)
    frequencies = [i for i, name in enumerate(experiment.names) if name.startswith("frequency")]
    np.testing.assert_allclose(np.median(many, axis=0)[frequencies], truth[frequencies], rtol=1e-3)
    assert (many.std(axis=0) > 0.7 * bound).all()


def test_a_system_from_its_modes_keeps_its_channels():
    system = make_system("galileo", "accelerometer5, accelerometer162", "shaker")
    whole = make_system("galileo", "default", "default")
    np.testing.assert_array_equal(system.model.C, whole.model.C[np.array([4, 161])])
    assert (system.order, whole.order) == (30, 30)


@pytest.mark.slow
def test_vmap_is_the_calls():
    experiment = make("chain2")
    keys = jax.random.split(KEY, 3)
    together = eqx.filter_jit(eqx.filter_vmap(experiment))(keys)
    np.testing.assert_allclose(together[1], call(experiment, keys[1]), rtol=1e-7, atol=1e-9)
