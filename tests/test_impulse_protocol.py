"""What holds for every estimator, and the choice among them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from impulse_truth import CHAIN, error, markov, noisy, respond

from jaxsid.checks import InputError
from jaxsid.impulse.direct import Direct
from jaxsid.impulse.ensemble import WaveletEnsemble
from jaxsid.impulse.estimate import METHODS, impulse_response
from jaxsid.impulse.fourier import Fourier
from jaxsid.impulse.protocol import ImpulseMethod
from jaxsid.impulse.select import select_method
from jaxsid.impulse.wavelet import Wavelet
from jaxsid.records import ImpulseResponse, Record

DT = 0.1
# Every estimator, at settings that keep the tests quick.
QUICK = (
    Fourier(segment=256),
    Direct(steps=30),
    Wavelet(steps=30),
    Wavelet(keep=128),
    WaveletEnsemble(taps=64),
)


def white(seed=0, samples=512, inputs=2):
    rng = np.random.default_rng(seed)
    u = np.zeros((samples, 3))
    u[:, :inputs] = rng.standard_normal((samples, inputs))
    y = respond(CHAIN, DT, u)[:, :2]
    return noisy(Record(u[:, :inputs], y, DT), 0.01, rng)


def test_the_public_list_is_tested():
    assert {type(m).__name__ for m in METHODS} <= {type(m).__name__ for m in QUICK}
    assert all(isinstance(m, ImpulseMethod) for m in METHODS)


@pytest.mark.parametrize("method", QUICK, ids=lambda m: type(m).__name__)
class TestEveryEstimator:
    def test_gives_an_impulse_response(self, method):
        ir = impulse_response(white(), method, samples=40)
        assert isinstance(ir, ImpulseResponse)
        assert ir.h.shape == (40, 2, 2)
        assert float(ir.dt) == DT
        assert ir.noise_std is not None
        assert ir.noise_std.shape == (2,)
        assert ir.hold == ("zero", "zero")
        assert len(ir.method) > 20
        assert error(ir.h, markov(CHAIN, DT, 40)[:, :2, :2]) < 0.3

    def test_same_under_jit(self, method):
        record = white()

        def taps(u, y):
            return impulse_response(Record(u, y, DT), method, samples=30).h

        np.testing.assert_allclose(jax.jit(taps)(record.u, record.y), taps(record.u, record.y), atol=1e-6)

    def test_scales_with_units(self, method):
        record = white()
        h = impulse_response(record, method, samples=30).h
        scaled = impulse_response(Record(100 * record.u, 1e-3 * record.y, DT), method, samples=30).h
        np.testing.assert_allclose(1e5 * scaled, h, atol=1e-5)

    def test_a_resting_input_is_refused(self, method):
        record = white()
        with pytest.raises(InputError, match="zero throughout"):
            impulse_response(Record(record.u.at[:, 1].set(0), record.y, DT), method)

    def test_too_many_samples_are_refused(self, method):
        with pytest.raises(InputError, match="513 samples"):
            impulse_response(white(), method, samples=513)


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (lambda r: Record(r.u, r.y, 2 * DT), "Resample"),
        (lambda r: Record(r.u[:, :1], r.y, DT), "same channels"),
        (lambda r: Record(r.u, r.y, DT, outputs=("a", "b")), "same channels"),
        (lambda r: Record(r.u, r.y, DT, hold="first"), "holds differ"),
        (lambda r: Record(r.u, r.y.at[3, 0].set(jnp.nan), DT), "NaN"),
    ],
)
def test_records_that_do_not_belong_together(other, message):
    with pytest.raises(InputError, match=message):
        impulse_response([white(), other(white())], Fourier())


def test_no_records():
    with pytest.raises(InputError, match="no record"):
        impulse_response([])


def test_selection_prefers_what_predicts():
    """A lightly damped structure over short segments: Fourier leaks, and the held-out samples show it."""
    found = select_method(white(samples=600, inputs=1), (Fourier(segment=64), Direct(steps=40)))
    assert isinstance(found.method, Direct)
    assert float(found.scores[1]) < 0.1 < float(found.scores[0])
    assert "held-out" in found.reason
    assert "Fourier" in found.reason


def test_selection_keeps_the_first_of_equals():
    method = WaveletEnsemble(taps=32)
    other = WaveletEnsemble("correlations", taps=32)
    assert select_method(white(), (method, other)).method == method


@pytest.mark.parametrize(
    ("options", "message"),
    [({"candidates": ()}, "no candidates"), ({"held_out": 1.5}, "held_out")],
)
def test_selection_refuses(options, message):
    with pytest.raises(InputError, match=message):
        select_method(white(), **options)
