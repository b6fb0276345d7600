"""Noise of measured inputs: found for what it is, and told from what acts elsewhere or is more than any sensor's."""

from dataclasses import replace

import numpy as np
import pytest
from gap_helpers import DT, chain, drive, exact, noisy, record
from scipy import signal

from jaxsid.examples.systems import rig
from jaxsid.examples.twin import rig_record
from jaxsid.gap.examine import examine
from jaxsid.gap.innovations import coherence, innovations
from jaxsid.gap.input_noise import CERTAIN, LARGEST, input_noise, refitted, whitening
from jaxsid.gap.noise import noise_of
from jaxsid.gap.null import COMMON, _leveled, _lone_line
from jaxsid.gap.recalibrate import as_given, recalibrated
from jaxsid.mechanics.lumped import Input
from jaxsid.records import Record

SAMPLES = 4096


def measured(part, seed=0, own=0.003, pole=0.0):
    """The chain as it is, its drive measured with noise."""
    u, rng = drive(SAMPLES, seed), np.random.default_rng(seed + 50)
    n = signal.lfilter([1], [1, -pole], rng.standard_normal(SAMPLES))
    return record(u + part * u.std() * n / n.std(), noisy(exact(u), own, seed))


def beside(r):
    fit = recalibrated(chain(), [r], noise_of(chain(), [r]), wide=True)
    return _leveled(fit.settings[0], fit.linear[0]), fit.linear[0]


@pytest.mark.parametrize("pole", [0.0, pytest.param(0.8, marks=pytest.mark.slow)])
def test_the_power_is_found(pole):
    for seed in range(3):
        found = input_noise(*beside(measured(0.01, seed, pole=pole)))
        assert found.relative == pytest.approx([0.01], rel=0.15)
        assert found.plausible


