"""Whether columns explain more of what is left than chance does, others out of the way first."""

from typing import NamedTuple

import numpy as np
from jax.scipy.special import betainc
from jaxtyping import Float

DEPENDENT = 1e-7  # eigenvalue of columns of unit size below which a combination of them is nothing
RIDGE = 1e-10  # of what is out of the way, likewise


class FTest(NamedTuple):
    """What columns explain.

    Attributes:
        p_value: probability of as much by chance.
        part: of what is left, in power, that they explain beyond what chance does.
    """

    p_value: float
    part: float


def f_test(gram: Float[np.ndarray, "k k"], first: int, equations: int) -> FTest:
    """F test of columns: F = (E / r) / (R / n), E and R what they explain and leave, r how many they are.

    Args:
        gram: products of columns that are out of the way first, of those that are asked for, and of what is left.
        first: how many are out of the way.
        equations: n + r, rows less all else that was fitted to them.

    Source: G. Seber and A. Lee, Linear Regression Analysis, 2nd ed. (2003), section 4.3.
    """
    norm = np.sqrt(np.diag(gram))
    gram = gram / np.where(norm > 0, norm, 1.0) / np.where(norm > 0, norm, 1.0)[:, None]
    own = gram[:first, :first] + RIDGE * np.eye(first)
    gram = gram[first:, first:] - gram[first:, :first] @ np.linalg.solve(own, gram[:first, first:])
    values, vectors = np.linalg.eigh(gram[:-1, :-1])
    seen = values > DEPENDENT
    explained = float(((vectors[:, seen].T @ gram[:-1, -1]) ** 2 / values[seen]).sum())
    rank, total = int(seen.sum()), float(gram[-1, -1])
    if rank == 0 or total <= 0:
        return FTest(1.0, 0.0)
    rest = max(equations - rank, 1)
    ratio = (explained / rank) / (max(total - explained, 1e-300) / rest)
    p = float(betainc(rest / 2, rank / 2, rest / (rest + rank * ratio)))
    return FTest(p, max(explained - (total - explained) * rank / rest, 0.0) / total)
