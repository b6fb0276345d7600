"""ERA against exact systems, a full decomposition, itself under transformations, and its derivative."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_markov import CHAIN, SYSTEMS, markov, pole_error, rebuilt

from jaxsid.checks import InputError
from jaxsid.mechanics.hold import shift_to_laguerre
from jaxsid.modes import modal
from jaxsid.realization.era import era
from jaxsid.realization.order import select_order
from jaxsid.records import ImpulseResponse, Realization

ORDERS = {"one": 2, "chain": 6, "chain_one_input": 6, "overdamped": 2}


def noisy(samples=240, dt=0.02, level=0.01, seed=0, system=CHAIN):
    h, poles = markov(system, samples, dt)
    noise = np.random.default_rng(seed).standard_normal(h.shape)
    return ImpulseResponse(h + level * np.abs(h[1:]).max() * noise, dt), poles


def assert_exact(name, samples, **window):
    h, poles = markov(SYSTEMS[name], samples)
    rz = era(ImpulseResponse(h, 1e-3), order=ORDERS[name], **window)
    md = modal(rz)
    assert pole_error(md.poles, poles) < 1e-12
    assert np.abs(rebuilt(rz, samples) - h).max() < 1e-13
    assert md.indicators is not None
    np.testing.assert_allclose(md.indicators.mac, 1, atol=1e-12)
    np.testing.assert_allclose(md.indicators.emac, 1, atol=1e-9)


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize(
    "window",
    [
        {"rows": 1000, "cols": 1000},
        pytest.param({"rows": 300, "cols": 300, "stride": 6}, marks=pytest.mark.slow),
        {},
    ],
)
def test_exact_recovery(name, window):
    assert_exact(name, 4096, **window)


@pytest.mark.parametrize("name", ["one", "chain_one_input"])
def test_exact_recovery_by_full_decomposition(name):
    assert_exact(name, 4096, rows=300, cols=300, stride=6, method="svd")


@pytest.mark.slow
def test_exact_recovery_by_full_decomposition_at_the_size_of_the_thesis():
    assert_exact("chain", 2048, rows=1000, cols=1000, method="svd")


@pytest.mark.parametrize(
    ("row_steps", "column_steps"),
    [
        ((0, 3, 10, 100, 500, 900), tuple(range(0, 900, 7))),
        (tuple(range(0, 800, 3)), tuple(range(0, 1000, 5))),
    ],
)
def test_chosen_rows_and_columns(row_steps, column_steps):
    assert_exact("chain", 2048, row_steps=row_steps, column_steps=column_steps)


def numpy_era(h, n, rows, cols):
    """The formulas as printed, with numpy's full decomposition."""
    m, r = h.shape[1:]

    def hankel(k):
        return np.block([[h[1 + k + i + j] for j in range(cols)] for i in range(rows)])

    u, s, vt = np.linalg.svd(hankel(0), full_matrices=False)
    root = np.sqrt(s[:n])
    A = (u[:, :n] / root).T @ hankel(1) @ (vt[:n].T / root)
    return A, (root[:, None] * vt[:n])[:, :r], (u[:, :n] * root)[:m], s


@pytest.mark.parametrize(
    ("order", "method"), [(2, "fast"), (5, "fast"), (6, "fast"), (7, "fast"), (6, "svd")]
)
def test_noisy_data_and_small_gaps_as_a_full_decomposition(order, method):
    ir, _ = noisy()
    h = np.asarray(ir.h)
    A, B, C, s = numpy_era(h, order, 120, 110)
    rz = era(ir, order=order, rows=120, cols=110, method=method)
    expected = rebuilt(Realization(A, B, C, h[0], 0.02), 100)
    np.testing.assert_allclose(rebuilt(rz, 100), expected, atol=1e-11 * np.abs(expected).max())
    assert rz.singular_values is not None
    np.testing.assert_allclose(rz.singular_values[:order], s[:order], rtol=1e-12)
    assert len(rz.singular_values) >= 2 * order + 10


@pytest.mark.parametrize("method", ["fast", "svd"])
def test_vmap_is_a_loop(method):
    irs = [noisy(seed=k, system=SYSTEMS["one"])[0] for k in range(4)]
    h = jnp.stack([ir.h for ir in irs])

    def response(h):
        rz = era(ImpulseResponse(h, 0.02), order=2, rows=100, cols=100, method=method)
        return rz.C @ rz.A @ rz.A @ rz.B, rz.singular_values[:2]

    together = jax.vmap(response)(h)
    apart = [response(x) for x in h]
    for k in range(2):
        np.testing.assert_allclose(together[k], [a[k] for a in apart], rtol=1e-11)


def test_jit_changes_nothing():
    ir, _ = noisy()
    plain = era(ir, order=6, rows=100, cols=100)
    jitted = jax.jit(lambda ir: era(ir, order=6, rows=100, cols=100))(ir)
    np.testing.assert_allclose(rebuilt(jitted, 50), rebuilt(plain, 50), atol=1e-12)


def test_balanced():
    ir, _ = noisy()
    rz = era(ir, order=6, rows=100, cols=110)
    assert rz.observability is not None
    assert rz.controllability is not None
    assert rz.singular_values is not None
    gramian = np.diag(rz.singular_values[:6])
    np.testing.assert_allclose(rz.observability.T @ rz.observability, gramian, atol=1e-12)
    np.testing.assert_allclose(rz.controllability @ rz.controllability.T, gramian, atol=1e-12)


