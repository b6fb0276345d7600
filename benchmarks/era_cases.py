"""Impulse responses on which realizations are timed, the same bits for every tool.

    .venv-bench/bin/python benchmarks/era_cases.py OUT.npz

Only numpy and scipy are needed. A and B are the thesis's systems at its sampling; C is the latter with noise, over
a window as long as its slowest period; D stands in for the Galileo test, whose records are not published.
"""

import sys
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.signal import cont2discrete


class Case(NamedTuple):
    """A block Hankel matrix to realize from.

    Attributes:
        title: what is measured, and the size of the matrix.
        order: states.
        rows, cols: block rows and block columns.
        dt: sampling interval, s.
        noise: standard deviation over the root mean square of the impulse response past its feedthrough.
        realizations: responses with different noise; with `together` all of them are one task.
    """

    title: str
    order: int
    rows: int
    cols: int
    dt: float
    noise: float = 0.0
    realizations: int = 1
    together: bool = False


CASES = {
    "A": Case("1 DOF, 1000 x 1000", 2, 1000, 1000, 1e-3),
    "B": Case("3 DOF, 3000 x 3000", 6, 1000, 1000, 1e-3),
    "C": Case("3 DOF, 200 noisy realizations of 300 x 300", 6, 100, 100, 0.02, 0.01, 200, True),
    "D1": Case("162 outputs, 324 x 496", 30, 2, 496, 1 / 102.4),
    "D1 noisy": Case("the same with 1 % noise", 30, 2, 496, 1 / 102.4, 0.01, 20),
    "D2": Case("162 outputs, 8100 x 250", 30, 50, 250, 1 / 102.4),
    "D2 noisy": Case("the same with 1 % noise", 30, 50, 250, 1 / 102.4, 0.01, 20),
}
ONE = np.eye(1), np.array([[0.01]]), np.array([[1.0]])
CHAIN = (
    np.eye(3),
    np.array([[0.2, -0.1, 0.0], [-0.1, 0.2, -0.1], [0.0, -0.1, 1.1]]),
    np.array([[4.0, -2.0, 0.0], [-2.0, 4.0, -2.0], [0.0, -2.0, 22.0]]),
)
OUTPUTS, MODES = 162, 15


def held_response(
    system: tuple[np.ndarray, np.ndarray, np.ndarray], dt: float, samples: int
) -> tuple[np.ndarray, np.ndarray]:
    """Accelerations (samples, N, N) to held unit forces of M q'' + D q' + K q = u, and the poles."""
    mass, damping, stiffness = system
    inverse, n = np.linalg.inv(mass), len(mass)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ stiffness, -inverse @ damping]])
    B = np.concatenate([np.zeros((n, n)), inverse])
    sampled = cont2discrete((A, B, A[n:], inverse), dt)
    state, h = sampled[1], [inverse]
    for _ in range(samples - 1):
        h.append(A[n:] @ state)
        state = sampled[0] @ state
    return np.array(h), np.linalg.eigvals(A)


def galileo_response(dt: float, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Decays (samples, 162, 1) of 15 modes from 13 to 45 Hz with 0.5 to 2 % damping, and the poles."""
    rng = np.random.default_rng(15)
    frequencies = 2 * np.pi * (np.linspace(13, 45, MODES) + rng.uniform(-0.6, 0.6, MODES))
    damping = rng.uniform(0.005, 0.02, MODES)
    poles = frequencies * (-damping + 1j * np.sqrt(1 - damping**2))
    residues = rng.normal(size=(OUTPUTS, MODES)) * rng.uniform(0.5, 2, MODES)
    decays = np.exp(poles * dt * np.arange(samples)[:, None])
    return (decays @ residues.T).imag[:, :, None], np.concatenate([poles, poles.conj()])


def response(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Impulse responses (realizations, samples, outputs, inputs) and the true poles, 1/s."""
    case = CASES[name]
    samples = case.rows + case.cols + 1  # the feedthrough, the Hankel matrix, and it one sample later
    if name.startswith("D"):
        h, poles = galileo_response(case.dt, samples)
    else:
        h, poles = held_response(ONE if name == "A" else CHAIN, case.dt, samples)
    size = case.noise * np.sqrt((h[1:] ** 2).mean())
    noise = np.random.default_rng(0).normal(size=(case.realizations, *h.shape))
    return h + size * noise, poles


def shifted_blocks(h: np.ndarray, case: Case) -> np.ndarray:
    """The block Hankel matrix with one block column more, filled a block row at a time."""
    outputs = h.shape[1]
    both = np.empty((case.rows * outputs, (case.cols + 1) * h.shape[2]))
    for i in range(case.rows):
        row = h[1 + i : 2 + i + case.cols].transpose(1, 0, 2)
        both[i * outputs : (i + 1) * outputs] = row.reshape(outputs, -1)
    return both


def full_svd_era(h: np.ndarray, case: Case) -> np.ndarray:
    """State matrix by ERA in plain numpy: thin singular value decomposition of the whole Hankel matrix."""
    both = shifted_blocks(h, case)
    inputs = h.shape[2]
    u, s, vt = np.linalg.svd(both[:, :-inputs], full_matrices=False)
    root = np.sqrt(s[: case.order])
    return (u[:, : case.order] / root).T @ (both[:, inputs:] @ (vt[: case.order].T / root))


def sorted_poles(A: np.ndarray, dt: float, truth: np.ndarray) -> np.ndarray:
    """Continuous poles of state matrices (..., n, n), each put where the true pole nearest to it is."""
    found = np.log(np.linalg.eigvals(A).astype(complex)) / dt
    flat = found.reshape(-1, found.shape[-1])
    places = [linear_sum_assignment(np.abs(p[:, None] - truth))[0:2] for p in flat]
    ordered = [p[rows[np.argsort(cols)]] for p, (rows, cols) in zip(flat, places, strict=True)]
    return np.array(ordered).reshape(found.shape)


def errors(data: dict[str, np.ndarray], name: str, A: np.ndarray) -> dict[str, float]:
    """How far poles are off: of the truth without noise, of the full decomposition's in its spreads with noise.

    `truth` is with noise the root mean square over realizations, also in spreads; the worst pole counts.
    """
    poles = data[f"{name} poles"]
    found = sorted_poles(A, CASES[name].dt, poles)
    if not CASES[name].noise:
        return {"truth": float((np.abs(found - poles) / np.abs(poles)).max())}
    reference, spread = data[f"{name} reference"][: len(found)], data[f"{name} spread"]
    away = np.sqrt((np.abs(found - poles) ** 2).mean(axis=0)) / spread
    return {"full": float((np.abs(found - reference) / spread).max()), "truth": float(away.max())}


def main() -> None:
    data = {}
    for name, case in CASES.items():
        data[name], data[f"{name} poles"] = response(name)
        if case.noise:
            A = np.array([full_svd_era(h, case) for h in data[name]])
            data[f"{name} reference"] = sorted_poles(A, case.dt, data[f"{name} poles"])
            data[f"{name} spread"] = data[f"{name} reference"].std(axis=0)
    np.savez(sys.argv[1], **data)


if __name__ == "__main__":
    main()
