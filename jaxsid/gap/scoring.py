"""Evidence of every place: a force there that is smooth in time, then one that is also a law of what moves there.

Shapes are evaluated on the motion that the place's own hypothesis implies, measured forces and errors of the linear
parameters included, so that at the right place they act on the true motion.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxsid.gap.apart import Hypotheses
from jaxsid.gap.evidence import Force, evidence
from jaxsid.gap.places import Place
from jaxsid.gap.ports import Chosen, Explained, Guess, Ports, explained, extents, ports_of, tables
from jaxsid.gap.setting import Setting
from jaxsid.gap.signals import LINEAR, MOST, Extent
from jaxsid.gap.spectra import Motion, motion_under
from jaxsid.mechanics.lumped import LumpedModel

STEP = (
    4.0  # from one rate of the processes to the next, from the slowest vibration up to half the sampling rate
)
MOST_RATES = 7
SIZES = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)  # next to a least-squares force
REMAINDERS = (1e-4, 1e-3, 0.01, 0.03, 0.1, 0.3, 1.0)  # what shapes leave of a force, next to its rms
SLABS = (1.0, 10.0)  # coefficients of shapes, next to the force's rms
ROUNDS = 2  # of evaluating shapes on the motion that the last round found


class Scores(NamedTuple):
    """Of every place.

    Attributes:
        process: (places,) logarithm of the evidence of a process alone.
        shaped: (places,) of shapes with a process for what they leave.
        linear: (places,) of delays and lags alone, where the place is a signal.
        process_force: (places,) the process that explains most.
        explained: for each record what the shapes make of it, a row a place.
        tried: the hypotheses behind it.
    """

    process: np.ndarray
    shaped: np.ndarray
    linear: np.ndarray
    process_force: Force
    explained: tuple[Explained, ...]
    tried: Hypotheses

    @property
    def best(self) -> np.ndarray:
        return np.maximum(self.process, self.shaped)


class _Round(NamedTuple):
    """Evidence (places, variants), what was chosen, what it makes of each record."""

    value: np.ndarray
    force: Force
    explained: tuple[Explained, ...]
    tried: Hypotheses


def scores(
    model: LumpedModel, settings: Sequence[Setting], places: tuple[Place, ...], tolerance: np.ndarray
) -> Scores:
    """Evidence of every place, all records together.

    Args:
        model: nominal.
        settings: of each record.
        places: in the order of the result.
        tolerance: (e,) relative standard deviations of the model's elements.
    """
    ports, count = ports_of(model, places), len(places)
    motions = [_spread(_nominal_motion(s), count) for s in settings]
    scale = np.max([_force_scale(s, ports) for s in settings], axis=0)
    rates = _rates(settings)
    alone = np.tile(tolerance, (count, 1, 1))
    first = _round(settings, ports, motions, _grid(scale, SIZES, rates), alone)
    latest = first
    for _ in range(ROUNDS):
        size = _rms_force(settings, latest.explained)
        force = _grid(size, REMAINDERS, rates)
        motions = [x.motion for x in latest.explained]
        latest = _round(settings, ports, motions, force, _shape_priors(tolerance, size))
    shaped, linear = latest.value[:, : len(SLABS)].max(axis=1), latest.value[:, len(SLABS)]
    return Scores(first.value[:, 0], shaped, linear, first.force, latest.explained, latest.tried)


def _nominal_motion(given: Setting) -> Motion:
    spectra = given.spectra
    none = jnp.zeros((len(spectra.omega), len(spectra.inverse_mass)), spectra.y.dtype)
    return motion_under(spectra, none, jnp.zeros_like(given.transient))


def _spread(motion: Motion, count: int) -> Motion:
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), motion)


def _round(
    settings: Sequence[Setting], ports: Ports, motions: list[Motion], force: Force, priors: np.ndarray
) -> _Round:
    """All hypotheses of every place on given motions, and the best one of each; with one variant, without shapes."""
    size = None
    if priors.shape[1] > 1:
        size = together([extents(s, ports, m) for s, m in zip(settings, motions, strict=True)])
    guesses = [Guess(m, size) for m in motions]
    parts = [tables(s, ports, g, force) for s, g in zip(settings, guesses, strict=True)]
    found = evidence(jax.tree.map(lambda *x: sum(x[1:], start=x[0]), *parts), priors)
    # the last variant is there to be compared, not to be chosen
    variants = found.value[:, : len(SLABS)]
    at, width = variants.reshape(len(variants), -1).argmax(axis=1), variants.shape[2]
    rows = np.arange(len(variants))
    process = Force(*(x[rows, at % width] for x in force))
    chosen = Chosen(process, jnp.asarray(found.coefficients[rows, at // width, at % width]))
    made = tuple(explained(s, ports, g, chosen) for s, g in zip(settings, guesses, strict=True))
    return _Round(found.value.max(axis=2), process, made, Hypotheses(ports, tuple(guesses), force, priors))


def together(sizes: list[Extent]) -> Extent:
    """Extents over all records.

    Args:
        sizes: of each.
    """
    most = jnp.stack([x.most for x in sizes]).max(axis=0)
    return Extent(most, jnp.sqrt((jnp.stack([x.rms for x in sizes]) ** 2).mean(axis=0)))


def _rates(settings: Sequence[Setting]) -> np.ndarray:
    """Of the processes, 1/s: what shapes leave may be as quick as the samples show, however slow the model."""
    slowest = float(settings[0].rate)
    quickest = max(np.pi / float(s.spectra.dt) for s in settings)
    count = int(np.log(max(quickest / slowest, 1.0)) / np.log(STEP)) + 1
    return slowest * STEP ** np.arange(min(count, MOST_RATES))


def _grid(scale: np.ndarray, sizes: Sequence[float], rates: np.ndarray) -> Force:
    size, speed = (x.ravel() for x in np.meshgrid(sizes, rates))
    return Force(jnp.asarray(scale[:, None] * size), jnp.broadcast_to(speed, (len(scale), len(speed))))


def _shape_priors(tolerance: np.ndarray, size: np.ndarray) -> np.ndarray:
    """(places, variants, e + k): all shapes with each slab, then delays and lags alone."""
    elements = len(tolerance)
    priors = np.zeros((len(size), len(SLABS) + 1, elements + MOST))
    priors[:, :, :elements] = tolerance
    for i, slab in enumerate(SLABS):
        priors[:, i, elements:] = slab * size[:, None]
    priors[:, -1, elements:][:, LINEAR] = SLABS[-1] * size[:, None]
    return priors


def _force_scale(given: Setting, ports: Ports) -> np.ndarray:
    """Rms of the force at each place that comes closest to what is left, frequency by frequency."""
    spectra, scale = given.spectra, np.asarray(given.scale)
    left, forced = np.asarray(spectra.y - spectra.response) * scale, np.asarray(spectra.forced)
    found = []
    for joint, sensor in zip(np.asarray(ports.joint), np.asarray(ports.sensor), strict=True):
        g = (forced @ joint + sensor) * scale
        square = (np.abs(g) ** 2).sum(axis=1)
        along = np.abs((g.conj() * left).sum(axis=1))
        found.append(np.sqrt((along**2).sum() / max((square**2).sum(), np.finfo(float).tiny)))
    return np.array(found)


def _rms_force(settings: Sequence[Setting], each: Sequence[Explained]) -> np.ndarray:
    samples = sum(s.spectra.samples for s in settings)
    power = sum(2 * (np.abs(np.asarray(x.force)) ** 2).sum(axis=1) for x in each)
    return np.sqrt(np.maximum(power / samples, np.finfo(float).tiny))
