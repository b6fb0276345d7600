"""Correlations of residuals: their size and lag, what chance does, and the warning where inputs are left."""

import numpy as np
import pytest
import scipy.stats
from band_limited import band_noise, coloured
from scipy import signal

from jaxsid.pipeline.correlations import correlations
from jaxsid.pipeline.misses import cross_peaks, input_warning, own_peaks

DT, SAMPLES = 0.01, 4000
RNG = np.random.default_rng


def noise(seed, columns=1):
    return RNG(seed).standard_normal((SAMPLES, columns))


def delayed(u, samples):
    return np.concatenate([np.zeros((samples, u.shape[1])), u[:-samples]])


def whitened(e):
    """Twice as long, its spectrum divided by the root mean square of 33 lines around each."""
    X = np.fft.rfft(e - e.mean(), 2 * SAMPLES)
    starts = [max(k - 16, 0) for k in range(len(X))]
    level = np.array([np.mean(np.abs(X[k : k + 33]) ** 2) for k in starts])
    return np.fft.irfft(X * np.sqrt(SAMPLES / level), 2 * SAMPLES)


def test_the_strongest_correlation_its_lag_and_its_score():
    u = band_noise(RNG(1), SAMPLES, 1, DT, 1.0, 20.0)
    e = np.hstack([noise(2), coloured(RNG(3), (SAMPLES, 1), "low") + 0.5 * delayed(u / u.std(), 7)])
    (peaks,) = cross_peaks((correlations(e, u, DT),))
    a, b = whitened(e[:, 1]), np.pad((u[:, 0] - u.mean()) / u.std(), (0, SAMPLES))
    by_hand = np.array([np.roll(a, -k) @ b for k in range(201)]) / SAMPLES
    assert np.abs(by_hand).argmax() == 7
    np.testing.assert_allclose(peaks.value[1, 0], by_hand[7], rtol=1e-9)
    np.testing.assert_allclose(peaks.lag[1, 0], 0.07)
    # Bartlett: sums of the products of both autocorrelations
    own = [np.array([np.roll(x, -k) @ x for k in range(2 * SAMPLES)]) / SAMPLES for x in (a, b)]
    spread = np.sqrt((own[0] * own[1]).sum() / SAMPLES)
    np.testing.assert_allclose(peaks.score[1, 0], by_hand[7] / spread, rtol=1e-3)
    assert peaks.score[1, 0] > peaks.limit > peaks.score[0, 0]
    np.testing.assert_allclose(peaks.limit, scipy.stats.norm.isf(0.5e-4 / (2 * 201)), rtol=1e-9)


def test_whiteness():
    e = np.hstack([noise(4), coloured(RNG(5), (SAMPLES, 1), "low"), np.full((SAMPLES, 1), np.nan)])
    (peaks,) = own_peaks((correlations(e, noise(6), DT),))
    x = e[:, 1] - e[:, 1].mean()
    np.testing.assert_allclose(peaks.value[1], (x[1:] * x[:-1]).sum() / (x**2).sum(), rtol=1e-9)
    np.testing.assert_allclose(peaks.lag[1], DT)
    np.testing.assert_allclose(peaks.score[1], np.abs(peaks.value[1]) * np.sqrt(SAMPLES), rtol=1e-3)
    assert peaks.score[0] < peaks.limit < peaks.score[1]
    assert np.isnan(peaks.score[2])


COLOURS = {
    "white": lambda rng: rng.standard_normal((SAMPLES, 2)),
    "low": lambda rng: coloured(rng, (SAMPLES, 2), "low"),
    "high": lambda rng: coloured(rng, (SAMPLES, 2), "high"),
    "ringing": lambda rng: signal.lfilter([1], [1, -1.98, 0.99], rng.standard_normal((SAMPLES, 2)), axis=0),
    "spikes": lambda rng: rng.standard_t(3, (SAMPLES, 2)),
}
FORCES = {
    "band": lambda rng: band_noise(rng, SAMPLES, 1, DT, 1.0, 20.0),
    "chirp": lambda rng: signal.chirp(DT * np.arange(SAMPLES), 1, 40, 20)[:, None],
    "steps": lambda rng: np.repeat(rng.standard_normal(SAMPLES // 50), 50)[:, None],
}


@pytest.mark.parametrize("force", FORCES)
@pytest.mark.parametrize("colour", COLOURS)
def test_noise_of_any_colour_is_chance(colour, force):
    rng = RNG(7)
    for _ in range(40):
        (peaks,) = cross_peaks((correlations(COLOURS[colour](rng), FORCES[force](rng), DT),))
        assert peaks.score.max() < peaks.limit


def test_feedback_is_no_fault_of_the_model():
    e = noise(8)
    u = delayed(e, 5) + noise(9)
    left = correlations(e, u, DT)
    (peaks,) = cross_peaks((left,))
    assert peaks.score[0, 0] < peaks.limit
    assert np.abs(np.asarray(left.cross_correlation)).max() > 0.6


def test_what_has_no_correlation_has_no_peak():
    flat = np.hstack([noise(10), np.ones((SAMPLES, 1))])
    (peaks,) = cross_peaks((correlations(noise(11), flat, DT),))
    assert np.isfinite(peaks.score[0, 0])
    assert np.isnan(peaks.score[0, 1])
    (short,) = own_peaks((correlations(noise(12)[:3], noise(13)[:3], DT),))
    assert np.isnan(short.value).all()
    assert cross_peaks(()) == own_peaks(()) == ()


def warned(e, u, left=0.1, **options):
    given = {"records": ("a.csv",), "outputs": ("s1", "s2"), "inputs": (("f1",),)}
    left = np.full(e[0].shape[1], left)
    each = [correlations(x, y, DT) for x, y in zip(e, u, strict=True)]
    return input_warning(each, **{**given, **options}, left=left)


def test_the_warning_names_sensor_input_number_and_lag():
    u = noise(14)
    e = np.hstack([noise(15), noise(16) + 0.5 * delayed(u, 12)])
    assert warned((e[:, [0, 0]],), (u,)) == ()
    (text,) = warned((e,), (u,))
    (peaks,) = cross_peaks((correlations(e, u, DT),))
    value, score = peaks.value[1, 0], peaks.score[1, 0]
    assert f"s2 with f1, correlation {value:.2g} at a lag of 0.12 s, {score:.3g} standard deviations" in text
    assert "s1" not in text
    assert "a.csv" not in text
    # what is next to nothing is no miss, however well it follows
    assert warned((e,), (u,), left=1e-5) == ()


def test_the_worst_record_of_several_is_named_and_many_pairs_are_counted():
    u, other = noise(17), noise(18)
    quiet, loud = (noise(19, 2) + x * np.hstack([delayed(u, 3)] * 2) for x in (0.2, 2.0))
    (text,) = warned((quiet, loud), (u, u), records=("a.csv", "b.csv"), inputs=(("f1",), ("f1",)))
    assert text.count("in b.csv") == 2
    assert "in a.csv" not in text
    both = np.hstack([u, other])
    follows = np.hstack([delayed(both.sum(axis=1, keepdims=True), 2)] * 3) + noise(20, 3)
    (text,) = warned((follows,), (both,), outputs=("s1", "s2", "s3"), inputs=(("f1", "f2"),))
    assert "and of 3 more pairs" in text
