"""ERA by numpy, python-control, pyMOR and pyYeti: from an impulse response to a state matrix.

Each is called as its documentation shows, its printing and plotting off. pyMOR's Hankel matrices are square in
blocks: where the case's is not, it gets the square one on the same samples.
"""

import logging
import warnings
from collections.abc import Callable

import control
import numpy as np
from era_cases import CASES, Case, full_svd_era
from pymor.core.logger import set_log_levels
from pymor.reductors.era import RandomizedERAReductor
from pyyeti.era import ERA

set_log_levels({"pymor": logging.ERROR})
warnings.simplefilter("ignore")
np.seterr(all="ignore")


def by_control(h: np.ndarray, case: Case) -> np.ndarray:
    found, _ = control.eigensys_realization(h.transpose(1, 2, 0), case.order, m=case.rows, n=case.cols)
    return found.A


def by_pymor(h: np.ndarray, case: Case, **options: int) -> np.ndarray:
    """Samples 1 to 2 s - 1 of a response, s blocks each way; not padded, since it has not decayed."""
    blocks = (case.rows + case.cols) // 2
    reductor = RandomizedERAReductor(
        h[1 : 2 * blocks], case.dt, force_stability=False, feedthrough=h[0], **options
    )
    return reductor.reduce(case.order).A.matrix


def by_pyyeti(h: np.ndarray, case: Case) -> np.ndarray:
    """The modal form that it goes on to costs next to nothing; every mode is kept."""
    settings = {"auto": True, "verbose": False, "show_plot": False, "all_lower_limits": 0.0}
    free = h[1 : case.rows + case.cols + 1].transpose(1, 0, 2)
    found = ERA(
        free,
        1 / case.dt,
        svd_tol=case.order,
        alpha=case.rows,
        beta=case.cols,
        damp_range=(-1.0, 1.0),
        **settings,
    )
    return found.A_hat


METHODS: dict[str, Callable[[np.ndarray, Case], np.ndarray]] = {
    "numpy": full_svd_era,
    "python-control": by_control,
    "pyMOR randomized": by_pymor,
    "pyMOR randomized, 15 output directions": lambda h, case: by_pymor(h, case, num_left=15),
    "pyYeti": by_pyyeti,
}


def task(tool: str, name: str, responses: np.ndarray) -> Callable[[], np.ndarray]:
    """What is timed: one realization, or one after another where the case asks for all of them."""
    case, method = CASES[name], METHODS[tool]
    given = responses if case.together else responses[:1]
    return lambda: np.array([method(h, case) for h in given])


prepared = task  # nothing is compiled beforehand
