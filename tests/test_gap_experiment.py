"""The next experiment: what tells two laws apart, and that nothing tells one law from itself."""

import numpy as np
import pytest
from gap_bench import bench, colored
from gap_helpers import DT, JOINT, SENSED, chain, drive, record
from gap_helpers import with_effect as truth

from jaxsid.gap.experiment import _menu, _sensor, experiment_between
from jaxsid.gap.ranking import Explanation
from jaxsid.gap.refit import Hypothesis, refitted
from jaxsid.mechanics.lumped import Effect

PLACE = (("between", ("b1", "b2")),)
THIRD, THRICE = "the same input at a third of its level", "the same input at three times its level"


@pytest.fixture(scope="module")
def measured():
    u = drive()
    y, level = colored(truth(u, "cubic_stiffness", JOINT, {"coefficient": 1e6}), 2)
    return record(u, y), bench(y, level)


@pytest.fixture(scope="module")
def menu(measured):
    data, records = measured
    return _menu(records, data)


def test_inputs_are_like_the_one_that_was_used(measured, menu):
    used = np.asarray(measured[0].u)
    assert len(menu) == 5
    assert {u.shape for u in menu.values()} == {used.shape}
    np.testing.assert_allclose(menu[THIRD] * 9, menu[THRICE])
    for name in menu.keys() - {THIRD, THRICE}:
        assert np.sqrt((menu[name] ** 2).mean()) == pytest.approx(np.sqrt((used**2).mean()), rel=0.35)


def test_a_multisine_covers_the_modes_and_ends_there(menu):
    (many,) = (u for name, u in menu.items() if "multisine" in name)
    power = np.abs(np.fft.rfft(many[:, 0])) ** 2
    f = np.fft.rfftfreq(len(many), DT)
    stiffness = np.array([[3500.0, -1500, 0], [-1500, 2500, -1000], [0, -1000, 1000]])
    modes = np.sqrt(np.linalg.eigvals(np.diag([1 / 1.0, 1 / 1.2, 1 / 0.8]) @ stiffness)) / 2 / np.pi
    inside = (f > 0) & (f < 1.4 * modes.max())
    assert power[inside].min() > 0.1 * power.max()
    assert power[f > 1.6 * modes.max()].max() < 1e-12 * power.max()


@pytest.mark.slow
def test_what_grows_with_the_motion_is_told_at_high_level(measured):
    data, records = measured
    cubic = Effect("cubic_stiffness", PLACE, {"coefficient": 1e6})
    coulomb = Effect("coulomb_friction", PLACE, {"force": 1.0})
    one, other = (
        Explanation(e.kind, dict(PLACE), refitted(records, Hypothesis((e,))), 0.0, 0.5, 1.0)
        for e in (cubic, coulomb)
    )
    found = experiment_between(one, other, records, [data])
    assert found.compared[THRICE] > 10 * found.compared[THIRD]
    assert found.told == max(found.compared.values()) == found.compared[found.name]
    np.testing.assert_array_equal(np.asarray(found.record.u), _menu(records, data)[found.name])
    # of itself nothing tells it, but for the pull of the priors of its numbers
    same = experiment_between(one, one, records, [data])
    assert max(same.compared.values()) < 0.05 < 1e-3 * found.told
    assert found.sensor is not None
    assert same.sensor == (same.sensor[0], 0.0)


@pytest.mark.slow
def test_no_further_sensor_where_all_displacements_are_read(measured):
    data, records = measured
    fit = refitted(records, Hypothesis((Effect("cubic_stiffness", PLACE, {"coefficient": 1e6}),)))
    all_read = chain(tuple((body, "displacement") for body, _ in SENSED))
    assert _sensor(fit, fit, records._replace(model=all_read), data, 0) is None
