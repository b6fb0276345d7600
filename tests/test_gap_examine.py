"""Agreement, wrong parameters and missing effects told apart; the gap by sensor, frequency, time, amplitude."""

import itertools
import json

import numpy as np
import pytest
from gap_helpers import DT, JOINT, SAMPLES, chain, drive, exact, noisy, record, with_effect

from jaxsid.checks import InputError
from jaxsid.gap.examine import examine
from jaxsid.gap.measure import gap_of, is_free_or_unstable, third_octaves
from jaxsid.gap.noise import noise_of
from jaxsid.gap.recalibrate import as_given, recalibrated
from jaxsid.mechanics.lumped import Input, Sensor, lumped_model


@pytest.mark.parametrize("periods", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_agreement(periods):
    u = drive(SAMPLES, periods=periods)
    found = examine(chain(), record(u, noisy(exact(u))))
    assert found.finding == "agreement"
    assert found.locations is None
    assert min(found.nominal_p_value, found.structural_p_value) > 0.01
    assert 0.95 < found.before.total < 1.1


def test_wrong_stiffness_is_an_error_of_parameters():
    u = drive()
    found = examine(chain(factor=1.05), record(u, noisy(exact(u))))
    assert found.finding == "parameters"
    assert found.before.total > 3
    assert found.recalibrated.total < 1.1
    np.testing.assert_allclose(found.refit.stiffness, chain().stiffness, rtol=0.02)


@pytest.mark.slow
def test_cubic_spring_is_a_matter_of_structure():
    u = drive()
    y = noisy(with_effect(u, "cubic_stiffness", JOINT, {"coefficient": 1e6}))
    found = examine(chain(), record(u, y))
    assert found.finding == "structure"
    assert found.locations is not None
    assert found.locations.ranked[0].place.ends == ("b1", "b2")
    written = json.loads(json.dumps(found.as_dict()))
    assert written["locations"][0]["place"] == {"between": ["b1", "b2"]}
    assert set(written["gap"]) >= {
        "before",
        "noise_floor",
        "p_value",
        "by_frequency",
        "by_amplitude",
        "by_time",
    }
    assert written["gap"]["before"]["s0"] > 0.05


def test_initial_motion_is_no_gap():
    u = drive()
    y = exact(u, start=[0.02, 0.0, -0.03, 0.3, 0.0, 0.1])
    assert examine(chain(), record(u, noisy(y))).finding == "agreement"


def measured_gap(y, u):
    noises = noise_of(chain(), [record(u, y)])
    return gap_of(as_given(chain(), [record(u, y)], noises), [record(u, y)])


def test_the_gap_lies_where_it_was_put():
    u = drive()
    y = noisy(exact(u))
    t = np.arange(SAMPLES) * DT
    y[:, 1] += np.where(t > t[-1] / 2, 0.2 * y[:, 1].std() * np.sin(2 * np.pi * 30 * t), 0.0)
    gap = measured_gap(y, u)
    assert gap.noise_units["s1"] > 3 > gap.noise_units["s0"]
    worst = max(gap.by_frequency, key=lambda row: row["noise_units"])
    assert worst["sensor"] == "s1"
    assert worst["band_hz"][0] < 30 < worst["band_hz"][1]
    assert worst["significant"]
    late = [row["noise_units"] for row in gap.by_time if row["sensor"] == "s1" and row["from_s"] > t[-1] / 2]
    early = [row["noise_units"] for row in gap.by_time if row["sensor"] == "s1" and row["to_s"] < t[-1] / 2]
    assert min(late) > 2 * max(early)
    assert {row["of"] for row in gap.by_amplitude} == {"displacement", "velocity"}


def test_nrmse_is_the_noise_of_a_right_model():
    u = drive()
    gap = measured_gap(noisy(exact(u), 0.02), u)
    np.testing.assert_allclose(list(gap.nrmse.values()), 0.02, rtol=0.1)
    np.testing.assert_allclose(list(gap.noise_floor.values()), 0.02, rtol=0.2)
    np.testing.assert_allclose([row["noise_units"] for row in gap.by_horizon], 1.0, rtol=0.15)
    assert [row["name"] for row in gap.by_horizon][:: len(gap.by_horizon) - 1] == ["one step", "free run"]
    assert not gap.windowed


def test_free_bodies_are_judged_by_windows():
    free = lumped_model(["m"], [2.0], inputs=[Input("f", "m")], sensors=[Sensor("s0", "m", "displacement")])
    assert is_free_or_unstable(free)
    assert not is_free_or_unstable(chain())


def test_refit_recovers_the_parameters():
    u = drive()
    data = [record(u, noisy(exact(u), 0.005))]
    model = chain(factor=0.9)
    fit = recalibrated(model, data, noise_of(model, data), wide=True)
    truth = np.concatenate([chain().mass, chain().damping, chain().stiffness])
    nominal = np.concatenate([model.mass, model.damping, model.stiffness])
    error = (fit.change - (truth / nominal - 1)) / np.sqrt(np.diag(fit.covariance))
    assert np.abs(error).max() < 4
    assert np.abs(fit.change[6:] - 1 / 9).max() < 0.01


def test_third_octaves_cover_without_gaps():
    bands = third_octaves(1.0, 100.0)
    assert bands[0][0] <= 1.0
    assert bands[-1][1] >= 100.0
    assert all(abs(a[1] - b[0]) < 1e-9 for a, b in itertools.pairwise(bands))


def test_bad_input():
    with pytest.raises(InputError, match="at least one record"):
        examine(chain(), [])
