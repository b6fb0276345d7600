"""Which kinds of effects at which places deserve a refit by simulation.

For a kind at a place the lines of what a model leaves are r = sum_i c_i b_i + sum_j l_j g_j + T t + noise: b_i the
errors of the linear parameters within the model's tolerance, g_j the kind's columns on a motion that is held for true,
t what a record's ends add. All is linear once the kind's shape parameters are given, so that its evidence is closed,
and these run over a grid. Two motions are worth trying: the one that a force at the place implies, which is near where
the gap is large, and that of a refitted linear model, which no noise has touched.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxsid.checks import require
from jaxsid.gap.dictionary import products, sizes
from jaxsid.gap.evidence import Table, evidence
from jaxsid.gap.grids import Grid, grid_of, parameters_of, plan_of
from jaxsid.gap.places import Place
from jaxsid.gap.ports import ports_of
from jaxsid.gap.resume import step
from jaxsid.gap.setting import Setting
from jaxsid.gap.spectra import Motion
from jaxsid.mechanics.effects.catalogue import CATALOGUE, MOST_PARAMETERS
from jaxsid.mechanics.effects.prior import Amplitudes
from jaxsid.mechanics.lumped import GROUND, LumpedModel, free_bodies, second_order
from jaxsid.mechanics.slots import Slots, nominal_at
from jaxsid.parallel import side_by_side
from jaxsid.physical.elements import element_matrices

FREQUENCIES = 15  # tried for a disturbance
BESIDE = (-0.5, -0.25, 0.0, 0.25, 0.5)  # of a line, in lines: where between them a frequency may lie
AROUND = 8  # lines on either side that a lone one is compared with
PARALLEL = 1e-9  # one less squared cosine between columns of which only the first counts


class Candidate(NamedTuple):
    """One kind at one place.

    Attributes:
        kind: of effect.
        place: as of an `Effect`, such as {"between": ("ground", "b1")}.
        parameters: to start a refit from, SI units; an array where each record has its own.
        changes: (e,) relative changes of the model's elements that go with it.
        evidence: its logarithm, up to what all candidates on the same motion share.
        left: sum of squares of what it leaves, in noise, by the number of equations.
        motion: on which it did best, next to the others on the same motion.
        ranks: its place among all candidates, from 1, on each motion.
    """

    kind: str
    place: dict[str, Any]
    parameters: Mapping[str, float | np.ndarray]
    changes: Float[np.ndarray, " e"]
    evidence: float
    left: float
    motion: str
    ranks: Mapping[str, int]


class _Rows(NamedTuple):
    """Places of one sort: their names, rows of `places` whose motion goes with them, what they are as slots."""

    where: str
    named: list[dict[str, Any]]
    rows: np.ndarray
    slots: Slots


@step
def screen(
    model: LumpedModel,
    settings: Sequence[Setting],
    places: tuple[Place, ...],
    motions: Mapping[str, Sequence[Motion]],
    tolerance: Float[np.ndarray, " e"],
    left: Sequence[Float[np.ndarray, "_ _"]],
    *,
    kinds: Sequence[str] | None = None,
) -> tuple[Candidate, ...]:
    """Every kind at every place it can have, the most promising first.

    Args:
        model: nominal.
        settings: of each record, about the nominal model.
        places: from `places_of`.
        motions: by name, what is held for true: for each record the motion of the bodies, a row for each place, or one
            for all.
        tolerance: (e,) relative standard deviations of the model's elements.
        left: size of the lines of each record that a disturbance of one frequency would stand out from.
        kinds: which to try; None for all.

    Returns:
        Candidates by their best rank on any motion, then by evidence; see `unseen` for those that no line shows.
    """
    require(len(motions) > 0, "give at least one motion.")
    tried = tuple(CATALOGUE) if kinds is None else tuple(kinds)
    hertz = lone_frequencies(settings, left)
    sorts = [x for x in (_rows(model, places, w) for w in ("between", "body", "sensor", "input")) if x.named]

    def of(part: tuple[str, _Rows]) -> list[Candidate]:
        return _of_sort(model, settings, part[1], motions[part[0]], tolerance, hertz, tried)

    parts = [(name, rows) for name in motions for rows in sorts]
    found: dict[str, list[Candidate]] = {}
    each = list(zip(parts, side_by_side(of, parts), strict=True))
    for name in motions:
        order = sorted((c for (on, _), cs in each if on == name for c in cs), key=lambda c: -c.evidence)
        found[name] = [c._replace(motion=name, ranks={name: i + 1}) for i, c in enumerate(order)]
    return _united(found)


def unseen(model: LumpedModel, places: tuple[Place, ...]) -> tuple[Candidate, ...]:
    """What is the same at all times, on a free axis: its line of zero frequency is that of the axis itself.

    Args:
        model: nominal.
        places: from `places_of`.

    Returns:
        Candidates whose evidence nothing is known of, 0; none where every body is held.
    """
    if free_bodies(model).shape[1] == 0:
        return ()
    steady = {n: k for n, k in CATALOGUE.items() if k.steady}
    nothing = np.zeros(len(element_matrices(model).listed))
    return tuple(
        Candidate(name, place, {p.name: 0.0 for p in kind.parameters}, nothing, 0.0, math.nan, "", {})
        for name, kind in steady.items()
        for place in _rows(model, places, kind.where).named
    )


def _united(found: Mapping[str, list[Candidate]]) -> tuple[Candidate, ...]:
    best: dict[tuple[str, str], Candidate] = {}
    for each in found.values():
        for c in each:
            key = c.kind, str(c.place)
            old = best.get(key)
            ranks = {**(old.ranks if old else {}), **c.ranks}
            first = c if old is None or min(c.ranks.values()) < min(old.ranks.values()) else old
            best[key] = first._replace(ranks=ranks)
    return tuple(sorted(best.values(), key=lambda c: (min(c.ranks.values()), -c.evidence)))


def _rows(model: LumpedModel, places: tuple[Place, ...], where: str) -> _Rows:
    """Of one sort; a body is the second end of a place that the ground is the first of."""
    at = "between" if where == "body" else where
    rows = [i for i, p in enumerate(places) if p.where == at and (where != "body" or p.ends[0] == GROUND)]
    chosen = tuple(places[i] for i in rows)
    ports = ports_of(model, chosen)
    count = len(rows)
    push = {"between": -1.0, "body": 1.0}.get(where, 0.0)
    slots = Slots(
        jnp.zeros(count, int),
        jnp.zeros((count, MOST_PARAMETERS)),
        ports.joint,
        push * ports.joint,
        ports.sensor,
        ports.drive,
    )
    value = lambda p: p.ends[1] if where == "body" else p.ends if where == "between" else p.ends[0]  # noqa: E731
    return _Rows(where, [{where: value(p)} for p in chosen], np.array(rows, int), slots)


def _of_sort(
    model: LumpedModel,
    settings: Sequence[Setting],
    at: _Rows,
    motions: Sequence[Motion],
    tolerance: np.ndarray,
    hertz: np.ndarray,
    tried: tuple[str, ...],
) -> list[Candidate]:
    names = [n for n in tried if CATALOGUE[n].where == at.where]
    if not names:
        return []
    rows = jnp.asarray(at.rows)
    moved = [_chosen(m, s, rows) for m, s in zip(motions, settings, strict=True)]
    size = _together(settings, [sizes(s, at.slots, m) for s, m in zip(settings, moved, strict=True)])
    grids = {n: grid_of(n, size, hertz) for n in names}
    probes = {n: jnp.asarray(g.probes) for n, g in grids.items()}
    jumps = jnp.asarray([float(i.hold == "zero") for i in model.inputs])
    parts = [products(s, at.slots, m, jumps, probes, at.where) for s, m in zip(settings, moved, strict=True)]
    equations = sum(
        int((2 * np.asarray(s.spectra.weight)[:, None] * (np.asarray(s.scale) > 0)).sum()) for s in settings
    )
    found = []
    for name in names:
        gram = np.sum([np.asarray(p[name].gram) for p in parts], axis=0)
        for i in _allowed(model, at, name):
            found.append(_candidate(name, at, i, grids[name], gram[i], tolerance, equations))
    return [c for c in found if c is not None]


def _chosen(motion: Motion, setting: Setting, rows: jax.Array) -> Motion:
    if motion.states.ndim == 2:
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (len(rows), *x.shape)), motion)
    return jax.tree.map(lambda x: x[rows], motion)


def _together(settings: Sequence[Setting], each: list[Amplitudes]) -> Amplitudes:
    """Rms values over all records; the rate and the mean duration."""
    weight = np.array([s.spectra.samples for s in settings], float)
    values = [np.stack([np.asarray(x) for x in field]) for field in zip(*each, strict=True)]
    mean = [np.sqrt(np.average(x**2, axis=0, weights=weight)) for x in values]
    return Amplitudes(*map(jnp.asarray, mean))


def _allowed(model: LumpedModel, at: _Rows, name: str) -> list[int]:
    needs = CATALOGUE[name].needs
    if not needs:
        return list(range(len(at.named)))
    nominal = nominal_at(at.slots, second_order(model))
    held = (np.abs(np.asarray(nominal.stiffness)) > 0) | (np.abs(np.asarray(nominal.damping)) > 0)
    return [i for i, h in enumerate(held) if h == (needs == "joined")]


def _candidate(
    name: str, at: _Rows, place: int, grid: Grid, gram: np.ndarray, tolerance: np.ndarray, equations: int
) -> Candidate | None:
    """The best point of a kind's grid at one place; None where it does nothing there."""
    k, points = len(grid.spread), len(gram)
    prior = np.concatenate(
        [grid.spread * _counting(gram[:, :k, :k]), np.tile(tolerance, (points, 1))], axis=1
    )
    if not prior[:, :k].any():
        return None
    mean = np.zeros(k) if plan_of(name).proportional else np.ones(k)
    about = _about(gram, mean)
    for _ in range(1 + k):
        found = evidence(Table(about[:, None], np.zeros((points, 1))), prior[:, None])  # type: ignore[arg-type]
        coefficients = found.coefficients[:, 0, 0]
        own = coefficients[:, :k] + mean
        beyond = (prior[:, :k] > 0) & ((own < grid.lowest[place]) | (own > grid.highest[place]))
        if not beyond.any():
            break
        prior[:, :k][beyond] = 0.0
    value = np.where(
        prior[:, :k].any(axis=1) & np.isfinite(found.value[:, 0, 0]), found.value[:, 0, 0], -np.inf
    )
    best = int(value.argmax())
    if not np.isfinite(value[best]):
        return None
    c = coefficients[best]
    left = about[best, -1, -1] - 2 * c @ about[best, :-1, -1] + c @ about[best, :-1, :-1] @ c
    parameters = parameters_of(name, grid, place, best, np.where(prior[best, :k] > 0, own[best], 0.0))
    score = float(value[best]) - math.log(points)
    return Candidate(name, at.named[place], parameters, c[k:], score, float(left) / equations, "", {})


