"""Records less what effects do to them: the linear chain's own readings are left."""

import numpy as np
import pytest
from gap_bench import bench, colored
from gap_helpers import DT, JOINT, SAMPLES, chain, drive, exact, record
from gap_helpers import with_effect as truth

from jaxsid.gap import deflate as module
from jaxsid.gap.deflate import deflated
from jaxsid.gap.null import null_test
from jaxsid.gap.places import places_of
from jaxsid.gap.recalibrate import recalibrated
from jaxsid.gap.refit import Hypothesis, refitted
from jaxsid.mechanics.effects.catalogue import CATALOGUE
from jaxsid.mechanics.lumped import Effect


def effect(kind, place, **parameters):
    return Effect(kind, ((CATALOGUE[kind].where, place),), parameters)


def late(y, samples):
    """Readings of which the second is some samples late."""
    found = y.copy()
    found[samples:, 1] = y[:-samples, 1]
    found[:samples, 1] = 0.0
    return found


CUBIC = effect("cubic_stiffness", ("b1", "b2"), coefficient=9e5)
DELAY = effect("sensor_delay", "s1", delay=1.8 * DT)


@pytest.mark.parametrize("followed", [False, True], ids=["in a run", "in windows"])
@pytest.mark.parametrize(
    ("effects", "late_by"),
    [
        pytest.param((CUBIC,), 0, id="law"),
        pytest.param((DELAY,), 2, id="signal"),
        pytest.param((DELAY, CUBIC), 2, id="both", marks=pytest.mark.slow),
    ],
)
def test_what_effects_do_is_taken_out(effects, late_by, followed, monkeypatch):
    monkeypatch.setattr(module, "_followed", lambda bench: followed)
    u = drive()
    plain = exact(u)
    law = CUBIC in effects
    y = truth(u, "cubic_stiffness", JOINT, {"coefficient": 1e6}) if law else plain
    y = late(y, late_by) if late_by else y
    measured, level = colored(y, 3)
    of = bench(measured, level)
    found = refitted(of, Hypothesis(effects))
    (left,) = deflated([record(u, measured)], of, found)
    noise = measured - y
    gone = np.asarray(left.y) - noise - plain  # nothing, were the effects' parameters exact
    did = np.sqrt(((y - plain) ** 2).mean(axis=0))
    assert (np.sqrt((gone**2).mean(axis=0)) < np.maximum(0.02 * did, 0.5 * level)).all()
    assert (left.inputs, left.outputs) == (record(u, y).inputs, record(u, y).outputs)


@pytest.mark.slow
def test_what_a_late_input_was_before_the_record_is_no_finding():
    """An accelerometer beside the drive reads it at once: at first what nobody recorded."""
    begin, late_by = 200, 2.4 * DT
    u = drive(SAMPLES + begin)
    y = truth(u, "input_delay", 0, {"delay": late_by})[begin:]
    for seed in range(3):
        measured, level = colored(y, seed)
        of = bench(measured, level, u=u[begin:])
        found = refitted(of, Hypothesis((effect("input_delay", "drive", delay=2.2 * DT),)))
        assert found.fit.squares < 1.1 * found.fit.equations
        (delay,) = (float(x.parameters["delay"]) for x in found.hypothesis.effects)
        assert abs(delay - late_by) < 4 * found.deviations[0]["delay"]
        left = deflated([record(u[begin:], measured)], of, found)
        fit = recalibrated(chain(), left, of.noises, wide=True, given=True)
        assert null_test(fit, places_of(chain()), deflated=True).p_value > 0.01


def test_nothing_is_taken_out_of_a_record_without_effects():
    y, level = colored(exact(drive()), 0)
    of = bench(y, level)
    given = record(drive(), y)
    (same,) = deflated([given], of, refitted(of, Hypothesis()))
    assert same is given


def test_windows_stand_in_for_a_run_that_grows_without_bound(monkeypatch):
    u = drive()
    measured, level = colored(truth(u, "cubic_stiffness", JOINT, {"coefficient": 1e6}), 3)
    of = bench(measured, level)
    found = refitted(of, Hypothesis((CUBIC,)))
    given = [record(u, measured)]
    monkeypatch.setattr(module, "_followed", lambda bench: False)
    monkeypatch.setattr(module, "_run", lambda *_: [np.full_like(s, np.inf) for s in found.fit.states])
    (left,) = deflated(given, of, found)
    monkeypatch.setattr(module, "_followed", lambda bench: True)
    (followed,) = deflated(given, of, found)
    assert np.isfinite(np.asarray(left.y)).all()
    np.testing.assert_array_equal(left.y, followed.y)
