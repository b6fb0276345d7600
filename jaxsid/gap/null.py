"""Is what a linear model leaves of records noise? Tests for laws of the motion, lone frequencies and power.

The shapes that an effect's force may have are evaluated on the refitted model's own motion, not on the measured one, so
that noise does not find itself. Whatever the level of the noise, and any colour that is the same throughout, an F test
says whether they explain more of what is left than chance does.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import betainc, gammaincc

from jaxsid.gap.balance import balance_of
from jaxsid.gap.evidence import Force
from jaxsid.gap.innovations import coherence, innovations, unsteadiness
from jaxsid.gap.places import Place
from jaxsid.gap.ports import Guess, extents, ports_of, tables
from jaxsid.gap.recalibrate import Linear, Recalibrated
from jaxsid.gap.scoring import together
from jaxsid.gap.setting import Setting
from jaxsid.gap.spectra import Motion
from jaxsid.impulse.lines import line_level

SIGNIFICANT = 0.005  # probability by chance from which on nothing is claimed: of two questions, 1 % together
DOUBT = 0.05  # likewise, from which on nothing speaks for it either
COMMON, CHANGE = "common to sensors", "change with time"
GUARD, AROUND = 4, 18  # lines from a lone one that it is compared with, from and to
LEAST = 1e-12  # of a line's power, that those around it have: rounding
DEPENDENT = 1e-7  # eigenvalue of columns of unit size below which a combination of them is nothing


class Test(NamedTuple):
    """One test.

    Attributes:
        name: what it looks for.
        p_value: probability of as much by chance.
        share: rms of what it found next to that of the response.
    """

    name: str
    p_value: float
    share: float


class Null(NamedTuple):
    """Whether records agree with a model within noise.

    Attributes:
        p_value: of all tests together, by Holm's rule.
        share: rms of the most that any test found for certain, next to that of the response.
        tests: each alone.
    """

    p_value: float
    share: float
    tests: tuple[Test, ...]

    @property
    def own(self) -> bool:
        """Whether nothing speaks against noise of each sensor's own, where there are several, the same throughout."""
        p = {t.name: t.p_value for t in self.tests}
        return p.get(COMMON, 0.0) > DOUBT and p.get(CHANGE, 0.0) > DOUBT


def null_test(fit: Recalibrated, places: Sequence[Place], *, deflated: bool = False) -> Null:
    """Whether a refitted model leaves noise alone.

    Args:
        fit: the model and what it leaves.
        places: where effects are looked for.
        deflated: whether effects were taken out of the records: what their numbers miss is neither each sensor's own
            nor the same throughout, so that neither is asked.

    Source: S. Holm, Scand. J. Statistics 6 (1979).
    """
    leveled = tuple(_leveled(s, x) for s, x in zip(fit.settings, fit.linear, strict=True))
    tests = [*_laws(fit, leveled, tuple(places)), _lone_line(fit), *_steady(fit, leveled)]
    tests += [] if deflated else _own(fit, leveled)
    if all(n.degrees > 0 for n in fit.noises):
        tests.append(_power(fit))
    worst = min(tests, key=lambda t: t.p_value)
    share = max(t.share for t in tests if t is worst or t.p_value * len(tests) < SIGNIFICANT)
    return Null(min(1.0, worst.p_value * len(tests)), share, tuple(tests))


def tolerance_test(within: Recalibrated, freely: Recalibrated) -> float:
    """Probability, by chance, of elements as far from their nominal values as the records ask for.

    Twice the logarithm of the ratio of likelihoods follows a chi-squared law with a degree for each element.

    Args:
        within: refitted with the model's tolerance as prior.
        freely: refitted without, to the same noise.
    """
    drawn = float(((within.change / within.prior) ** 2).sum())
    ratio = max(within.squares + drawn - freely.squares, 0.0)
    return float(gammaincc(len(within.change) / 2, ratio / 2))


def _laws(fit: Recalibrated, settings: tuple[Setting, ...], places: tuple[Place, ...]) -> list[Test]:
    """An F test for the shapes of each place."""
    ports, count = ports_of(fit.model, places), len(places)
    spread = lambda m: jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), m)  # noqa: E731
    motions: list[Motion] = [spread(x.motion) for x in fit.linear]
    sizes = [extents(s, ports, m) for s, m in zip(fit.settings, motions, strict=True)]
    size = together(sizes)
    none = Force(jnp.zeros((count, 1)), jnp.ones((count, 1)))
    parts = [tables(s, ports, Guess(m, size), none) for s, m in zip(settings, motions, strict=True)]
    gram = np.sum([np.asarray(x.gram)[:, 0] for x in parts], axis=0)
    elements = len(fit.change)
    nuisances = elements + sum(len(s.transient) for s in fit.settings)
    return [
        _shapes_test(f"law at {p.label}", g, elements, nuisances, fit)
        for p, g in zip(places, gram, strict=True)
    ]


def _shapes_test(name: str, gram: np.ndarray, elements: int, nuisances: int, fit: Recalibrated) -> Test:
    """Of one place, elements out of the way first."""
    norm = np.sqrt(np.diag(gram))
    gram = gram / np.where(norm > 0, norm, 1.0) / np.where(norm > 0, norm, 1.0)[:, None]
    e = elements
    own = gram[:e, :e] + 1e-10 * np.eye(e)
    gram = gram[e:, e:] - gram[e:, :e] @ np.linalg.solve(own, gram[:e, e:])
    values, vectors = np.linalg.eigh(gram[:-1, :-1])
    seen = values > DEPENDENT
    explained = float(((vectors[:, seen].T @ gram[:-1, -1]) ** 2 / values[seen]).sum())
    rank, total = int(seen.sum()), float(gram[-1, -1])
    if rank == 0 or total <= 0:
        return Test(name, 1.0, 0.0)
    rest = max(fit.equations - nuisances - rank, 1)
    ratio = (explained / rank) / (max(total - explained, 1e-300) / rest)
    p = float(betainc(rest / 2, rank / 2, rest / (rest + rank * ratio)))
    excess = max(explained - (total - explained) * rank / rest, 0.0) / total
    return Test(name, p, np.sqrt(excess) * left_share(fit))


