"""Which samples are held out: the last quarter, less where that alone holds what is to be found."""

import numpy as np
import pytest
from gap_helpers import SAMPLES, chain, drive, exact, noisy, record, with_effect

from jaxsid import diagnose
from jaxsid.gap.held_out import FEWEST, HELD_OUT, LOUDER, later_ends, seen_part, usual_end

END = 3 * SAMPLES // 4
B12 = {"between": ["b1", "b2"]}


@pytest.fixture(scope="module")
def data():
    u = drive()
    return record(u, exact(u))


def white(samples, seed=0):
    return np.random.default_rng(seed).standard_normal((samples, 3))


def ends_with(data, after):
    (end,) = later_ends([data], [END], [white(END)], [after])
    return end


def test_a_quarter_is_held_out(data):
    assert usual_end(data) == END == round((1 - HELD_OUT) * SAMPLES)
    seen = seen_part(data, END)
    np.testing.assert_array_equal(seen.y, data.y[:END])
    np.testing.assert_array_equal(seen.u, data.u[:END])
    for name in ("inputs", "outputs", "hold", "name", "dt"):
        assert getattr(seen, name) == getattr(data, name)


def test_what_is_no_louder_than_before_stays_held_out(data):
    after = white(SAMPLES - END, 1)
    assert ends_with(data, after) == END
    assert ends_with(data, 0.9 * np.sqrt(LOUDER) * after) == END


def test_a_quarter_of_what_is_louder_stays_held_out(data):
    after = white(SAMPLES - END, 1)
    after[100:180] *= 50.0
    power = np.cumsum((after**2).mean(axis=1))
    end = ends_with(data, after)
    assert power[end - END - 1] / power[-1] == pytest.approx(1 - HELD_OUT, abs=0.03)
    # whatever the unit, and with a sensor that the record lacks
    scale = np.array([1e-6, 1.0, 1e3])
    absent = np.array([0.0, 0.0, np.nan])
    assert later_ends([data], [END], [white(END) * scale], [after * scale]) == (end,)
    (without,) = later_ends([data], [END], [white(END) + absent], [after + absent])
    assert abs(without - end) < 20


def test_some_samples_always_stay(data):
    after = white(SAMPLES - END, 1)
    after[-2:] *= 1e4
    assert ends_with(data, after) == SAMPLES - FEWEST
    # nothing to compare with
    assert later_ends([data], [END], [0 * white(END)], [after]) == (END,)
    assert later_ends([data], [END], [np.nan * white(END)], [after]) == (END,)


@pytest.mark.slow
def test_a_stop_that_is_met_in_the_last_quarter_only_is_found():
    u = drive()
    u[END:] *= 5.0
    parameters = {"stiffness": 3000.0, "clearance": 0.035}
    y = with_effect(u, "end_stop", (0, 1), parameters)
    before = exact(u)
    assert np.abs(y - before)[:END].max() < 1e-6 < np.abs(y - before)[END:].max()
    found = diagnose(chain(), record(u, noisy(y)))
    assert found.verdict == "effect"
    (selected,) = found.selected()
    assert (selected["kind"], selected["place"]) == ("end_stop", B12)
    (left,) = found.causes.lefts[-1].left
    assert FEWEST <= len(left) < SAMPLES - END
    assert found.closure.fraction > 0.95


@pytest.mark.slow
def test_a_stop_met_in_the_last_quarter_only_is_found_beside_a_gain_that_explains_all_before_it():
    u = drive()
    u[END:] *= 5.0
    y = with_effect(u, "end_stop", (0, 1), {"stiffness": 3000.0, "clearance": 0.035})
    y[:, 2] *= 1.3
    found = diagnose(chain(), record(u, noisy(y)))
    assert found.verdict == "effect"
    assert {x["kind"] for x in found.selected()} == {"sensor_gain", "end_stop"}
    assert len(found.causes.lefts[-1].left[0]) < SAMPLES - END
    assert found.closure.fraction > 0.95
