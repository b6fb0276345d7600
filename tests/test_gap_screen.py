"""Columns of every kind against simulations of small effects, plans of parameters, the truth among the first."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gap_helpers import (
    BODIES,
    DAMPING,
    JOINT,
    MASS,
    STIFFNESS,
    WALL,
    chain,
    drive,
    noisy,
    record,
    with_effect,
)

import jaxsid
from jaxsid.gap.dictionary import columns
from jaxsid.gap.grids import RESONANCES, WIDTHS, _speeds, grid_of, plan_of, quantiles
from jaxsid.gap.noise import noise_of
from jaxsid.gap.places import places_of
from jaxsid.gap.recalibrate import as_given, beside, recalibrated
from jaxsid.gap.scoring import scores
from jaxsid.gap.screen import _rows, lone_frequencies, screen, unseen
from jaxsid.gap.setting import element_directions, setting_of, slowest_rate
from jaxsid.gap.spectra import spectra_of, stacked
from jaxsid.mechanics.effects.catalogue import CATALOGUE
from jaxsid.mechanics.effects.prior import Amplitudes
from jaxsid.mechanics.lumped import Connection, Effect, Input, Sensor, lumped_model
from jaxsid.physical.elements import element_matrices

FINE, SAMPLES = 1e-3, 4000
B12, B1, B13 = ("b1", "b2"), ("ground", "b1"), ("b1", "b3")
# small effects, from 1e-5 to 1e-3 of the response: kind, place, parameters
SMALL = [
    ("mass_error", "b2", {"factor": 1.0001}),
    ("stiffness_error", B12, {"factor": 1.0001}),
    ("damping_error", B12, {"factor": 1.001}),
    ("missing_connection", B13, {"stiffness": 0.1, "damping": 0.001}),
    ("missing_mode", "b2", {"mass": 1e-4, "stiffness": 0.1, "damping": 1e-3}),
    ("coulomb_friction", B1, {"force": 1e-3}),
    ("stribeck_friction", B12, {"force": 1e-3, "static_force": 2e-3, "velocity": 0.1}),
    ("quadratic_damping", B12, {"coefficient": 0.01}),
    ("cubic_stiffness", B12, {"coefficient": 300.0}),
    ("quadratic_stiffness", B12, {"coefficient": 10.0}),
    ("bilinear_stiffness", B12, {"stiffness": 0.1}),
    ("backlash", B12, {"half_gap": 1e-6}),
    ("end_stop", B12, {"stiffness": 0.5, "clearance": 0.005}),
    ("hysteresis", B12, {"stiffness": 0.1, "beta": 60.0, "gamma": 40.0, "exponent": 1.0}),
    ("hysteresis", B12, {"stiffness": 0.1, "beta": 2e3, "gamma": -1e3, "exponent": 1.7}),
    ("cogging_ripple", B12, {"amplitude": 1e-3, "wavenumber": 300.0, "phase": 0.4}),
    ("constant_load", "b3", {"force": 1e-3}),
    ("periodic_disturbance", "b3", {"amplitude": 1e-3, "frequency_hz": 7.3, "phase": 0.3}),
    ("time_varying_stiffness", B12, {"rate": 0.1}),
    ("sensor_gain", "s1", {"factor": 1.01}),
    ("sensor_bias", "s0", {"offset": 0.1}),
    ("sensor_delay", "s1", {"delay": 0.0034}),
    ("sensor_delay", "s0", {"delay": 0.0034}),
    ("sensor_lag", "s0", {"time_constant": 0.004}),
    ("sensor_lag", "s1", {"time_constant": 0.004}),
    ("input_gain", "drive", {"factor": 1.01}),
    ("input_delay", "drive", {"delay": 0.0034}),
    ("actuator_lag", "drive", {"time_constant": 0.004}),
    ("actuator_saturation", "drive", {"limit": 15.0}),
]
QUICK = ("cubic_stiffness", "sensor_delay")
SENSED = (("b1", "acceleration"), ("b2", "displacement"), ("b3", "velocity"))


def fine_chain(effects=()):
    ends = ("ground", *BODIES)
    return lumped_model(
        BODIES,
        MASS,
        STIFFNESS,
        DAMPING,
        connections=[Connection(f"c{i + 1}", ends[i : i + 2]) for i in range(3)],
        inputs=[Input("drive", "b1")],
        sensors=[Sensor(f"s{i}", *x) for i, x in enumerate(SENSED)],
        effects=effects,
    )


def fine_record(y=None):
    f = np.fft.rfftfreq(SAMPLES, FINE)
    phase = np.exp(2j * np.pi * np.random.default_rng(0).random(len(f)))
    u = np.fft.irfft(np.where((f > 0.5) & (f < 20), phase, 0), SAMPLES)
    y = np.zeros((SAMPLES, 3)) if y is None else np.asarray(y)
    return jaxsid.Record(15 * u[:, None] / u.std(), y, FINE, inputs=("drive",), outputs=("s0", "s1", "s2"))


@pytest.fixture(scope="module")
def calm():
    """A record without effect, beside its own model, the model's motion."""
    model = fine_chain()
    plain = np.asarray(jaxsid.simulate(model, fine_record()))
    spectra = spectra_of(model, fine_record(plain))
    noise = np.full(spectra.y.shape, 1e-8)
    given = setting_of(spectra, noise, element_directions(model), slowest_rate(model))
    return model, plain, spectra, beside(given).motion


