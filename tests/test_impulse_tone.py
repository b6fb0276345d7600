"""Is a single tone enough for the wavelet estimate, as the thesis claims? In numbers.

A sine that starts at time zero, sampled and held, is not only one line: its start excites every frequency.
With the
record at rest before, T(u) is triangular, and without its zero first row it has full rank: 1 / u(z) is the
finite
series (1 - 2 cos(w) z^-1 + z^-2) / (z^-1 sin(w)). Noise-free data therefore give the response to rounding,
in any
basis. What a tone lacks is power away from its frequency: the same inverse amplifies noise by
sqrt(6) / sin(w), that is by 390 for 1 Hz at 1 kHz.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from impulse_truth import CHAIN, ONE, error, markov, noisy, one_at_a_time

from jaxsid.impulse.direct import Direct
from jaxsid.impulse.toeplitz import substitute
from jaxsid.impulse.wavelet import Wavelet
from jaxsid.records import Record

DT = 1e-3
TONE = np.sin(2 * np.pi * DT * np.arange(4096))


@pytest.mark.parametrize(
    "matrices", [pytest.param(ONE, id="1 DOF"), pytest.param(CHAIN, marks=pytest.mark.slow, id="3 DOF")]
)
def test_noise_free_tone_is_enough(matrices):
    records = one_at_a_time(matrices, DT, TONE)
    h = np.asarray(Wavelet("db4")(records).h)[:-1]
    np.testing.assert_allclose(h, markov(matrices, DT, 4096)[:-1], atol=1e-11)


def test_the_amplification_is_that_of_the_finite_inverse():
    u = jnp.asarray(TONE)[None, :, None]
    amplification = substitute(u, u)[1]
    assert float(amplification) == pytest.approx(np.sqrt(2 + 4) / np.sin(2 * np.pi * DT), rel=1e-4)


def noisy_tone(matrices):
    record = one_at_a_time(matrices, DT, TONE)[0]
    record = Record(record.u[:, :1], record.y[:, :1], DT)
    return noisy(record, 0.01, np.random.default_rng(0)), markov(matrices, DT, 4096)[1:-1, :1, :1]


@pytest.mark.parametrize(("matrices", "least"), [(ONE, 1000), (CHAIN, 1000)], ids=["1 DOF", "3 DOF"])
def test_with_noise_the_plain_estimate_is_useless(matrices, least):
    """1 % noise becomes more than `least` times the response after the feedthrough."""
    record, truth = noisy_tone(matrices)
    assert error(Direct(solver="exact")([record]).h[1:-1], truth) > least


@pytest.mark.slow
@pytest.mark.parametrize(("matrices", "most"), [(ONE, 0.2), (CHAIN, 0.2)], ids=["1 DOF", "3 DOF"])
def test_with_noise_a_smooth_prior_rescues_what_is_smooth(matrices, most):
    """The prior, not the tone, supplies the rest: right only where the response is as smooth as it says."""
    record, truth = noisy_tone(matrices)
    assert error(Wavelet("db4")([record]).h[1:-1], truth) < most
    assert error(Direct()([record]).h[1:-1], truth) < most


def test_a_tone_without_its_start_is_not_enough():
    """The steady state of a tone determines two numbers only; estimators then cannot know the response."""
    record = one_at_a_time(CHAIN, 0.05, np.sin(2 * np.pi * 0.05 * np.arange(6000)))[0]
    steady = Record(record.u[4000:, :1], record.y[4000:, :1], 0.05)
    truth = markov(CHAIN, 0.05, 300)[1:, :, :1]
    h = Direct(history="unknown", taps=600)([steady], samples=300).h[1:]
    assert error(h, truth) > 0.3