def _steady(fit: Recalibrated, settings: tuple[Setting, ...]) -> list[Test]:
    """F tests for steady forces on free bodies and for offsets of sensors beside them, where there are such."""
    rest = max(fit.equations - len(fit.change) - sum(len(s.transient) for s in settings), 1)
    names = "steady force on free bodies", "offset of sensors beside free bodies"
    return [
        Test(name, float(betainc(rest / 2, x.count / 2, rest / (rest + x.count * x.statistic))), x.share)
        for name, x in zip(names, balance_of(fit, settings) or (), strict=False)
        if x.count
    ]


def _own(fit: Recalibrated, settings: tuple[Setting, ...]) -> list[Test]:
    """Whether what is left is each sensor's own, where there are several, and the same throughout."""
    white = [innovations(s, x) for s, x in zip(settings, fit.linear, strict=True)]
    found = [(COMMON, coherence(white))] if any(e.shape[1] > 1 for e in white) else []
    found.append((CHANGE, unsteadiness(white)))
    return [Test(name, p, float(np.sqrt(part)) * left_share(fit)) for name, (p, part) in found]


def _leveled(setting: Setting, linear: Linear) -> Setting:
    """The setting with the noise's level taken from what is left around each line, whatever a filter makes of it."""
    white = linear.left * setting.scale
    level = line_level(white, (setting.scale > 0) * 1.0)
    return eqx.tree_at(lambda s: s.scale, setting, setting.scale / level)


def left_share(fit: Recalibrated) -> float:
    """Rms of what is left next to that of the response, the mean over all sensors.

    Args:
        fit: the model and what it leaves.
    """
    left = sum((np.abs(np.asarray(x.left)) ** 2).sum(axis=0) for x in fit.linear)
    size = sum((np.abs(np.asarray(s.spectra.y)) ** 2).sum(axis=0) for s in fit.settings)
    present = np.asarray(size) > 0
    return float(np.sqrt((np.asarray(left)[present] / np.asarray(size)[present]).mean()))


def _lone_line(fit: Recalibrated) -> Test:
    """Whether one frequency holds more, next to those around it, than chance gives to any: an F test of 2 degrees.

    Lines are those of Hann's window, so that a frequency between two of them has no skirts; of those around it the
    nearest are left out, and of the others every second, which share nothing. It must stand out from either side.
    """
    apart = np.arange(-AROUND, AROUND + 1)
    below = ((apart >= GUARD) & (apart % 2 == GUARD % 2)).astype(float)
    every = []
    for setting, linear in zip(fit.settings, fit.linear, strict=True):
        used = np.asarray(setting.spectra.weight) == 1
        left = np.asarray(linear.left)[used][:, np.asarray(setting.spectra.present) > 0]
        lines = left * np.asarray(setting.scale)[used][:, np.asarray(setting.spectra.present) > 0]
        power = np.abs(lines[1:-1] - (lines[:-2] + lines[2:]) / 2) ** 2
        # the noise may have taken a lone frequency for its colour, but the part of it that is left is what it is
        whole = np.maximum((np.abs(left) ** 2).sum(axis=0), np.finfo(float).tiny)
        part = _sums(np.abs(left[1:-1]) ** 2, np.ones(2 * GUARD - 1)) / whole
        sides = [_sums(x, side) for side in (below, below[::-1]) for x in (power, np.ones_like(power))]
        every.append(np.stack([power, part, *sides]).reshape(6, -1))
    power, part, *sides = np.concatenate(every, axis=1)
    # on either side: the edge of what is strong at low frequencies is no lone one
    pairs = ((np.where(n > 0, np.maximum(x, LEAST * power), np.inf), n) for x, n in (sides[:2], sides[2:]))
    alone = np.maximum(*((1 + power / np.maximum(x, np.finfo(float).tiny)) ** -n for x, n in pairs))
    p = float(-np.expm1(len(alone) * np.log1p(-min(alone.min(), 0.5))))
    share = np.sqrt(part[alone.argmin()]) * left_share(fit)
    return Test("lone frequency", p, float(share))


def _sums(x: np.ndarray, around: np.ndarray) -> np.ndarray:
    """Of every column, about each row, as far as there are rows."""
    half = len(around) // 2
    return np.stack([np.convolve(c, around)[half : half + len(c)] for c in x.T], axis=1)


def _power(fit: Recalibrated) -> Test:
    """Whether more is left than the noise that was measured apart."""
    degrees = sum(n.degrees for n in fit.noises)
    nuisances = len(fit.change) + sum(len(s.transient) for s in fit.settings)
    equations = max(fit.equations - nuisances, 1)
    ratio = fit.squares / equations
    p = float(betainc(degrees / 2, equations / 2, degrees / (degrees + equations * ratio)))
    share = np.sqrt(max(1 - 1 / max(ratio, 1e-300), 0.0)) * left_share(fit)
    return Test("power beyond the noise", p, share)