def test_every_kind_is_tested():
    assert {kind for kind, *_ in SMALL} == set(CATALOGUE)


@pytest.mark.parametrize(
    ("kind", "place", "parameters"),
    [x if x[0] in QUICK else pytest.param(*x, marks=pytest.mark.slow) for x in SMALL],
)
def test_columns_are_what_a_small_effect_adds(calm, kind, place, parameters):
    model, plain, spectra, motion = calm
    where = CATALOGUE[kind].where
    effect = Effect(kind, ((where, place),), {k: jnp.asarray(v) for k, v in parameters.items()})
    added = np.asarray(jaxsid.simulate(fine_chain([effect]), fine_record(), substeps=4)) - plain
    at = _rows(model, places_of(model), where)
    slot = jax.tree.map(lambda x: x[at.named.index({where: place})], at.slots)
    values = [parameters.get(p.name, p.default) for p in CATALOGUE[kind].parameters]
    probes = jnp.asarray([[[*values, WIDTHS[0]]]])
    found = columns(spectra, slot, motion, jnp.ones(1), kind, probes)[0]
    lines = np.fft.rfft(added, axis=0) / np.sqrt(SAMPLES)
    size = np.sqrt((np.abs(lines) ** 2).sum(axis=0))
    # what rounding leaves is nothing
    size = np.where(size > 1e-9 * np.sqrt((plain**2).sum(axis=0)), size, np.inf)
    flat = lambda x: np.asarray(stacked(jnp.asarray(x / size[:, None])))  # noqa: E731
    free, rest = flat(np.asarray(spectra.free)), flat(lines[:, :, None] - np.asarray(found))
    rest = rest - free @ np.linalg.lstsq(free, rest, rcond=None)[0]
    # dry friction jumps between samples
    tolerance = 5e-2 if CATALOGUE[kind].slip is not None else 1e-2
    assert np.linalg.norm(rest) < tolerance * np.linalg.norm(flat(lines[:, :, None]))


def test_plans_say_how_parameters_enter():
    assert plan_of("coulomb_friction").linear == (0,)
    assert plan_of("stribeck_friction")[:1] == ((0, 1),)
    assert plan_of("stribeck_friction").shape == (2,)
    assert plan_of("hysteresis").shape == (1, 2, 3)
    assert plan_of("cogging_ripple")[:4] == ((0,), False, 2, None)
    assert plan_of("periodic_disturbance").frequency == 1
    assert plan_of("missing_mode").whole
    # a sharp resonance is found by a fit that begins within a few percent of its frequency
    stiffness = np.unique(quantiles(CATALOGUE["missing_mode"].parameters[1].prior, RESONANCES[0]))
    steps = np.sqrt(stiffness[1:] / stiffness[:-1])
    assert 1 < steps.max() < 1.09
    assert np.sqrt(stiffness[-1] / stiffness[0]) > 90
    for name in ("backlash", "sensor_delay", "actuator_lag", "actuator_saturation"):
        assert not plan_of(name).proportional


def test_waves_are_so_close_that_none_between_two_is_missed():
    """A wave that is out by a radian rms where it is ten long is still like the next one of the grid."""
    moved = Amplitudes(*(np.ones(1) for _ in Amplitudes._fields))
    grid = grid_of("cogging_ripple", moved, np.zeros(0))
    names = [p.name for p in CATALOGUE["cogging_ripple"].parameters]
    waves = np.unique(grid.base[0, :, row := names.index("wavenumber")])
    least = CATALOGUE["cogging_ripple"].parameters[row].prior.lowest
    assert least <= waves.min() < 1.05 * least < 1.1
    assert waves.max() > 30
    assert np.diff(waves)[waves[1:] < 10].max() < 1
    d = np.random.default_rng(0).standard_normal(2000)
    for between in np.sqrt(waves[1:] * waves[:-1])[waves[1:] < 10]:
        near = waves[np.argsort(np.abs(waves - between))[0]]
        columns = np.stack([np.sin(near * d), np.cos(near * d)], axis=1)
        left = np.sin(between * d + 0.4)
        rest = left - columns @ np.linalg.lstsq(columns, left, rcond=None)[0]
        assert (rest**2).sum() < 0.25 * (left**2).sum()


def test_attached_parts_are_also_tried_where_lines_stand_out():
    at = Amplitudes(*(np.array([1.0, 3.0]) * (i + 1) for i in range(len(Amplitudes._fields))))
    hertz = np.array([0.7, 7.33])
    plain, grid = (grid_of("missing_mode", at, x) for x in (np.zeros(0), hertz))
    count = plain.base.shape[1]
    assert np.array_equal(grid.base[:, :count], plain.base)
    more = grid.base[:, count:].reshape(2, len(hertz), RESONANCES[1], 3)
    swings = np.sqrt(more[..., 1] / more[..., 0]) / (2 * np.pi)
    assert swings == pytest.approx(np.broadcast_to(hertz[:, None], swings.shape))
    assert np.array_equal(
        more[..., 2], np.broadcast_to(plain.base[:, None, : RESONANCES[1], 2], swings.shape)
    )
    assert grid.probes.shape[1] == grid.base.shape[1]


