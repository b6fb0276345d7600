"""Lines and the in-band observer: exact Markov parameters in the Laguerre shift, from records of any state."""

import jax.numpy as jnp
import numpy as np
import pytest
from band_limited import DT, band_noise, chain, poles, respond, state_space
from scipy import signal

from jaxsid.checks import InputError, InsufficientDataError
from jaxsid.impulse.fourier import Fourier
from jaxsid.impulse.inband import InBand, observer_response, output_groups
from jaxsid.impulse.laguerre import time_samples
from jaxsid.impulse.lines import excited_band, laguerre_pole, laguerre_shift, record_lines
from jaxsid.impulse.select import CANDIDATES, select_method
from jaxsid.mechanics.hold import shift_to_laguerre
from jaxsid.mechanics.recursion import markov
from jaxsid.realization.era import era
from jaxsid.records import ImpulseResponse, Record

SYSTEM = chain([1.2, 0.9], [3000, 2500], [1.5, 1.2])


@pytest.fixture(scope="module")
def record():
    u = band_noise(np.random.default_rng(0), 8000, 1)
    return Record(u, respond(SYSTEM, u, state=np.array([0.01, -0.02, 1.0, 0.5])), DT)


@pytest.fixture(scope="module")
def lines(record):
    return record_lines([record])


def shifted_markov(pole, samples):
    """Coefficients of G in powers of 1/w, from values of G on the unit circle of w."""
    A, B, C, D, _ = signal.cont2discrete(state_space(SYSTEM), DT)
    n = 1 << 14
    w = np.exp(2j * np.pi * np.arange(n) / n)
    z = (w + pole) / (1 + pole * w)
    G = C @ np.linalg.solve(z[:, None, None] * np.eye(4) - A, B[None]) + D
    return np.fft.ifft(G, axis=0).real[:samples]


def test_lines_obey_the_transfer_function_up_to_a_transient_of_its_poles(record, lines):
    A, B, C, D, _ = signal.cont2discrete(state_space(SYSTEM), DT)
    z, used = np.asarray(lines.z), np.asarray(lines.weight)[:, 0] > 0
    z = z[used]
    G = C @ np.linalg.solve(z[:, None, None] * np.eye(4) - A, B[None]) + D
    transient = np.asarray(lines.y)[used] - np.einsum("koi,ki->ko", G, np.asarray(lines.u)[used])
    shapes = np.hstack([1 / (z[:, None] - np.linalg.eigvals(A)), np.ones((len(z), 1))])
    left = transient - shapes @ np.linalg.lstsq(shapes, transient)[0]
    assert np.linalg.norm(left) < 1e-9 * np.linalg.norm(np.asarray(lines.y))
    assert np.linalg.norm(transient) > 1e-3 * np.linalg.norm(np.asarray(lines.y))


def test_markov_parameters_without_noise_are_exact(lines):
    found = observer_response(lines)
    truth = shifted_markov(float(found.pole), len(found.h))
    assert np.linalg.norm(found.h - truth) < 1e-4 * np.linalg.norm(truth)
    own = np.log(np.linalg.eigvals(np.asarray(era(found, order=4, rows=90, cols=90).A))) / DT
    for p in poles(SYSTEM):
        assert np.abs(own - p).min() < 1e-6 * abs(p)


def test_noise_is_estimated(record):
    rng = np.random.default_rng(1)
    noise = 0.02 * np.asarray(record.y).std(axis=0)
    noisy = Record(record.u, record.y + noise * rng.standard_normal(record.y.shape), DT)
    found = InBand()([noisy])
    assert found.noise_std is not None
    assert found.band is not None
    assert "in-band observer" in found.method
    truth = shifted_markov(float(found.pole), 60)
    assert np.linalg.norm(found.h[:60] - truth) < 0.1 * np.linalg.norm(truth)


def test_the_shift_keeps_the_circle_and_spreads_the_band():
    pole = laguerre_pole(60.0, DT)
    z = np.exp(2j * np.pi * DT * np.array([0.0, 30.0, 60.0]))
    w = laguerre_shift(z, pole)
    np.testing.assert_allclose(np.abs(w), 1.0, rtol=1e-12)
    np.testing.assert_allclose(np.angle(w)[[0, 2]], [0, 0.8 * np.pi], atol=1e-9)
    assert laguerre_pole(500.0, DT) == 0.0


def test_the_band_that_is_excited():
    u = band_noise(np.random.default_rng(2), 20000, 1)
    low, high = excited_band([Record(u, u, DT)])
    assert 0.3 < low < 1.1
    assert 59 < high < 110


def test_outputs_are_grouped_by_the_records_that_hold_them(record):
    parts = [Record(record.u, record.y[:, [i]], DT, outputs=[f"s{i}"]) for i in range(2)]
    lines = record_lines(parts)
    assert [list(g) for g in output_groups(lines)] in ([[0], [1]], [[1], [0]])
    whole = observer_response(lines)
    assert whole.h.shape == (200, 2, 1)
    truth = shifted_markov(float(whole.pole), 200)
    assert np.linalg.norm(whole.h - truth) < 1e-3 * np.linalg.norm(truth)


def test_what_cannot_be_used_is_told(record):
    lines = record_lines([record])
    with pytest.raises(InputError, match="too short to realize"):
        observer_response(lines, samples=2)
    with pytest.raises(InputError, match="lower end first"):
        record_lines([record], band=(60.0, 1.0))
    with pytest.raises(InsufficientDataError, match="spectral lines"):
        record_lines([record], band=(10.0, 10.2))
    tone = Record(jnp.sin(2 * jnp.pi * 10.03 * DT * jnp.arange(8000)), record.y, DT)
    with pytest.raises(InsufficientDataError, match="single tone"):
        record_lines([tone])
    with pytest.raises(InputError, match="differ from those"):
        record_lines([record, Record(record.u, record.y, DT, inputs=["other"])])


@pytest.mark.parametrize("pole", [0.0, 0.85, 0.93])
def test_time_samples_of_a_laguerre_response(pole):
    """A system's own Markov parameters, by scipy, come out of its expansion in the Laguerre shift."""
    system = chain([1.2, 0.9], [3000, 2500], [15.0, 12.0], driven=(0, 1))
    a, b, c, d, _ = signal.cont2discrete(state_space(system), DT)
    shifted = shift_to_laguerre(*(jnp.asarray(x) for x in (a, b, c, d)), pole)
    count = {0.0: 1500, 0.85: 700, 0.93: 400}[pole]
    h = markov(*shifted, count)
    truth = np.stack([d, *(c @ np.linalg.matrix_power(a, k) @ b for k in range(1499))])
    got = time_samples(ImpulseResponse(h, DT, pole=pole), 1500)
    np.testing.assert_allclose(got, truth, atol=1e-9 * np.abs(truth).max())
    with pytest.raises(InputError, match="band"):
        time_samples(ImpulseResponse(h, DT, pole=pole, hold="band"), 1500)


def test_selection_takes_the_observer_for_a_band_limited_force():
    rng = np.random.default_rng(4)
    system = chain([1.2, 0.9], [3000, 2500], [1.5, 1.2])
    u = band_noise(rng, 6000, 1)
    y = respond(system, u)
    record = Record(u, y + 0.02 * y.std(axis=0) * rng.standard_normal(y.shape), DT)
    found = select_method(record, (Fourier(), InBand()))
    assert found.method == InBand()
    assert float(found.scores[1]) < 0.1
    assert CANDIDATES[0] == InBand()
