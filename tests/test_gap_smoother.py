"""The latent-force smoother against plain recursions, a dense Gaussian process, and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from jaxsid.gap.smoother import foretold_covariance, latent_model, smooth

DT, SIZE, RATE = 0.01, 3.0, 8.0
NOISE = np.array([0.002, 0.05])
MASS, DAMPING, STIFFNESS = 1.3, 0.9, 260.0
PLAIN = np.array([[0.0, 1.0], [-STIFFNESS / MASS, -DAMPING / MASS]])
PUSH = np.array([0.0, 1 / MASS])
SEEN, DIRECT = np.array([[1.0, 0.0], PLAIN[1]]), np.array([0.0, 1 / MASS])


def model():
    arrays = (jnp.asarray(x) for x in (PLAIN, PUSH, SEEN, DIRECT, SIZE, RATE, NOISE, DT))
    return latent_model(*arrays)


def augmented():
    whole = np.zeros((4, 4))
    whole[:2, :2], whole[:2, 2] = PLAIN, PUSH
    whole[2:, 2:] = [[0, 1], [-(RATE**2), -2 * RATE]]
    return whole


def record(samples=600):
    rng, found = np.random.default_rng(3), model()
    A, Q, C = (np.asarray(x) for x in (found.A, found.Q, found.C))
    root = scipy.linalg.sqrtm(Q).real
    x, states, y = np.zeros(4), [], []
    for _ in range(samples):
        states.append(x)
        y.append(C @ x + NOISE * rng.standard_normal(2))
        x = A @ x + root @ rng.standard_normal(4)
    return np.array(states), np.array(y)


def test_sampled_model_is_that_of_a_fine_quadrature():
    whole, found = augmented(), model()
    white = np.diag([0, 0, 0, 4 * RATE**3 * SIZE**2])
    points = (np.arange(200) + 0.5) * DT / 200
    steps = [scipy.linalg.expm(whole * s) for s in points]
    Q = sum(F @ white @ F.T for F in steps) * DT / len(steps)
    np.testing.assert_allclose(found.A, scipy.linalg.expm(whole * DT), rtol=1e-10, atol=1e-12)
    assert np.linalg.norm(found.Q - Q) < 1e-3 * np.linalg.norm(Q)


def test_the_force_alone_keeps_its_stationary_variance():
    found = model()
    own, Q = np.asarray(found.A)[2:, 2:], np.asarray(found.Q)[2:, 2:]
    stationary = SIZE**2 * np.diag([1.0, RATE**2])
    np.testing.assert_allclose(own @ stationary @ own.T + Q, stationary, rtol=1e-9, atol=1e-8)


def test_covariance_solves_the_riccati_equation_of_scipy():
    found = model()
    A, Q, C, R = (np.asarray(x) for x in found)
    expected = scipy.linalg.solve_discrete_are(A.T, C.T, Q, R)
    P = np.asarray(foretold_covariance(found))
    assert np.linalg.norm(P - expected) < 1e-7 * np.linalg.norm(expected)


@pytest.mark.parametrize("plain", [PLAIN, [[0.0, 1.0], [4.0, -0.5]]], ids=["stable", "unstable"])
def test_covariance_of_one_accelerometer_that_hardly_has_noise(plain):
    plain = np.array(plain)
    given = (plain, PUSH, plain[1:], PUSH[1:], SIZE, RATE, np.array([1e-10]), DT)
    found = latent_model(*(jnp.asarray(x) for x in given))
    A, Q, C, R = (np.asarray(x) for x in found)
    expected = scipy.linalg.solve_discrete_are(A.T, C.T, Q, R)
    P = np.asarray(foretold_covariance(found))
    unit = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(P / unit / unit[:, None], expected / unit / unit[:, None], atol=1e-6)
    gain = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
    assert np.abs(np.linalg.eigvals(A @ (np.eye(4) - gain @ C))).max() < 1


def test_smoothing_is_that_of_a_plain_recursion_with_the_full_covariances():
    found = model()
    A, Q, C, R = (np.asarray(x) for x in found)
    _, y = record(1500)
    x, P = np.zeros(4), np.asarray(foretold_covariance(found))
    foretold, filtered = [], []
    for seen in y:
        foretold.append((x, P))
        gain = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
        x, P = x + gain @ (seen - C @ x), P - gain @ C @ P
        filtered.append((x, P))
        x, P = A @ x, A @ P @ A.T + Q
    states, covariances = [filtered[-1][0]], [filtered[-1][1]]
    for (x, P), (ahead, wide) in zip(filtered[-2::-1], foretold[:0:-1], strict=True):
        back = P @ A.T @ np.linalg.inv(wide)
        states.append(x + back @ (states[-1] - ahead))
        covariances.append(P + back @ (covariances[-1] - wide) @ back.T)
    result = smooth(found, jnp.asarray(y), jnp.zeros(4))
    scale = np.sqrt(np.diag(np.asarray(result.covariance)))
    np.testing.assert_allclose(result.state / scale, np.array(states[::-1]) / scale, atol=1e-5)
    middle = covariances[750]
    assert np.linalg.norm((result.covariance - middle) / scale / scale[:, None]) < 1e-5


def test_force_is_that_of_a_dense_gaussian_process():
    """The posterior of a Matern force on the exact impulse response, away from the ends."""
    found, samples = model(), 800
    _, y = record(samples)
    A, Q, C, R = (np.asarray(x) for x in found)
    stationary = scipy.linalg.solve_discrete_lyapunov(A, Q)
    powers = [np.eye(4)]
    for _ in range(samples - 1):
        powers.append(A @ powers[-1])
    forward = np.array([C @ F @ stationary @ C.T for F in powers])  # covariance of y_(t+k) with y_t
    crossed = np.array([(F @ stationary @ C.T)[2] for F in powers])  # of f_(t+k) with y_t
    backed = np.array([stationary[2] @ F.T @ C.T for F in powers])  # of f_t with y_(t+k)
    lag = np.arange(samples)[:, None] - np.arange(samples)
    late = (lag >= 0)[:, :, None, None]
    K = np.where(late, forward[np.abs(lag)], np.swapaxes(forward[np.abs(lag)], 2, 3)).swapaxes(1, 2)
    kf = np.where(late[..., 0], crossed[np.abs(lag)], backed[np.abs(lag)])
    dense = K.reshape(2 * samples, -1) + np.kron(np.eye(samples), R)
    expected = kf.reshape(samples, -1) @ np.linalg.solve(dense, y.ravel())
    spread = stationary[2, 2] - np.einsum(
        "ij,ji->i", kf.reshape(samples, -1), np.linalg.solve(dense, kf.reshape(samples, -1).T)
    )
    result = smooth(found, jnp.asarray(y), jnp.zeros(4))
    inner = slice(350, 450)
    assert np.abs(np.asarray(result.state)[inner, 2] - expected[inner]).max() < 1e-4 * SIZE
    np.testing.assert_allclose(result.covariance[2, 2], spread[inner], rtol=1e-4)


def test_errors_are_as_large_as_said():
    states, y = record(3000)
    result = smooth(model(), jnp.asarray(y), jnp.zeros(4))
    error = (np.asarray(result.state) - states)[200:-200]
    np.testing.assert_allclose(error.std(axis=0), np.sqrt(np.diag(result.covariance)), rtol=0.2)


def test_free_body_is_tracked():
    plain = np.array([[0.0, 1.0], [0.0, 0.0]])
    arrays = (plain, PUSH, np.array([[1.0, 0.0]]), np.zeros(1), SIZE, RATE, NOISE[:1], DT)
    found = latent_model(*(jnp.asarray(x) for x in arrays))
    t = np.arange(2000) * DT
    y = np.sin(2 * t)[:, None]
    result = smooth(found, jnp.asarray(y), jnp.zeros(4))
    expected = -4 * np.sin(2 * t) * MASS
    inner = slice(300, 1700)
    assert np.abs(np.asarray(result.state)[inner, 2] - expected[inner]).max() < 0.05 * 4 * MASS


def test_under_jit_and_vmap():
    _, y = record(200)
    found = model()
    one = smooth(found, jnp.asarray(y), jnp.zeros(4))
    both = jax.jit(jax.vmap(smooth, (None, 0, None)))(found, jnp.stack([y, 2 * y]), jnp.zeros(4))
    np.testing.assert_allclose(both.state[0], one.state, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(both.state[1], 2 * one.state, rtol=1e-8, atol=1e-9)
