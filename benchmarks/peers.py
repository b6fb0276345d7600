"""python-control and mdof on the flexible structure.

    .venv-bench/bin/python benchmarks/peers.py OUT.json

They run in an environment of their own. Each is given several settings, its unstable poles are dropped, its
inputs are taken as they are and one sample early, and the setting that predicts the held-out samples best is
kept: choices in its favour, which a user without those samples could not make.
"""

import json
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from importlib.metadata import version

import control
import flexible_structure as data
import mdof
import numpy as np
from mdof.markov import okid
from mdof.realize import era

warnings.simplefilter("ignore")  # an unstable model overflows: an outcome here, and reported as one
np.seterr(all="ignore")
Model = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
Attempt = tuple[str, Callable[[], Model]]
VERSIONS = ("control", "mdof", "numpy", "pymor", "pyyeti")  # of all peers, for the tables
ADVANCES = (0, 1)  # samples by which the inputs are taken early


def control_attempts(u: np.ndarray, y: np.ndarray) -> Iterator[Attempt]:
    """Markov parameters by least squares, then ERA; one response serves all orders."""
    for count in (400, 900):
        response = np.asarray(control.markov(y.T, u.T, m=count, truncate=True))
        for order in (40, 60, 100):

            def attempt(response: np.ndarray = response, order: int = order) -> Model:
                found, _ = control.eigensys_realization(response, order, m=60, n=250)
                return stable(found.A, found.B, found.C, found.D)

            yield f"markov({count}), eigensys_realization(order {order})", attempt


def mdof_attempts(u: np.ndarray, y: np.ndarray) -> Iterator[Attempt]:
    """SRIM, its unstable poles dropped before B and D are fitted, and OKID with ERA."""
    for horizon, order in ((10, 40), (20, 40), (20, 60)):
        options = {"method": "srim", "horizon": horizon, "order": order, "stabilize_intermediate": True}
        yield f"srim(horizon {horizon}, order {order})", lambda o=options: tuple(mdof.sysid(u.T, y.T, **o))
    response = okid(u.T, y.T, m=40)
    for order in (40, 60):
        options = {"horizon": 20, "nc": 20, "order": order}
        yield f"okid(m 40), era(order {order})", lambda o=options: stable(*era(response, **o))


def stable(A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray) -> Model:
    """The model without its unstable modes; the peers themselves return them."""
    values, vectors = np.linalg.eig(A)
    kept = np.abs(values) < 1
    left = np.linalg.inv(vectors)
    slow = (vectors[:, kept] * values[kept]) @ left[kept]
    return slow.real, (vectors[:, kept] @ left[kept] @ B).real, C, D


def score(attempt: Callable[[], Model], u: np.ndarray, y: np.ndarray) -> tuple[list[float], float]:
    """NRMSE of each output on held-out samples, infinite where the tool gives no usable model; seconds."""
    begin = time.perf_counter()
    try:
        A, B, C, D = (np.real(np.asarray(x)) for x in attempt())
        seconds = time.perf_counter() - begin
        return data.nrmse(data.predict(A, B, C, D, u, y), y).tolist(), seconds
    except (np.linalg.LinAlgError, ValueError, AssertionError, FloatingPointError):
        return [float("inf")] * y.shape[1], time.perf_counter() - begin


def trials(attempts: Callable[[np.ndarray, np.ndarray], Iterator[Attempt]]) -> list[dict]:
    """Every setting of one tool."""
    u, y, u_held, y_held = data.load()
    rows = []
    for advance in ADVANCES:
        keep, held = len(u) - advance, len(u_held) - advance
        for words, attempt in attempts(u[advance:], y[:keep]):
            wrong, seconds = score(attempt, u_held[advance:], y_held[:held])
            words += ", inputs one sample early" if advance else ""
            rows.append({"setting": words, "nrmse": wrong, "seconds": seconds})
            print(f"{words}: median {np.median(wrong):.3g}, {seconds:.1f} s", file=sys.stderr, flush=True)
    return rows


def main() -> None:
    found = {
        "versions": {name: version(name) for name in VERSIONS},
        "structure": {},
    }
    if data.data_file().exists():
        found["structure"] = {"mdof": trials(mdof_attempts), "python-control": trials(control_attempts)}
    with open(sys.argv[1], "w") as file:
        json.dump(found, file)


if __name__ == "__main__":
    main()
