"""The search for the most probable unknowns of a hypothesis, and the evidence there.

Levenberg and Marquardt over unknowns and all initial states, the latter eliminated window by window, or along the chain
where windows lead to one another; Laplace's approximation at the end.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsid.gap.chain import RIDGE, Chain, Links
from jaxsid.gap.shooting import Shot, products_of
from jaxsid.gap.windows import Block

STEPS = 25  # of the search
GAIN = 0.05  # of the cost, in mean squares of what is left: where no more is to be had the search ends
PART = 1e-5  # or this part of it
DAMPING = 1e-3  # to begin with
LEAST_DAMPING, MOST_DAMPING = 1e-9, 1e8
EASED = 1e3  # factor by which damping falls where it held a step back
IDLE = 2  # steps in a row that bring little, after which no more is expected
SLOWER = 2.0  # factor of damping after a step that failed, doubled with each more
NEEDLESS = 8  # most evaluations that are not counted
NONE = slice(0, 0)
HALVINGS = 5  # of a law that lets the motion grow, towards what is likely beforehand, to begin with
MORE = 1.3  # mean square in noise from which on more is left than noise, so that deviations must come from windows


class Fit(NamedTuple):
    """Where the posterior of a hypothesis is largest.

    Attributes:
        theta: (p,) unknowns: relative changes of elements, those of effects, further phases of effects.
        states: of each block (windows, n).
        squares: sum of squares of the weighted residual.
        equations: number of them.
        covariance: (p, p) of the unknowns; where more than noise is left, from how windows differ.
        evidence: its logarithm after Laplace, up to what all hypotheses share.
        steps: of the search.
        settled: whether it came to an end by itself.
    """

    theta: Float[np.ndarray, " p"]
    states: tuple[Float[np.ndarray, "windows n"], ...]
    squares: float
    equations: int
    covariance: Float[np.ndarray, "p p"]
    evidence: float
    steps: int
    settled: bool


class Prior(NamedTuple):
    """Normal priors.

    Attributes:
        deviation, mean: (p,) of the unknowns.
        least: (p,) smallest values that make sense.
        most: (p,) largest change in a step.
        states: (n,) standard deviations of initial states.
        before: (n,) likewise, of those before a record's start, where nothing is measured that could tell of them.
        jump: (n,) from where a window ends to where the next begins; infinite where each stands alone.
    """

    deviation: Float[np.ndarray, " p"]
    mean: Float[np.ndarray, " p"]
    least: Float[np.ndarray, " p"]
    most: Float[np.ndarray, " p"]
    states: Float[np.ndarray, " n"]
    before: Float[np.ndarray, " n"]
    jump: Float[np.ndarray, " n"]


def fitted(
    shot: Shot,
    blocks: Sequence[Block],
    prior: Prior,
    theta: Float[np.ndarray, " p"],
    states: Sequence[Float[np.ndarray, "windows n"]],
    *,
    substeps: int,
    steps: int = STEPS,
    gain: float = GAIN,
    eased: slice = NONE,
) -> Fit:
    """Least squares by Levenberg and Marquardt over unknowns and all initial states, the latter eliminated.

    Args:
        shot: the hypothesis.
        blocks: windows of the records.
        prior: of unknowns and states.
        theta: (p,) to begin with.
        states: likewise, of each block.
        substeps: steps for each sampling interval.
        steps: most evaluations; not counted are the first ones that only tell how much damping a step needs.
        gain: of the cost, in mean squares of what is left, that is not worth a step.
        eased: unknowns that begin nearer to their prior's mean where the motion grows without bound.
    """
    links = links_of(blocks if np.isfinite(prior.jump).all() else ())

    def evaluated(theta: np.ndarray, states: list[np.ndarray]) -> _At:
        return _evaluated(shot, blocks, links, prior, theta, states, substeps)

    def led(at: _At) -> _At:
        return evaluated(at.theta, _added(at.states, _led(at, prior, links)))

    at = _begun(evaluated, theta, list(states), prior, eased)
    if links.after.size and np.isfinite(at.cost):
        # what windows that stood alone hardly told of their states need not lead from one to the next
        at = min(at, led(at), key=lambda x: x.cost)
    damping, growth, settled, done, idle = DAMPING, SLOWER, False, 1, 0
    free, moved = 0, False
    while done - free < steps and np.isfinite(at.cost):
        move, moves = _step(at, prior, links, damping)
        found = evaluated(np.maximum(at.theta + move, prior.least), _added(at.states, moves))
        done += 1
        if links.after.size and np.isfinite(found.cost) and found.cost >= at.cost:
            # ties are stiff: what bends along the chain is made good by the states alone
            found = led(found)
            done += 1
        less = at.cost - found.cost
        if less > 0:
            # what has just failed with less damping would fail again
            moved = True
            at, damping = found, damping if growth > SLOWER else max(damping / 5, LEAST_DAMPING)
            growth = SLOWER
            little = gain * max(1.0, found.squares / max(found.equations, 1)) + PART * abs(found.cost)
            idle = idle + 1 if less < little else 0
            if idle:
                # a step held back by its damping brings little even far from the end
                by_unknowns, by_states = _expected(at, prior, links)
                if idle == IDLE or by_unknowns + by_states < little:
                    settled = True
                    break
                if by_unknowns > little:
                    # along a valley of the unknowns, which some records hardly tell apart
                    damping = max(damping / EASED, LEAST_DAMPING)
        else:
            damping, growth = damping * growth, SLOWER * growth
            free += not moved and free < NEEDLESS
            if damping > MOST_DAMPING:
                settled = True
                break
    return _concluded(at, prior, links, done, settled)


def newton_step(
    shot: Shot,
    blocks: Sequence[Block],
    prior: Prior,
    theta: Float[np.ndarray, " p"],
    states: Sequence[Float[np.ndarray, "windows n"]],
    *,
    substeps: int,
) -> Float[np.ndarray, " p"]:
    """How far unknowns lie off those of the smallest cost, were it a parabola, initial states going with them.

    Args:
        shot: the hypothesis.
        blocks: windows of the records.
        prior: of unknowns and states.
        theta: (p,) unknowns.
        states: initial ones, of each block.
        substeps: steps for each sampling interval.
    """
    links = links_of(blocks if np.isfinite(prior.jump).all() else ())
    at = _evaluated(shot, blocks, links, prior, theta, list(states), substeps)
    reduced, _, _ = _normal(at, prior, links).reduced()
    return -_solved(reduced[:, :-1], reduced[:, -1:])[:, 0]


class _At(NamedTuple):
    """A point of the search.

    Attributes:
        theta: unknowns.
        states: of every block.
        cost: half the sum of all squares, those of the priors too.
        squares: of the residual.
        gram: (windows, q, q) of all windows.
        equations: how many entries of the residual count.
        ends: (windows, n, 1 + p + n) states where the next window begins, and their slopes.
        spread: (windows, n) standard deviations of initial states beforehand.
    """

    theta: np.ndarray
    states: list[np.ndarray]
    cost: float
    squares: float
    gram: np.ndarray
    equations: int
    ends: np.ndarray
    spread: np.ndarray


def _begun(
    evaluated: Callable[[np.ndarray, list[np.ndarray]], _At],
    theta: np.ndarray,
    states: list[np.ndarray],
    prior: Prior,
    eased: slice,
) -> _At:
    """The first point, with unknowns nearer to their prior's mean where the motion grows without bound."""
    at = evaluated(theta, states)
    for _ in range(HALVINGS):
        if np.isfinite(at.cost) or not np.any(theta[eased]):
            break
        theta = theta.copy()
        theta[eased] = np.maximum((theta[eased] + prior.mean[eased]) / 2, prior.least[eased])
        at = evaluated(theta, states)
    return at


