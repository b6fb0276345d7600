"""Refinement: exact without noise, efficient with it, honest about what it knows, clear about what it cannot use."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from band_limited import THREE, chain, experiment
from chains import CHAINS, chain_model, exact_response, factors, truth_of
from scipy.optimize import least_squares

from jaxsid import ImpulseResponse, InputError, Record, frequency_response, refine
from jaxsid.impulse.spectra import FrequencyResponse
from jaxsid.uncertainty.noise import CorrelatedNoise, IndependentNoise, StationaryNoise

TRUTH = truth_of(THREE)
EXACT = exact_response(chain_model(THREE))
SIZE = 0.01 * np.asarray(EXACT.h).std(axis=(0, 2))


def noisy(seed, size=SIZE):
    h = np.asarray(EXACT.h)
    e = np.random.default_rng(seed).standard_normal(h.shape) * size[:, None]
    return ImpulseResponse(h + e, EXACT.dt)


def wrong(seed, **options):
    return chain_model(THREE, factors(np.random.default_rng(seed), THREE), **options)


def relative(found, truth=TRUTH):
    return np.abs(np.asarray(found.elements.values) / truth - 1).max()


def pulls(found):
    return (np.asarray(found.elements.values) - TRUTH) / np.asarray(found.elements.deviation)


@pytest.mark.parametrize("name", [pytest.param("one", marks=pytest.mark.slow), "three"])
def test_exact_responses_give_exact_values_from_far_away(name):
    elements, samples = CHAINS[name]
    ir = exact_response(chain_model(elements), samples)
    rng = np.random.default_rng(0)
    for _ in range(4):
        found = refine(chain_model(elements, factors(rng, elements)), ir)
        assert relative(found, truth_of(elements)) < 1e-8
        assert bool(found.converged)
        assert found.warnings == ()


@pytest.mark.slow
@pytest.mark.parametrize("sensed", [None, "few"])
@pytest.mark.parametrize("name", CHAINS)
def test_nearly_every_start_within_thirty_percent_converges(name, sensed):
    elements, samples = CHAINS[name]
    bodies = {"one": (0,), "three": (0,), "seven": (0, 3, 6)}[name] if sensed else None
    ir = exact_response(chain_model(elements, sensed=bodies), samples)
    rng, good = np.random.default_rng(1), 0
    for _ in range(100):
        model = chain_model(elements, factors(rng, elements), sensed=bodies)
        good += relative(refine(model, ir, validate=False), truth_of(elements)) < 1e-8
    assert good >= 95


@pytest.mark.slow
def test_one_sensor_is_enough_for_a_chain():
    ir = exact_response(chain_model(THREE, sensed=(0,)))
    assert relative(refine(wrong(3, sensed=(0,)), ir)) < 1e-8


@pytest.mark.slow
def test_deviations_are_those_of_the_errors_whether_the_noise_is_known_or_not():
    known = IndependentNoise(jnp.asarray(SIZE**2))
    for noise in (None, known):
        sample = np.array([pulls(refine(wrong(seed), noisy(seed), noise=noise)) for seed in range(40)])
        assert 0.85 < np.sqrt((sample**2).mean()) < 1.15
        assert np.abs(sample.mean(axis=0)).max() < 0.6


@pytest.mark.slow
def test_coloured_noise_that_is_known_is_weighed_and_covered():
    colour = 0.9 ** np.arange(400)[:, None] * SIZE**2
    noise = StationaryNoise(jnp.asarray(colour))
    h, sample, plain = np.asarray(EXACT.h), [], []
    for seed in range(25):
        rng = np.random.default_rng(seed)
        white = rng.standard_normal(h.shape)
        e = np.zeros(h.shape)
        e[0] = white[0]
        for k in range(1, len(h)):
            e[k] = 0.9 * e[k - 1] + np.sqrt(1 - 0.81) * white[k]
        ir = ImpulseResponse(h + e * SIZE[:, None], EXACT.dt)
        found = refine(wrong(seed), ir, noise=noise)
        sample.append((pulls(found), np.asarray(found.elements.values) / TRUTH - 1))
        plain.append(np.asarray(refine(wrong(seed), ir).elements.values) / TRUTH - 1)
    pull, weighed = np.moveaxis(np.array(sample), 1, 0)
    assert 0.8 < np.sqrt(np.square(pull).mean()) < 1.2
    # knowing the colour pays, for the masses above all
    assert np.sqrt(np.square(weighed).mean(axis=0))[0] < 0.7 * np.sqrt(np.square(plain).mean(axis=0))[0]


@pytest.mark.slow
def test_noise_known_from_repeats_widens_the_deviations_as_it_must():
    rng = np.random.default_rng(0)
    factor = rng.standard_normal((30, *EXACT.h.shape)) * SIZE[:, None] / np.sqrt(29)
    repeats = refine(wrong(1), noisy(1), noise=CorrelatedNoise(jnp.asarray(factor)))
    known = refine(wrong(1), noisy(1), noise=IndependentNoise(jnp.asarray(SIZE**2)))
    ratio = np.asarray(repeats.elements.deviation / known.elements.deviation)
    assert ratio.min() > 0.6
    assert ratio.max() < 1.6


@pytest.mark.slow
def test_held_tied_and_prior_values():
    model = chain_model(THREE, np.array([1, 1, 1, 0.8, 0.8, 1.1, 1.2, 0.9, 0.8]))
    found = refine(
        model,
        noisy(2),
        fixed=["*.mass"],
        tied=[["c1.damping", "c2.damping"]],
        priors={"c3.stiffness": (1990.0, 1e-3)},
    )
    np.testing.assert_array_equal(found.elements.values[:3], THREE[0])
    np.testing.assert_array_equal(found.elements.deviation[:3], 0.0)
    np.testing.assert_allclose(found.value("c1.damping") / found.value("c2.damping"), 1.5 / 1.2)
    np.testing.assert_allclose(found.value("c3.stiffness"), 1990.0, atol=1e-2)
    assert float(found.deviation("c3.stiffness")) <= 1e-3
    assert float(found.data_share[8]) < 0.01
    assert float(found.data_share[6]) == 1.0
    np.testing.assert_allclose(found.elements.correlation[3, 4], 1.0)


def test_bounds_hold_and_the_rest_is_the_best_that_they_allow():
    ir, noise = noisy(3), IndependentNoise(jnp.asarray(SIZE**2))
    model = chain_model(THREE, np.array([1, 1, 1, 1, 1, 1, 1, 1, 0.9]))
    found = refine(model, ir, bounds={"c3.stiffness": (100.0, 1950.0)}, noise=noise)
    assert found.at_bound == ("c3.stiffness",)
    np.testing.assert_allclose(found.value("c3.stiffness"), 1950.0, rtol=1e-14)
    assert any("At a bound: c3.stiffness" in w for w in found.warnings)

    def residual(factor):
        h = exact_response(chain_model(THREE, factor)).h
        return (np.asarray(h - ir.h) / SIZE[:, None]).ravel()

    upper = np.full(9, 1.5)
    upper[8] = 1950.0 / 2000.0
    wanted = least_squares(
        residual, np.asarray(found.elements.values) / TRUTH - 1e-4, bounds=(0.5, upper), xtol=1e-14
    )
    np.testing.assert_allclose(np.asarray(found.elements.values) / TRUTH, wanted.x, atol=2e-6)


@pytest.mark.slow
def test_what_cannot_be_told_apart_is_said_and_a_prior_settles_it():
    """Two springs side by side: only their sum acts."""
    from jaxsid.mechanics.lumped import Connection, lumped_model

    one = chain_model(THREE)
    twice = lumped_model(
        one.bodies,
        one.mass,
        [1000.0, 2500.0, 2000.0, 1900.0],
        [1.5, 1.2, 1.0, 0.0],
        connections=[*one.connections, Connection("beside", ("ground", "b1"))],
        inputs=one.inputs,
        sensors=one.sensors,
    )
    found = refine(twice, noisy(4), fixed=["beside.damping"])
    spread = dict(
        zip((x.name for x in found.elements.listed), np.asarray(found.elements.deviation), strict=True)
    )
    assert {n for n, s in spread.items() if np.isinf(s)} == {"c1.stiffness", "beside.stiffness"}
    assert len(found.open_combinations) == 1
    assert any("c1.stiffness" in w and "beside.stiffness" in w for w in found.warnings)
    np.testing.assert_allclose(
        found.value("c1.stiffness") + found.value("beside.stiffness"), 3000.0, rtol=1e-2
    )
    settled = refine(twice, noisy(4), fixed=["beside.damping"], priors={"beside.stiffness": (2000.0, 50.0)})
    np.testing.assert_allclose(settled.deviation("beside.stiffness"), 50.0, rtol=1e-3)
    np.testing.assert_allclose(settled.value("beside.stiffness"), 2000.0, rtol=1e-3)
    assert settled.open_combinations == ()


def test_a_refined_model_predicts_what_was_held_out():
    found = refine(wrong(5), noisy(5))
    assert found.validation.better
    assert float(found.validation.refined.max()) < 0.03
    assert float(found.after.max()) < 0.03 < float(found.before.max())


def test_traced_and_mapped_it_is_the_same_fit():
    model = chain_model(THREE, np.linspace(0.97, 1.03, 9))
    noise = IndependentNoise(jnp.asarray(SIZE**2))
    fit = lambda h: refine(model, ImpulseResponse(h, EXACT.dt), noise=noise).elements  # noqa: E731
    many = jnp.stack([noisy(seed).h for seed in range(3)])
    mapped, mapped_std = jax.jit(jax.vmap(lambda h: (fit(h).values, fit(h).deviation)))(many)
    for seed in range(3):
        alone = refine(model, noisy(seed), noise=noise, validate=False).elements
        np.testing.assert_allclose(mapped[seed], alone.values, rtol=1e-6)
        np.testing.assert_allclose(mapped_std[seed], alone.deviation, rtol=1e-3)


@pytest.mark.slow
def test_solvers_of_optimistix_come_to_the_same_place():
    import optimistix

    from jaxsid.mechanics.lumped import second_order
    from jaxsid.physical.measured import response_term, response_weights
    from jaxsid.physical.posterior import most_probable
    from jaxsid.physical.restrictions import restricted

    model, noise = wrong(8), IndependentNoise(jnp.asarray(SIZE**2))
    known, ir = restricted(model, priors={"b1.mass": (1.3, 0.01)}), noisy(8)
    term = response_term(ir, second_order(model), response_weights(ir, noise))
    start = known.unknowns.of_values(jnp.asarray(known.unknowns.nominal))
    own = most_probable((term,), known.unknowns, known.prior, start)
    for solver in (optimistix.LevenbergMarquardt(1e-9, 1e-9), optimistix.Dogleg(1e-9, 1e-9)):
        other = most_probable((term,), known.unknowns, known.prior, start, solver)
        np.testing.assert_allclose(other.theta, own.theta, rtol=1e-6)
        np.testing.assert_allclose(other.information, own.information, rtol=1e-5)
        np.testing.assert_allclose(other.squares, own.squares, rtol=1e-8)
    priors = {"b1.mass": (1.3, 0.01)}
    whole = refine(model, ir, noise=noise, priors=priors, validate=False, solver=solver)
    np.testing.assert_allclose(whole.elements.values, known.unknowns.values(own.theta), rtol=1e-6)


def recorded(seed, model, outputs=(0, 1, 2)):
    u, y = experiment(chain(*THREE), seed)
    names = [f"s{i + 1}" for i in outputs]
    return Record(u, y[:, outputs], 1e-3, inputs=["f1"], outputs=names)


@pytest.mark.slow
def test_raw_records_with_residuals_that_are_noise():
    found = refine(wrong(6), recorded(6, None))
    assert np.abs(pulls(found)).max() < 4
    assert relative(found) < 0.01
    assert found.warnings == ()
    assert found.validation.better
    np.testing.assert_allclose(found.after, 0.01, rtol=0.05)
    left = found.residuals
    inside = np.abs(np.asarray(left.cross_correlation)) < np.asarray(left.cross_limit)
    assert inside.mean() > 0.97
    assert (np.abs(np.asarray(left.autocorrelation)[1:]) < left.white_limit).mean() > 0.97


@pytest.mark.slow
def test_a_hidden_sensor_and_two_records():
    records = [recorded(seed, None, (0, 2)) for seed in (7, 8)]
    found = refine(wrong(7), records)
    assert found.outputs == ("s1", "s3")
    assert np.abs(pulls(found)).max() < 4
    assert relative(found) < 0.01


def test_frequency_responses():
    u, y = experiment(chain(*THREE), 9)
    seen = frequency_response(Record(u, y, 1e-3), segment=8192)
    f = np.asarray(seen.frequencies)
    band = (f > 1.5) & (f < 30)
    parts = seen.frequencies, seen.H, seen.coherence, seen.multiple_coherence, seen.noise_psd
    cut = FrequencyResponse(*(x[band] for x in parts), seen.averages)
    found = refine(chain_model(THREE, np.linspace(0.95, 1.05, 9)), cut, dt=1e-3)
    stiffness = np.asarray(found.elements.values)[6:]
    np.testing.assert_allclose(stiffness, THREE[1], rtol=0.05)
    assert found.validation.better


def test_what_cannot_be_used_is_told():
    model = wrong(1)
    for options, text in (
        ({"fixed": ["b9.mass"]}, "'b9.mass' is no value of the model; did you mean 'b"),
        ({"bounds": {"b1.mass": (2.0, 1.0)}}, "lowest first"),
        ({"bounds": {"c1.damping": (-2.0, -1.0)}}, "contradict each other"),
        ({"priors": {"b1.mass": (1.0, 0.0)}}, "belongs among `fixed`"),
        ({"fixed": ["*"]}, "nothing to refine"),
        ({"fixed": ["b1.mass"], "priors": {"b1.mass": (1.0, 0.1)}}, "'b1.mass' is fixed"),
        ({"tied": [["b1.mass"]]}, "stands alone"),
        ({"tied": [["b1.mass", "c1.damping"]]}, "different quantities"),
        ({"tied": [["b1.mass", "b2.mass"]], "fixed": ["b1.mass"]}, "one of these is fixed"),
        ({"tied": [["b1.mass", "b2.mass"], ["b2.mass", "b3.mass"]]}, "in two groups"),
    ):
        with pytest.raises(InputError, match=text.replace("(", r"\(")):
            refine(model, EXACT, **options)
    with pytest.raises(InputError, match="3 outputs and 1 inputs, the model 1 sensors"):
        refine(wrong(1, sensed=(0,)), EXACT)
    with pytest.raises(InputError, match="Laguerre"):
        refine(model, ImpulseResponse(EXACT.h, EXACT.dt, pole=0.3))
    with pytest.raises(InputError, match="noise belongs to an impulse response"):
        refine(model, recorded(1, model), noise=IndependentNoise(jnp.ones(3)))
    with pytest.raises(InputError, match="'s9' is no sensor"):
        refine(model, Record(np.ones((100, 1)), np.ones((100, 1)), 1e-3, inputs=["f1"], outputs=["s9"]))


@pytest.mark.slow
def test_a_value_on_which_nothing_depends_is_told():
    """A body that a zero spring leaves alone."""
    from jaxsid.mechanics.lumped import Connection, Input, Sensor, lumped_model

    def pair(mass):
        return lumped_model(
            ["b1", "alone"],
            [mass, 1.0],
            [3000.0, 50.0],
            [1.5, 0.1],
            connections=[Connection("c1", ("ground", "b1")), Connection("c2", ("ground", "alone"))],
            inputs=[Input("f1", "b1")],
            sensors=[Sensor("s1", "b1", "acceleration")],
        )

    ir = exact_response(pair(1.2))
    with pytest.raises(
        InputError, match=r"nothing in these data depends on alone.mass, c2.damping, c2.stiffness"
    ):
        refine(pair(1.0), ir)
