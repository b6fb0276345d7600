"""Windows, unknowns and fits by simulation: against plain indices, closed forms, finite differences, SciPy, truth."""

import jax.numpy as jnp
import numpy as np
import pytest
from effects_truth import GROUND, Chain, Truth
from gap_bench import PART, POLE, bench, colored, known, stepped, whitened, windows_of
from gap_helpers import (
    BODIES,
    DAMPING,
    DT,
    JOINT,
    MASS,
    SAMPLES,
    STIFFNESS,
    chain,
    drive,
    exact,
    record,
)
from gap_helpers import with_effect as truth
from scipy.linalg import expm
from scipy.optimize import least_squares

from jaxsid import Record
from jaxsid.gap.fit import Fit
from jaxsid.gap.hypothesis import FIXED, coordinates_of, parameter_rows, shifts_of
from jaxsid.gap.noise import Noise
from jaxsid.gap.ranking import density
from jaxsid.gap.refit import (
    Hypothesis,
    Refit,
    _with_own,
    as_guessed,
    prior_of,
    refitted,
    shot_of,
    states_without,
    weighed_anew,
)
from jaxsid.gap.roughly import loudest
from jaxsid.gap.setting import slowest_rate
from jaxsid.gap.shooting import parameters_of, products_of
from jaxsid.gap.windows import BLOCKS, LEAD, LONGEST, SHORTEST, blocks_of, untold, window_length
from jaxsid.impulse.whitening import MOST
from jaxsid.mechanics.effects.catalogue import CATALOGUE, MOST_PARAMETERS
from jaxsid.mechanics.effects.prior import Amplitudes
from jaxsid.mechanics.lumped import Connection, Effect, Input, Sensor, lumped_model, second_order

EVERY = Hypothesis(wrong=tuple(range(9)))
PLACES = {"between": ("b1", "b2"), "body": "b2", "sensor": "s1", "input": "drive"}


def effect(kind, place, **parameters):
    return Effect(kind, ((CATALOGUE[kind].where, place),), parameters)


def pull(found, name, value, row=0):
    """How many deviations a fitted parameter lies off."""
    fitted_value = float(found.hypothesis.effects[row].parameters[name])
    return (fitted_value - value) / found.deviations[row][name]


# windows


@pytest.mark.parametrize(("samples", "begin"), [(1024, 0), (1000, 700), (700, 0), (5000, 123), (9000, 0)])
def test_blocks_judge_every_sample_once(samples, begin):
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal(samples), rng.standard_normal((samples, 3))
    data = [record(u, y), record(u[:900], y[:900])]
    noise = known(np.array([1.0, 2.0, 4.0]))
    length, lead = 256, 256 // LEAD
    blocks = blocks_of(chain(), data, [noise] * 2, length, [begin, 0])
    judged = {0: [], 1: []}
    for block in blocks:
        assert block.lead == lead
        assert block.y.shape[1:] == (lead + length, 3)
        assert block.u.shape[1:] == (2 * lead + length, 1)
        assert len(block.y) * length in BLOCKS
        np.testing.assert_array_equal(block.taps[:, 1], np.tile([1.0, -POLE], (len(block.y), 1)))
        assert len(set(np.asarray(block.record).tolist())) == 1
        for w, (first, number) in enumerate(zip(block.first.tolist(), block.record.tolist(), strict=True)):
            own_u, own_y = np.asarray(data[number].u), np.asarray(data[number].y)
            weight = np.asarray(block.weight)[w]
            before = first + np.arange(lead)
            # the filter may look back, as far as there is a record
            least = 0 if (begin, 0)[number] else untold(len(own_y))
            np.testing.assert_array_equal(weight[:lead, 0] > 0, (before >= least) & (before < len(own_y)))
            here = lead + np.flatnonzero(weight[lead:, 0])
            np.testing.assert_array_equal(weight[here], np.tile(1 / noise.level, (len(here), 1)))
            judged[number] += (first + here).tolist()
            np.testing.assert_array_equal(np.asarray(block.y)[w, here], own_y[first + here])
            at = first - lead + np.arange(2 * lead + length)
            padded = np.where(at < 0, 0.0, own_u[np.clip(at, 0, len(own_u) - 1), 0])
            np.testing.assert_array_equal(np.asarray(block.u)[w, :, 0], padded)
    assert sorted(judged[0]) == list(range(begin or untold(samples), samples))
    second = min(900, samples)
    assert sorted(judged[1]) == list(range(untold(second), second))


