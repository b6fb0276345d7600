"""The Cramer-Rao bound against explicit covariance matrices, finite differences and an efficient estimator."""

import numpy as np
import pytest
import scipy.linalg

from jaxsid.study.bound import Sampling, cramer_rao, driven, spread
from jaxsid.study.noise import POLE
from jaxsid.study.quantities import structure_of
from jaxsid.study.system import make_system

RNG = np.random.default_rng(5)


def response(mass, damping, stiffness, B, kind, dt, samples):
    """Markov parameters of M q'' + D q' + K q = B u seen on every body, by the matrix exponential."""
    n, r = B.shape
    lower = -np.linalg.solve(mass, np.hstack([stiffness, damping]))
    push = np.linalg.solve(mass, B)
    A = np.vstack([np.hstack([np.zeros((n, n)), np.eye(n)]), lower])
    C, D = {
        "displacement": (np.eye(n, 2 * n), 0 * push),
        "velocity": (np.eye(n, 2 * n, n), 0 * push),
        "acceleration": (lower, push),
    }[kind]
    augmented = np.zeros((2 * n + r,) * 2)
    augmented[: 2 * n] = np.hstack([A, np.vstack([0 * push, push])])
    step = scipy.linalg.expm(augmented * dt)
    x, h = step[: 2 * n, 2 * n :], [D]
    for _ in range(samples - 1):
        h.append(C @ x)
        x = step[: 2 * n, : 2 * n] @ x
    return np.array(h), np.linalg.eigvals(A)


def judged(poles):
    poles = poles[np.imag(poles) > 0]
    poles = poles[np.argsort(np.abs(poles))]
    return np.concatenate([np.abs(poles) / (2 * np.pi), -np.real(poles) / np.abs(poles)])


def differences(function, x):
    """Central differences of fourth order, one column an unknown."""

    def column(s):
        near, far = (function(x + a * s) - function(x - a * s) for a in (1, 2))
        return (8 * near - far) / (12 * s.max())

    return np.stack([column(s) for s in np.diag(1e-4 * np.maximum(np.abs(x), 1.0))], axis=-1)


