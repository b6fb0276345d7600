"""Noise from periods, repeated records, quiet parts and residuals: its level, its colour, and which was used."""

import numpy as np
import pytest
from gap_helpers import SAMPLES, chain, drive, exact, record
from scipy.signal import lfilter

from jaxsid.checks import InputError
from jaxsid.gap.decay import without_decays
from jaxsid.gap.noise import Noise, no_louder, noise_of, period_of, quiet_part, quieter, residual_noise
from jaxsid.impulse.whitening import whitening_filter

LEVEL = 0.05


def coloured(shape, seed=0, pole=0.8):
    white = np.random.default_rng(seed).standard_normal((shape[0] + 200, shape[1]))
    return LEVEL * lfilter([1], [1, -pole], white, axis=0)[200:]


@pytest.mark.parametrize("periods", [2, 4])
def test_periods(periods):
    u = drive(periods * 512, periods=periods)
    (noise,) = noise_of(chain(), [record(u, exact(u) + coloured((len(u), 3)))])
    assert noise.source == "periods"
    np.testing.assert_allclose(noise.level, LEVEL, rtol=0.15)
    np.testing.assert_allclose(noise.taps[:, 1], -0.8, atol=0.1)
    np.testing.assert_allclose(noise.rms(), LEVEL / 0.6, rtol=0.3)


def test_motion_that_does_not_repeat_is_no_noise():
    """A contact that chatters differently in every period, in one of two records, in one alone, and in both."""
    u, rng = drive(periods=4), np.random.default_rng(3)
    white = lambda level: level * rng.standard_normal((SAMPLES, 3))  # noqa: E731
    chatter = lfilter([1.0], [1.0, -1.6, 0.9], white(0.1 * exact(u).std()), axis=0)
    restless = record(u, exact(u) + chatter + white(LEVEL))
    quiet = record(0.7 * u, 0.7 * exact(u) + white(LEVEL))
    # where no other record tells, the quietest band does: that at Nyquist's frequency, where poles make it 3.5
    quietest = np.hypot(LEVEL, 0.1 * exact(u).std() / 3.5)
    for noise in (*noise_of(chain(), [restless]), *noise_of(chain(), [restless, restless])):
        np.testing.assert_allclose(noise.rms(), quietest, rtol=0.3)
        assert noise.degrees == 0
    # noise is as loud in every band, however large a part of what sensors read
    loud = exact(u).std(axis=0)
    (noise,) = noise_of(chain(), [record(u, exact(u) + loud * rng.standard_normal((SAMPLES, 3)))])
    np.testing.assert_allclose(noise.rms(), loud, rtol=0.1)
    assert noise.degrees > 0
    for noise in noise_of(chain(), [restless, quiet]):
        np.testing.assert_allclose(noise.rms(), LEVEL, rtol=0.15)
        assert noise.degrees > 0
    # noise that is far louder in one record, as in another range of the sensors, but small beside the signal is noise
    y, little = exact(u), LEVEL / 20
    louder, fine = (record(u, y + white(x)) for x in (10 * little, little))
    assert 10 * little < 0.15 * y.std(axis=0).min()
    np.testing.assert_allclose(noise_of(chain(), [louder, fine])[0].rms(), 10 * little, rtol=0.15)


def test_repeated_records():
    u = drive()
    records = [record(u, exact(u) + coloured((SAMPLES, 3), seed)) for seed in (1, 2)]
    noises = noise_of(chain(), records)
    assert {n.source for n in noises} == {"repeated records"}
    np.testing.assert_allclose([n.level for n in noises], LEVEL, rtol=0.1)


def test_drift_without_input_is_noise_however_large():
    u = np.concatenate([np.zeros(1000), drive(1000)])
    drift = coloured((2000, 3), pole=0.98)
    y = exact(u) + drift * exact(u).std(axis=0) / drift.std(axis=0)
    (noise,) = noise_of(chain(), [record(u, y)])
    assert noise.source == "quiet part"
    assert (noise.rms() > 0.4 * exact(u).std(axis=0)).all()


def test_quiet_part():
    u = np.concatenate([np.zeros(400), drive(1000)])
    (noise,) = noise_of(chain(), [record(u, exact(u) + coloured((1400, 3)))])
    assert noise.source == "quiet part"
    np.testing.assert_allclose(noise.level, LEVEL, rtol=0.15)


def test_residual():
    u = drive()
    white = LEVEL * np.random.default_rng(0).standard_normal((SAMPLES, 3))
    (noise,) = noise_of(chain(), [record(u, exact(u) + white)])
    assert (noise.source, noise.degrees) == ("residual", 0)
    np.testing.assert_allclose(noise.level, LEVEL, rtol=0.2)