def test_absent_sensors_and_gaps_have_no_weight():
    u, y = drive(), exact(drive())
    y[100:110, 0] = np.nan
    some = Record(u[:, None], y[:, :2], DT, inputs=("drive",), outputs=("s0", "s1"))
    level = np.array([1.0, 1.0, np.nan])
    (block,) = blocks_of(chain(), [some], [Noise(level, np.ones((3, 1)), 1.0, "periods")], 256)
    count = (np.asarray(block.weight)[:, block.lead :] > 0).sum(axis=(0, 1))
    told = SAMPLES - untold(SAMPLES)
    assert count.tolist() == [told - 10, told, 0]
    assert np.isfinite(np.asarray(block.y)).all()


def test_windows_last_some_periods_within_limits():
    assert window_length(2 * np.pi, 0.01, 10**6) == 512  # 400 samples wished for
    assert window_length(1e4, 0.01, 10**6) == SHORTEST
    assert window_length(1e-3, 0.01, 10**6) == LONGEST
    assert window_length(2 * np.pi, 0.01, 200) == 256
    assert window_length(slowest_rate(chain()), DT, SAMPLES) == 256


# unknowns

AMPLITUDES = Amplitudes(*(np.array([x]) for x in (7.0, 0.02, 0.3, 5.0, 20.0, 10.0)))


@pytest.mark.parametrize("kind", CATALOGUE)
def test_unknowns_and_parameters_undo_each_other(kind):
    of = CATALOGUE[kind].parameters
    coordinates = coordinates_of([effect(kind, PLACES[CATALOGUE[kind].where])], AMPLITUDES)
    rng = np.random.default_rng(0)
    for _ in range(5):
        z = np.maximum(rng.standard_normal((1, MOST_PARAMETERS)), coordinates.least())
        parameters = np.asarray(coordinates.parameters(jnp.asarray(z)))
        np.testing.assert_allclose(coordinates.unknowns(parameters), z, atol=1e-9)
        ratio = {}
        for i, p in enumerate(of):  # from the definitions
            prior = p.prior
            if prior.shape == "log-normal":
                ratio[p.name] = prior.centre * prior.spread ** z[0, i]
            else:
                ratio[p.name] = z[0, i] if prior.shape == "uniform" else prior.centre + prior.spread * z[0, i]
        for i, p in enumerate(of):
            at = Amplitudes(*(float(x[0]) for x in AMPLITUDES))
            scale = float(p.scale.of(at)) ** (ratio[p.raised] if p.raised else 1)
            assert parameters[0, i] == pytest.approx(ratio[p.name] * scale, rel=1e-9)
    deviation = np.asarray(coordinates.deviation)[0]
    angles = np.array([p.prior.shape == "uniform" for p in of])
    np.testing.assert_allclose(deviation[: len(of)], np.where(angles, np.pi / np.sqrt(3), 1.0))
    assert (deviation[len(of) :] < 1e-6).all()


def test_a_start_beyond_what_makes_sense_is_brought_back():
    coordinates = coordinates_of([effect("coulomb_friction", PLACES["between"])], AMPLITUDES)
    z = coordinates.unknowns(parameter_rows([effect("coulomb_friction", PLACES["between"], force=-3.0)]))
    assert float(coordinates.parameters(jnp.asarray(z))[0, 0]) == pytest.approx(0.0, abs=1e-12)


def test_every_record_has_a_phase_of_its_own():
    y = exact(drive())
    of = bench(*colored(y, 0))._replace(records=3)
    sine = effect("periodic_disturbance", "b2", amplitude=1.0, frequency_hz=3.0, phase=0.2)
    delay = effect("sensor_delay", "s1", delay=0.02)
    shot = shot_of(of, (sine, delay))
    z = shot.coordinates.unknowns(parameter_rows((sine, delay)))
    theta = np.concatenate([np.zeros(9), z.ravel(), [0.5, 9.0], [-1.0, 9.0]])
    rows = np.array([parameters_of(shot, jnp.asarray(theta), k) for k in range(3)])
    np.testing.assert_allclose(rows[:, 0, :3], [[1, 3, 0.2], [1, 3, 0.7], [1, 3, -0.8]], rtol=1e-9)
    np.testing.assert_allclose(rows[:, 1, 0], 0.02)
    # a fit that goes on begins with them
    fitted = effect("periodic_disturbance", "b2", amplitude=1.0, frequency_hz=3.0, phase=rows[:, 0, 2])
    np.testing.assert_allclose(shifts_of((fitted, delay), 3), [0.5, 0.0, -1.0, 0.0], rtol=1e-9)
    deviation = prior_of(of, Hypothesis((sine, delay)), shot).deviation[-4:]
    np.testing.assert_allclose(deviation, [np.pi, 1e-9, np.pi, 1e-9])