def _about(gram: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Products where the coefficients of the first columns are counted from their means."""
    k = len(mean)
    change = np.eye(gram.shape[-1])
    change[:k, -1] = -mean
    return change.T @ gram @ change


def _counting(own: Float[np.ndarray, "grid k k"]) -> Float[np.ndarray, "grid k"]:
    """1 for columns that count, 0 for those that are nothing or repeat one before."""
    square = np.diagonal(own, axis1=1, axis2=2)
    counts = (square > 0) * 1.0
    for j in range(own.shape[1]):
        for i in range(j):
            same = own[:, i, j] ** 2 >= (1 - PARALLEL) * square[:, i] * square[:, j]
            counts[:, j] *= ~(same & (counts[:, i] > 0))
    return counts


def lone_frequencies(
    settings: Sequence[Setting], left: Sequence[Float[np.ndarray, "_ _"]]
) -> Float[np.ndarray, " f"]:
    """Frequencies, Hz, about the lines that stand out most from those around them.

    Args:
        settings: of each record.
        left: size of the lines that a model leaves of each.
    """
    around = np.ones(2 * AROUND + 1)
    around[AROUND - 1 : AROUND + 2] = 0.0
    strongest: list[tuple[float, float, float]] = []
    for setting, lines in zip(settings, left, strict=True):
        power = ((lines * np.asarray(setting.scale)) ** 2).sum(axis=1)
        used = (np.asarray(setting.spectra.weight) == 1) * 1.0
        beside = np.convolve(power * used, around, mode="same") / np.maximum(
            np.convolve(used, around, "same"), 1
        )
        ratio = used * power / np.maximum(beside, np.finfo(float).tiny)
        hertz = np.asarray(setting.spectra.omega) / (2 * np.pi)
        for i in _peaks(ratio):
            strongest.append((float(ratio[i]), float(hertz[i]), float(hertz[1])))
    chosen = sorted(strongest, reverse=True)[: FREQUENCIES // len(BESIDE)]
    chosen += chosen[:1] * (FREQUENCIES // len(BESIDE) - len(chosen))
    return np.array([f + x * step for _, f, step in chosen for x in BESIDE])


def _peaks(ratio: Float[np.ndarray, " lines"]) -> list[int]:
    """The largest, none next to another."""
    found: list[int] = []
    for i in np.argsort(-ratio):
        if all(abs(int(i) - j) > 1 for j in found):
            found.append(int(i))
        if len(found) == FREQUENCIES // len(BESIDE):
            break
    return found
