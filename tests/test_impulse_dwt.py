"""The periodized wavelet transform against PyWavelets, and the properties that make it one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import pywt

from jaxsid.checks import InputError
from jaxsid.impulse.dwt import depth, dwt, idwt, levels_of


@pytest.mark.filterwarnings("ignore:Level value")
@pytest.mark.parametrize(
    "wavelet", ["haar", "db4", "db20", *(pytest.param(x, marks=pytest.mark.slow) for x in ("sym5", "coif3"))]
)
@pytest.mark.parametrize(
    ("length", "level"), [(16, 1), pytest.param(64, None, marks=pytest.mark.slow), (96, 5)]
)
def test_agrees_with_pywavelets(wavelet, length, level):
    x = np.random.default_rng(0).standard_normal((length, 2))
    ours = dwt(jnp.asarray(x), wavelet=wavelet, level=level)
    theirs = pywt.wavedec(x, wavelet, "periodization", level=depth(length, level), axis=0)
    np.testing.assert_allclose(ours, np.concatenate(theirs), atol=1e-11)
    np.testing.assert_allclose(idwt(ours, wavelet=wavelet, level=level), x, atol=1e-11)


def test_orthonormal_under_jit_and_vmap():
    def transform(x):
        return dwt(x, wavelet="db4")

    matrix = jax.jit(jax.vmap(transform))(jnp.eye(64))
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(64), atol=1e-11)
    np.testing.assert_allclose(matrix[3], transform(jnp.eye(64)[3]), atol=1e-14)


def test_single_precision():
    x = np.random.default_rng(0).standard_normal(32).astype(np.float32)
    c = dwt(jnp.asarray(x), wavelet="db4")
    assert c.dtype == jnp.float32
    np.testing.assert_allclose(idwt(c, wavelet="db4"), x, atol=1e-5)


def test_levels_say_where_a_coefficient_lives():
    assert levels_of(16, 4).tolist() == [4] * 2 + [3] * 2 + [2] * 4 + [1] * 8
    assert levels_of(12, 2).tolist() == [2] * 6 + [1] * 6


@pytest.mark.parametrize("wavelet", ["bior2.2", "dmey", "nonsense"])
def test_a_wavelet_that_is_not_orthonormal_is_refused(wavelet):
    with pytest.raises(InputError, match=wavelet):
        dwt(jnp.zeros(16), wavelet=wavelet)


def test_too_deep_is_refused():
    with pytest.raises(InputError, match="at most 2 levels, not 3"):
        dwt(jnp.zeros(12), wavelet="haar", level=3)