def test_its_share_is_that_of_the_response_to_it():
    r = measured(0.01)
    setting, linear = beside(r)
    noise = np.fft.rfft(np.asarray(r.u) - drive(SAMPLES, 0)[:, None], axis=0) / np.sqrt(SAMPLES)
    made = np.einsum("lpi,li->lp", np.asarray(setting.spectra.driven), noise)
    share = np.sqrt((np.abs(made) ** 2).sum(axis=0) / (np.abs(np.asarray(linear.left)) ** 2).sum(axis=0))
    assert input_noise(setting, linear).share == pytest.approx(share, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("own", [0.01, 0.001])
def test_nothing_is_common_without_it(own):
    """Also where sensors are far quieter than the input: then the fit must ask for it too."""
    before, after = [], []
    for seed in range(8):
        setting, linear = beside(measured(0.01, seed, own))
        found = input_noise(setting, linear)
        (linear,) = refitted([setting], [linear], [found])
        before.append(coherence([innovations(setting, linear)])[0])
        after.append(coherence([innovations(setting, linear, input_noise(setting, linear))])[0])
    assert max(before) < 1e-12
    assert min(after) > 3e-3
    assert max(after) > 0.1


def test_what_is_made_white_has_the_covariance_of_white_noise():
    """In law, not in one draw: of lines drawn from the covariance that was found."""
    setting, linear = beside(measured(0.01))
    found = input_noise(setting, linear)
    scale, driven = np.asarray(setting.scale), np.asarray(setting.spectra.driven)[:, :, 0]
    rng = np.random.default_rng(0)
    draw = lambda *shape: (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)  # noqa: E731
    total = 0
    for _ in range(40):
        n = draw(len(scale)) * np.sqrt(found.power[:, 0])
        left = driven * n[:, None] + draw(*scale.shape) * np.sqrt(found.own) / scale
        white = np.einsum("lpq,lq->lp", whitening(setting, found), left)
        total = total + np.einsum("lp,lq->lpq", white, white.conj()) / 40
    assert total[1:-1].mean(axis=0) == pytest.approx(np.eye(3), abs=0.015)
    assert (np.abs(total - np.eye(3)) ** 2).mean() < 1.3 / 40


def of_two(u, y):
    return Record(u, y, DT, inputs=("drive", "other"), outputs=("s0", "s1", "s2"), name="two")


def steady(model, u):
    """The periodic response to two inputs."""
    r = of_two(u, np.zeros((SAMPLES, 3)))
    lines = as_given(model, [r], noise_of(model, [r])).settings[0].spectra.response
    return np.fft.irfft(np.asarray(lines) * np.sqrt(SAMPLES), SAMPLES, axis=0)


def test_two_inputs_have_noise_of_their_own():
    model = replace(chain(), inputs=(Input("drive", "b1"), Input("other", "b3")))
    u, rng = np.stack([drive(SAMPLES, 1), drive(SAMPLES, 2)], axis=1), np.random.default_rng(4)
    read = u + u.std(axis=0) * rng.standard_normal(u.shape) * [0.012, 0.004]
    r = of_two(read, noisy(steady(model, u), 0.002, 5))
    fit = recalibrated(model, [r], noise_of(model, [r]), wide=True)
    found = input_noise(_leveled(fit.settings[0], fit.linear[0]), fit.linear[0])
    assert found.relative == pytest.approx([0.012, 0.004], rel=0.15)


def test_a_measured_drive_is_agreement():
    found = examine(chain(), [measured(0.01)])
    assert found.finding == "agreement"
    assert found.null.input_noise == pytest.approx([0.01], rel=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("one", [False, True])
def test_its_resonances_are_no_lone_frequency(one):
    """Of springs that are damped little: where noise of the input is not allowed for they are."""
    model = replace(chain(), damping=0.3 * chain().damping)
    before, after = [], []
    for seed in range(5):
        u, rng = drive(SAMPLES, seed), np.random.default_rng(seed)
        lines = as_given(
            model, [record(u, np.zeros((SAMPLES, 3)))], noise_of(model, [measured(0, seed)])
        ).settings
        y = np.fft.irfft(np.asarray(lines[0].spectra.response) * np.sqrt(SAMPLES), SAMPLES, axis=0)
        r = record(u + 0.01 * u.std() * rng.standard_normal(SAMPLES), noisy(y, 0.003, seed))
        r = alone(r) if one else r
        fit = recalibrated(model, [r], noise_of(model, [r]), wide=True)
        setting, linear = _leveled(fit.settings[0], fit.linear[0]), fit.linear[0]
        before.append(_lone_line(fit, (setting,), ()).p_value)
        after.append(_lone_line(fit, (setting,), (input_noise(setting, linear),)).p_value)
    assert min(before) < 1e-4
    assert min(after) > 0.01


@pytest.mark.slow
def test_more_than_a_sensor_of_inputs_has_is_a_gap():
    found = examine(chain(), [measured(3 * LARGEST)])
    assert found.finding == "structure"
    assert found.null.input_noise == (0.0,)


@pytest.mark.slow
def test_a_random_force_elsewhere_is_no_noise_of_the_input():
    u = drive(SAMPLES, 3)
    model = replace(chain(), inputs=(Input("drive", "b1"), Input("other", "b3")))
    force = 0.01 * u.std() * np.random.default_rng(8).standard_normal(SAMPLES)
    both = Record(
        np.stack([u, force], axis=1),
        np.zeros((SAMPLES, 3)),
        DT,
        inputs=("drive", "other"),
        outputs=("s0", "s1", "s2"),
    )
    lines = as_given(model, [both], noise_of(model, [both])).settings[0].spectra.response
    y = np.fft.irfft(np.asarray(lines) * np.sqrt(SAMPLES), SAMPLES, axis=0)
    found = examine(chain(), [record(u, noisy(y, 0.002, 5))])
    assert found.finding == "structure"
    assert {t.name: t.p_value for t in found.null.tests}[COMMON] < 1e-9


@pytest.mark.slow
def test_one_sensor_tells_it_by_the_peaks_of_the_model():
    """Less than there is, as long as elements were fitted as if it were not."""
    found = [input_noise(*beside(alone(measured(0.01, seed)))) for seed in range(12)]
    assert np.median([x.relative[0] for x in found]) == pytest.approx(0.009, rel=0.15)
    assert np.median([x.seen for x in found]) > CERTAIN


@pytest.mark.slow
@pytest.mark.parametrize("pole", [0.0, 0.9])
def test_one_sensor_tells_nothing_where_there_is_none(pole):
    """Its own noise, white or not, has no such peaks."""
    seen = []
    for seed in range(12):
        r, rng = alone(measured(0.0, seed, own=0.0)), np.random.default_rng(seed)
        n = signal.lfilter([1], [1, -pole], rng.standard_normal((SAMPLES + 300, 1)), axis=0)[300:]
        y = np.asarray(r.y)
        seen.append(input_noise(*beside(replace(r, y=y + 0.01 * y.std() * n / n.std()))).seen)
    assert max(seen) < CERTAIN


# where laws were claimed as long as this noise was not allowed for
@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (22, 24, 26, 31, 32))]
)
def test_one_sensor_and_a_measured_drive_are_agreement(seed):
    found = examine(chain(), [alone(measured(0.01, seed))])
    assert found.finding == "agreement"
    assert found.null.input_noise == pytest.approx([0.01], rel=0.35)


def alone(r):
    return Record(r.u, np.asarray(r.y)[:, :1], DT, inputs=r.inputs, outputs=("s0",), name="alone")


@pytest.mark.slow
def test_a_record_of_one_sensor_beside_another_of_all_changes_nothing():
    found = examine(chain(), [measured(0.01, 1), alone(measured(0.01, 2))])
    assert found.finding == "agreement"
    assert found.null.input_noise == pytest.approx([0.01], rel=0.15)


def test_periods_of_a_measured_input_tell_its_noise_with_one_sensor():
    """What inputs of two periods differ by drives the model: it is in the noise that periods tell of."""
    u, rng = drive(SAMPLES, 2, periods=4), np.random.default_rng(9)
    read = u + 0.01 * u.std() * rng.standard_normal(SAMPLES)
    y = noisy(exact(u), 0.002, 3)[:, 1:2]
    found = examine(
        chain(), [Record(read[:, None], y, DT, inputs=("drive",), outputs=("s1",), name="periods")]
    )
    assert found.noises[0].source == "periods"
    assert found.finding == "agreement"
    quiet = examine(chain(), [Record(u[:, None], y, DT, inputs=("drive",), outputs=("s1",), name="periods")])
    assert found.noises[0].rms()[1] > 1.5 * quiet.noises[0].rms()[1]


@pytest.mark.slow
def test_the_rig_agrees_with_its_own_numbers_though_its_torque_is_measured_with_noise():
    torque = drive(4096, 7) / 10 * 3
    found = examine(rig(), [rig_record(1, demand=torque, torque_noise=0.01)])
    assert found.finding == "agreement"
    assert found.structural_p_value > 0.01
    assert found.null.input_noise == pytest.approx([0.01], rel=0.15)
