"""Is what a linear model leaves of records noise? Tests for laws of the motion, lone frequencies and power.

The shapes that an effect's force may have are evaluated on the refitted model's own motion, not on the measured one, so
that noise does not find itself. Whatever the level of the noise, and any colour that is the same throughout, an F test
says whether they explain more of what is left than chance does. Noise of measured inputs is noise too.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import betainc, gammaincc
from jaxtyping import Float
from scipy.stats import norm

from jaxsid.gap.balance import balance_of
from jaxsid.gap.evidence import Force
from jaxsid.gap.f_test import f_test
from jaxsid.gap.innovations import coherence, innovations, unsteadiness
from jaxsid.gap.input_noise import CERTAIN, LARGEST, InputNoise, input_noise, made, refitted, whitening
from jaxsid.gap.lone_frequency import lone_frequency
from jaxsid.gap.noise import BANDS
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
UNTOLD = 1e-6  # of an element's variance beforehand: less than that tells nothing of it
CARRIED = 0.1  # of what noise of inputs leaves: tests may take it for a law, whose motion has it too
HEARD = 30.0  # power of an input next to that of its noise from which on it is well above it
MARGIN = 1.5  # times what it does on others that a law's share must be to be asked of those too


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
        input_noise: of each measured input, rms next to its own, where sensors certainly have that in common; else 0.
    """

    p_value: float
    share: float
    tests: tuple[Test, ...]
    input_noise: tuple[float, ...]

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
    noise, own = _own(fit, leveled)
    carried = CARRIED * max((_mean(left_shares(fit) * x.share) for x in noise), default=0.0)
    sought = [*_laws(fit, leveled, tuple(places), noise), *_steady(fit, leveled)]
    tests = [_beyond(x, carried) for x in sought]
    tests.append(_lone_line(fit, leveled, noise))
    tests += [] if deflated else own
    if all(n.degrees > 0 for n in fit.noises):
        tests.append(_power(fit))
    worst = min(tests, key=lambda t: t.p_value)
    share = max(t.share for t in tests if t is worst or t.p_value * len(tests) < SIGNIFICANT)
    told = [x.relative for x in noise if x.seen > CERTAIN] or [np.zeros(len(fit.model.inputs))]
    relative = tuple(np.max(told, axis=0).tolist())
    return Null(min(1.0, worst.p_value * len(tests)), share, tuple(tests), relative)


def told_at(null: Null, places: Sequence[Place]) -> tuple[Place, ...]:
    """Places at which a law was found.

    Args:
        null: tests.
        places: that these were asked of.
    """
    return tuple(
        p for p, t in zip(places, null.tests, strict=False) if t.p_value * len(null.tests) < SIGNIFICANT
    )


def _beyond(test: Test, carried: float) -> Test:
    """What a test finds beyond what noise of the inputs may give it: as good as chance where that is all."""
    if 0 < test.share <= carried:
        return test._replace(p_value=1.0, share=0.0)
    return test._replace(share=float(np.sqrt(test.share**2 - min(carried, test.share) ** 2)))


def tolerance_tests(within: Recalibrated, freely: Recalibrated) -> tuple[float, float]:
    """Probabilities, by chance, of elements as far from their nominal values as the records ask for: all, and any one.

    Twice the logarithm of the ratio of likelihoods is a sum of squares of normal variables, of which those count that
    the records tell of: where few modes are excited they are fewer than the elements. One that is far off among many
    is little of that sum: see `farthest_test`.

    Args:
        within: refitted with the model's tolerance as prior.
        freely: refitted with a wide one, to the same noise.
    """
    drawn = float(((within.change / within.prior) ** 2).sum())
    ratio = max(within.squares + drawn - freely.squares, 0.0)
    information = np.sum([np.asarray(x.gram)[:-1, :-1] for x in within.linear], axis=0)
    scale, degrees = ratio_law(information, within.prior, freely.prior)
    together = float(gammaincc(degrees / 2, ratio / scale / 2))
    return together, farthest_test(within.change, information, within.prior)