def test_an_effect_is_not_taken_for_noise():
    """A model with springs 20 % too stiff leaves much more than noise, in most of the band."""
    u = drive()
    white = LEVEL * np.random.default_rng(0).standard_normal((SAMPLES, 3))
    (noise,) = noise_of(chain(factor=1.2), [record(u, exact(u) + white)])
    assert (noise.level < 3 * LEVEL).all()


def test_a_guess_is_no_more_than_what_is_left():
    """Sensor by sensor; what was measured stands, and so does the guess for a sensor that is absent."""
    taps = np.tile([1.0, -0.5], (3, 1))
    guess = Noise(np.array([8.0, 1.0, np.nan]), np.tile([1.0, 0.0], (3, 1)), 0.0, "residual")
    left = Noise(np.array([0.7, 2.0, np.nan]), taps, 0.0, "residual")
    found = quieter(guess, left)
    np.testing.assert_array_equal(found.level, [0.7, 1.0, np.nan])
    np.testing.assert_array_equal(found.taps, [[1.0, -0.5], [1.0, 0.0], [1.0, 0.0]])
    assert (found.rms()[:2] <= np.minimum(guess.rms(), left.rms())[:2]).all()
    measured = Noise(guess.level, guess.taps, 500.0, "periods")
    np.testing.assert_array_equal(quieter(measured, left).level, guess.level)


def test_a_guess_is_no_less_than_what_tests_do_not_find():
    """Where they find 19 % of the power, the rest is 0.9 of what is left; the guess stands where it lies between."""
    taps = np.tile([1.0, -0.6], (3, 1))  # rms level / 0.8
    guess = Noise(np.array([0.1, 0.95, 8.0]), np.tile([1.0, 0.0], (3, 1)), 0.0, "residual")
    left = Noise(np.array([0.8, 0.8, 0.8]), taps, 0.0, "residual")
    found = quieter(guess, left, 0.19)
    np.testing.assert_allclose(found.rms(), [0.9, 0.95, 1.0], rtol=1e-3)
    np.testing.assert_array_equal(found.taps[:, 1], [-0.6, 0.0, -0.6])
    np.testing.assert_allclose(quieter(guess, left, 2.0).rms(), [0.1, 0.95, 1.0], rtol=1e-3)


def test_noise_that_was_guessed_is_no_louder_than_what_is_left_of_other_samples():
    taps = np.tile([1.0, -0.8], (3, 1))  # rms level / 0.6
    left = np.column_stack([np.full(400, 0.3), np.full(400, 9.0), np.full(400, np.nan)])
    left[::2, 0] = np.nan  # where nothing was measured
    found = no_louder(Noise(np.array([0.6, 0.6, np.nan]), taps, 0.0, "residual"), left)
    np.testing.assert_allclose(found.rms(), [0.3, 1.0, np.nan], rtol=1e-3)
    np.testing.assert_array_equal(found.taps, taps)


@pytest.mark.parametrize(("part", "stands"), [(1.1, True), (0.8, True), (0.5, False)])
def test_noise_that_was_measured_stands_unless_far_less_is_left_of_other_samples(part, stands):
    """An impact may come a little later in the next period, as noise that it is not."""
    measured = Noise(np.array([0.6, 0.6]), np.tile([1.0, -0.8], (2, 1)), 500.0, "periods")
    found = no_louder(measured, np.column_stack([np.full(400, part), np.full(400, 9.0)]))
    np.testing.assert_allclose(found.rms(), [1.0 if stands else part, 1.0], rtol=1e-3)
    assert (found.degrees, found.source) == (measured.degrees, measured.source)
    # what takes up noise itself refutes none
    still = no_louder(measured, np.full((400, 2), part), 0.0)
    np.testing.assert_array_equal(still.level, measured.level)


def test_lines_have_the_deviation_that_is_said():
    signals = coloured((8192, 2), 3)
    noise = residual_noise(signals)
    lines = np.fft.rfft(signals, axis=0) / np.sqrt(len(signals))
    omega = 2 * np.pi * np.arange(len(lines)) / len(signals)
    whitened = np.abs(lines / noise.deviation(omega, 1.0)) ** 2
    thirds = [x.mean() for x in np.array_split(whitened, 6)]
    np.testing.assert_allclose(thirds, 1.0, atol=0.1)


