"""True systems and records for the tests of impulse responses, by scipy alone."""

import numpy as np
from scipy import signal

from jaxsid.records import Record

ONE = (np.eye(1), 0.01 * np.eye(1), np.eye(1))
CHAIN = (
    np.eye(3),
    np.array([[0.2, -0.1, 0], [-0.1, 0.2, -0.1], [0, -0.1, 1.1]]),
    np.array([[4.0, -2, 0], [-2, 4, -2], [0, -2, 22]]),
)


def acceleration_system(matrices, dt):
    """Discrete A, B, C, D from forces to accelerations, zero-order hold."""
    M, D, K = matrices
    n = len(M)
    inverse = np.linalg.inv(M)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ K, -inverse @ D]])
    B = np.vstack([np.zeros((n, n)), inverse])
    return signal.cont2discrete((A, B, A[n:], inverse), dt)[:4]


def markov(matrices, dt, samples):
    """(samples, outputs, inputs)."""
    A, B, C, D = acceleration_system(matrices, dt)
    h, x = [D], B
    for _ in range(samples - 1):
        h.append(C @ x)
        x = A @ x
    return np.array(h)


def respond(matrices, dt, u):
    """Accelerations from rest to u (samples, inputs)."""
    return signal.dlsim((*acceleration_system(matrices, dt), dt), u)[1]


def poles(matrices):
    M, D, K = matrices
    n = len(M)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    return sorted_poles(np.linalg.eigvals(A))


def sorted_poles(p):
    return p[np.lexsort((p.imag, np.round(np.abs(p), 3)))]


def chirp(low, high, duration, dt, samples):
    """A sine sweep that starts at zero."""
    return signal.chirp(np.arange(samples) * dt, low, duration, high, phi=-90)


def one_at_a_time(matrices, dt, u):
    """A record for each input, the other inputs resting."""
    inputs = len(matrices[0])
    records = []
    for j in range(inputs):
        force = np.zeros((len(u), inputs))
        force[:, j] = u
        records.append(Record(force, respond(matrices, dt, force), dt))
    return records


def noisy(record, level, rng):
    """White noise of `level` times each output's standard deviation."""
    y = np.asarray(record.y)
    return Record(record.u, y + level * y.std(axis=0) * rng.standard_normal(y.shape), record.dt)


def error(h, truth):
    """Relative error, over the taps that both have."""
    n = min(len(h), len(truth))
    return np.linalg.norm(np.asarray(h)[:n] - truth[:n]) / np.linalg.norm(truth[:n])


def era(h, dt, order, blocks=40):
    """Poles and modal B (continuous), C by a plain ERA of a strided Hankel matrix, shifted by the stride."""
    stride = (len(h) - 1) // (2 * blocks)
    at = np.arange(blocks) * stride
    H = np.vstack([np.hstack([h[1 + i + j] for j in at]) for i in at])
    H1 = np.vstack([np.hstack([h[1 + stride + i + j] for j in at]) for i in at])
    U, s, Vt = np.linalg.svd(H)
    root = np.sqrt(s[:order])
    A = (U[:, :order] / root).T @ H1 @ (Vt[:order].T / root)
    B = root[:, None] * Vt[:order, : h.shape[2]]
    C = U[: h.shape[1], :order] * root
    values, vectors = np.linalg.eig(A)
    lam = np.log(values) / (stride * dt)
    B_modal = np.linalg.solve(vectors, B) * (lam / (np.exp(lam * dt) - 1))[:, None]
    return lam, B_modal, C @ vectors


def physical(lam, B, C, force):
    """M, D, K from a modal model with an accelerometer at each degree of freedom, by the transfer function.

    Receptance shapes Phi = C / lam^2; T = [Phi; Phi lam]; A = T lam T^-1 = [0 I; -M^-1 K, -M^-1 D], and
    Phi lam B = M^-1 B.
    """
    shapes = C / lam**2
    T = np.vstack([shapes, shapes * lam])
    A = (T * lam) @ np.linalg.inv(T)
    n = len(shapes)
    M = force @ np.linalg.inv(((shapes * lam) @ B).real)
    return M, (-M @ A[n:, n:]).real, (-M @ A[n:, :n]).real
