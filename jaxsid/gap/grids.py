"""Which parameters of a kind of effect its columns are proportional to, and a grid of the others from their priors.

An effect is a sum over its linear parameters, E(l, s) = sum_i (l_i - n_i) c_i(s), n_i the values that change nothing:
these follow in closed form once its shape parameters s are given. Kinds without any are proportional to all of
their parameters together, or are scaled as they are.
"""

import math
from collections.abc import Callable, Mapping
from functools import cache
from itertools import product
from statistics import NormalDist
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxsid.mechanics.effects.catalogue import CATALOGUE
from jaxsid.mechanics.effects.kind import Changes, Kind, Motion, Nominal, Parameter
from jaxsid.mechanics.effects.prior import Amplitudes, Prior

COUNTS = {0: (), 1: (15,), 2: (15, 4), 3: (4, 3, 2)}  # points of each shape parameter, by how many there are
RESONANCES = (61, 4)  # of stiffness and damping of what is attached: 8 % in frequency, for sharp ones too
WAVES = (
    91,
)  # of the wavenumber of a wave along the way: 7 %, as an eighth of ten radians puts it out of step
WIDTHS = (0.02, 0.1)  # of the smoothed sign of dry friction, next to the rms velocity
LINEAR_CHANGES = ("mass", "damping", "stiffness", "gain", "offset")
SIGNALS = (
    -3,
    -2,
    -1,
)  # the changes of a signal that it is not proportional to, last of all: delay, lag, limit
LOOSE = 0.5  # deviation of the factor of a column that has no linear parameter


class Plan(NamedTuple):
    """How a kind's parameters enter, by their numbers.

    Attributes:
        linear: those that the effect is proportional to, each from its neutral value.
        whole: whether it is proportional to all other parameters but angles together, where none is linear.
        angle: of a sine that a linear parameter multiplies, or None.
        frequency: in Hz, or None.
        shape: all others.
    """

    linear: tuple[int, ...]
    whole: bool
    angle: int | None
    frequency: int | None
    shape: tuple[int, ...]

    @property
    def proportional(self) -> bool:
        """Whether the coefficients of columns may be anything; else the one that there is is about one."""
        return bool(self.linear) or self.whole


class Grid(NamedTuple):
    """Parameters at which a kind's columns are evaluated, at every place.

    Attributes:
        probes: (places, grid, columns, parameters + 1) the last the width of a smoothed sign.
        base: (places, grid, parameters) where the linear ones change nothing.
        step: (places, grid, columns) what a coefficient of one adds to a linear parameter; 1 without any.
        lowest, highest: (places, grid, columns) of the coefficients.
        spread: (columns,) their standard deviations.
    """

    probes: Float[np.ndarray, "places grid columns p1"]
    base: Float[np.ndarray, "places grid p"]
    step: Float[np.ndarray, "places grid columns"]
    lowest: Float[np.ndarray, "places grid columns"]
    highest: Float[np.ndarray, "places grid columns"]
    spread: Float[np.ndarray, " columns"]


@cache
def plan_of(name: str) -> Plan:
    """How the parameters of a kind enter, from its functions at a few numbers.

    Args:
        name: of the kind.
    """
    kind = CATALOGUE[name]
    count = len(kind.parameters)
    start = 1.1 + 0.3 * np.arange(count)
    eye = np.eye(count)
    plain, fixed = _seen(kind, start)
    linear: list[int] = []
    for i in range(count):
        steps = [_seen(kind, start + f * eye[i]) for f in (1.0, 2.0)]
        same = all(np.allclose(s[1], fixed) for s in steps)
        moved, twice = steps[0][0] - plain, steps[1][0] - plain
        crossed = all(
            np.allclose(_seen(kind, start + eye[i] + eye[j])[0] - _seen(kind, start + eye[j])[0], moved)
            for j in linear
        )
        if same and crossed and np.allclose(twice, 2 * moved) and not np.allclose(moved, 0):
            linear.append(i)
    # what is attached pulls in proportion to its mass, spring and damper together
    doubled = _seen(kind, 2 * start)
    alone = kind.changes is not None and not any((kind.force, kind.rate, kind.slip))
    attached = alone and np.allclose(doubled[1], 2 * fixed) and not np.any(fixed[list(SIGNALS)])
    whole = not linear and attached and np.allclose(doubled[0], 2 * plain)
    angles = [i for i, p in enumerate(kind.parameters) if p.prior.shape == "uniform" and p.unit[0] == "rad"]
    hertz = [i for i, p in enumerate(kind.parameters) if p.unit[0] == "Hz"]
    angle = angles[0] if angles and len(linear) == 1 else None
    held = {*linear, angle, *([0] if whole else [])}
    return Plan(
        tuple(linear),
        whole,
        angle,
        hertz[0] if hertz else None,
        tuple(i for i in range(count) if i not in held),
    )


