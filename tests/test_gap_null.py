"""Tests for a lone frequency, a small offset, and elements off by more than they may be, as often as they should."""

import jax.numpy as jnp
import numpy as np
import pytest
from gap_bench import known
from gap_helpers import DT, chain, drive, exact, fed_back, noisy, record
from scipy.linalg import eigh
from scipy.special import gammaincc

from jaxsid.gap.noise import Noise, noise_of
from jaxsid.gap.null import _lone_line, farthest_test, null_test, ratio_law
from jaxsid.gap.places import places_of
from jaxsid.gap.recalibrate import as_given, recalibrated
from jaxsid.mechanics.lumped import second_order
from jaxsid.physical.elements import element_matrices, with_values

SAMPLES = 800


def lone(y):
    noise = known(np.ones(3))
    noise.taps[:, 1:] = 0.0
    return _lone_line(as_given(chain(), [record(np.zeros(len(y)), y)], [noise]), (), ())


def white(seed):
    return np.random.default_rng(seed).standard_normal((SAMPLES, 3))


def test_white_noise_holds_none():
    p = np.array([lone(white(seed)).p_value for seed in range(200)])
    # at most 20 of 200 expected, give or take 4.2
    assert (p < 0.1).sum() <= 33
    assert p.min() > 1e-5


@pytest.mark.parametrize("between", [0.0, 0.25, 0.5])
def test_a_lone_frequency_is_found_on_and_between_lines(between):
    omega = 2 * np.pi * (100 + between) / (SAMPLES * DT)
    tone = np.sin(omega * DT * np.arange(SAMPLES))
    found = lone(white(0) + 2.0 * tone[:, None] * [0.0, 1.0, 0.0])
    assert found.p_value < 1e-8
    # its part of what is left of that sensor, next to a response that is all of it
    assert found.share == pytest.approx(np.sqrt(2 / 3), abs=0.1)


def test_a_frequency_that_records_share_is_found_where_one_alone_is_not_sure():
    """Of records of unlike lengths and sensors; what each has at a frequency of its own is chance."""
    noise = known(np.ones(3))
    noise.taps[:, 1:] = 0.0

    def p_of(first, second):
        records = []
        for seed, hertz, samples in ((1, first, SAMPLES), (2, second, 600)):
            tone = 0.45 * np.sin(2 * np.pi * hertz * DT * np.arange(samples))
            y = white(seed)[:samples] + tone[:, None] * [0.0, 1.0, 0.0]
            if seed == 2:
                y[:, 2] = np.nan
            records.append(record(np.zeros(samples), y))
        return _lone_line(as_given(chain(), records, [noise, noise]), (), ()).p_value

    assert p_of(17.3, 17.3) < 1e-3
    assert p_of(17.3, 31.1) > 5e-3


@pytest.mark.parametrize(("damping", "found"), [(4.0, True), (1e-4, False)])
def test_a_tone_that_noise_took_for_its_colour_is_found_but_not_a_mode_that_rings(damping, found):
    """At the second mode of a model that damps it, or of one where noise shakes it as long as the record lasts."""
    elements = element_matrices(chain())
    quantity = np.array([x.quantity == "damping" for x in elements.listed])
    nominal = np.asarray(elements.nominal)
    model = with_values(chain(), jnp.asarray(np.where(quantity, damping * nominal, nominal)))
    plain = second_order(model)
    omega = np.sqrt(eigh(plain.stiffness, plain.mass, eigvals_only=True)[1])
    tone = 3 * np.sin(omega * DT * np.arange(SAMPLES))[:, None] * [0.0, 1.0, 0.0]
    # a filter of two poles on that frequency, which noise that holds a tone is taken for
    pole = 0.998 * np.exp(1j * omega * DT)
    taps = np.array([[1.0, 0.0, 0.0], [1.0, -2 * pole.real, abs(pole) ** 2], [1.0, 0.0, 0.0]])
    noise = Noise(np.array([0.1, 1.0, 0.1]), taps, 0.0, "residual")
    p = _lone_line(
        as_given(model, [record(np.zeros(SAMPLES), tone + 0.1 * white(3))], [noise]), (), ()
    ).p_value
    assert p < 1e-20 if found else p > 1e-6


@pytest.mark.slow
def test_several_records_of_white_noise_hold_none():
    noise = known(np.ones(3))
    noise.taps[:, 1:] = 0.0

    def p_of(seed):
        records = [record(np.zeros(n), white(2 * seed + i)[:n]) for i, n in enumerate((SAMPLES, 500))]
        return _lone_line(as_given(chain(), records, [noise, noise]), (), ()).p_value

    p = np.array([p_of(seed) for seed in range(1000, 1100)])
    # at most 10 of 100 expected, give or take 3
    assert (p < 0.1).sum() <= 20
    assert p.min() > 1e-4