@pytest.mark.parametrize("colour", ["white", "coloured", "quantization"])
@pytest.mark.parametrize("excited", [False, True])
def test_explicit_covariance_of_two_bodies(colour, excited):
    system, samples, dt = make_system("chain2", "velocity", "force2"), 40, 0.08
    u = RNG.standard_normal(samples) if excited else None
    so = system.mechanics.matrices
    upper = np.triu_indices(2)
    blocks = [np.asarray(x)[upper] for x in (so.mass, so.damping, so.stiffness)]
    B = np.asarray(so.input_matrix)

    def full(x):
        triple = []
        for part in np.split(x, 3):
            matrix = np.zeros((2, 2))
            matrix[upper] = part
            triple.append(matrix + np.triu(matrix, 1).T)
        return triple

    def record(x):
        h = response(*full(x), B, "velocity", dt, samples)[0][:, :, 0]
        columns = h if u is None else np.stack([np.convolve(u, c)[:samples] for c in h.T], axis=1)
        return columns.T.ravel()  # one output after the other

    def quantities(x):
        return np.concatenate([judged(response(*full(x), B, "velocity", dt, 2)[1]), x])

    x = np.concatenate(blocks)
    J, G = differences(record, x), differences(quantities, x)
    deviation = np.array([0.3, 0.02])
    row = POLE ** np.arange(samples) if colour == "coloured" else np.eye(samples)[0]
    covariance = np.kron(np.diag(deviation**2), scipy.linalg.toeplitz(row))
    information = J.T @ np.linalg.solve(covariance, J)
    expected = np.sqrt(np.diag(G @ np.linalg.solve(information, G.T)))
    sampling = Sampling(dt, samples, u, deviation, colour)
    got = cramer_rao(system, structure_of(system, system.order), sampling)
    np.testing.assert_allclose(got, expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("inputs", "excited"), [("default", (0, 1, 2, 3, 4)), ("force_x, force_y", (0, 1, 3, 4))]
)
def test_modes_against_all_unknowns_at_once(inputs, excited):
    """The projection, against the dense information on poles, shapes, participations and feedthrough together."""
    system, samples, dt = (
        make_system("mini_mast", "bay3_x, bay12_rotation, bay18_y", inputs),
        300,
        1 / 80,
    )
    deviation = np.array([1.0, 2.0, 0.5])
    A, B, C = (np.asarray(getattr(system.model, name)) for name in "ABC")
    poles, vectors = np.linalg.eig(A)
    b = np.linalg.solve(vectors, B)
    c = C @ vectors
    up = np.argmin(np.abs(poles - system.poles[:, None]), axis=1)  # the weak modes count as known
    poles, b, c = poles[up], b[up], c[:, up] * np.expm1(poles[up] * dt) / poles[up]
    t = (np.arange(samples) - 1) * dt
    k, m, r = len(poles), 3, b.shape[1]

    def columns():
        for i in range(k):
            e = np.where(t < 0, 0, np.exp(poles[i] * np.maximum(t, 0)))
            outer = np.multiply.outer
            changes = [outer(e * t, outer(c[:, i], b[i]))]
            changes += [outer(e, outer(np.eye(m)[o], b[i])) for o in range(m)]
            changes += [outer(e, outer(c[:, i], np.eye(r)[j])) for j in range(r)]
            for x in changes:
                yield from ((2 * (z * x).real / deviation[:, None]).ravel() for z in (1, 1j))
        for o in range(m):
            for j in range(r):
                x = np.zeros((samples, m, r))
                x[0, o, j] = 1 / deviation[o]
                yield x.ravel()

    J = np.stack(list(columns()), axis=1)
    scale = np.linalg.norm(J, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    _, s, vt = np.linalg.svd(J / scale, full_matrices=False)
    kept = s > 1e-9 * s[0]
    factor = vt[kept] / s[kept, None] / scale
    per_pole = 2 * (1 + m + r)
    expected = []
    for p in system.poles:
        i = per_pole * np.argmin(np.abs(poles - p))
        real, imag = factor[:, i], factor[:, i + 1]
        size = abs(p)
        growth = (p.real * real + p.imag * imag) / size
        expected.append(
            [np.linalg.norm(growth) / (2 * np.pi), np.linalg.norm(-real / size + p.real * growth / size**2)]
        )
    got = cramer_rao(system, None, Sampling(dt, samples, None, deviation, "white"))
    got = got.reshape(2, -1)
    np.testing.assert_allclose(got[:, excited], np.array(expected).T[:, excited], rtol=1e-6)
    assert np.isfinite(got).sum() == 2 * len(excited)


def test_explicit_covariance_of_a_free_shaft():
    """The rig: its stiffness is one number, since no spring holds the free rotation."""
    system, samples, dt = make_system("rig", "default", "default"), 120, 1e-3
    upper, B = np.triu_indices(2), np.array([[1.0], [0.0]])
    scale = np.array([0.005, 0.005, 0.18, 1, 1, 1, 9365.0])

    def full(x):
        mass, damping = np.zeros((2, 2)), np.zeros((2, 2))
        mass[upper], damping[upper] = (x * scale)[:3], (x * scale)[3:6]
        stiffness = x[6] * scale[6] * np.array([[1, -1], [-1, 1]])
        return mass + np.triu(mass, 1).T, damping + np.triu(damping, 1).T, stiffness

    def record(x):
        return (response(*full(x), B, "velocity", dt, samples)[0] / [[1.0], [0.1]]).ravel()

    def quantities(x):
        poles = response(*full(x), B, "velocity", dt, 2)[1]
        still = poles[np.abs(np.imag(poles)) < 1e-6]
        return np.concatenate([judged(poles), [np.real(still).min()], *(y[upper] for y in full(x))])

    so = system.mechanics.matrices
    x = np.concatenate([np.asarray(so.mass)[upper], np.asarray(so.damping)[upper], [9365.0]]) / scale
    J, G = differences(record, x), differences(quantities, x)
    expected = np.sqrt(np.diag(G @ np.linalg.solve(J.T @ J, G.T)))
    sampling = Sampling(dt, samples, None, np.array([1.0, 0.1]), "white")
    got = cramer_rao(system, structure_of(system, 3), sampling)
    np.testing.assert_allclose(got, expected, rtol=1e-5)


def test_modes_and_matrices_agree_where_the_unknowns_are_the_same():
    """One body: M, D, K are as many numbers as a pole pair and its shape of one output, but for the zero phase."""
    system = make_system("one_dof", "displacement", "default")
    sampling = Sampling(1.0, 100, None, np.ones(1), "white")
    structured = cramer_rao(system, None, sampling)
    free = cramer_rao(system._replace(mechanics=None), None, sampling)
    assert (structured <= free * (1 + 1e-9)).all()
    assert (free < 2.5 * structured).all()


def test_maximum_likelihood_reaches_it():
    """Gauss-Newton on m, d, k of one body from 400 noisy responses scatters as the bound says."""
    system, samples, dt, deviation = make_system("one_dof", "default", "default"), 60, 1.0, 0.01
    structure = structure_of(system, 2)
    bound = cramer_rao(system, structure, Sampling(dt, samples, None, np.array([deviation]), "white"))
    truth = np.array([1.0, 0.01, 1.0])

    def model(x):
        m, d, k = (np.full((1, 1), v) for v in x)
        return response(m, d, k, np.eye(1), "acceleration", dt, samples)[0].ravel()

    def quantities(x):
        m, d, k = (np.full((1, 1), v) for v in x)
        return np.concatenate([judged(response(m, d, k, np.eye(1), "acceleration", dt, 2)[1]), x])

    exact, found = model(truth), []
    J = differences(model, truth)
    for _ in range(400):
        y, x = exact + deviation * RNG.standard_normal(samples), truth
        for _ in range(4):  # the slope hardly changes over the scatter
            x = x + np.linalg.lstsq(J, y - model(x), rcond=None)[0]
        found.append(quantities(x))
    # the scatter of a standard deviation from 400 is 3.5 %
    np.testing.assert_allclose(np.std(found, axis=0), bound, rtol=0.13)


def test_what_leaves_no_trace_has_no_bound():
    system = make_system("chain3", "sensor1", "force1")
    everything = structure_of(make_system("chain3", "default", "default"), 6)
    got = cramer_rao(system, everything, Sampling(0.25, 120, None, np.ones(1), "white"))
    assert np.isfinite(got[:6]).all()  # poles
    assert np.isfinite(got[6])  # mass_1_1, sensed and driven
    assert np.isnan(got[[9, 11]]).all()  # mass_2_2, mass_3_3


def test_spread_of_a_quantity():
    R = RNG.standard_normal((30, 4)) * [1, 1e6, 1e-6, 1]
    G = RNG.standard_normal((2, 4))
    expected = np.sqrt(np.diag(G @ np.linalg.inv(R.T @ R) @ G.T))
    np.testing.assert_allclose(spread(R, G), expected, rtol=1e-9)
    copied = np.hstack([R, R[:, :1]])  # only the sum of the first and the last is seen
    G = np.array([[1.0, 0, 0, 0, 1.0], [1.0, 0, 0, 0, 0]])
    got = spread(copied, G)
    np.testing.assert_allclose(got[0], spread(R, np.eye(1, 4))[0], rtol=1e-9)
    assert np.isnan(got[1])


def test_driven_is_convolution():
    h, u = RNG.standard_normal((50, 2, 3)), RNG.standard_normal(50)
    expected = np.apply_along_axis(lambda x: np.convolve(x, u)[:50], 0, h)
    np.testing.assert_allclose(driven(h, u), expected, atol=1e-12)
    assert driven(h, None) is h


def test_it_does_not_matter_in_which_units():
    system = make_system("rig", "default", "default")
    structure = structure_of(system, 3)
    one, two = (
        cramer_rao(system, structure, Sampling(1e-3, 200, None, np.array([1.0, 3.0]) * scale, "white"))
        for scale in (1.0, 1e-4)
    )
    np.testing.assert_allclose(two, 1e-4 * one, rtol=1e-8)
    assert np.isfinite(one).all()
