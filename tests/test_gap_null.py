"""The test for a lone frequency: as often as it should on noise, and wherever the frequency lies between two lines."""

import numpy as np
import pytest
from gap_bench import known
from gap_helpers import DT, chain, record

from jaxsid.gap.null import _lone_line
from jaxsid.gap.recalibrate import as_given

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


def test_low_frequencies_are_no_lone_one_at_the_other_end():
    slow = np.cumsum(white(0), axis=0)
    assert lone(slow).p_value > 1e-3


def test_the_shortest_records_have_a_test_too():
    assert 0 < lone(white(0)[:64]).p_value <= 1