def farthest_test(
    change: Float[np.ndarray, " e"], information: Float[np.ndarray, "e e"], near: Float[np.ndarray, " e"]
) -> float:
    """Probability, by chance, that any element is found so many of its deviations from its nominal value.

    Of changes that are drawn from N(0, P) and told by their information H, the posterior means have the covariance
    P - (H + 1 / P)^-1. The largest of e is as Sidak has it, or less probable where they are found together.

    Args:
        change: the posterior means.
        information: of the records about them, J' J.
        near: standard deviations beforehand, the root of P.

    Source: Z. Sidak, J. Am. Stat. Assoc. 62 (1967).
    """
    told = 1 - np.diag(np.linalg.inv(near[:, None] * information * near + np.eye(len(near))))
    far = np.abs(change / near) / np.sqrt(np.maximum(told, UNTOLD))
    return float(1 - (1 - 2 * norm.sf(far.max())) ** len(far))


def ratio_law(
    information: Float[np.ndarray, "e e"], near: Float[np.ndarray, " e"], far: Float[np.ndarray, " e"]
) -> tuple[float, float]:
    """Scale and degrees of the chi-squared law that has the mean and variance of the ratio where elements are near.

    With changes x ~ N(0, P), of information H about them, all in units of the root of P, and the wide prior 1 / D, the
    ratio is b' M b with M = 2 G - G H G - (1 + H)^-1, G = (H + D)^-1, and b of covariance C = H + H H. Its mean is
    tr(M C) and its variance 2 tr(M C M C), where M C = 1 - (G D) (G D) (1 + H).

    Args:
        information: of the records about the changes, J' J.
        near: standard deviations of the changes, the root of P.
        far: those of the wide prior, the root of W.

    Source: F. Satterthwaite, Biometrics Bulletin 2 (1946).
    """
    H, D = near[:, None] * information * near, np.diag((near / far) ** 2)
    kept = np.linalg.solve(H + D, D)
    product = np.eye(len(near)) - kept @ kept @ (np.eye(len(near)) + H)
    mean, variance = float(np.trace(product)), 2 * float(np.trace(product @ product))
    if mean <= 0 or variance <= 0:
        return 1.0, 1.0
    return variance / mean / 2, 2 * mean**2 / variance


def _laws(
    fit: Recalibrated, settings: tuple[Setting, ...], places: tuple[Place, ...], noise: tuple[InputNoise, ...]
) -> list[Test]:
    """An F test for the shapes of each place.

    On all lines where it finds more than noise of the inputs would do on those where they are hardly above it: what is
    in a record alone never moved the bodies, which a law of its shapes may seem to say. Else on the others.
    """
    power = [_input_power(s, of) for s, of in zip(settings, noise or [None] * len(settings), strict=True)]
    heard = [_heard(s, p) for s, p in zip(settings, power, strict=True)]
    gram, told = _grams(fit, settings, places, noise), float(np.mean(np.concatenate(heard)))
    every = [_shapes_test(f"law at {p.label}", g, fit) for p, g in zip(places, gram, strict=True)]
    if told == 1:
        return every
    loud = [
        eqx.tree_at(lambda s: s.scale, s, s.scale * h[:, None]) for s, h in zip(settings, heard, strict=True)
    ]
    gram, part = _grams(fit, tuple(loud), places, noise), fit._replace(equations=int(fit.equations * told))
    again = [_shapes_test(x.name, g, part) for x, g in zip(every, gram, strict=True)]
    most = MARGIN * _unheard_share(fit, settings, power, heard)
    return [a if a.share > most else b for a, b in zip(every, again, strict=True)]


def _input_power(setting: Setting, noise: InputNoise | None) -> Float[np.ndarray, "lines inputs"]:
    """Of the noise of inputs: found in what sensors have in common, else as much as each input's quietest band allows.

    Beside loud sensors their products do not show it, but sums over lines where an input is nothing else do.
    """
    if noise is not None and noise.power.any():
        return noise.power
    power = np.abs(np.asarray(setting.spectra.u)) ** 2
    quiet = np.min([x.mean(axis=0) for x in np.array_split(power[1:], BANDS)], axis=0)
    return np.broadcast_to(np.minimum(quiet, LARGEST**2 * power.mean(axis=0)), power.shape)


