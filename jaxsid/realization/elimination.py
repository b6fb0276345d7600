"""The poles that the lines need, out of those of a larger model.

A model of just the right order spends its poles on what is largest in the impulse response, and that may be the drift
of a sensor rather than a weak mode. Among the poles of a larger model, those that explain the lines are kept: the one
whose loss raises the weighted sum of squares least goes, until `order` are left, all residues being free.

With R the triangle of the weighted equations, x = R^-1 q the residues and C = R^-1 R^-T their covariance, leaving out
the columns j adds x_j' C_jj^-1 x_j. Source: backward elimination, N. Draper and H. Smith, Applied Regression Analysis,
3rd ed., ch. 15.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from jaxsid.impulse.lines import Lines, laguerre_shift, line_level
from jaxsid.records import as_array

RIDGE = 1e-9  # on columns of unit norm, so that poles that coincide do no harm
REAL = 1e-9  # height below which a pole in the Laguerre shift is real


class _Equations(NamedTuple):
    """What the lines ask of the residues.

    Attributes:
        shift: (lines,) the Laguerre shift w of each line.
        drive: (lines, inputs and records).
        y: (lines, outputs).
        weight: (lines, outputs) one over the noise.
    """

    shift: np.ndarray
    drive: np.ndarray
    y: np.ndarray
    weight: np.ndarray


def needed_poles(
    candidates: Sequence[np.ndarray], lines: Lines, order: int, *, stable: bool = True
) -> np.ndarray:
    """The `order` poles that explain the lines best, of each set of candidates in turn.

    Args:
        candidates: sets of poles z, each with all conjugates. The first has `order` poles and is what remains where
            the others do no better; larger ones are thinned out.
        lines: in-band lines of the records.
        order: number of poles wanted.
        stable: mirror poles outside of the unit circle into it.

    Returns:
        (order,) poles z.
    """
    pole = float(lines.pole)
    shifted = [laguerre_shift(np.asarray(z, complex), pole) for z in candidates]
    sets = [_units(mirrored(w) if stable else w) for w in shifted]
    drive = np.concatenate([np.asarray(lines.u), np.asarray(lines.record)], axis=1)
    y, used = np.asarray(lines.y), np.asarray(lines.weight)
    plain = np.sqrt((np.abs(y) ** 2 * used).sum(axis=0) / np.maximum(used.sum(axis=0), 1.0))
    plain = np.where(plain > 0, plain, 1.0)
    equations = _Equations(laguerre_shift(np.asarray(lines.z), pole), drive, y, used / plain)
    left = plain * _residual(equations, max(sets, key=_states))
    noise = np.maximum(line_level(as_array(left), as_array(used)), RIDGE * plain)
    equations = equations._replace(weight=used / noise)
    found = [_thinned(equations, units, order) for units in sets]
    costs = [_cost(_triangles(equations, units)) if _states(units) == order else np.inf for units in found]
    w = np.array([p for u in found[int(np.argmin(costs))] for p in ([u, u.conjugate()] if u.imag else [u])])
    return (w + pole) / (1 + pole * w)


def mirrored(w: np.ndarray) -> np.ndarray:
    """Poles outside of the unit circle, which only noise puts there in a passive system, mirrored into it."""
    return w / np.maximum(np.abs(w), 1.0) ** 2


def _units(w: np.ndarray) -> list[complex]:
    """One of each pair, and the real ones."""
    every: list[complex] = w.tolist()
    return [complex(p.real) if abs(p.imag) <= REAL else p for p in every if p.imag > -REAL]


def _states(units: Sequence[complex]) -> int:
    return sum(2 if u.imag else 1 for u in units)


def _columns(equations: _Equations, units: Sequence[complex]) -> np.ndarray:
    """Partial fractions of every unit driven by every input and transient, then what has no pole."""
    w = equations.shift
    parts = []
    for u in units:
        section = 1 / ((w - u) * (w - u.conjugate())) if u.imag else 1 / (w - u)
        parts += [section * w, section] if u.imag else [section]
    parts.append(np.ones_like(w))
    return (np.stack(parts, axis=1)[:, :, None] * equations.drive[:, None, :]).reshape(len(w), -1)


def _real(x: np.ndarray) -> np.ndarray:
    return np.concatenate([np.real(x), np.imag(x)])


def _tables(equations: _Equations, units: Sequence[complex]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """For each output the weighted columns, of unit norm and ridged, and the weighted lines."""
    columns = _columns(equations, units)
    for y, weight in zip(equations.y.T, equations.weight.T, strict=True):
        table = _real(columns * weight[:, None])
        size = np.linalg.norm(table, axis=0)
        table = np.concatenate([table / np.where(size > 0, size, 1.0), RIDGE * np.eye(table.shape[1])])
        yield table, np.concatenate([_real(y * weight), np.zeros(table.shape[1])])


def _triangles(equations: _Equations, units: Sequence[complex]) -> list[np.ndarray]:
    """For each output the triangle of its table and lines."""
    return [_triangle(np.column_stack(pair)) for pair in _tables(equations, units)]


def _triangle(x: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.qr(x, mode="r"))


def _cost(triangles: Sequence[np.ndarray]) -> float:
    return float(sum(r[-1, -1] ** 2 for r in triangles))


def _residual(equations: _Equations, units: Sequence[complex]) -> np.ndarray:
    """What the poles leave of each line, in units of its weight, (lines, outputs)."""
    left, count = [], len(equations.y)
    for table, target in _tables(equations, units):
        triangle = _triangle(np.column_stack([table, target]))
        rest = target - table @ np.linalg.solve(triangle[:-1, :-1], triangle[:-1, -1])
        left.append(rest[:count] + 1j * rest[count : 2 * count])
    return np.stack(left, axis=1)


def _thinned(equations: _Equations, units: list[complex], order: int) -> list[complex]:
    """Units without those needed least, several at a time while many are too many."""
    if _states(units) <= order:
        return units
    width = equations.drive.shape[1]
    triangles = _triangles(equations, units)
    while (excess := _states(units) - order) > 0:
        ends = np.cumsum([0, *(width * _states([u]) for u in units)])
        blocks = [np.arange(a, b) for a, b in pairwise(ends)]
        gone = _least_needed(np.sum([_loss(r, blocks) for r in triangles], axis=0), units, excess)
        if not gone:
            break
        kept = np.concatenate(
            [b for i, b in enumerate(blocks) if i not in gone] + [np.arange(ends[-1], len(triangles[0]))]
        )
        triangles = [_triangle(r[:, kept]) for r in triangles]
        units = [u for i, u in enumerate(units) if i not in gone]
    return units


def _least_needed(loss: np.ndarray, units: list[complex], excess: int) -> set[int]:
    """Up to a quarter of those that may go, by the loss, within the number of states that must go."""
    allowed = [int(i) for i in np.argsort(loss) if _states([units[i]]) <= excess]
    gone: set[int] = set()
    for i in allowed[: max(1, len(allowed) // 4)]:
        if _states([units[j] for j in gone]) + _states([units[i]]) <= excess:
            gone.add(i)
    return gone


def _loss(triangle: np.ndarray, blocks: Sequence[np.ndarray]) -> np.ndarray:
    """By how much leaving out each block of columns raises the sum of squares."""
    inverse = np.linalg.inv(triangle[:-1, :-1])
    x = inverse @ triangle[:-1, -1]
    return np.array([x[b] @ np.linalg.solve(inverse[b] @ inverse[b].T, x[b]) for b in blocks])
