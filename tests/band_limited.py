"""Records of mechanical systems under band-limited forces, by numpy and scipy alone."""

from typing import NamedTuple

import numpy as np
from scipy import linalg, signal

KINDS = {"d": "displacement", "v": "velocity", "a": "acceleration"}
DT = 1e-3


class System(NamedTuple):
    """Mass, damping, stiffness, the body that each input acts on, and one sensor kind (d, v, a) a body."""

    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    driven: tuple[int, ...]
    kinds: str

    @property
    def kind_names(self):
        return tuple(KINDS[k] for k in self.kinds)

    @property
    def force(self):
        return np.eye(len(self.mass))[:, list(self.driven)]


def chain(mass, stiffness, damping, driven=(0,), kinds=None):
    """Bodies in a row; element i joins body i - 1 (ground for the first) to body i, one more the last to ground."""
    n = len(mass)
    K, D = np.zeros((n, n)), np.zeros((n, n))
    for matrix, values in ((K, stiffness), (D, damping)):
        for i, value in enumerate(values):
            joint = np.zeros(n)
            if i < n:
                joint[i] = 1
            if i > 0:
                joint[i - 1] -= 1
            matrix += value * np.outer(joint, joint)
    return System(np.diag(np.asarray(mass, float)), D, K, tuple(driven), kinds or "a" * n)


def state_space(system):
    """Continuous A, B, C, D of displacements and velocities."""
    M, D, K = system.mass, system.damping, system.stiffness
    n = len(M)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    B = np.vstack([np.zeros((n, len(system.driven))), np.linalg.solve(M, system.force)])
    rows = {"d": np.eye(n, 2 * n), "v": np.eye(n, 2 * n, n), "a": A[n:]}
    C = np.stack([rows[k][i] for i, k in enumerate(system.kinds)])
    through = np.stack([B[n + i] * (k == "a") for i, k in enumerate(system.kinds)])
    return A, B, C, through


def poles(system):
    """All poles, 1/s."""
    return np.linalg.eigvals(state_space(system)[0])


def modes(system):
    """Frequencies (Hz) and damping ratios of the oscillating poles and of the real ones that are not zero."""
    p = poles(system)
    p = p[(p.imag > 1e-6 * np.abs(p)) | ((np.abs(p.imag) <= 1e-6 * np.abs(p)) & (np.abs(p) > 1e-3))]
    return np.abs(p) / 2 / np.pi, -p.real / np.abs(p)


def band_noise(rng, samples, inputs, dt=DT, low=1.0, high=60.0):
    """Gaussian noise between two frequencies (Hz), (samples, inputs)."""
    sections = signal.butter(6, [low, high], "band", fs=1 / dt, output="sos")
    return signal.sosfilt(sections, rng.standard_normal((samples + 2000, inputs)), axis=0)[2000:]


def respond(system, u, dt=DT, hold="zoh", state=None):
    """Outputs at the samples, exact for inputs held as "zoh" or "foh" (linear)."""
    model = signal.cont2discrete(state_space(system), dt, method=hold)
    return signal.dlsim((*model[:4], dt), u, x0=state)[1]


def periodic(system, rng, samples, period, dt=DT, low=1.0, high=60.0):
    """A window of a random-phase multisine and of the steady response, exact between the samples too."""
    f = np.fft.rfftfreq(period, dt)
    inside = (f >= low) & (f <= high)
    U = np.zeros((len(f), len(system.driven)), complex)
    U[inside] = np.exp(2j * np.pi * rng.random((inside.sum(), U.shape[1])))
    A, B, C, D = state_space(system)
    s = 2j * np.pi * f[inside]
    G = C @ np.linalg.solve(s[:, None, None] * np.eye(len(A)) - A, B[None]) + D
    Y = np.zeros((len(f), len(C)), complex)
    Y[inside] = np.einsum("koi,ki->ko", G, U[inside])
    size = period / np.sqrt(inside.sum())
    return tuple(np.fft.irfft(x * size, period, axis=0)[:samples] for x in (U, Y))


def coloured(rng, shape, colour=None):
    """Noise of unit standard deviation, white, AR(1) ("low") or differenced ("high")."""
    e = rng.standard_normal(shape)
    if colour == "low":
        e = signal.lfilter([1], [1, -0.95], e, axis=0)
    if colour == "high":
        e = signal.lfilter([1, -0.9], [1], e, axis=0)
    return e / e.std(axis=0)


def experiment(system, seed, noise=0.01, colour=None, seconds=20.0, dt=DT):
    """Inputs and noisy outputs; the noise in parts of each output's rms."""
    rng = np.random.default_rng(seed)
    u = band_noise(rng, int(seconds / dt), len(system.driven), dt)
    y = respond(system, u, dt)
    return u, y + noise * y.std(axis=0) * coloured(rng, y.shape, colour)


def minimal(system, rng, order):
    """The observable part of a system, in a random basis: continuous A, B, C, D of this order.

    The unobservable states have poles at zero: those of rigid motion. They lie in the null space of the
    observability matrix, here found in states scaled to equal size.
    """
    A, B, C, D = state_space(system)
    if order < len(A):
        A, B, C = _observable(A, B, C, order)
    T = linalg.qr(rng.standard_normal((order, order)))[0] * np.exp(rng.uniform(-1, 1, order))
    inverse = np.linalg.inv(T)
    return inverse @ A @ T, inverse @ B, C @ T, D


def _observable(A, B, C, order):
    rate = np.abs(np.linalg.eigvals(A)).max()
    n = len(A) // 2
    scale = np.repeat([1 / rate, 1.0], n)  # displacements as velocities
    A, B, C = A * scale / scale[:, None], B / scale[:, None], C * scale
    C_unit = C / np.linalg.norm(C, axis=1, keepdims=True)
    rows = [C_unit]
    for _ in range(len(A) - 1):
        rows.append(rows[-1] @ A / rate)
    basis = np.linalg.svd(np.vstack(rows))[2][:order]
    return basis @ A @ basis.T, basis @ B, C @ basis.T


def error(found, truth):
    """Relative errors by the Frobenius norm and by the largest entry."""
    found, truth = np.asarray(found), np.asarray(truth)
    return (
        np.linalg.norm(found - truth) / np.linalg.norm(truth),
        np.abs(found - truth).max() / np.abs(truth).max(),
    )


THREE = ([1.2, 0.9, 0.7], [3000, 2500, 2000], [1.5, 1.2, 1.0])
SEVEN = (
    [1, 1.1, 0.9, 1, 1.2, 0.8, 1.0],
    [9000, 8000, 9000, 7000, 8000, 9000, 7000],
    [3, 3, 2, 3, 2, 3, 2],
)