def _heard(setting: Setting, power: Float[np.ndarray, "lines inputs"]) -> Float[np.ndarray, " lines"]:
    """1 where some input is well above its noise, else 0."""
    u = jnp.asarray(setting.spectra.u)
    level = np.asarray(line_level(u, jnp.ones(u.shape))) ** 2
    return np.asarray((level > HEARD * power).any(axis=1) * 1.0)


def _unheard_share(
    fit: Recalibrated, settings: Sequence[Setting], power: Sequence[np.ndarray], heard: Sequence[np.ndarray]
) -> float:
    """What noise of the inputs does on lines where they are hardly above it, in the measure of tests of laws."""
    done, size = 0.0, 0.0
    for setting, linear, p, h in zip(settings, fit.linear, power, heard, strict=True):
        scale = np.asarray(setting.scale)
        every = made(np.asarray(setting.spectra.driven) * scale[:, :, None], p)
        done += float(((1 - h)[:, None] * every).sum())
        size += float((np.abs(np.asarray(linear.left) * scale) ** 2).sum())
    return np.sqrt(done / max(size, np.finfo(float).tiny)) * left_share(fit)


def _grams(
    fit: Recalibrated, settings: tuple[Setting, ...], places: tuple[Place, ...], noise: tuple[InputNoise, ...]
) -> np.ndarray:
    """Products of elements, shapes and what is left, (places, k, k), of all records."""
    ports, count = ports_of(fit.model, places), len(places)
    spread = lambda m: jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), m)  # noqa: E731
    motions: list[Motion] = [spread(x.motion) for x in fit.linear]
    size = together([extents(s, ports, m) for s, m in zip(fit.settings, motions, strict=True)])
    none = Force(jnp.zeros((count, 1)), jnp.ones((count, 1)))
    white = [jnp.asarray(whitening(*x)) for x in zip(settings, noise, strict=True)] if noise else None
    parts = [
        tables(s, ports, Guess(m, size), none, None if white is None else white[i])
        for i, (s, m) in enumerate(zip(settings, motions, strict=True))
    ]
    return np.asarray(np.sum([np.asarray(x.gram)[:, 0] for x in parts], axis=0))


def _shapes_test(name: str, gram: np.ndarray, fit: Recalibrated) -> Test:
    """Of one place, elements out of the way first."""
    elements = len(fit.change)
    nuisances = elements + sum(len(s.transient) for s in fit.settings)
    found = f_test(gram, elements, fit.equations - nuisances)
    return Test(name, found.p_value, np.sqrt(found.part) * left_share(fit))


def _steady(fit: Recalibrated, settings: tuple[Setting, ...]) -> list[Test]:
    """F tests for steady forces on free bodies and for offsets of sensors beside them, where there are such."""
    rest = max(fit.equations - len(fit.change) - sum(len(s.transient) for s in settings), 1)
    names = "steady force on free bodies", "offset of sensors beside free bodies"
    return [
        Test(name, float(betainc(rest / 2, x.count / 2, rest / (rest + x.count * x.statistic))), x.share)
        for name, x in zip(names, balance_of(fit, settings) or (), strict=False)
        if x.count
    ]