def test_what_a_part_swings_by_may_come_in_any_order():
    vibrates = CATALOGUE["missing_mode"].vibrates
    assert _speeds(vibrates, (1, 2), np.array([1.0, 40.0, 0.3])) == 0
    assert _speeds(lambda m, c, k: vibrates(m, k, c), (1, 2), np.array([1.0, 0.3, 40.0])) == 1


def screened(model, records, **more):
    noises = noise_of(model, records)
    settings = as_given(model, records, noises).settings
    places = places_of(model)
    tolerance = np.array([getattr(model.tolerance, x.quantity) for x in element_matrices(model).listed])
    refit = recalibrated(model, records, noises, wide=False, given=True)
    own = scores(model, settings, places, tolerance).explained
    motions = {"own": [x.motion for x in own], "refit": [x.motion for x in refit.linear]}
    left = [np.abs(np.asarray(x.left)) for x in refit.linear]
    return screen(model, settings, places, motions, tolerance, left, **more)


TRUE = [
    ("cubic_stiffness", JOINT, {"between": B12}, {"coefficient": 3e6}),
    ("coulomb_friction", WALL, {"between": B1}, {"force": 1.0}),
    ("periodic_disturbance", 2, {"body": "b3"}, {"amplitude": 2.0, "frequency_hz": 7.33, "phase": 0.3}),
]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "at", "place", "parameters"), TRUE)
def test_truth_is_among_the_first_with_its_parameters(kind, at, place, parameters):
    u = drive()
    records = (record(u, noisy(with_effect(u, kind, at, parameters))),)
    found = screened(chain(), records)
    linear = recalibrated(chain(), records, noise_of(chain(), records), wide=False, given=True)
    (own,) = [c for c in found[:6] if c.kind == kind and c.place == place]
    assert set(own.parameters) == set(parameters)
    for name, value in parameters.items():
        assert own.parameters[name] == pytest.approx(value, rel=0.2, abs=0.2 if name == "phase" else None)
    # in the quietest band's noise, which what the law leaves on the wrong trajectory is above
    assert own.left < 0.15 * linear.squares / linear.equations


@pytest.mark.slow
def test_a_sharp_resonance_is_found_at_its_body():
    """Of 0.3 % damping, between two frequencies of the grid: a tenth as wide as their distance."""
    frequency, mass = 7.63, 0.003
    own = {"stiffness": mass * (2 * np.pi * frequency) ** 2, "damping": 6e-3 * mass * 2 * np.pi * frequency}
    u = drive(4096)
    records = (record(u, noisy(with_effect(u, "missing_mode", 1, {"mass": mass, **own}))),)
    best = screened(chain(), records, kinds=("missing_mode",))[0]
    assert best.place == {"body": "b2"}
    found = np.sqrt(best.parameters["stiffness"] / best.parameters["mass"]) / (2 * np.pi)
    assert found == pytest.approx(frequency, rel=5e-3)


@pytest.mark.slow
def test_records_of_different_lengths_count_together():
    kind, at, place, parameters = TRUE[0]
    records = []
    for samples, seed in ((1024, 0), (700, 1)):
        u = drive(samples, seed)
        records.append(record(u, noisy(with_effect(u, kind, at, parameters), seed=seed), name=f"r{seed}"))
    found = screened(chain(), tuple(records), kinds=("cubic_stiffness", "quadratic_stiffness"))
    assert (found[0].kind, found[0].place) == (kind, place)


def test_lone_frequencies_are_those_of_a_sine(calm):
    model, plain, spectra, _ = calm
    given = setting_of(spectra, np.ones(spectra.y.shape), element_directions(model), slowest_rate(model))
    t = FINE * np.arange(SAMPLES)
    left = np.random.default_rng(0).standard_normal(plain.shape) + np.sin(2 * np.pi * 31.3 * t)[:, None]
    found = lone_frequencies([given], [np.abs(np.fft.rfft(left, axis=0)) / np.sqrt(SAMPLES)])
    assert np.abs(found - 31.3).min() < 0.07


def test_what_no_line_of_a_free_axis_shows_is_a_candidate_there():
    free = lumped_model(
        ("motor", "load"),
        [1.0, 2.0],
        [50.0],
        [0.1],
        connections=[Connection("shaft", ("motor", "load"))],
        inputs=[Input("torque", "motor")],
        sensors=[Sensor("v", "motor", "velocity")],
    )
    found = {(c.kind, *c.place.values()) for c in unseen(free, places_of(free))}
    assert found == {("constant_load", "motor"), ("constant_load", "load"), ("sensor_bias", "v")}
    assert unseen(chain(), places_of(chain())) == ()
