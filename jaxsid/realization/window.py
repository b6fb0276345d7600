"""Which block rows and block columns, and the refusal of windows that cannot work."""

from functools import cache
from itertools import pairwise

import equinox as eqx
import numpy as np

from jaxsid.checks import is_concrete, require, require_finite
from jaxsid.records import ImpulseResponse, Steps

METHODS = ("fast", "svd")


class Window(eqx.Module):
    """Block rows s_i and block columns t_j as one static value: calls do not look at every number."""

    rows: Steps = eqx.field(static=True)
    columns: Steps = eqx.field(static=True)

    def shape(self, outputs: int, inputs: int) -> tuple[int, int]:
        """Rows and columns of the block Hankel matrix."""
        return len(self.rows) * outputs, len(self.columns) * inputs


@cache
def era_window(
    samples: int,
    rows: int | None,
    cols: int | None,
    stride: int,
    row_steps: Steps | None,
    column_steps: Steps | None,
) -> Window:
    """The window from what was said of it, checked."""
    require(stride >= 1, f"stride must be at least 1 sample, not {stride}")
    # Markov parameters 1 .. samples - 2 and one more for the shift make this many strided blocks.
    blocks = max((samples - 3) // stride + 1, 1)
    if row_steps is None:
        if rows is None:
            given = None if column_steps is None else 1 + column_steps[-1] // stride
            given = cols if given is None else given
            rows = (blocks + 1) // 2 if given is None else max(blocks + 1 - given, 1)
        row_steps = range(0, stride * rows, stride)
    if column_steps is None:
        cols = max(blocks - row_steps[-1] // stride, 1) if cols is None and row_steps else cols
        column_steps = range(0, stride * (cols or 0), stride)
    window = Window(row_steps, column_steps)
    _check_steps(window, samples)
    return window


def check_response(ir: ImpulseResponse) -> None:
    """Raise InputError where an impulse response cannot be realized at all."""
    require(ir.h.ndim == 3, f"the impulse response must be (samples, outputs, inputs), not {ir.h.shape}")
    require(
        ir.h.shape[0] >= 3, "the impulse response has fewer than 3 samples: Y_0, Y_1 and Y_2 are the least"
    )
    require_finite(ir.h, "impulse response")
    if is_concrete(ir.h):
        require(
            bool(np.asarray(ir.h)[1:].any()),
            "the impulse response is zero after Y_0: there are no dynamics to realize",
        )


def check_method(method: str) -> None:
    require(method in METHODS, f"method '{method}' is unknown; choose from {', '.join(METHODS)}.")


def _check_steps(window: Window, samples: int) -> None:
    """Raise InputError for steps that are not increasing from 0, or that read past the last sample."""
    for name, steps in (("rows", window.rows), ("cols", window.columns)):
        require(len(steps) > 0, f"the Hankel matrix needs at least one of {name}")
        increasing = all(a < b for a, b in pairwise(steps))
        require(steps[0] == 0 and increasing, f"{name}: steps must increase from 0, not {steps[:5]}...")
    check_reach(window.rows[-1] + window.columns[-1] + 2, samples)


def check_reach(last: int, samples: int) -> None:
    """Raise InputError where sample `last` is wanted of `samples`."""
    require(
        last < samples,
        f"the window reads the impulse response up to sample {last}, but its last one is {samples - 1}. "
        "Take fewer rows, columns or lags, a smaller stride, or a longer impulse response.",
    )


def check_order(order: int, shape: tuple[int, int]) -> None:
    """Raise InputError where a matrix of this shape cannot hold the order."""
    require(order >= 1, f"the order must be at least 1, not {order}")
    require(
        order <= min(shape),
        f"order {order} needs a matrix of at least {order} rows and columns, but the window makes "
        f"{shape[0]} x {shape[1]} (blocks times channels). Take more rows or columns, or a smaller order.",
    )
