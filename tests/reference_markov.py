"""Markov parameters of the reference systems, by scipy's matrix exponential: the truth for tests."""

import numpy as np
from scipy.linalg import expm

STIFFNESS = np.array([[4.0, -2, 0], [-2, 4, -2], [0, -2, 22]])
DAMPING = np.array([[0.2, -0.1, 0], [-0.1, 0.2, -0.1], [0, -0.1, 1.1]])
ONE = (np.eye(1), 0.01 * np.eye(1), np.eye(1), np.eye(1))
CHAIN = (np.eye(3), DAMPING, STIFFNESS, np.eye(3))
CHAIN_ONE_INPUT = (np.eye(3), DAMPING, STIFFNESS, np.eye(3)[:, :1])
OVERDAMPED = (np.eye(1), 5.0 * np.eye(1), 4.0 * np.eye(1), np.eye(1))  # poles -1 and -4
SYSTEMS = {"one": ONE, "chain": CHAIN, "chain_one_input": CHAIN_ONE_INPUT, "overdamped": OVERDAMPED}


def state_space(system, kind="acceleration"):
    """A, B, C, D of M q'' + D q' + K q = B u seen by one kind of sensor on every body."""
    mass, damping, stiffness, force = system
    n, inverse = len(mass), np.linalg.inv(mass)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ stiffness, -inverse @ damping]])
    B = np.vstack([np.zeros_like(force), inverse @ force])
    rows = {"displacement": np.eye(2 * n)[:n], "velocity": np.eye(2 * n)[n:], "acceleration": A[n:]}
    D = inverse @ force if kind == "acceleration" else np.zeros_like(force)
    return A, B, rows[kind], D


def hold_matrices(A, B, dt, hold="zero"):
    """Ad, B0, B1 with x_(k+1) = Ad x_k + B0 u_k + B1 (u_(k+1) - u_k), by one matrix exponential."""
    n, r = B.shape
    block = np.zeros((n + 2 * r, n + 2 * r))
    block[:n, :n], block[:n, n : n + r], block[n : n + r, n + r :] = A * dt, B * dt, np.eye(r)
    e = expm(block)
    return e[:n, :n], e[:n, n : n + r], e[:n, n + r :] if hold == "first" else np.zeros((n, r))


def impulse_samples(matrices, dt, samples, hold="zero"):
    """Response to u_0 = 1, u_k = 0 otherwise, one input after another: (samples, outputs, inputs)."""
    A, B, C, D = matrices
    Ad, B0, B1 = hold_matrices(A, B, dt, hold)
    # with a first-order hold u also rises over the interval that ends at t_0
    y, x = [C @ B1 + D], Ad @ B1 + B0 - B1
    for _ in range(samples - 1):
        y.append(C @ x)
        x = Ad @ x
    return np.array(y)


def markov(system, samples, dt=1e-3, kind="acceleration", hold="zero"):
    """Markov parameters and continuous poles."""
    matrices = state_space(system, kind)
    return impulse_samples(matrices, dt, samples, hold), np.linalg.eigvals(matrices[0])


def pole_error(found, poles):
    """Largest relative distance from a true pole to the nearest one found."""
    found = np.asarray(found)
    return max(np.abs(found - p).min() / abs(p) for p in poles)


def rebuilt(rz, samples):
    """Markov parameters of a realization."""
    A, B, C, D = (np.asarray(x) for x in (rz.A, rz.B, rz.C, rz.D))
    y, x = [D], B
    for _ in range(samples - 1):
        y.append(C @ x)
        x = A @ x
    return np.array(y)
