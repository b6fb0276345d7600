"""The wavelet estimate: equal to the direct one where nothing is dropped, better where coarse is enough."""

import numpy as np
import pytest
from impulse_truth import CHAIN, ONE, chirp, error, markov, noisy, one_at_a_time, respond

from jaxsid.checks import InputError
from jaxsid.impulse.direct import Direct
from jaxsid.impulse.ensemble import WaveletEnsemble
from jaxsid.impulse.wavelet import Wavelet
from jaxsid.records import Record


def definite_record(samples=256, inputs=1, seed=0):
    """An input that starts with a blow, so that its Toeplitz matrix has full rank and is well conditioned."""
    rng = np.random.default_rng(seed)
    u = 0.1 * rng.standard_normal((samples, 3)) * 0.97 ** np.arange(samples)[:, None]
    u[0] = 3
    u[:, inputs:] = 0
    return Record(u[:, :inputs], respond(CHAIN, 0.05, u), 0.05)


@pytest.mark.parametrize("wavelet", ["haar", "db4", "sym6"])
def test_all_coefficients_are_the_direct_solution(wavelet):
    """Dense least squares for every wavelet coefficient against structured inversion in time."""
    record = definite_record()
    through = Wavelet(wavelet, keep=256, shrink=False)([record])
    direct = Direct(solver="exact")([record])
    np.testing.assert_allclose(through.h, direct.h, atol=1e-10)
    assert error(direct.h, markov(CHAIN, 0.05, 256)[:, :, :1]) < 1e-10


def test_other_lengths_are_modelled_by_the_next_power_of_two():
    record = definite_record(samples=200)
    ir = Wavelet(keep=256, shrink=False)([record])
    assert ir.h.shape == (200, 3, 1)
    assert "length 256" in ir.method
    assert error(ir.h, markov(CHAIN, 0.05, 200)[:, :, :1]) < 1e-9


def test_the_feedthrough_is_not_lost_in_a_coarse_subspace():
    """256 of 4096 coefficients: the spike at 0 is exact, the smooth rest good to the subspace."""
    records = one_at_a_time(ONE, 1e-3, chirp(0.02, 3, 100, 1e-3, 4096))
    h = np.asarray(Wavelet(keep=256)(records).h)[:4000, 0, 0]
    truth = markov(ONE, 1e-3, 4000)[:, 0, 0]
    assert h[0] == pytest.approx(1, abs=1e-3)
    assert error(h[1:], truth[1:]) < 0.03


@pytest.mark.slow
def test_a_coarse_subspace_regularizes():
    """What the basis buys: with 1 % noise on a sweep the plain solution is useless, the coarse one is not."""
    rng = np.random.default_rng(0)
    record = noisy(one_at_a_time(ONE, 1e-3, chirp(0.02, 3, 100, 1e-3, 4096))[0], 0.01, rng)
    truth = markov(ONE, 1e-3, 4096)
    exact = error(Direct(solver="exact")([record]).h[:-1], truth)
    assert exact > 100
    assert error(Wavelet(keep=64)([record]).h, truth) < 0.05
    assert error(Wavelet()([record]).h, truth) < 0.05
    assert error(Direct()([record]).h, truth) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("dt", [1e-3, 0.02])
def test_white_excitation_with_noise(dt):
    rng = np.random.default_rng(0)
    u = np.zeros((4096, 3))
    u[:, :1] = rng.standard_normal((4096, 1))
    record = noisy(Record(u[:, :1], respond(CHAIN, dt, u)[:, :1], dt), 0.01, rng)
    ir = Wavelet()([record])
    assert error(ir.h, markov(CHAIN, dt, 4096)[:, :1, :1]) < 0.05
    np.testing.assert_allclose(ir.noise_std, 0.01 * np.asarray(record.y).std(axis=0), rtol=0.05)


def ensemble(count, noise=0.02, inputs=2):
    rng = np.random.default_rng(count)
    records = []
    for i in range(count):
        u = np.zeros((300 + 20 * i, 3))
        u[:, :inputs] = rng.standard_normal((len(u), inputs))
        records.append(noisy(Record(u[:, :inputs], respond(CHAIN, 0.1, u), 0.1), noise, rng))
    return records


def time_domain(records, taps):
    """sum(y U') (sum U U')^-1, formed densely."""
    yu, uu = 0, 0
    for record in records:
        u, y = np.asarray(record.u), np.asarray(record.y)
        U = np.concatenate([np.pad(u, ((k, 0), (0, 0)))[: len(u)] for k in range(taps)], axis=1)
        yu, uu = yu + y.T @ U, uu + U.T @ U
    h = np.linalg.solve(uu, yu.T).T
    return h.reshape(len(h), taps, -1).swapaxes(0, 1)


@pytest.mark.parametrize("count", [1, 4])
@pytest.mark.parametrize("orthonormal", [True, False])
@pytest.mark.parametrize("variant", ["products", "correlations"])
def test_square_ensemble_average_is_the_time_domain_one(variant, orthonormal, count):
    records = ensemble(count)
    ir = WaveletEnsemble(variant, taps=64, orthonormal=orthonormal)(records)
    np.testing.assert_allclose(ir.h, time_domain(records, 65), atol=1e-8)


def test_the_variants_differ_when_coefficients_are_dropped():
    records = ensemble(4)
    products, correlations = (
        np.asarray(WaveletEnsemble(v, taps=64, keep=40)(records).h) for v in ("products", "correlations")
    )
    assert 1e-3 < np.linalg.norm(products - correlations) / np.linalg.norm(products) < 1


def test_dropping_is_the_same_for_an_unnormalized_transform():
    """The diagonal D undoes the scale of the rows, so that the subspace alone matters."""
    records = ensemble(2)
    a, b = (WaveletEnsemble(taps=64, keep=16, orthonormal=o)(records).h for o in (True, False))
    np.testing.assert_allclose(a, b, atol=1e-8)


@pytest.mark.slow
def test_averaging_reduces_the_error():
    truth = markov(CHAIN, 0.1, 129)[:, :, :2]
    errors = [error(WaveletEnsemble(taps=128)(ensemble(n)).h, truth) for n in (3, 12)]
    assert errors[1] < errors[0] / 1.5


@pytest.mark.parametrize(
    ("method", "message"),
    [
        (Wavelet("bior2.2"), "bior2.2"),
        (Wavelet(keep=999), "keep must be"),
        (Wavelet(level=-1), "level must not"),
        (Wavelet(shrink=False), "needs `keep`"),
        (WaveletEnsemble("sums"), "sums"),
        (WaveletEnsemble(taps=999), "taps must be"),
        (WaveletEnsemble(taps=64, keep=65), "keep must be"),
    ],
)
def test_bad_options(method, message):
    with pytest.raises(InputError, match=message):
        method([definite_record()])
