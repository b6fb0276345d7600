"""Which samples are held out: the last quarter, less where that alone holds what is to be found."""

import numpy as np
import pytest
from gap_helpers import DT, SAMPLES, chain, drive, exact, noisy, record, with_effect
from scipy.signal import cont2discrete

from jaxsid import diagnose
from jaxsid.gap.examine import examine
from jaxsid.gap.held_out import FEWEST, HELD_OUT, LOUDER, later_ends, seen_part, usual_end
from jaxsid.gap.later import later_than_agreed
from jaxsid.mechanics.lumped import Connection, Input, Sensor, lumped_model, second_order
from jaxsid.records import Record

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
def test_what_comes_last_on_a_free_axis_is_seen_beside_its_drift():
    """It drifts away by far more, which a long simulation would take for what is left of the samples seen."""
    model = lumped_model(
        ["b1", "b2"],
        [1.0, 2.0],
        [300.0],
        [0.5],
        connections=[Connection("joint", ("b1", "b2"))],
        inputs=[Input("drive", "b1", "zero")],
        sensors=[Sensor(f"v{b}", b, "velocity") for b in ("b1", "b2")],
    )
    plain = second_order(model)
    M, D, K = (np.asarray(x) for x in (plain.mass, plain.damping, plain.stiffness))
    inverse = np.linalg.inv(M)
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ K, -inverse @ D]])
    B = np.concatenate([np.zeros((2, 2)), inverse])
    velocities = np.eye(4)[2:]
    step = cont2discrete((A, B, velocities, np.zeros((2, 2))), DT)[:2]
    rng, whole = np.random.default_rng(0), []
    for burst in (0.0, 0.3):
        pushes = np.column_stack([drive(), np.zeros(SAMPLES)])
        pushes[END + 50 : END + 100, 1] = burst * pushes[:, 0].std()
        x, y = np.zeros(4), []
        for push in pushes:
            y.append(x[2:])
            x = step[0] @ x + step[1] @ push
        y = np.array(y)
        y += 0.001 * y.std(axis=0) * rng.standard_normal(y.shape)
        whole.append(Record(pushes[:, :1], y, DT, inputs=("drive",), outputs=("vb1", "vb2"), name="free"))
    seen = [[seen_part(r, END)] for r in whole]
    ends = [later_than_agreed(model, s, [r], examine(model, s)) for s, r in zip(seen, whole, strict=True)]
    assert ends[0] == (END,)
    assert END + 50 < ends[1][0] < END + 150


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