def _seen(kind: Kind, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a kind does to numbers in place of a motion: what acts as it is, and what acts in a way of its own."""
    rng = np.random.default_rng(0)
    d, v, z, t = (jnp.asarray(3 * rng.standard_normal(30)) for _ in range(4))
    given = [jnp.asarray(x) for x in values]
    motion = Motion(d, v, z, jnp.abs(t), jnp.asarray(1.7))
    direct, own = [], []
    for hook, seen, into in (
        (kind.force, motion, direct),
        (kind.slip, jnp.abs(v), direct),
        (kind.rate, motion, own),
    ):
        if hook is not None:
            into.append(np.ravel(np.asarray(hook(seen, *given))))
    changes = Changes()
    if kind.changes is not None:
        changes = kind.changes(Nominal(jnp.asarray(1.3), jnp.asarray(0.7), jnp.asarray(2.1)), *given)
    for field, value in changes._asdict().items():
        (direct if field in LINEAR_CHANGES else own).append(np.ravel(np.asarray(value, float)))
    return np.concatenate(direct), np.concatenate(own)


def quantiles(prior: Prior, count: int) -> np.ndarray:
    """Ratios in the middle of parts of equal probability, ends a little further out.

    Args:
        prior: of the ratio.
        count: of them.
    """
    at = (np.arange(count) + 0.5) / count
    if prior.shape == "uniform":
        return prior.lowest + at * (prior.highest - prior.lowest)
    if prior.shape == "log-normal":
        # even steps: what lies between two points is as far from either
        ratios = prior.centre * prior.spread ** (np.linspace(-2, 2, count) if count > 1 else np.zeros(1))
        return np.maximum(ratios, prior.lowest)
    normal = NormalDist(prior.centre, prior.spread)
    low, high = normal.cdf(prior.lowest), normal.cdf(prior.highest)
    if prior.lowest == prior.centre and count > 4:
        return prior.centre + prior.spread * np.geomspace(0.02, 2.5, count)
    return np.array([normal.inv_cdf(low + x * (high - low)) for x in at])


def neutral(parameter: Parameter) -> tuple[float, bool]:
    """The value of a linear parameter that changes nothing, and whether it is a ratio to the scale.

    Args:
        parameter: of a kind.
    """
    if parameter.default is not None:
        return parameter.default, False
    return (parameter.prior.centre, True) if parameter.prior.shape == "normal" else (0.0, True)


def grid_of(name: str, at: Amplitudes, hertz: Float[np.ndarray, " f"]) -> Grid:
    """The grid of a kind at places that move so.

    Args:
        name: of the kind.
        at: of every place, each (places,).
        hertz: frequencies to try, for parameters in Hz.
    """
    kind, plan = CATALOGUE[name], plan_of(name)
    several = COUNTS.get(len(plan.shape), (3,) + (2,) * (len(plan.shape) - 1))
    counts = RESONANCES if plan.whole else several if plan.angle is None else WAVES
    axes = [
        hertz if i == plan.frequency else quantiles(kind.parameters[i].prior, count)
        for i, count in zip(plan.shape, counts, strict=True)
    ]
    widths = WIDTHS if kind.slip is not None else WIDTHS[:1]
    points = np.array([[*x, w] for *x, w in product(*axes, widths)])
    scale = np.array([np.asarray(p.scale.of(at)) * np.ones(len(at.rate)) for p in kind.parameters])
    scale = np.maximum(scale, np.finfo(float).tiny)
    base = np.zeros((scale.shape[1], len(points), len(kind.parameters)))
    # the scale may be raised to a power that is a parameter: those without come first
    order = sorted(range(len(kind.parameters)), key=lambda i: kind.parameters[i].raised is not None)
    for i in order:
        p = kind.parameters[i]
        power = base[..., _number(kind, p.raised)] if p.raised else 1.0
        if i in plan.shape:
            ratio, own = points[:, plan.shape.index(i)], i == plan.frequency
        elif i == plan.angle:
            ratio, own = 0.0, True
        else:
            value, is_ratio = neutral(p) if i in plan.linear else (p.prior.centre, True)
            ratio, own = value, not is_ratio
        base[..., i] = ratio * (1.0 if own else scale[i][:, None] ** power)
    widths = points[:, -1]
    if kind.vibrates is not None and plan.whole:
        k = _speeds(kind.vibrates, plan.shape, base[0, 0])
        rest = points[:, k] == points[0, k]  # all other numbers, once
        sharp = _swinging(kind.vibrates, plan.shape[k], base[:, rest], hertz)
        base = np.concatenate([base, sharp], axis=1)
        widths = np.concatenate([widths, np.tile(widths[rest], len(hertz))])
    return _grid(kind, plan, base, scale, widths)


def _speeds(vibrates: Callable[..., float], shape: tuple[int, ...], at: np.ndarray) -> int:
    """Which of the shape parameters most changes how fast the part swings."""
    once = math.log(vibrates(*at))
    return int(
        np.argmax(
            [abs(math.log(vibrates(*np.where(np.arange(len(at)) == i, 2 * at, at))) - once) for i in shape]
        )
    )


def _swinging(vibrates: Callable[..., float], i: int, base: np.ndarray, hertz: np.ndarray) -> np.ndarray:
    """Points whose part swings at given frequencies, by its i-th parameter: a sharp resonance lies between others."""
    swings = np.vectorize(vibrates)
    doubled = base.copy()
    doubled[..., i] *= 2
    own, faster = (swings(*np.moveaxis(x, -1, 0)) for x in (base, doubled))
    power = np.log2(faster / own)
    at = np.repeat(base[:, None], len(hertz), axis=1)
    at[..., i] *= (2 * np.pi * hertz[:, None] / own[:, None]) ** (1 / power[:, None])
    return at.reshape(len(base), -1, base.shape[-1])


def _number(kind: Kind, name: str) -> int:
    return [p.name for p in kind.parameters].index(name)


def _grid(kind: Kind, plan: Plan, base: np.ndarray, scale: np.ndarray, widths: np.ndarray) -> Grid:
    linear, turns = plan.linear, (0.0, np.pi / 2) if plan.angle is not None else (None,)
    columns = len(linear) * len(turns) if linear else 1
    places, points, count = base.shape
    probes = np.zeros((places, points, columns, count + 1))
    probes[..., :count] = base[:, :, None]
    probes[..., count] = widths[:, None]
    step = np.ones((places, points, columns))
    low, high = np.full_like(step, -np.inf), np.full_like(step, np.inf)
    spread = np.full(columns, LOOSE)
    for j, (i, turn) in enumerate(product(linear, turns)):
        p = kind.parameters[i]
        width = p.prior.spread * (p.prior.centre if p.prior.shape == "log-normal" else 1.0)
        step[..., j] = width * scale[i][:, None]
        probes[..., j, i] += step[..., j]
        spread[j] = 1.0
        if turn is None:
            least = np.maximum(
                p.lowest, p.prior.lowest * scale[i] if p.prior.shape == "normal" else -np.inf + 0 * scale[i]
            )
            low[..., j] = (least[:, None] - base[..., i]) / step[..., j]
            high[..., j] = (p.prior.highest * scale[i][:, None] - base[..., i]) / step[..., j]
        else:
            probes[..., j, plan.angle] = turn
    if not linear:
        spread[0] = kind.parameters[0].prior.spread if plan.whole else LOOSE
        low[:], high[:] = 0.0, np.inf if plan.whole else 3.0
    return Grid(probes, base, step, low, high, spread)


def parameters_of(
    name: str, grid: Grid, place: int, point: int, coefficients: Float[np.ndarray, " columns"]
) -> Mapping[str, float]:
    """Parameters of a point of the grid with the coefficients of its columns.

    Args:
        name: of the kind.
        grid: of the kind.
        place: number of the place.
        point: of the grid.
        coefficients: of the columns; 0 leaves a parameter as it is.
    """
    kind, plan = CATALOGUE[name], plan_of(name)
    values = grid.base[place, point].copy()
    if plan.angle is not None:
        size = coefficients * grid.step[place, point]
        values[plan.linear[0]] += float(np.hypot(*size))
        values[plan.angle] = float(np.arctan2(size[1], size[0]))
    elif plan.linear:
        values[list(plan.linear)] += coefficients * grid.step[place, point]
    elif plan.whole:
        values = values * coefficients[0]
    said = zip(kind.parameters, values, strict=True)
    # of two that do the same, the one that did nothing is left out
    given = {p.name: float(x) for p, x in said if p.default is None or x != p.default}
    return given or {kind.parameters[0].name: float(values[0])}
