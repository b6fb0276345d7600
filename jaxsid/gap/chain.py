"""Least squares over windows that each lead to the next: their states form a chain, the unknowns are common to all.

Normal equations of states x_k and unknowns theta, block tridiagonal in the former, are solved by elimination from one
end to the other (G. Golub and C. Van Loan, Matrix Computations, 4th ed., 2013, section 4.5), with all states divided by
the root of their own diagonal.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

RIDGE = 1e-13  # of a matrix with ones on its diagonal: less than its rounding matters


class Links(NamedTuple):
    """Which windows lead to which: rows of the same length, of a window and of the one after it."""

    before: Int[np.ndarray, " links"]
    after: Int[np.ndarray, " links"]


class Chain(NamedTuple):
    """Second derivatives by the states of all windows.

    Attributes:
        inner: of each window by itself.
        ahead: of each link, rows of the window before, columns of the one after.
        links: which windows they are; windows without any stand alone.
    """

    inner: Float[np.ndarray, "windows n n"]
    ahead: Float[np.ndarray, "links n n"]
    links: Links

    def solved(
        self, right: Float[np.ndarray, "windows n k"]
    ) -> tuple[Float[np.ndarray, "windows n k"], float]:
        """The inverse times columns, and the logarithm of the determinant.

        Args:
            right: of each window.
        """
        scale = np.sqrt(np.diagonal(self.inner, axis1=-2, axis2=-1))
        own = self.inner / scale[:, :, None] / scale[:, None, :] + RIDGE * np.eye(scale.shape[1])
        right = right / scale[:, :, None]
        before, after = self.links
        ahead = self.ahead / scale[before][:, :, None] / scale[after][:, None, :]
        # windows stand in the order of time, so that each link is used before the next
        kept = []
        for link in np.argsort(after, kind="stable"):
            i, j = before[link], after[link]
            back = np.linalg.solve(own[i], ahead[link])
            own[j] -= ahead[link].T @ back
            right[j] -= back.T @ right[i]
            kept.append((i, j, back))
        found = np.linalg.solve(own, right)
        for i, j, back in reversed(kept):
            found[i] -= back @ found[j]
        determinant = 2 * np.log(scale).sum() + np.linalg.slogdet(own)[1].sum()
        return found / scale[:, :, None], float(determinant)
