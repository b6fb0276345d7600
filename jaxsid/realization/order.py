"""The order of a model from the singular values of its Hankel matrix, with the reason in words."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

SMALLEST_DROP = 1.5  # a singular value this many times the next one may end the model
OUTSTANDING = 6.0  # deviations by which a drop must exceed those between noise singular values


class OrderChoice(NamedTuple):
    """An order, why, and the other orders worth a look, most probable first, the chosen one included."""

    order: int
    reason: str
    candidates: tuple[int, ...]


def select_order(
    singular_values: Float[Array, " k"] | np.ndarray,
    *,
    shape: tuple[int, int] | None = None,
    noise_floor: float | None = None,
    expected: int | None = None,
    largest: int | None = None,
) -> OrderChoice:
    """The order after which the singular values fall into noise or rounding.

    A drop is s_k / s_(k+1). The order is the last k whose drop stands out: at least 1.5, and beyond the
    drops between the values of the tail by six of their deviations. Values below the floor do not count.

    Args:
        singular_values: largest first; the more past the order, the better the noise is known.
        shape: of the matrix, for the floor of rounding, eps * max(shape) * s_1.
        noise_floor: largest singular value that noise alone would make, in their unit, where it is known.
        expected: order that a model promises; taken where the values allow it, and said so where they do not.
        largest: orders above it are not considered.

    Returns:
        OrderChoice; eager, for values and not for tracers.
    """
    s = np.asarray(singular_values, dtype=float)
    eps = float(np.finfo(np.asarray(singular_values).dtype).eps)
    rounding = 10 * eps * max(shape or (len(s), len(s))) * s[0]
    floor = max(rounding, noise_floor or 0.0)
    above = max(int(np.sum(s > floor)), 1)
    drops = np.log(np.maximum(s[:-1], floor) / np.maximum(s[1:], floor)) if len(s) > 1 else np.zeros(0)
    threshold = _standing_out(drops[: min(above, len(drops))] if above < len(s) else drops)
    last = min(above, len(drops), largest or len(s))
    standing = [k + 1 for k in range(last) if drops[k] > threshold]
    candidates = _ranked(standing, drops, above, largest)
    order = max(standing) if standing else min(above, largest or above)
    choice = OrderChoice(order, _reason(order, s, floor, above, bool(standing)), candidates)
    return choice if expected is None else _expected(choice, floor, above, expected)


def _standing_out(drops: np.ndarray) -> float:
    """Logarithm of the drop beyond which it is no ordinary one of the tail."""
    tail = drops[len(drops) // 2 :]
    if len(tail) < 3:
        return float(np.log(SMALLEST_DROP))
    middle = np.median(tail)
    deviation = 1.4826 * np.median(np.abs(tail - middle))
    return float(max(np.log(SMALLEST_DROP), middle + OUTSTANDING * deviation))


def _ranked(standing: list[int], drops: np.ndarray, above: int, largest: int | None) -> tuple[int, ...]:
    by_drop = sorted(standing[:-1], key=lambda k: -drops[k - 1])
    rest = [above] if above <= (largest or above) else []
    return tuple(dict.fromkeys([*standing[-1:], *by_drop[:4], *rest]))


def _reason(order: int, s: np.ndarray, floor: float, above: int, standing: bool) -> str:
    if not standing:
        return f"no drop between singular values stands out; all {above} above the floor {floor:.2g} are kept"
    after = s[order] if order < len(s) else 0.0
    if after <= floor:
        return f"singular value {order + 1} falls to the floor {floor:.2g}, from {s[order - 1]:.3g}"
    return (
        f"the last drop that stands out is after singular value {order}: {s[order - 1]:.3g} to {after:.3g}, "
        f"{s[order - 1] / after:.1f} times"
    )


def _expected(choice: OrderChoice, floor: float, above: int, expected: int) -> OrderChoice:
    """The expected order where the singular values carry it, else the chosen one, and what was missing."""
    if expected == choice.order:
        return choice._replace(reason=f"{choice.reason}, as the model expects")
    have = f"{above} values exceed the floor {floor:.2g}"
    if expected > above:
        reason = f"the model expects {expected}, but only {have}: {choice.reason}"
        return choice._replace(reason=reason)
    reason = (
        f"the model expects {expected}, and {have}; by themselves they say {choice.order}: {choice.reason}"
    )
    return OrderChoice(expected, reason, tuple(dict.fromkeys([expected, *choice.candidates])))
