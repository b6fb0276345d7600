"""ERA by jaxsid: from an impulse response to a state matrix, as a caller of the library gets it."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
from era_cases import CASES, Case

import jaxsid

jax.config.update("jax_enable_x64", True)
CORES = 2  # that share an ensemble, one realization at a time each, as jaxsid.ensemble does it
POOL = ThreadPoolExecutor(CORES)

METHODS = {"jaxsid": "fast", "jaxsid, full decomposition": "svd"}


def state_matrix(h: jax.Array, case: Case, method: str) -> jax.Array:
    response = jaxsid.ImpulseResponse(h, case.dt)
    return jaxsid.era(response, order=case.order, rows=case.rows, cols=case.cols, method=method).A


def task(tool: str, name: str, responses: np.ndarray) -> Callable[[], np.ndarray]:
    """What is timed, from numpy arrays to numpy arrays: one realization, or all of them, shared by the cores."""
    case, method = CASES[name], METHODS[tool]
    if case.together:
        every = jax.jit(lambda h: jax.lax.map(lambda x: state_matrix(x, case, method), h))
        shares = np.split(responses, CORES)
        return lambda: np.concatenate(list(POOL.map(lambda h: np.asarray(every(h)), shares)))
    return lambda: np.asarray(state_matrix(responses[0], case, method))[None]


def prepared(tool: str, name: str, responses: np.ndarray) -> Callable[[], np.ndarray]:
    """The task of one realization as a program that is compiled but has not run."""
    case, method = CASES[name], METHODS[tool]
    program = jax.jit(lambda h: state_matrix(h, case, method)).lower(responses[0]).compile()
    return lambda: np.asarray(program(responses[0]))[None]
