"""The DaISy flexible structure: 2 forces, 28 accelerations, and the protocol that every tool is held to.

Only numpy and scipy are needed, so that the peers' environment can use it too. The data set is the
publisher's and is not part of this repository: `JAXSID_DATA` names the folder that holds `flexible_structure`.
"""

import os
from pathlib import Path

import numpy as np
from scipy.io import loadmat

RATE = 1024.0  # Hz
BAND = (10.0, 500.0)  # Hz, excited
SHARE = 0.7  # of the samples, for identification
START = 256  # held-out samples that give the initial state; the ones after them are scored


def data_file() -> Path:
    """Where the measured record should be."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    return Path(os.environ.get("JAXSID_DATA", beside)) / "flexible_structure" / "flexibleStructure.mat"


def load() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Inputs and outputs for identification, then held out; means of the first part taken off both."""
    table = loadmat(data_file())["flexibleStructure"]
    split = int(SHARE * len(table))
    table = table - table[:split].mean(axis=0)
    u, y = table[:, :2], table[:, 2:]
    return u[:split], y[:split], u[split:], y[split:]


def nrmse(predicted: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Root-mean-square error of each output over its standard deviation, after the initial stretch."""
    wrong = np.sqrt(((predicted - measured)[START:] ** 2).mean(axis=0)) / measured[START:].std(axis=0)
    return np.where(np.isfinite(wrong), wrong, np.inf)


def predict(
    A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray, u: np.ndarray, y: np.ndarray
) -> np.ndarray:
    """Simulation of a sampled model; its initial state is a least-squares fit to the first stretch of y."""
    state = np.zeros(len(A))
    forced = recursion(A, B, C, D, u[:START], state)
    rows = [C]
    for _ in range(START - 1):
        rows.append(rows[-1] @ A)
    seen = np.concatenate(rows)
    if not np.isfinite(seen).all() or not np.isfinite(forced).all():
        return np.full_like(y, np.inf)
    state = np.linalg.lstsq(seen, (y[:START] - forced).ravel(), rcond=1e-8)[0]
    return recursion(A, B, C, D, u, state)


def recursion(
    A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray, u: np.ndarray, x: np.ndarray
) -> np.ndarray:
    """y_k = C x_k + D u_k, x_(k+1) = A x_k + B u_k."""
    states = np.empty((len(u), len(A)))
    for k, push in enumerate(u @ B.T):
        states[k] = x
        x = A @ x + push
    return states @ C.T + u @ D.T