def test_scaling_and_order_of_channels():
    ir, _ = noisy()
    scale, order = np.array([1e3, 2.0, 0.5]), [2, 0, 1]
    rz = era(ir, order=6, rows=100, cols=100)
    louder = era(ImpulseResponse(1e6 * ir.h, ir.dt), order=6, rows=100, cols=100)
    moved = era(ImpulseResponse(ir.h[:, order][:, :, order], ir.dt), order=6, rows=100, cols=100)
    np.testing.assert_allclose(np.abs(louder.A), np.abs(rz.A), atol=1e-9)  # signs of states are free
    np.testing.assert_allclose(rebuilt(moved, 50), rebuilt(rz, 50)[:, order][:, :, order], atol=1e-11)
    h, poles = markov(CHAIN, 2048)
    scaled = era(ImpulseResponse(h * scale[:, None] / scale, 1e-3), order=6, rows=300, cols=300, stride=3)
    assert pole_error(modal(scaled).poles, poles) < 1e-9


def laguerre_response(a, samples):
    """Markov parameters of the chain in the Laguerre shift, from its exact samples."""
    h, poles = markov(CHAIN, 4096)
    rz = era(ImpulseResponse(h, 1e-3), order=6, rows=1000, cols=1000)
    A, B, C, D = shift_to_laguerre(rz.A, rz.B, rz.C, rz.D, a)
    return rebuilt(Realization(A, B, C, D, 1e-3), samples), h, poles


def test_laguerre_shift():
    g, h, poles = laguerre_response(0.98, 200)
    rz = era(ImpulseResponse(g, 1e-3, pole=0.98), order=6, rows=80, cols=80)
    md = modal(rz)
    assert pole_error(md.poles, poles) < 1e-9
    np.testing.assert_allclose(rebuilt(rz, 500), h[:500], atol=1e-11)
    assert md.indicators is not None
    np.testing.assert_allclose(md.indicators.mac, 1, atol=1e-9)
    np.testing.assert_allclose(md.indicators.emac, 1, atol=1e-6)


@pytest.mark.parametrize(
    ("method", "level"), [("fast", 0.0), ("fast", 0.02), pytest.param("svd", 0.02, marks=pytest.mark.slow)]
)
def test_derivative_is_the_difference_quotient(method, level):
    ir, _ = noisy(samples=160, dt=0.05, level=level)
    direction = jnp.asarray(np.random.default_rng(1).standard_normal(ir.h.shape))

    def quantity(h):
        md = modal(era(ImpulseResponse(h, ir.dt), order=6, rows=75, cols=80, method=method))
        transfer = (md.shapes / (1.5j - md.poles)) @ md.participation
        return jnp.sum(md.frequencies * md.damping_ratios) + jnp.sum(jnp.abs(transfer))

    step = 1e-6
    quotient = (quantity(ir.h + step * direction) - quantity(ir.h - step * direction)) / (2 * step)
    forward = jax.jvp(quantity, (ir.h,), (direction,))[1]
    reverse = jnp.vdot(jax.grad(quantity)(ir.h), direction)
    np.testing.assert_allclose(forward, quotient, rtol=2e-6)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)


def test_single_precision(single_precision):
    h, poles = markov(CHAIN, 400, 0.02)
    rz = era(ImpulseResponse(h.astype(np.float32), 0.02), order=6, rows=150, cols=150)
    assert rz.A.dtype == jnp.float32
    assert pole_error(modal(rz).poles, poles) < 1e-4


def test_order_by_itself():
    h, _ = markov(CHAIN, 2048)
    assert era(ImpulseResponse(h, 1e-3), rows=900, cols=900).A.shape == (6, 6)
    ir, poles = noisy(samples=600, level=1e-3)
    rz = era(ir)
    assert rz.A.shape == (6, 6)
    assert pole_error(modal(rz).poles, poles) < 0.01


def test_order_choice_says_why():
    exact = select_order(np.array([3.0, 2, 1, 0.9, 1e-16, 1e-16, 1e-17]))
    assert exact.order == 4
    assert "floor" in exact.reason
    tail = 0.1 * 0.98 ** np.arange(20)
    chosen = select_order(np.concatenate([[50.0, 49, 30, 29, 1.0, 0.9], tail]))
    assert chosen.order == 6
    assert set(chosen.candidates) >= {6, 4, 2}
    assert "singular value 6" in chosen.reason
    flat = select_order(tail)
    assert "no drop" in flat.reason
    assert select_order(tail, expected=4).order == 4
    refused = select_order(np.array([1.0, 0.5, 1e-18, 1e-18]), expected=4)
    assert refused.order == 2
    assert "only 2" in refused.reason
    assert select_order(np.concatenate([[5.0, 4.0], tail]), noise_floor=0.5).order == 2


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rows": 60, "cols": 60}, "sample 120"),
        ({"rows": 2, "cols": 2, "order": 7}, "order 7"),
        ({"order": 0}, "at least 1"),
        ({"method": "magic"}, "magic"),
        ({"row_steps": (0, 2, 1), "cols": 3}, "increase"),
        ({"row_steps": (1, 2), "cols": 3}, "increase from 0"),
        ({"stride": 0}, "stride"),
        ({"rows": 0, "cols": 3}, "rows"),
    ],
)
def test_bad_windows(options, words):
    h, _ = markov(CHAIN, 100)
    with pytest.raises(InputError, match=words):
        era(ImpulseResponse(h, 1e-3), **{"order": 6, **options})


def test_bad_responses():
    h, _ = markov(CHAIN, 100)
    with pytest.raises(InputError, match="zero after Y_0"):
        era(ImpulseResponse(0 * h, 1e-3), order=2)
    with pytest.raises(InputError, match="fewer than 3"):
        era(ImpulseResponse(h[:2], 1e-3), order=2)
    h[5, 0, 0] = np.nan
    with pytest.raises(InputError, match="NaN"):
        era(ImpulseResponse(h, 1e-3), order=2)
