"""ERA of many outputs that move together: the full decomposition's answer and derivative, with and without noise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_markov import CHAIN, markov, rebuilt

import jaxsid.realization.era as module
from jaxsid.realization import subspace
from jaxsid.realization.era import era
from jaxsid.realization.hankel import (
    DenseOperator,
    FourierOperator,
    fast_length,
    hankel_matrix,
    hankel_operator,
)
from jaxsid.realization.outputs import few_outputs
from jaxsid.records import ImpulseResponse

DT, OUTPUTS, ORDER, WINDOW = 0.05, 60, 6, {"rows": 20, "cols": 30}


def many(noise=0.0, seed=0):
    """The chain of three seen by 60 sensors, each of which weighs the motions of its bodies."""
    rng = np.random.default_rng(seed)
    h = np.einsum("tmr,om->tor", markov(CHAIN, 60, DT)[0], rng.standard_normal((OUTPUTS, 3)))
    return jnp.asarray(h + noise * h[1:].std() * rng.standard_normal(h.shape))


def realized(h, method="fast"):
    return era(ImpulseResponse(h, DT), order=ORDER, method=method, **WINDOW)


def as_svd(found, h, tolerance):
    full = realized(h, "svd")
    np.testing.assert_allclose(rebuilt(found, 60), rebuilt(full, 60), rtol=0, atol=tolerance)
    values = np.asarray(found.singular_values)[:ORDER]
    np.testing.assert_allclose(values, full.singular_values[:ORDER], rtol=1e-11)
    sign = np.sign(np.sum(np.asarray(found.observability) * np.asarray(full.observability), axis=0))
    size = float(jnp.abs(full.observability).max())
    np.testing.assert_allclose(found.observability * sign, full.observability, rtol=0, atol=tolerance * size)


def test_few_directions_hold_all_of_a_response_without_noise_only():
    few = few_outputs(many()[1:], 8)
    assert bool(few.exact)
    assert few.h.shape == (59, 8, 3)
    np.testing.assert_allclose(few.directions.T @ few.directions, np.eye(8), atol=1e-14)
    back = jnp.einsum("twr,mw->tmr", few.h, few.directions)
    np.testing.assert_allclose(back, many()[1:], rtol=0, atol=1e-13)
    assert not bool(few_outputs(many(1e-12)[1:], 8).exact)


@pytest.mark.parametrize("noise", [0.0, 1e-12, 0.01])
def test_the_answer_is_that_of_the_full_decomposition(noise):
    h = many(noise)
    found = realized(h)
    assert found.C.shape == (OUTPUTS, ORDER)
    assert found.observability.shape == (20 * OUTPUTS, ORDER)
    as_svd(found, h, 1e-10)


@pytest.mark.parametrize("dense", [False, True])
@pytest.mark.parametrize("columns", [tuple(range(30)), (0, 2, 3, 11, 20)])
def test_gram_matrix(dense, columns):
    rows = (0, 1, 4, 5, 17)
    h = many(0.01)
    matrix = np.asarray(hankel_matrix(h, rows, columns, 1))
    length = fast_length(len(h) - 1)
    by_fourier = FourierOperator(jnp.fft.rfft(h[1:], length, axis=0), rows, columns, length)
    operator = DenseOperator(jnp.asarray(matrix)) if dense else by_fourier
    np.testing.assert_allclose(operator.gram(), matrix.T @ matrix, rtol=0, atol=1e-13 * (matrix**2).sum())


def test_from_the_gram_matrix_nothing_is_left_to_do_where_there_is_noise(monkeypatch):
    """Without restarts and without a full decomposition the answer is still that of one."""
    monkeypatch.setattr(subspace, "_coarse", lambda state, order: jnp.array(False))
    steps = tuple(range(20)), tuple(range(30))
    operator = hankel_operator(many(0.01), *steps, 1)
    found = subspace.dominant_subspace(operator, ORDER, False)
    u, s, vt = np.linalg.svd(np.asarray(hankel_matrix(many(0.01), *steps, 1)), full_matrices=False)
    np.testing.assert_allclose(found.values[:ORDER], s[:ORDER], rtol=1e-13)
    np.testing.assert_allclose(np.abs(np.sum(u[:, :ORDER] * found.left, axis=0)), 1, atol=1e-12)
    np.testing.assert_allclose(np.abs(np.sum(vt[:ORDER].T * found.right, axis=0)), 1, atol=1e-12)


def test_both_in_one_batch():
    batch = jnp.stack([many(), many(0.01)])
    together = jax.vmap(realized)(batch)
    for i, h in enumerate(batch):
        as_svd(jax.tree.map(lambda x: x[i], together), h, 1e-10)  # noqa: B023


def test_few_directions_are_used_where_they_pay(monkeypatch):
    seen = []
    before = module.few_outputs
    monkeypatch.setattr(module, "few_outputs", lambda h, width: seen.append(width) or before(h, width))
    jax.eval_shape(lambda h: realized(h).A, many()[:59])  # a shape of its own: nothing traced before
    jax.eval_shape(lambda h: realized(h[:, :20]).A, many()[:59])
    assert seen == [8]


@pytest.mark.parametrize("mode", [jax.jacfwd, pytest.param(jax.jacrev, marks=pytest.mark.slow)])
def test_derivative_in_directions_that_the_outputs_lack(mode):
    """A change that leaves the few directions moves the shapes, though the response itself has no such part."""
    h = many()
    change = jnp.asarray(np.random.default_rng(3).standard_normal(h.shape))

    def numbers(size, method="fast"):
        found = realized(h + size * change, method)
        markov_parameters = jnp.einsum("on,nm,mr->or", found.C, found.A @ found.A, found.B)
        wide = found.observability @ found.controllability
        return jnp.concatenate([markov_parameters.ravel(), wide[::97].ravel()])

    slope = mode(numbers)(0.0)
    step = 1e-6
    numeric = (numbers(step, "svd") - numbers(-step, "svd")) / (2 * step)
    np.testing.assert_allclose(slope, numeric, rtol=0, atol=1e-6 * float(jnp.abs(numeric).max()))


def test_single_precision(single_precision):
    h = many().astype(jnp.float32)
    found = realized(h)
    assert found.A.dtype == jnp.float32
    np.testing.assert_allclose(rebuilt(found, 60), h, atol=1e-4 * float(jnp.abs(h).max()))
