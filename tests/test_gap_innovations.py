"""Whether what a model leaves is each sensor's own, and the same throughout: as often as it should on noise."""

import numpy as np
import pytest
from gap_bench import known
from gap_helpers import chain, drive, exact, record
from scipy import signal, stats

from jaxsid.gap.innovations import LAGS, PARTS, coherence, unsteadiness
from jaxsid.gap.null import _leveled, _own, left_shares, null_test
from jaxsid.gap.places import places_of
from jaxsid.gap.recalibrate import as_given

SAMPLES = 800
POLES = [0.9, 0.5, -0.5]


def left(y):
    """A model beside what is all noise."""
    noise = known(np.ones(3))
    noise.taps[:, 1:] = 0.0
    return as_given(chain(), [record(np.zeros(len(y)), y)], [noise])


def asked(y):
    fit = left(y)
    leveled = tuple(_leveled(s, x) for s, x in zip(fit.settings, fit.linear, strict=True))
    return {t.name: t for t in _own(fit, leveled)[1]}


def white(seed, samples=SAMPLES):
    return np.random.default_rng(seed).standard_normal((samples, 3))


def coloured(seed):
    """Each sensor's noise of its own colour."""
    e = white(seed)
    return np.stack([signal.lfilter([1], [1, -p], e[:, j]) for j, p in enumerate(POLES)], axis=1)


def test_noise_of_any_colour_is_each_sensors_own_and_steady():
    every = [asked(coloured(seed)) for seed in range(60)]
    for name in ("common to sensors", "change with time"):
        p = np.array([x[name].p_value for x in every])
        assert (p < 0.1).sum() <= 13  # 6 expected, give or take 2.3
        assert p.min() > 1e-4


def test_probabilities_are_those_of_chance():
    p = [(coherence([white(s), white(s + 1000)])[0], unsteadiness([white(s)])[0]) for s in range(400)]
    for values in np.array(p).T:
        assert stats.kstest(values, "uniform").pvalue > 1e-3


def test_squares_are_those_of_correlations_by_definition():
    e = white(5, 200)[:, :2]
    total = sum(
        (np.mean([e[(t + lag) % 200, 1] * e[t, 0] for t in range(200)])) ** 2
        for lag in range(-LAGS, LAGS + 1)
    )
    assert coherence([e])[0] == pytest.approx(stats.chi2.sf(200 * total, 2 * LAGS + 1), rel=1e-9)


def test_a_force_that_several_sensors_feel_is_common_to_them():
    y, force = coloured(1), 0.5 * white(2)[:, 0]
    found = asked(y + np.stack([force, signal.lfilter([1], [1, -0.5], force), 0 * force], axis=1))
    assert found["common to sensors"].p_value < 1e-6
    assert 0.05 < found["common to sensors"].share < 1
    assert found["change with time"].p_value > 1e-3


def test_a_sensor_alone_has_nothing_in_common():
    assert coherence([white(0)[:, :1]]) == (1.0, 0.0, ())
    assert unsteadiness([np.zeros((SAMPLES, 1))]) == (1.0, 0.0, ())


def test_shares_are_those_of_the_sensor_that_has_it():
    """A quiet sensor that does what no noise does counts as little as what it has left, however loud another is."""
    u, rng = drive(SAMPLES), np.random.default_rng(3)
    y = exact(u)
    e = y.std(axis=0) * rng.standard_normal(y.shape) * [0.05, 0.05, 1e-4]
    e[300:350, 2] *= 4
    noise = known(e.std(axis=0))
    noise.taps[:, 1:] = 0.0
    fit = as_given(chain(), [record(u, y + e)], [noise])
    assert left_shares(fit) == pytest.approx([0.05, 0.05, 1.4e-4], rel=0.1)
    leveled = tuple(_leveled(s, x) for s, x in zip(fit.settings, fit.linear, strict=True))
    found = {t.name: t for t in _own(fit, leveled)[1]}
    assert found["change with time"].p_value < 1e-5
    assert found["change with time"].share < 2e-4
    assert found["common to sensors"].p_value > 1e-3


def test_what_acts_at_times_changes_with_time():
    y = coloured(3)
    y[300:350] *= 2.5
    found = asked(y)
    assert found["change with time"].p_value < 1e-5
    assert found["change with time"].share > 0.1


def test_outliers_throughout_are_steady():
    rng = np.random.default_rng(7)
    p = [unsteadiness([rng.standard_t(3, size=(SAMPLES, 3))])[0] for _ in range(60)]
    assert (np.array(p) < 0.01).sum() <= 4
    assert SAMPLES // PARTS > 2 * LAGS


def test_neither_is_asked_where_effects_were_taken_out():
    fit = left(coloured(1) + 0.5 * white(2)[:, :1])
    names = lambda **how: {t.name for t in null_test(fit, places_of(fit.model), **how).tests}  # noqa: E731
    assert names() - names(deflated=True) == {"common to sensors", "change with time"}
    assert null_test(fit, places_of(fit.model)).p_value < 1e-6
