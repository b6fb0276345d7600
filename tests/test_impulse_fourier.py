"""Averaged spectra and their impulse response against scipy and exact periodic cases."""

import jax.numpy as jnp
import numpy as np
import pytest
from impulse_truth import CHAIN, error, markov, respond
from scipy import signal

from jaxsid.checks import InputError
from jaxsid.impulse.fourier import Fourier
from jaxsid.impulse.spectra import COSINES, coherence, frequency_response, spectra, window_samples
from jaxsid.records import Record

DT = 0.02


def random_record(samples=2000, inputs=3, noise=0.05, seed=0):
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((samples, inputs))
    y = respond(CHAIN, DT, np.pad(u, ((0, 0), (0, 3 - inputs))))
    return Record(u, y + noise * y.std(axis=0) * rng.standard_normal(y.shape), DT)


@pytest.mark.parametrize("window", list(COSINES))
def test_windows_are_those_of_scipy(window):
    np.testing.assert_allclose(window_samples(window, 33), signal.get_window(window, 33), atol=1e-9)


@pytest.mark.parametrize("segment", [256, 255])
@pytest.mark.parametrize("window", ["hann", "boxcar"])
def test_spectra_are_those_of_scipy(segment, window):
    record = random_record()
    S = spectra([record], segment=segment, overlap=0.5, window=window, detrend=True, periods=None)
    u, y = np.asarray(record.u), np.asarray(record.y)
    # scipy rounds the overlap to whole samples, as is done here.
    options = {"fs": 1 / DT, "window": window, "nperseg": segment, "noverlap": round(segment / 2)}
    f, uu = signal.welch(u[:, 0], **options)
    _, yu = signal.csd(u[:, 1], y[:, 2], **options)
    np.testing.assert_allclose(S.frequencies, f)
    np.testing.assert_allclose(S.uu[:, 0, 0], uu, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(S.yu[:, 2, 1], yu, rtol=1e-9, atol=1e-12)


def test_coherence_is_that_of_scipy():
    record = random_record()
    f, ordinary, multiple = coherence(record, segment=200, detrend=True)
    theirs = signal.coherence(record.u[:, 0], record.y[:, 1], fs=1 / DT, nperseg=200)
    np.testing.assert_allclose(f, theirs[0])
    np.testing.assert_allclose(ordinary[:, 1, 0], theirs[1], rtol=1e-8)
    assert np.all(multiple >= ordinary.max(axis=2) - 1e-9)


def test_multiple_coherence_of_one_input_is_the_ordinary_one():
    found = frequency_response(random_record(inputs=1), segment=200)
    np.testing.assert_allclose(found.multiple_coherence, found.coherence[..., 0], atol=1e-10)


def periodic_record(periods, noise=0.0):
    """Three independent periodic forces; records of whole periods after the transient."""
    rng = np.random.default_rng(1)
    n = 2000
    records = []
    for _ in range(3):
        u = np.tile(rng.standard_normal((n, 3)), (periods + 10, 1))
        y = respond(CHAIN, DT, u)[10 * n :]
        y = y + noise * y.std(axis=0) * rng.standard_normal(y.shape)
        records.append(Record(u[10 * n :], y, DT))
    return records


@pytest.mark.parametrize("estimator", ["h1", "h2", "hv"])
def test_whole_periods_give_the_exact_response(estimator):
    h = Fourier(estimator=estimator, periods=2)(periodic_record(2), samples=500).h
    n = 2000
    truth = markov(CHAIN, DT, 10 * n).reshape(10, n, 3, 3).sum(axis=0)[:500]  # what wraps around, included
    assert error(h, truth) < 1e-6


def test_periods_show_the_noise():
    records = periodic_record(4, noise=0.02)
    ir = Fourier(periods=4)(records)
    expected = 0.02 * np.sqrt(np.mean([np.asarray(r.y).var(axis=0) for r in records], axis=0))
    np.testing.assert_allclose(ir.noise_std, expected, rtol=0.05)


def noisy_gain(on_input, on_output, samples=40000):
    """A static gain 2 with white noise on what is measured."""
    rng = np.random.default_rng(3)
    u = rng.standard_normal((samples, 1))
    y = 2 * u + on_output * rng.standard_normal((samples, 1))
    return Record(u + on_input * rng.standard_normal((samples, 1)), y, 1.0)


@pytest.mark.parametrize(
    ("estimator", "on_input", "on_output", "gain"),
    [
        ("h1", 0.0, 1.0, 2.0),
        ("h1", 0.5, 0.0, 2 / 1.25),  # H1 is low by 1 + noise / signal of the input
        ("h2", 0.5, 0.0, 2.0),
        ("h2", 0.0, 1.0, 2 * 1.25),
        ("hv", 0.5, 1.0, 2.0),  # equal noise-to-signal ratios
    ],
)
def test_each_estimator_is_unbiased_for_its_noise(estimator, on_input, on_output, gain):
    found = frequency_response(noisy_gain(on_input, on_output), estimator=estimator, segment=64)
    assert np.mean(found.H[2:-2, 0, 0].real) == pytest.approx(gain, rel=0.01)


def test_h2_of_more_outputs_than_inputs_is_row_by_row():
    record = random_record(inputs=1)
    both = frequency_response(record, estimator="h2", segment=200).H
    alone = frequency_response(Record(record.u, record.y[:, 1:2], DT), estimator="h2", segment=200).H
    np.testing.assert_allclose(both[:, 1:2], alone, rtol=1e-9)


def test_noise_psd_from_coherence():
    ir = Fourier(segment=64)([noisy_gain(0.0, 0.5)])
    assert float(ir.noise_std[0]) == pytest.approx(0.5, rel=0.03)
    assert float(ir.h[0, 0, 0]) == pytest.approx(2, rel=0.02)


def test_single_precision(single_precision):
    record = random_record()
    record = Record(*(np.asarray(x, np.float32) for x in (record.u, record.y)), DT)
    assert Fourier(segment=200)([record]).h.dtype == jnp.float32


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"estimator": "h3"}, "h3"),
        ({"window": "triangle"}, "triangle"),
        ({"segment": 5000}, "segment must be"),
        ({"overlap": 1.0}, "overlap"),
        ({"periods": 1}, "periods"),
        ({"segment": 1500}, "averages cannot separate"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(InputError, match=message):
        frequency_response(random_record(), **options)