def comes_and_goes(what, samples):
    """What a law may leave: a sine whose frequency goes by steps, one at the end alone, a burst."""
    t = np.arange(samples)
    sine = np.sin(2 * np.pi * np.cumsum(np.repeat(np.linspace(0.01, 0.2, 12), -(-samples // 12))[:samples]))
    burst = np.exp(-(((t - samples / 2) / 200) ** 2)) * np.random.default_rng(9).standard_normal(samples)
    return {"steps": sine, "slight": 0.1 * sine, "late": sine * (t > 0.83 * samples), "burst": burst}[what]


@pytest.mark.parametrize("pole", [0.0, 0.9])
@pytest.mark.parametrize("what", ["steps", "slight", "late", "burst"])
def test_what_comes_and_goes_is_no_noise(what, pole):
    noise = 0.02 * lfilter([1.0], [1.0, -pole], np.random.default_rng(4).standard_normal(6000))
    left = noise + comes_and_goes(what, 6000)
    found = residual_noise(left[:, None])
    np.testing.assert_allclose(found.rms() / noise.std(), 1, atol=0.15)
    np.testing.assert_allclose(found.level / 0.02, 1, atol=0.15)


@pytest.mark.parametrize("shape", [(1, 20), (1, 500), (1, 800), (1, 6000), (30, 20), (30, 128)])
@pytest.mark.parametrize("pole", [0.0, 0.6, 0.95])
def test_noise_that_is_there_throughout_is_all_of_what_is_left(pole, shape):
    for seed in range(20):
        white = np.random.default_rng(seed).standard_normal((shape[0], shape[1] + 200))
        left = lfilter([1.0], [1.0, -pole], white)[:, 200:, None]
        found = residual_noise(left)
        np.testing.assert_array_equal(found.taps[0], whitening_filter(left[:, :, 0] - left.mean()))


@pytest.mark.parametrize("period", [256, 300])
def test_period_is_found_in_a_noisy_input(period):
    rng = np.random.default_rng(0)
    u = np.tile(rng.standard_normal((period, 2)), (5, 1))[: int(4.3 * period)]
    assert period_of(u + 0.005 * rng.standard_normal(u.shape)) == period


def test_no_period_where_there_is_none():
    t = np.arange(2000) * 0.01
    assert period_of(np.sin(t**2)[:, None]) is None
    assert period_of(np.exp(-t)[:, None]) is None
    assert period_of(np.zeros((2000, 1))) is None
    assert period_of(np.random.default_rng(0).standard_normal((2000, 1))) is None


def test_quiet_parts():
    u = np.concatenate([np.zeros(200), np.ones(100)])[:, None]
    assert quiet_part(u) == slice(0, 200)
    assert quiet_part(u[100:]) is None
    assert quiet_part(0 * u) == slice(0, 300)


def test_absent_sensors_have_none():
    u = drive()
    y = exact(u) + coloured((SAMPLES, 3))
    y[:, 1] = np.nan
    (noise,) = noise_of(chain(), [record(u, y)])
    assert np.isnan(noise.level).tolist() == [False, True, False]


def test_bad_input():
    u = drive(200)
    with pytest.raises(InputError, match="at least one record"):
        noise_of(chain(), [])
    y = exact(u)
    y[7, 1] = np.nan
    with pytest.raises(InputError, match=r"s1.*NaN"):
        noise_of(chain(), [record(u, y)])
    with pytest.raises(InputError, match="too little"):
        noise_of(chain(), [record(u[:20], y[20:40])])


@pytest.mark.parametrize("periods", [2, 3])
@pytest.mark.parametrize("level", [0.0, LEVEL, 20 * LEVEL])
def test_noise_from_periods_does_not_hang_on_the_model(periods, level):
    """From rest the first period differs from the next by a free decay, whose frequencies the model need not know."""
    u = drive(periods * 512, periods=periods)
    white = level * np.random.default_rng(0).standard_normal((len(u), 3))
    y = exact(u) + white
    (noise,) = noise_of(chain(factor=1.03), [record(u, y)])
    assert noise.source == "periods"
    np.testing.assert_allclose(noise.rms(), level, rtol=0.1, atol=1e-6 * y.std())


def test_exponentials_are_taken_out_exactly_and_noise_is_not():
    t = np.arange(900)
    modes = np.stack([np.exp(-0.002 * t) * np.cos(0.03 * t), 0.999**t, np.sin(0.4 * t + 1)], axis=1)
    signal = modes @ np.random.default_rng(0).standard_normal((3, 4))
    assert np.abs(without_decays(signal, 5, 0.5)).max() < 1e-9 * np.abs(signal).max()
    white = np.random.default_rng(1).standard_normal((900, 4))
    both = without_decays(signal + 0.01 * white, 5, 0.5)
    np.testing.assert_allclose(both.std(axis=0), 0.01, rtol=0.05)
    alone = without_decays(white, 5, 0.5)
    np.testing.assert_allclose(alone.std(axis=0), 1.0, rtol=0.05)


@pytest.mark.parametrize("samples", [6, 40])
def test_too_few_samples_are_left_as_they_are(samples):
    signal = np.random.default_rng(0).standard_normal((samples, 1))
    left = without_decays(signal, 6, 1.0)
    assert left.shape == signal.shape
    assert np.isfinite(left).all()