# one program: springs, dampers and masses, sensors and inputs


def simulated(block, of, states):
    """(windows, samples, 3) readings, exact for the hold."""
    u, x, found = windows_of(block)[0], np.asarray(states, float), []
    for k in range(u.shape[1]):
        found.append(x @ of.C.T + np.outer(u[:, k], of.D))
        x = x @ of.E.T + np.outer(u[:, k], of.F)
    return np.stack(found, axis=1)


@pytest.fixture(scope="module")
def straight():
    """The linear chain, its springs 3 % softer than the model's, fitted with a wide prior, then to the very bottom."""
    of = bench(*colored(exact(drive()), 1), model=chain(factor=1.03), wide=True)
    found = last = refitted(of, EVERY)
    for _ in range(3):  # a fit ends where a step brings little
        last = refitted(of, EVERY, changes=last.fit.theta[:9], states=last.fit.states)
    return of, found, last


def test_linear_elements_agree_with_an_independent_fit(straight):
    of, found, last = straight
    (block,) = of.blocks
    _, y, weight = windows_of(block)
    before, first = prior_of(of, EVERY, shot_of(of, ())).before[:6], np.asarray(block.first)[:, None]

    def residual(unknowns):
        change, states = unknowns[:9], unknowns[9:].reshape(-1, 6) * of.still / 100
        left = simulated(block, stepped(of.model, change), states) - y
        own = change / of.wide, (states / np.where(first < 0, before, of.still)).ravel()
        return np.concatenate([whitened(left, weight, block.lead).ravel(), *own])

    scipy = least_squares(residual, np.zeros(9 + 6 * len(y)), method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    np.testing.assert_allclose(last.fit.theta[:9], scipy.x[:9], atol=1e-6)
    covariance = np.linalg.inv(scipy.jac.T @ scipy.jac)[:9, :9]
    deviation = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(np.sqrt(np.diag(last.fit.covariance)[:9]), deviation, rtol=1e-3)
    assert np.abs((found.fit.theta[:9] - scipy.x[:9]) / deviation).max() < 0.05
    squares = (residual(scipy.x)[: whitened(y, weight, block.lead).size] ** 2).sum()
    assert last.fit.squares == pytest.approx(squares, rel=1e-6)
    assert found.fit.settled


@pytest.mark.slow
def test_deviations_are_those_of_twenty_seeds():
    values = np.concatenate([MASS, DAMPING, STIFFNESS])
    model = chain(factor=1.02)
    pulls = []
    for seed in range(20):
        found = refitted(bench(*colored(exact(drive()), seed), model=model, wide=True), EVERY)
        nominal = np.concatenate([model.mass, model.damping, model.stiffness])
        pulls.append(
            (found.fit.theta[:9] - (values / nominal - 1)) / np.sqrt(np.diag(found.fit.covariance)[:9])
        )
    rms = np.sqrt(np.mean(np.square(pulls), axis=0))
    assert 0.85 < np.sqrt((rms**2).mean()) < 1.15
    assert ((rms > 0.6) & (rms < 1.5)).all()


def late(u, back, of=()):
    """Readings on half sampling intervals, the input or some sensors late by so many halves."""
    half = chain()
    plain = second_order(half)
    M, D, K, B = (np.asarray(x) for x in (plain.mass, plain.damping, plain.stiffness, plain.input_matrix))
    A = np.block([[np.zeros((3, 3)), np.eye(3)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    force = np.concatenate([np.zeros((3, 1)), np.linalg.solve(M, B)])
    step = expm(np.block([[A, force], [np.zeros((1, 7))]]) * DT / 2)
    twice = np.repeat(u, 2)
    if not of:
        twice = np.concatenate([np.zeros(back), twice])[: len(twice)]
    x, y = np.zeros(6), []
    for push in twice:
        y.append(A[3:] @ x + force[3:, 0] * push)
        x = step[:6, :6] @ x + step[:6, 6] * push
    y = np.array(y)
    for j in of:
        y[:, j] = np.concatenate([np.zeros(back), y[:, j]])[: len(y)]
    return y[::2]


@pytest.mark.parametrize(
    ("kind", "place", "of"), [("sensor_delay", "s1", (1,)), ("input_delay", "drive", ())]
)
def test_delays_reach_over_the_borders_of_windows(kind, place, of):
    """Seven half samples; windows would not see what was before them if each began with itself."""
    found = refitted(
        bench(*colored(late(drive(), 7, of), 3)), Hypothesis((effect(kind, place, delay=0.015),))
    )
    assert abs(pull(found, "delay", 0.035)) < 3
    assert found.deviations[0]["delay"] < 2e-4
    assert found.fit.squares / found.fit.equations == pytest.approx(1, abs=0.08)
    assert np.abs(found.fit.theta[:9] / np.sqrt(np.diag(found.fit.covariance)[:9])).max() < 3.5


# laws


@pytest.fixture(scope="module")
def cubic():
    return bench(*colored(truth(drive(), "cubic_stiffness", JOINT, {"coefficient": 1e6}), 2))


@pytest.fixture(scope="module")
def recovered(cubic):
    return refitted(cubic, Hypothesis((effect("cubic_stiffness", ("b1", "b2"), coefficient=4e5),)))


def test_products_are_those_of_finite_differences(cubic):
    shot = shot_of(cubic, (effect("cubic_stiffness", ("b1", "b2"), coefficient=1e6),))
    (block,) = cubic.blocks
    weight = windows_of(block)[2]
    rng = np.random.default_rng(0)
    z = shot.coordinates.unknowns(parameter_rows([effect("cubic_stiffness", ("b1", "b2"), coefficient=1e6)]))
    theta = np.concatenate([0.02 * rng.standard_normal(9), z.ravel()])
    states = np.pad(0.01 * cubic.still * rng.standard_normal((len(block.y), 6)), ((0, 0), (0, 2)))

    def all_of(theta, states):
        return products_of(shot, [block], theta, [states], 2)[0]

    slopes, p = [], len(theta)
    some = [
        0,
        4,
        7,
        9,
        p + 1,
        p + 5,
    ]  # a mass, a damper, a spring, the coefficient, a displacement, a velocity
    for i in some:
        step = 1e-5 * (1.0 if i < p else cubic.still[i - p] / 100)
        ends = []
        for sign in (-1, 1):
            t, s = theta.copy(), states.copy()
            (t if i < p else s.T)[i if i < p else i - p] += sign * step
            ends.append(np.asarray(all_of(t, s).left))
        slopes.append(whitened(ends[1] - ends[0], weight, block.lead) / (2 * step))
    found = all_of(theta, states)
    rows = np.stack([*slopes, whitened(np.asarray(found.left), weight, block.lead)], axis=-1).reshape(
        len(weight), -1, 7
    )
    gram = np.einsum("wri,wrj->wij", rows, rows)
    own = np.asarray(found.gram)[:, [*some, -1]][:, :, [*some, -1]]
    size = np.sqrt(np.einsum("wi,wj->wij", *[np.einsum("wii->wi", gram)] * 2))
    np.testing.assert_allclose(own / size, gram / size, atol=1e-6)
    judged = whitened(np.ones_like(weight), weight, block.lead) != 0
    np.testing.assert_array_equal(found.equations, judged.sum(axis=(1, 2)))
    assert found.forces.shape == (*weight.shape[:2], 1)


def test_a_cubic_spring_is_recovered(recovered):
    assert abs(pull(recovered, "coefficient", 1e6)) < 3
    assert recovered.deviations[0]["coefficient"] < 0.01 * 1e6
    assert recovered.fit.squares / recovered.fit.equations == pytest.approx(1, abs=0.08)
    assert recovered.fit.settled
    assert np.abs(recovered.fit.theta[:9] / np.sqrt(np.diag(recovered.fit.covariance)[:9])).max() < 3.5


def test_evidence_is_for_the_true_kind_at_the_true_place(cubic, recovered):
    others = [
        effect("cubic_stiffness", ("b2", "b3"), coefficient=1e5),
        effect("quadratic_stiffness", ("b1", "b2"), coefficient=1e3),
        effect("quadratic_damping", ("b1", "b2"), coefficient=1.0),
    ]
    evidences = [refitted(cubic, Hypothesis((x,))).fit.evidence for x in others]
    evidences.append(refitted(cubic, Hypothesis()).fit.evidence)
    evidences.append(refitted(cubic, EVERY).fit.evidence)
    assert recovered.fit.evidence > max(evidences) + 100


def test_evidence_is_against_what_is_not_needed():
    """A law that is not there costs its prior, far less than it would gain were it there."""
    of = bench(*colored(exact(drive()), 4))
    with_law = refitted(of, Hypothesis((effect("cubic_stiffness", ("b1", "b2"), coefficient=1e3),)))
    assert 1 < refitted(of, Hypothesis()).fit.evidence - with_law.fit.evidence < 15
    assert abs(pull(with_law, "coefficient", 0.0)) < 3.5


def test_a_start_that_diverges_has_no_evidence(cubic):
    found = refitted(cubic, Hypothesis((effect("cubic_stiffness", ("b1", "b2"), coefficient=-1e9),)))
    assert found.fit.evidence == -np.inf
    assert found.fit.squares == np.inf
    assert not found.fit.settled
    assert found.fit.steps == 1


def test_a_law_that_lets_the_motion_grow_begins_nearer_to_none(monkeypatch, cubic):
    off = Hypothesis((effect("cubic_stiffness", ("b1", "b2"), coefficient=-1e7),))
    found = refitted(cubic, off, steps=60)
    assert abs(pull(found, "coefficient", 1e6)) < 3
    monkeypatch.setattr("jaxsid.gap.fit.HALVINGS", 0)
    assert refitted(cubic, off).fit.evidence == -np.inf


def test_states_make_room_for_effects():
    plain, own = np.arange(12.0).reshape(2, 6), np.array([[1.0, 2.0], [3.0, 4.0]])
    grown = _with_own(np.hstack([plain, own]), 6, 3)
    np.testing.assert_array_equal(grown[:, :6], plain)
    np.testing.assert_array_equal(grown[:, 6:], [[1, 0, 0, 2, 0, 0], [3, 0, 0, 4, 0, 0]])
    np.testing.assert_array_equal(_with_own(grown, 6, 1), np.hstack([plain, own]))
    np.testing.assert_array_equal(_with_own(plain, 6, 1), np.pad(plain, ((0, 0), (0, 2))))


@pytest.mark.parametrize("loud", [0, 1])
def test_the_loudest_block_is_the_one_that_is_missed_most(loud):
    u = drive(2 * BLOCKS[-1])
    y, level = colored(exact(u), 0)
    y[loud * BLOCKS[-1] + np.arange(BLOCKS[-1] // 2)] += 3 * level
    of = bench(y, level, u=u)
    assert len(of.blocks) == 2
    frozen = of._replace(tolerance=np.full(9, FIXED))
    part = loudest(frozen, refitted(frozen, Hypothesis()))
    assert part.blocks[0] is of.blocks[loud]
    assert part.states[0] is of.states[loud]


def with_guess(of, level):
    """The same bench, its noise a guess."""
    guess = Noise(np.asarray(level), np.tile([1.0, *np.zeros(MOST)], (3, 1)), 0.0, "residual")
    return as_guessed(of._replace(tolerance=np.full(9, FIXED), noises=(guess,), guesses=(guess,)))


def test_noise_is_what_a_fit_leaves_and_a_search_begins_with_the_guess():
    y, level = colored(exact(drive()), 0)
    frozen = with_guess(bench(y, level), 3 * level)
    found = refitted(frozen, Hypothesis())
    anew = weighed_anew(frozen, found)
    np.testing.assert_allclose(anew.noises[0].rms() / known(level).rms(), 1, atol=0.15)
    for of in (frozen, anew):
        weight = np.asarray(of.blocks[0].weight).max(axis=(0, 1))
        np.testing.assert_allclose(weight, 1 / of.noises[0].level, rtol=1e-12)
    back = as_guessed(anew._replace(jump=0.1))
    np.testing.assert_array_equal(back.blocks[0].weight, frozen.blocks[0].weight)
    np.testing.assert_array_equal(back.blocks[0].taps, frozen.blocks[0].taps)
    assert back.jump == np.inf
    # a motion that grows without bound tells nothing of it
    lost = refitted(frozen, Hypothesis((effect("cubic_stiffness", ("b1", "b2"), coefficient=-1e9),)))
    assert lost.fit.evidence == -np.inf
    assert weighed_anew(frozen, lost) is frozen
    # noise that something else tells of stays as it is
    sure = bench(y, level)
    assert as_guessed(sure) is sure
    assert weighed_anew(sure, found).noises == sure.noises


def test_density_is_largest_with_the_noise_that_there_is():
    y, level = colored(exact(drive()), 0)
    densities = {}
    for part in (0.7, 1.0, 1.4):
        of = with_guess(bench(y, level), part * known(level).rms())
        densities[part] = density(of, refitted(of, Hypothesis()))
        if part == 1.0:
            anew = weighed_anew(of, refitted(of, Hypothesis()))
            densities["colour"] = density(anew, refitted(anew, Hypothesis()))
            count = float((np.asarray(of.blocks[0].weight)[:, of.blocks[0].lead :] > 0).sum())
    assert densities[1.0] > max(densities[0.7], densities[1.4])
    # half of log(1 / (1 - POLE^2)) for every value, next to white noise of the same rms
    gain = (densities["colour"] - densities[1.0]) / count
    assert gain == pytest.approx(-0.5 * np.log(1 - POLE**2), rel=0.15)


def test_states_without_an_effect(cubic):
    effects = (
        effect("cubic_stiffness", ("b1", "b2"), coefficient=1e6),
        effect("sensor_gain", "s2", factor=1.0),
    )
    shot = shot_of(cubic, effects)
    nothing = np.zeros(1)
    states = (np.arange(20.0).reshape(2, 10),)
    of = Refit(Hypothesis(effects), Fit(nothing, states, 0.0, 1, np.eye(1), 0.0, 1, True), None, (), shot)
    (first,), (last,) = (states_without(of, i) for i in range(2))
    np.testing.assert_array_equal(first[0], [0, 1, 2, 3, 4, 5, 7, 9])
    np.testing.assert_array_equal(last[0], [0, 1, 2, 3, 4, 5, 6, 8])


@pytest.mark.slow
def test_two_effects_at_once(cubic):
    y = np.asarray(cubic.moved[0].y).copy()
    y[:, 2] *= 1.1
    hypothesis = Hypothesis(
        (effect("cubic_stiffness", ("b1", "b2"), coefficient=5e5), effect("sensor_gain", "s2", factor=1.0))
    )
    found = refitted(bench(y, PART * y.std(axis=0)), hypothesis, steps=60)
    assert abs(pull(found, "coefficient", 1e6)) < 3
    assert abs(pull(found, "factor", 1.1, row=1)) < 3
    assert found.fit.squares / found.fit.equations == pytest.approx(1, abs=0.08)


@pytest.mark.slow
def test_coulomb_friction_is_recovered():
    """Well damped and short: the reference goes from event to event."""
    ends = ("ground", *BODIES)
    model = lumped_model(
        BODIES,
        MASS,
        STIFFNESS,
        8 * np.array(DAMPING),
        connections=[Connection(f"c{i + 1}", ends[i : i + 2]) for i in range(3)],
        inputs=[Input("drive", "b1")],
        sensors=[Sensor(f"s{i}", body, "acceleration") for i, body in enumerate(BODIES)],
    )
    plain, u = second_order(model), drive()[:256]
    of = Chain(
        *(np.asarray(x) for x in (plain.mass, plain.damping, plain.stiffness)),
        0,
        tuple((i, "acceleration") for i in range(3)),
    )
    y = Truth(of, "coulomb_friction", (GROUND, 0), {"force": 3.0}, DT).run(u)
    found = refitted(
        bench(*colored(y, 5), u=u, model=model),
        Hypothesis((effect("coulomb_friction", ("ground", "b1"), force=1.0),)),
    )
    assert abs(pull(found, "force", 3.0)) < 3
    assert found.deviations[0]["force"] < 0.1


def test_deviations_come_from_windows_where_more_than_noise_is_left():
    y, level = colored(truth(drive(), "cubic_stiffness", JOINT, {"coefficient": 1e6}), 2)
    start = Hypothesis((effect("cubic_stiffness", ("b1", "b2"), coefficient=9e5),))
    right, wrong = (refitted(bench(y, level / part), start) for part in (1.0, 5.0))
    assert wrong.fit.squares == pytest.approx(25 * right.fit.squares, rel=0.02)
    true, said = (x.deviations[0]["coefficient"] for x in (right, wrong))
    assert 0.5 * true < said < 2 * true  # and not a fifth of it
