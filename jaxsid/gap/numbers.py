"""Which numbers of a model records contradict, apart from a factor that all of them share with a gain."""

from typing import NamedTuple

import numpy as np

from jaxsid.physical.elements import ElementValues

LEAST_CHANGE = -0.95  # of a number by its nominal value, beyond which no fit goes
ROUNDING = 1e-6  # of a number in single precision
SURE = 3.0  # standard deviations from which on a difference is one
NOTABLE = 0.1  # of a number, from which on a difference is worth a word
FEWEST = 3  # masses and stiffnesses of which a common factor may be told from a change of each
SHARED = 0.75  # part of them that it brings nearer to the nominal values


class OffNumbers(NamedTuple):
    """Refitted numbers next to nominal ones.

    M, D and K times c respond to u as M, D and K do to u / c: c is told by no record whose gains are in doubt.

    Attributes:
        common: factor c of all masses and stiffnesses; 1 where they share none.
        others: name of each number that is still off, "storey1.stiffness", and its factor beside c; most off first.
    """

    common: float
    others: tuple[tuple[str, float], ...]


def off_numbers(values: ElementValues) -> OffNumbers:
    """Numbers that differ surely, and by much, from the nominal ones.

    Args:
        values: refitted; those without a nominal value are left out.
    """
    value, deviation, nominal = (np.asarray(x) for x in (values.values, values.deviation, values.nominal))
    there = (nominal != 0) & (value / np.where(nominal != 0, nominal, 1.0) > 0)
    ratio = np.where(there, value / np.where(there, nominal, 1.0), 1.0)
    spread = np.where(there, deviation / np.where(there, np.abs(value), 1.0), np.inf)
    scaled = there & np.array([x.quantity in ("mass", "stiffness") for x in values.listed], bool)
    common = _common(ratio[scaled], spread[scaled])
    off = np.log(ratio / common)
    told = there & (np.abs(off) > np.maximum(NOTABLE, SURE * spread))
    order = sorted(np.flatnonzero(told), key=lambda i: -abs(off[i]))
    return OffNumbers(common, tuple((values.listed[i].name, float(ratio[i] / common)) for i in order))


def at_the_least(values: ElementValues) -> tuple[str, ...]:
    """Names of numbers that fits made as small as they may be.

    Args:
        values: refitted; those without a nominal value are left out.
    """
    value, nominal = np.asarray(values.values), np.asarray(values.nominal)
    change = np.divide(value, nominal, out=np.ones_like(value), where=nominal != 0) - 1
    small = np.flatnonzero(np.isclose(change, LEAST_CHANGE, rtol=ROUNDING, atol=0))
    return tuple(values.listed[i].name for i in small)


def _common(ratio: np.ndarray, spread: np.ndarray) -> float:
    if len(ratio) < FEWEST:
        return 1.0
    middle = float(np.median(ratio))
    nearer = np.abs(np.log(ratio / middle)) < np.abs(np.log(ratio))
    least = max(NOTABLE, SURE * float(np.median(spread)))
    return middle if abs(np.log(middle)) > least and nearer.mean() >= SHARED else 1.0