def test_low_frequencies_are_no_lone_one_at_the_other_end():
    slow = np.cumsum(white(0), axis=0)
    assert lone(slow).p_value > 1e-3


def test_the_shortest_records_have_a_test_too():
    assert 0 < lone(white(0)[:64]).p_value <= 1


VELOCITIES = tuple((body, "velocity") for body in range(3))


@pytest.mark.parametrize(("offset", "found"), [(0.0, False), (1.0, True)])
def test_an_offset_as_large_as_the_noise_is_found(offset, found):
    """In the mean of a thousand samples it is thirty times the noise, and the only line that holds it."""
    u = drive(seed=1)
    y = noisy(exact(u, VELOCITIES), seed=1)
    y[:, 1] += offset * 0.01 * y[:, 1].std()
    records = [record(u, y, VELOCITIES)]
    model = chain(VELOCITIES)
    fit = recalibrated(model, records, noise_of(model, records), wide=True)
    p = null_test(fit, places_of(model)).p_value
    assert p < 1e-6 if found else p > 0.01


def test_noise_that_a_controller_feeds_back_is_no_law_of_inputs_or_sensors():
    """What is left then goes by the inputs to come, but not by those before."""
    model = chain(VELOCITIES)
    size = 0.1 * exact(drive(), VELOCITIES).std(axis=0)
    every = []
    for seed in range(4):
        noise = size * np.random.default_rng(seed).standard_normal((1024, 3))
        records = [record(*fed_back(drive(seed=seed), noise, 20.0, VELOCITIES), VELOCITIES)]
        fit = recalibrated(model, records, noise_of(model, records), wide=True)
        tests = null_test(fit, places_of(model)).tests
        every += [t.p_value for t in tests if "input" in t.name or "sensor s" in t.name]
    # of four tests in four records
    assert len(every) == 16
    assert min(every) > 1e-3


@pytest.mark.parametrize("told", [9, 2, 1])
def test_elements_within_their_tolerance_are_as_far_off_as_chance_has_it(told):
    """Of linear models in closed form, with as many combinations of elements told by the records as that."""
    rng, draws = np.random.default_rng(told), 4000
    near, far = np.repeat([0.005, 0.05], [6, 3]), np.repeat([0.3, 1.0], [6, 3])
    slopes = rng.standard_normal((30, told)) @ rng.standard_normal((told, 9)) * 10.0 ** rng.uniform(1, 4, 9)
    information = slopes.T @ slopes
    scale, degrees = ratio_law(information, near, far)
    assert scale * degrees == pytest.approx(told, rel=0.1)
    y = slopes @ (near[:, None] * rng.standard_normal((9, draws))) + rng.standard_normal((30, draws))
    within = np.linalg.inv(np.eye(30) + (slopes * near**2) @ slopes.T)
    freely = np.eye(30) - slopes @ np.linalg.solve(information + np.diag(far**-2.0), slopes.T)
    ratio = (y * (within @ y)).sum(axis=0) - ((freely @ y) ** 2).sum(axis=0)
    p = gammaincc(degrees / 2, np.maximum(ratio, 0.0) / scale / 2)
    for level in (0.5, 0.05, 0.01):
        spread = np.sqrt(level * (1 - level) / draws)
        assert abs((p < level).mean() - level) < 4 * spread


@pytest.mark.parametrize("told", [9, 2, 0])
def test_one_element_among_many_is_found_as_far_off_as_chance_has_it(told):
    """At most as often as said, and nearly so where each is told apart; what the sum hides is found."""
    rng, draws = np.random.default_rng(told + 1), 4000
    near = np.repeat([0.005, 0.05], [6, 3])
    slopes = (
        rng.standard_normal((30, 9)) * np.where(np.arange(9) < told, 1e3, 0.0) / np.repeat([1, 10], [6, 3])
    )
    information = slopes.T @ slopes
    gain = np.linalg.solve(information + np.diag(near**-2.0), slopes.T)
    x = near[:, None] * rng.standard_normal((9, draws))
    noise = rng.standard_normal((30, draws))
    p = np.array([farthest_test(c, information, near) for c in (gain @ (slopes @ x + noise)).T])
    for level in (0.05, 0.01):
        spread = np.sqrt(level * (1 - level) / draws)
        assert (p < level).mean() < level + 4 * spread
        if told == 9:
            assert (p < level).mean() > level - 4 * spread
    if told:
        x[0] = 6 * near[0]
        p = np.array([farthest_test(c, information, near) for c in (gain @ (slopes @ x + noise)).T])
        assert (p < 0.001).mean() > 0.9