def _own(fit: Recalibrated, settings: tuple[Setting, ...]) -> tuple[tuple[InputNoise, ...], list[Test]]:
    """Noise of the inputs, where sensors have it in common; whether the rest is each sensor's own, and steady."""
    linear = fit.linear
    noise = tuple(input_noise(s, x) for s, x in zip(settings, linear, strict=True))
    if any(x.power.any() for x in noise) and all(x.plausible for x in noise):
        linear = refitted(settings, linear, noise)
        noise = tuple(input_noise(*x) for x in zip(settings, linear, noise, strict=True))
        white = [innovations(*x) for x in zip(settings, linear, noise, strict=True)]
    else:
        noise, white = (), [innovations(s, x) for s, x in zip(settings, linear, strict=True)]
    left, found = left_shares(fit), {CHANGE: unsteadiness(white)}
    if any(e.any(axis=0).sum() > 1 for e in white):
        found[COMMON] = coherence(white)
    share = lambda x: float(np.sqrt(x.part) * np.prod(left[list(x.sensors)]) ** (1 / max(len(x.sensors), 1)))  # noqa: E731
    return noise, [Test(name, x.p_value, share(x)) for name, x in found.items()]


def _leveled(setting: Setting, linear: Linear) -> Setting:
    """The setting with the noise's level taken from what is left around each line, whatever a filter makes of it.

    An offset is in one line alone, and would there be taken for the level.
    """
    white = linear.left * setting.scale
    level = line_level(white, ((setting.scale > 0) * 1.0).at[0].set(0.0))
    return eqx.tree_at(lambda s: s.scale, setting, setting.scale / level)


def left_share(fit: Recalibrated) -> float:
    """Rms of what is left next to that of the response, the mean over all sensors.

    Args:
        fit: the model and what it leaves.
    """
    return _mean(left_shares(fit))


def found_part(null: Null, fit: Recalibrated) -> float:
    """Part of what is left, in power, that tests find.

    Args:
        null: the tests.
        fit: the model and what it leaves.
    """
    return (null.share / max(left_share(fit), np.finfo(float).tiny)) ** 2


def left_shares(fit: Recalibrated) -> Float[np.ndarray, " outputs"]:
    """Likewise of each sensor; NaN for those that no record has.

    Args:
        fit: the model and what it leaves.
    """
    # a line on a pole of the model, as that of zero where bodies are free, tells nothing of what it misses
    each = [np.asarray(s.spectra.weight) for s in fit.settings]
    left = np.sum(
        [w @ np.abs(np.asarray(x.left)) ** 2 for w, x in zip(each, fit.linear, strict=True)], axis=0
    )
    size = np.sum(
        [w @ np.abs(np.asarray(s.spectra.y)) ** 2 for w, s in zip(each, fit.settings, strict=True)], axis=0
    )
    return np.sqrt(np.divide(left, size, out=np.full(len(size), np.nan), where=size > 0))


def _mean(shares: np.ndarray) -> float:
    known = shares[np.isfinite(shares)]
    return float(np.sqrt((known**2).mean())) if len(known) else 0.0


def _lone_line(fit: Recalibrated, leveled: tuple[Setting, ...], noise: tuple[InputNoise, ...]) -> Test:
    """Whether one frequency stands out from noise of the inputs, too, that has the model's resonances."""
    beyond = (
        [_beyond_inputs(*x) for x in zip(leveled, noise, strict=True)] if noise else [1.0] * len(fit.settings)
    )
    p, part = lone_frequency(fit.settings, [np.asarray(x.left) for x in fit.linear], beyond)
    return Test("lone frequency", p, float(np.sqrt(part) * left_share(fit)))


def _beyond_inputs(setting: Setting, noise: InputNoise) -> Float[np.ndarray, "lines outputs"]:
    """Rms of all noise next to that of each sensor's own."""
    driven = np.asarray(setting.spectra.driven) * np.asarray(setting.scale)[:, :, None]
    return np.sqrt(1 + made(driven, noise.power) / noise.own)


def _power(fit: Recalibrated) -> Test:
    """Whether more is left than the noise that was measured apart."""
    degrees = sum(n.degrees for n in fit.noises)
    nuisances = len(fit.change) + sum(len(s.transient) for s in fit.settings)
    equations = max(fit.equations - nuisances, 1)
    ratio = fit.squares / equations
    p = float(betainc(degrees / 2, equations / 2, degrees / (degrees + equations * ratio)))
    share = np.sqrt(max(1 - 1 / max(ratio, 1e-300), 0.0)) * left_share(fit)
    return Test("power beyond the noise", p, share)
