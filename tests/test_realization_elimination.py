"""Poles chosen out of too many: the true ones stay, and what is counted is what a refit would say."""

import numpy as np
import pytest
from band_limited import DT, THREE, band_noise, chain, poles, respond

from jaxsid.impulse.lines import record_lines
from jaxsid.realization.elimination import needed_poles
from jaxsid.records import Record

SYSTEM = chain(*THREE)


def lines_of(noise=0.02, seed=0, drift=0.0):
    rng = np.random.default_rng(seed)
    u = band_noise(rng, 8000, 1)
    y = respond(SYSTEM, u)
    y = y + noise * y.std(axis=0) * rng.standard_normal(y.shape)
    y += drift * y.std(axis=0) * np.sin(2 * np.pi * 1.3 * DT * np.arange(len(y)))[:, None]
    return record_lines([Record(u, y, DT)], band=(0.5, 80.0))


def spurious(count, seed=0):
    """Poles z of `count` pairs that have nothing to do with the system."""
    rng = np.random.default_rng(seed)
    s = 2 * np.pi * rng.uniform(1, 70, count) * np.exp(1j * rng.uniform(1.6, 2.4, count))
    return np.exp(DT * np.concatenate([s, s.conj()]))


def misfit(z, lines):
    """Sum over the outputs of the squares that poles z leave, each output over its own size, by plain lstsq."""
    points, drive = np.asarray(lines.z), np.concatenate([lines.u, lines.record], axis=1)
    s = [1 / (points - p) for p in z if p.imag >= 0] + [points / (points - p) for p in z if p.imag > 0]
    s += [1 / (points - p.conj()) for p in z if p.imag > 0] + [
        points / (points - p.conj()) for p in z if p.imag > 0
    ]
    table = (np.stack([*s, np.ones_like(points)], axis=1)[:, :, None] * drive[:, None]).reshape(
        len(points), -1
    )
    used = np.asarray(lines.weight)[:, 0] > 0
    left = 0.0
    for y in np.asarray(lines.y)[used].T:
        x = np.linalg.lstsq(table[used], y, rcond=1e-13)[0]
        left += np.sum(np.abs(y - table[used] @ x) ** 2) / np.sum(np.abs(y) ** 2)
    return left


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("count", [1, 4, 9])
def test_the_true_poles_stay(seed, count):
    true = np.exp(DT * poles(SYSTEM))
    got = needed_poles(
        [spurious(3, 50 + seed), np.concatenate([true, spurious(count, seed)])], lines_of(seed=seed), 6
    )
    np.testing.assert_allclose(np.sort_complex(got), np.sort_complex(true), rtol=1e-9)


def test_the_set_of_the_right_size_stays_where_it_is_better():
    true = np.exp(DT * poles(SYSTEM))
    off = np.exp(DT * poles(SYSTEM) * 1.05)
    got = needed_poles([true, np.concatenate([off, spurious(2)])], lines_of(), 6)
    np.testing.assert_allclose(np.sort_complex(got), np.sort_complex(true), rtol=1e-9)


def test_a_drift_does_not_push_out_a_mode():
    """A pole for the drift, which one sensor has and no input makes, explains less than the weakest mode."""
    true = np.exp(DT * poles(SYSTEM))
    slow = np.exp(2j * np.pi * 1.3 * DT)
    got = needed_poles([spurious(3), np.array([*true, slow, slow.conjugate()])], lines_of(drift=0.02), 6)
    np.testing.assert_allclose(np.sort_complex(got), np.sort_complex(true), rtol=1e-9)


def test_one_step_drops_what_a_refit_would_drop():
    true, other = np.exp(DT * poles(SYSTEM)), spurious(1, 3)
    every, lines = np.concatenate([true, other]), lines_of(noise=0.3)
    got = needed_poles([every], lines, 6)
    upper = every[every.imag > 0]
    costs = [
        misfit(np.concatenate([np.delete(upper, i), np.delete(upper, i).conj()]), lines) for i in range(4)
    ]
    gone = upper[np.argmin(costs)]
    assert np.abs(got - gone).min() > 1e-6
    assert len(got) == 6


def test_real_poles_go_alone_and_an_odd_order_keeps_one():
    true = np.exp(DT * poles(SYSTEM))
    real = np.array([0.3, 0.9])
    got = needed_poles([np.concatenate([true, real])], lines_of(), 7)
    assert len(got) == 7
    assert np.sum(np.abs(got.imag) < 1e-9) == 1
    got = needed_poles([np.concatenate([true, real])], lines_of(), 6)
    np.testing.assert_allclose(np.sort_complex(got), np.sort_complex(true), rtol=1e-9)


def test_poles_outside_of_the_circle_are_mirrored_unless_the_system_is_unstable():
    true = np.exp(DT * poles(SYSTEM))
    outside = true / np.abs(true) ** 2
    inside = needed_poles([outside], lines_of(), 6)
    assert np.abs(inside).max() < 1
    kept = needed_poles([outside], lines_of(), 6, stable=False)
    np.testing.assert_allclose(np.sort_complex(kept), np.sort_complex(outside), rtol=1e-9)