class _Normal(NamedTuple):
    """Derivatives of the cost.

    Attributes:
        own: (p, p) second ones by the unknowns.
        slope: (p,) first ones.
        mixed: (windows, n, p) second ones by states and unknowns.
        slopes: (windows, n) first ones by states.
        chain: second ones by states.
    """

    own: np.ndarray
    slope: np.ndarray
    mixed: np.ndarray
    slopes: np.ndarray
    chain: Chain

    def reduced(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Second and first derivatives by the unknowns where states follow, (p, p + 1); how states do so, (windows, n,
        p + 1); the logarithm of the states' determinant."""
        back, determinant = self.chain.solved(np.concatenate([self.mixed, self.slopes[:, :, None]], axis=2))
        whole = np.concatenate([self.own, self.slope[:, None]], axis=1)
        reduced = whole - np.einsum("wnp,wnq->pq", self.mixed, back)
        # of what the states can do in a parameter's place rounding may leave less than nothing
        rows = np.arange(len(self.own))
        reduced[rows, rows] = np.maximum(reduced[rows, rows], np.finfo(float).eps * self.own[rows, rows])
        return reduced, back, determinant


def links_of(blocks: Sequence[Block]) -> Links:
    """Windows that lead to the next one of the same record, numbered through all blocks.

    Args:
        blocks: windows.
    """
    if not blocks:
        return Links(np.zeros(0, int), np.zeros(0, int))
    length = blocks[0].y.shape[1] - blocks[0].lead
    record, first = (np.concatenate([np.asarray(getattr(b, n)) for b in blocks]) for n in ("record", "first"))
    judged = np.concatenate([(np.asarray(b.weight)[:, b.lead :] > 0).any(axis=(1, 2)) for b in blocks])
    at = {(r, f): i for i, (r, f) in enumerate(zip(record.tolist(), first.tolist(), strict=True))}
    pairs = [
        (i, at[r, f + length])
        for (r, f), i in at.items()
        if (r, f + length) in at and judged[i] and judged[at[r, f + length]]
    ]
    before, after = np.array(pairs, int).reshape(-1, 2).T
    return Links(before, after)


def _evaluated(
    shot: Shot,
    blocks: Sequence[Block],
    links: Links,
    prior: Prior,
    theta: np.ndarray,
    states: list[np.ndarray],
    substeps: int,
) -> _At:
    parts = products_of(shot, blocks, theta, states, substeps)
    gram, ends = (np.concatenate([np.asarray(getattr(x, n)) for x in parts]) for n in ("gram", "ends"))
    equations = sum(int(np.asarray(x.equations).sum()) for x in parts)
    squares = float(gram[:, -1, -1].sum())
    first = np.concatenate([np.asarray(b.first) for b in blocks])
    spread = np.where(first[:, None] < 0, prior.before, prior.states)
    at = _At(theta, states, np.inf, squares, gram, equations, ends, spread)
    with np.errstate(over="ignore"):  # a step too far is refused below
        own = (((theta - prior.mean) / prior.deviation) ** 2).sum() + (_stray(at, links) ** 2).sum()
        own += (_jumps(at, prior, links) ** 2).sum()
        cost = 0.5 * (squares + float(own))
    return at._replace(cost=cost) if np.isfinite(gram).all() and np.isfinite(cost) else at


def _stray(at: _At, links: Links) -> np.ndarray:
    """(windows, n) initial states in deviations, 0 of those that another window leads to."""
    found = np.concatenate(at.states) / at.spread
    found[links.after] = 0.0
    return found


def _jumps(at: _At, prior: Prior, links: Links) -> np.ndarray:
    """(links, n) from where windows end to where the next begin, in deviations."""
    return (np.concatenate(at.states)[links.after] - at.ends[links.before, :, 0]) / prior.jump


def _normal(at: _At, prior: Prior, links: Links) -> _Normal:
    p = len(at.theta)
    own = at.gram[:, :p, :p].sum(axis=0) + np.diag(prior.deviation**-2)
    slope = at.gram[:, :p, -1].sum(axis=0) + (at.theta - prior.mean) / prior.deviation**2
    mixed, inner = at.gram[:, p:-1, :p].copy(), at.gram[:, p:-1, p:-1].copy()
    told = at.spread**-2
    told[links.after] = 0.0
    inner += told[:, :, None] * np.eye(told.shape[1])
    slopes = at.gram[:, p:-1, -1] + _stray(at, links) / at.spread
    # a jump in deviations, and its slopes by the unknowns and by the state before
    jumps = _jumps(at, prior, links)
    by_unknowns = -at.ends[links.before, :, 1 : 1 + p] / prior.jump[:, None]
    by_state = -at.ends[links.before, :, 1 + p :] / prior.jump[:, None]
    inverse = np.diag(1 / prior.jump)
    own = own + np.einsum("lnp,lnq->pq", by_unknowns, by_unknowns)
    slope = slope + np.einsum("lnp,ln->p", by_unknowns, jumps)
    mixed[links.before] += by_state.mT @ by_unknowns
    mixed[links.after] += inverse @ by_unknowns
    inner[links.before] += by_state.mT @ by_state
    inner[links.after] += inverse @ inverse
    slopes[links.before] += np.einsum("lnm,ln->lm", by_state, jumps)
    slopes[links.after] += jumps / prior.jump
    return _Normal(own, slope, mixed, slopes, Chain(inner, by_state.mT @ inverse, links))


def _step(at: _At, prior: Prior, links: Links, damping: float) -> tuple[np.ndarray, list[np.ndarray]]:
    """Changes of unknowns and of the states of every block."""
    p, normal = len(at.theta), _normal(at, prior, links)
    inner = normal.chain.inner
    normal = normal._replace(
        own=normal.own + damping * np.diag(np.diag(normal.own)),
        chain=normal.chain._replace(inner=inner + damping * inner * np.eye(inner.shape[1])),
    )
    reduced, back, _ = normal.reduced()
    move = -_solved(reduced[:, :p], reduced[:, p:])[:, 0]
    move = move / max(1.0, np.abs(move / prior.most).max())
    moves = -back[:, :, p] - np.einsum("wnp,p->wn", back[:, :, :p], move)
    return move, np.split(moves, np.cumsum([len(x) for x in at.states])[:-1])


def _expected(at: _At, prior: Prior, links: Links) -> tuple[float, float]:
    """How much less the cost would be at its lowest, were it a parabola: by the unknowns, and by the states alone."""
    p, normal = len(at.theta), _normal(at, prior, links)
    reduced, back, _ = normal.reduced()
    slope = reduced[:, p]
    by_states = (normal.slopes * back[:, :, p]).sum()
    by_unknowns = slope @ _solved(reduced[:, :p], slope[:, None])[:, 0]
    return 0.5 * float(by_unknowns), 0.5 * float(by_states)


def _added(states: list[np.ndarray], moves: list[np.ndarray]) -> list[np.ndarray]:
    return [a + b for a, b in zip(states, moves, strict=True)]


def _led(at: _At, prior: Prior, links: Links) -> list[np.ndarray]:
    """Changes of the states of every block alone, the unknowns as they are."""
    p = len(at.theta)
    _, back, _ = _normal(at, prior, links).reduced()
    return np.split(-back[:, :, p], np.cumsum([len(x) for x in at.states])[:-1])


def _solved(matrix: Float[np.ndarray, "n n"], right: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
    """Of a positive matrix whose rows differ by orders of magnitude."""
    scale, scaled = _unit(matrix)
    whole = scaled + RIDGE * np.eye(len(scaled))
    return np.linalg.solve(whole, right / scale[:, None]) / scale[:, None]


def _unit(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    scale = np.sqrt(np.diag(matrix))
    return scale, matrix / scale[:, None] / scale


def _covariance(at: _At, prior: Prior, reduced: np.ndarray, back: np.ndarray) -> Float[np.ndarray, "p p"]:
    """The inverse of the cost's second derivatives, its deviations no less than those that windows tell.

    Source: H. White, Econometrica 50 (1982).
    """
    p = len(reduced)
    try:
        np.linalg.cholesky(_unit(reduced)[1] + RIDGE * np.eye(p))
    except np.linalg.LinAlgError:
        # rounding is all that is left where states do what a parameter does: no more is known than beforehand
        return np.diag(prior.deviation**2)
    found = _solved(reduced, np.eye(p))
    if at.squares < MORE * max(at.equations, 1) or len(back) < 2:
        return found
    # windows that lead to one another share what is left of either
    each = at.gram[:, :p, -1] - np.einsum("wnp,wn->wp", back[:, :, :p], at.gram[:, p:-1, -1])
    moves = (each - each.mean(axis=0)) @ found
    told = (moves**2).sum(axis=0) * len(moves) / (len(moves) - 1)
    own = np.diag(found)
    larger = np.sqrt(np.maximum(np.divide(told, own, out=np.ones_like(own), where=own > 0), 1.0))
    return found * larger * larger[:, None]


def _concluded(at: _At, prior: Prior, links: Links, steps: int, settled: bool) -> Fit:
    p = len(at.theta)
    if not np.isfinite(at.cost):
        nothing = np.full((p, p), np.nan)
        return Fit(at.theta, tuple(at.states), np.inf, 1, nothing, -np.inf, steps, False)
    normal = _normal(at, prior, links)
    reduced, back, determinant = normal.reduced()
    scale, scaled = _unit(reduced[:, :p])
    determinant += 2 * float(np.log(scale).sum()) + float(np.linalg.slogdet(scaled)[1])
    free = np.setdiff1d(np.arange(len(back)), links.after)
    determinant += 2 * float(np.log(prior.deviation).sum() + np.log(at.spread[free]).sum())
    if len(links.after):
        determinant += 2 * float(len(links.after) * np.log(prior.jump).sum())
    evidence = -at.cost - 0.5 * determinant
    return Fit(
        theta=at.theta,
        states=tuple(at.states),
        squares=at.squares,
        equations=at.equations,
        covariance=_covariance(at, prior, reduced[:, :p], back),
        evidence=evidence if np.isfinite(evidence) else -np.inf,
        steps=steps,
        settled=settled,
    )
